"""The interface of simulated sensors, and their registry by name."""

from typing import TYPE_CHECKING, Protocol, Self

import numpy as np

from active6d_core.camera import PinholeCamera
from active6d_core.registry import Registry

# The renderer loads Open3D, which takes a second; names of sensors are in the help of most commands.
if TYPE_CHECKING:
    from active6d_sim.rendering.renderer import RenderedView

#: The sensor that active6d was developed with.
DEFAULT_SENSOR = "active_stereo"


class Sensor(Protocol):
    """Turns a perfect view into a measured one."""

    def measure(
        self, rendered: "RenderedView", camera: PinholeCamera, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """(H, W, 3) uint8 colour, and (H, W) float32 depth in metres with NaN for missing returns."""
        ...

    def scaled(self, factor: float) -> Self:
        """The sensor with ``factor`` times the noise; 0 is a perfect sensor."""
        ...


_registry: Registry[Sensor] = Registry(
    "sensor",
    lambda object_name: DEFAULT_SENSOR,
    {name: f"active6d_sim.rendering.{name}" for name in (DEFAULT_SENSOR, "structured_light", "time_of_flight")},
    "active6d.sensors",
)
#: Decorates a factory ``(model, **parameters) -> Sensor``.
register_sensor = _registry.register
#: All names, without ``auto``; and the same with where each comes from.
list_sensors, sensor_origins = _registry.names, _registry.origins
#: Makes one by name; see :meth:`active6d_core.registry.Registry.create`.
create_sensor = _registry.create
