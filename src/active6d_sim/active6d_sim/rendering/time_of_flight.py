"""Model of a time-of-flight camera: noise by reflected light, flying pixels, and bias in corners and with distance."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter, uniform_filter

from active6d_core.camera import PinholeCamera
from active6d_core.object_model import ObjectModel
from active6d_sim.rendering.depth_sensor import DepthSensor, correlated, facing, jittered, rounded
from active6d_sim.rendering.renderer import RenderedView
from active6d_sim.rendering.sensor_registry import register_sensor

_NOMINAL_DISTANCE = 0.8
_NOMINAL_ALBEDO = 0.4


@dataclass(frozen=True)
class TimeOfFlight(DepthSensor):
    """A camera that measures the phase of modulated light, such as the second Kinect.

    Sources: Foix, Alenya and Torras, "Lock-in Time-of-Flight (ToF) Cameras: A Survey" (IEEE Sensors 2011), and
    Sarbolandi, Lefloch and Kolb, "Kinect Range Sensing: Structured-Light versus Time-of-Flight Kinect" (CVIU 2015).

    Attributes:
        noise: standard deviation in metres at 0.8 m on a surface of albedo 0.4 that faces the camera. It grows with
            the square of the distance and falls with the reflected light.
        patch: side of the square over which depth errors are correlated, pixels.
        flying_pixels: share of the pixels at edges that measure a mixture of the near and the far surface.
        edge_step: jump in depth between neighbours, metres, that counts as an edge.
        multipath: light that arrives by way of other surfaces makes corners and insides look farther by this share of
            how much nearer their surroundings are.
        wiggling: amplitude of the error that is periodic in the distance, metres.
        wiggling_period: of that error, metres.
        least_amplitude: pixels that reflect less light than this, relative to the nominal one, have no return.
        jitter: largest distance between a pixel and the point that it measures, pixels; roughens edges.
        quantum: depth is rounded to multiples of this, metres; 0 does not round.

    Raises:
        ValueError: a parameter is out of range; the message names it.
    """

    noise: float = 0.0012
    patch: int = 2
    flying_pixels: float = 0.7
    edge_step: float = 0.02
    multipath: float = 0.06
    wiggling: float = 0.0015
    wiggling_period: float = 0.9
    least_amplitude: float = 0.04
    jitter: int = 0
    quantum: float = 0.0005
    misalignment: tuple[int, int] = (1, 0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.wiggling_period > 0 and self.patch >= 1):
            raise ValueError("sensor: wiggling_period and patch must be positive")

    def scaled(self, factor: float) -> Self:
        """The sensor with ``factor`` times the noise of depth and colour; 0 gives a noise-free sensor."""
        if factor == 0:
            names = ("noise", "flying_pixels", "multipath", "wiggling", "least_amplitude", "quantum")
            return replace(self._without_noise(names), jitter=0)
        return replace(self, noise=self.noise * factor, color=self.color * factor)

    @classmethod
    def random(cls, rng: np.random.Generator) -> Self:
        """A random camera of this kind, for training data."""
        return cls(
            noise=rng.uniform(0.0003, 0.0025),
            patch=int(rng.integers(1, 4)),
            flying_pixels=rng.uniform(0.0, 1.0),
            multipath=rng.uniform(0.0, 0.12),
            wiggling=rng.uniform(0.0, 0.003),
            wiggling_period=rng.uniform(0.5, 1.5),
            least_amplitude=rng.choice([0.0, 0.03, 0.08]),
            jitter=int(rng.integers(0, 2)),
            quantum=rng.choice([0.0001, 0.0005, 0.001]),
            color=rng.uniform(0.5, 5.0),
            misalignment=(int(rng.integers(-2, 3)), int(rng.integers(-2, 3))),
        )

    def measure_depth(self, rendered: RenderedView, camera: PinholeCamera, rng: np.random.Generator) -> np.ndarray:
        """See :meth:`.DepthSensor.measure_depth`."""
        true = rendered.depth
        depth = jittered(true, self.jitter, rng)
        if self.flying_pixels > 0:
            depth = self._with_flying_pixels(depth, rng)
        depth = depth + self._bias(true)
        amplitude = self._amplitude(rendered, camera)
        if self.noise > 0:
            depth = depth + self.noise / np.maximum(amplitude, 0.05) * correlated(depth.shape, self.patch, rng)
        return np.where(amplitude < self.least_amplitude, np.nan, rounded(depth, self.quantum)).astype(np.float32)

    def _with_flying_pixels(self, depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        filled = np.nan_to_num(depth, nan=100.0)
        near, far = minimum_filter(filled, 3), maximum_filter(filled, 3)
        mixed = (
            (far - near > self.edge_step) & (far < 100.0) & (rng.random(depth.shape, np.float32) < self.flying_pixels)
        )
        # Light of both surfaces adds; the nearer one mostly reflects more of it.
        share = rng.random(depth.shape, np.float32) ** 2
        return np.where(mixed, near + share * (far - near), depth)

    def _bias(self, depth: np.ndarray) -> np.ndarray:
        """(H, W) systematic error, metres."""
        bias = self.wiggling * np.sin(2 * np.pi * depth / self.wiggling_period)
        if self.multipath > 0:
            valid = np.isfinite(depth)
            share = uniform_filter(valid.astype(np.float32), 31, mode="nearest")
            around = uniform_filter(np.nan_to_num(depth), 31, mode="nearest") / np.maximum(share, 1e-3)
            bias = bias + self.multipath * np.clip(depth - around, 0.0, 0.1)
        return bias

    def _amplitude(self, rendered: RenderedView, camera: PinholeCamera) -> np.ndarray:
        """(H, W) reflected light, relative to a nominal surface at the nominal distance; 0 without surface."""
        albedo, _ = rendered.reflectance()
        light = albedo / _NOMINAL_ALBEDO * np.maximum(facing(rendered, camera), 0)
        return np.nan_to_num(light * (_NOMINAL_DISTANCE / rendered.depth) ** 2)


@register_sensor("time_of_flight")
def time_of_flight(model: ObjectModel, scale_error: float = 0.0, offset_error: float = 0.0) -> TimeOfFlight:
    """Factory of the sensor ``time_of_flight``; it is the same for every model."""
    return TimeOfFlight(scale_error=scale_error, offset_error=offset_error)
