"""The interface of simulated sensors, and their registry by name."""

from typing import Any, Protocol, Self

import numpy as np

from active6d_core.camera import PinholeCamera
from active6d_core.object_model import ObjectModel
from active6d_core.registry import Registry
from active6d_sim.rendering.renderer import RenderedView

#: The sensor that active6d was developed with.
DEFAULT_SENSOR = "active_stereo"


class Sensor(Protocol):
    """Turns a perfect view into a measured one."""

    def measure(
        self, rendered: RenderedView, camera: PinholeCamera, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """(H, W, 3) uint8 colour, and (H, W) float32 depth in metres with NaN for missing returns."""
        ...

    def scaled(self, factor: float) -> Self:
        """The sensor with ``factor`` times the noise; 0 is a perfect sensor."""
        ...


_registry = Registry(
    "sensor",
    lambda object_name: DEFAULT_SENSOR,
    {name: f"active6d_sim.rendering.{name}" for name in (DEFAULT_SENSOR, "structured_light", "time_of_flight")},
    "active6d.sensors",
)
#: Decorates a factory ``(model, **parameters) -> Sensor``; see :meth:`active6d_core.registry.Registry.register`.
register_sensor = _registry.register
#: Names that :func:`create_sensor` knows beside ``auto``.
list_sensors = _registry.names
#: Those names with where each sensor comes from; see :meth:`active6d_core.registry.Registry.origins`.
sensor_origins = _registry.origins


def create_sensor(name: str, model: ObjectModel, **parameters: Any) -> Sensor:
    """Make a sensor by name.

    Args:
        name: one of :func:`list_sensors`.
        model: the object that fills the bin.
        parameters: of that sensor.

    Raises:
        ValueError: no such sensor, no such parameter, or a value out of range; the message names it.
    """
    return _registry.create(name, model, **parameters)
