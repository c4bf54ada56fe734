"""A random sensor of any kind, with errors of calibration, for training data and wild scenes."""

from dataclasses import replace

import numpy as np

from active6d_sim.rendering.active_stereo import ActiveStereo
from active6d_sim.rendering.depth_sensor import DepthSensor
from active6d_sim.rendering.structured_light import StructuredLight
from active6d_sim.rendering.time_of_flight import TimeOfFlight

_KINDS = (ActiveStereo, StructuredLight, TimeOfFlight)


def random_sensor(rng: np.random.Generator) -> DepthSensor:
    """Draw kind and parameters of a sensor; its depth is off by about 0.4 % and 1.5 mm."""
    sensor = _KINDS[int(rng.choice(len(_KINDS), p=(0.35, 0.4, 0.25)))].random(rng)
    return replace(sensor, scale_error=rng.normal(0.0, 0.004), offset_error=rng.normal(0.0, 0.0015))
