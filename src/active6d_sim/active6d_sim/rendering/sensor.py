"""Model of an active stereo camera: noise, missing depth, rough edges and rounding of a noise-free view."""

from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter, uniform_filter
from scipy.special import expit

from active6d_core.camera import PinholeCamera, pixel_rays
from active6d_core.object_model import ObjectModel
from active6d_sim.rendering.renderer import RenderedView
from active6d_sim.rendering.sensor_registry import DEFAULT_SENSOR, register_sensor


@dataclass(frozen=True)
class SensorNoise:
    """Parameters of the sensor; the defaults are those of a short-range active stereo camera.

    Attributes:
        disparity: standard deviation of the matched disparity, pixels. Stereo triangulation turns it into a depth
            error of ``z^2 * disparity / (fx * baseline)``: 1.5 mm at 0.8 m for a VGA image.
        baseline: distance between the two imagers, metres.
        patch: side of the square over which depth errors are correlated, pixels; stereo matches windows.
        jitter: largest distance between a pixel and the point that it measures, pixels; roughens edges.
        grazing_degrees: angle between ray and surface normal at which half of the returns are missing.
        grazing_width_degrees: width of the transition around that angle.
        edge_step: jump in depth between neighbours, metres, that counts as an edge.
        edge_loss: share of the pixels at edges that have no return.
        speckle_loss: share of all pixels that have no return.
        quantum: depth is rounded to multiples of this, metres; 0 does not round.
        color: standard deviation of each colour channel, in levels of 0 to 255.

    Raises:
        ValueError: a parameter is negative or not finite, or a share is above 1; the message names it.
    """

    disparity: float = 0.07
    baseline: float = 0.055
    patch: int = 3
    jitter: int = 1
    grazing_degrees: float = 82.0
    grazing_width_degrees: float = 2.0
    edge_step: float = 0.015
    edge_loss: float = 0.5
    speckle_loss: float = 0.002
    quantum: float = 0.0005
    color: float = 2.0

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if not (np.isfinite(value) and value >= 0):
                raise ValueError(f"sensor noise: {item.name} must be finite and not negative, got {value}")
        for name in ("edge_loss", "speckle_loss"):
            if getattr(self, name) > 1:
                raise ValueError(f"sensor noise: {name} is a share of pixels, got {getattr(self, name)}")
        if not (self.baseline > 0 and self.patch >= 1 and self.grazing_width_degrees > 0):
            raise ValueError("sensor noise: baseline, patch and grazing_width_degrees must be positive")

    def scaled(self, factor: float) -> "SensorNoise":
        """The sensor with ``factor`` times the noise of disparity and colour and the losses at edges and of speckle.

        Jitter, grazing angle and quantum are unchanged, except for factor 0, which gives a noise-free sensor.
        """
        if factor == 0:
            return SensorNoise.off()
        return replace(
            self,
            disparity=self.disparity * factor,
            edge_loss=min(self.edge_loss * factor, 1.0),
            speckle_loss=min(self.speckle_loss * factor, 1.0),
            color=self.color * factor,
        )

    @classmethod
    def off(cls) -> "SensorNoise":
        """A noise-free sensor."""
        return cls(
            disparity=0.0, jitter=0, grazing_degrees=180.0, edge_loss=0.0, speckle_loss=0.0, quantum=0.0, color=0.0
        )

    def depth_sigma(self, depth: np.ndarray, camera: PinholeCamera) -> np.ndarray:
        """Standard deviation in metres of a depth (...,) in metres."""
        return depth**2 * (self.disparity / (camera.fx * self.baseline))

    def measure(
        self, rendered: RenderedView, camera: PinholeCamera, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Simulate the measurement of a noise-free view.

        Args:
            rendered: the noise-free view, with colour.
            camera: its intrinsics.
            rng: random generator.

        Returns:
            (H, W, 3) uint8 colour, and (H, W) float32 depth in metres with NaN for missing returns.

        Raises:
            ValueError: the view has no colour.
        """
        if rendered.color is None:
            raise ValueError("the view was rendered without colour")
        missing = rng.random(rendered.depth.shape, np.float32) < _loss(rendered, camera, self)
        depth = _jittered(rendered.depth, self.jitter, rng)
        if self.disparity > 0:
            depth = depth + self.depth_sigma(depth, camera) * _correlated(depth.shape, self.patch, rng)
        if self.quantum > 0:
            depth = np.round(depth / self.quantum) * self.quantum
        depth = np.where(missing, np.nan, depth).astype(np.float32)
        return _noisy_color(rendered.color, self.color, rng), depth


@register_sensor(DEFAULT_SENSOR)
def active_stereo(model: ObjectModel) -> SensorNoise:
    """The short-range active stereo camera; it is the same for every model."""
    return SensorNoise()


def _loss(rendered: RenderedView, camera: PinholeCamera, noise: SensorNoise) -> np.ndarray:
    """(H, W) probability that a pixel has no return."""
    rays = pixel_rays(camera)
    cosine = -np.einsum("...i,...i", rendered.normals, rays) / np.sqrt(np.einsum("...i,...i", rays, rays))
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    kept = expit((noise.grazing_degrees - angle) / noise.grazing_width_degrees)
    if noise.edge_loss > 0:
        filled = np.nan_to_num(rendered.depth, nan=100.0)
        edge = maximum_filter(filled, 3) - minimum_filter(filled, 3) > noise.edge_step
        kept *= 1 - noise.edge_loss * edge
    return 1 - kept * (1 - noise.speckle_loss)


def _jittered(depth: np.ndarray, jitter: int, rng: np.random.Generator) -> np.ndarray:
    """(H, W) depth in which each pixel takes the value of a random pixel at most ``jitter`` away."""
    if jitter == 0:
        return depth
    height, width = depth.shape
    shifts = rng.integers(-jitter, jitter + 1, (2, height, width), dtype=np.int8)
    rows = np.clip(np.arange(height)[:, None] + shifts[0], 0, height - 1)
    columns = np.clip(np.arange(width) + shifts[1], 0, width - 1)
    return depth[rows, columns]


def _correlated(shape: tuple[int, int], patch: int, rng: np.random.Generator) -> np.ndarray:
    """Normal noise of unit variance, correlated over squares of ``patch`` pixels."""
    white = rng.standard_normal(shape, np.float32)
    return uniform_filter(white, patch, mode="wrap") * patch if patch > 1 else white


def _noisy_color(color: np.ndarray, sigma: float, rng: np.random.Generator) -> np.ndarray:
    if sigma == 0:
        return color
    noisy = color + sigma * rng.standard_normal(color.shape, np.float32)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
