"""What all simulated depth sensors share: their parameters' checks, calibration errors, and effects on images."""

from dataclasses import dataclass, fields, replace
from typing import Self

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter, uniform_filter
from scipy.special import expit

from active6d_core.camera import PinholeCamera, pixel_rays
from active6d_sim.rendering.renderer import RenderedView

_SIGNED = ("scale_error", "offset_error", "misalignment")


@dataclass(frozen=True)
class DepthSensor:
    """Base of the sensors: colour noise, and an error of calibration that is the same for all pixels.

    Attributes:
        scale_error: relative error of all depths; 0.005 measures 1 m as 1.005 m.
        offset_error: added to all depths, metres.
        color: standard deviation of each colour channel, in levels of 0 to 255.
        misalignment: shift (columns, rows) in pixels of the colour image against the depth image.

    Raises:
        ValueError: a parameter is out of range; the message names it.
    """

    scale_error: float = 0.0
    offset_error: float = 0.0
    color: float = 2.0
    misalignment: tuple[int, int] = (0, 0)

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if not np.isfinite(value).all() or (item.name not in _SIGNED and value < 0):
                raise ValueError(f"sensor: {item.name} must be finite and not negative, got {value}")
            if item.name.endswith("_loss") and value > 1:
                raise ValueError(f"sensor: {item.name} is a share of pixels, got {value}")

    def scaled(self, factor: float) -> Self:
        """The sensor with ``factor`` times the noise; 0 is a noise-free sensor.

        Raises:
            ValueError: ``factor`` is negative or not finite.
        """
        raise NotImplementedError

    def measure_depth(self, rendered: RenderedView, camera: PinholeCamera, rng: np.random.Generator) -> np.ndarray:
        """(H, W) float32 depth of a noise-free view, metres, NaN for missing returns, without calibration errors."""
        raise NotImplementedError

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
        depth = self.measure_depth(rendered, camera, rng)
        if self.scale_error or self.offset_error:
            depth = (depth * (1 + self.scale_error) + self.offset_error).astype(np.float32)
        color = shifted(rendered.color, *self.misalignment)
        return noisy_color(color, self.color, rng), depth

    def _without_noise(self, names: tuple[str, ...]) -> Self:
        """The sensor with 0 for these parameters, for the calibration errors and for the noise of colour."""
        off = dict.fromkeys((*names, "scale_error", "offset_error", "color"), 0.0)
        return replace(self, misalignment=(0, 0), **off)


def grazing_share(rendered: RenderedView, camera: PinholeCamera, degrees: float, width: float) -> np.ndarray:
    """(H, W) share of returns that a grazing angle leaves: half at ``degrees``, over a transition of ``width``."""
    return expit((degrees - np.degrees(np.arccos(np.clip(facing(rendered, camera), -1, 1)))) / width)


def facing(rendered: RenderedView, camera: PinholeCamera) -> np.ndarray:
    """(H, W) cosine of the angle between the surface normal and the ray to the camera."""
    rays = pixel_rays(camera)
    return -np.einsum("...i,...i", rendered.normals, rays) / np.sqrt(np.einsum("...i,...i", rays, rays))


def at_edge(depth: np.ndarray, step: float, size: int = 3) -> np.ndarray:
    """(H, W) bool, whether depths within ``size`` pixels differ by more than ``step`` metres."""
    filled = np.nan_to_num(depth, nan=100.0)
    return maximum_filter(filled, size) - minimum_filter(filled, size) > step


def jittered(depth: np.ndarray, jitter: int, rng: np.random.Generator) -> np.ndarray:
    """(H, W) depth in which each pixel takes the value of a random pixel at most ``jitter`` away."""
    if jitter == 0:
        return depth
    height, width = depth.shape
    shifts = rng.integers(-jitter, jitter + 1, (2, height, width), dtype=np.int8)
    rows = np.clip(np.arange(height)[:, None] + shifts[0], 0, height - 1)
    columns = np.clip(np.arange(width) + shifts[1], 0, width - 1)
    return depth[rows, columns]


def correlated(shape: tuple[int, int], patch: int, rng: np.random.Generator) -> np.ndarray:
    """Normal noise of unit variance, correlated over squares of ``patch`` pixels."""
    white = rng.standard_normal(shape, np.float32)
    return uniform_filter(white, patch, mode="wrap") * patch if patch > 1 else white


def rounded(depth: np.ndarray, quantum: float) -> np.ndarray:
    """Depth rounded to multiples of ``quantum`` metres; 0 does not round."""
    return np.round(depth / quantum) * quantum if quantum > 0 else depth


def shifted(image: np.ndarray, columns: int, rows: int) -> np.ndarray:
    """The image moved to the right and down by whole pixels; the border is repeated."""
    if not (columns or rows):
        return image
    height, width = image.shape[:2]
    from_row = np.clip(np.arange(height) - rows, 0, height - 1)
    from_column = np.clip(np.arange(width) - columns, 0, width - 1)
    return image[from_row[:, None], from_column]


def noisy_color(color: np.ndarray, sigma: float, rng: np.random.Generator) -> np.ndarray:
    """(H, W, 3) uint8 colour with normal noise of ``sigma`` levels."""
    if sigma == 0:
        return color
    noisy = color + sigma * rng.standard_normal(color.shape, np.float32)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
