"""Random sensors of any kind, with errors of calibration, for training data and wild scenes."""

from dataclasses import replace

import numpy as np

from active6d_core.object_model import ObjectModel
from active6d_core.registry import AUTOMATIC
from active6d_sim.rendering.active_stereo import ActiveStereo
from active6d_sim.rendering.depth_sensor import DepthSensor
from active6d_sim.rendering.sensor_registry import Sensor, create_sensor
from active6d_sim.rendering.structured_light import StructuredLight
from active6d_sim.rendering.time_of_flight import TimeOfFlight
from active6d_sim.scenes.scene import Scene

_KINDS = (ActiveStereo, StructuredLight, TimeOfFlight)


def random_sensor(rng: np.random.Generator) -> DepthSensor:
    """Draw kind and parameters of a sensor; its depth is off by about 0.4 % and 1.5 mm."""
    sensor = _KINDS[int(rng.choice(len(_KINDS), p=(0.35, 0.4, 0.25)))].random(rng)
    return replace(sensor, scale_error=rng.normal(0.0, 0.004), offset_error=rng.normal(0.0, 0.0015))


def sensor_of(name: str, model: ObjectModel, scene: Scene, *seeds: int) -> Sensor:
    """The sensor that sees a scene.

    Args:
        name: of a sensor. ``auto`` is the default one, or for a wild scene a random one.
        model: the scene's object.
        scene: the scene; its seed decides what is random.
        seeds: what else does.

    Raises:
        ValueError: no such sensor; the message lists the known ones.
    """
    if name == AUTOMATIC and scene.surroundings is not None:
        return random_sensor(np.random.default_rng([scene.seed, *seeds, 11]))
    return create_sensor(name, model)
