"""Model of a structured-light camera: disparity steps, shadows, thick edges, and holes on dark and shiny surfaces."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.ndimage import gaussian_filter, minimum_filter
from scipy.special import expit

from active6d_core.camera import PinholeCamera
from active6d_core.object_model import ObjectModel
from active6d_sim.rendering.depth_sensor import (
    DepthSensor,
    at_edge,
    correlated,
    facing,
    grazing_share,
    jittered,
    rounded,
)
from active6d_sim.rendering.renderer import RenderedView
from active6d_sim.rendering.sensor_registry import register_sensor

_VGA_WIDTH = 640


@dataclass(frozen=True)
class StructuredLight(DepthSensor):
    """A camera with a pattern projector beside it, such as the first Kinect.

    Sources: Khoshelham and Elberink, "Accuracy and Resolution of Kinect Depth Data for Indoor Mapping Applications"
    (Sensors 2012): disparity noise and steps. Mallick, Das and Majumdar, "Characterizations of Noise in Kinect Depth
    Images" (IEEE Sensors 2014): shadows, unstable edges, holes on dark, specular and grazing surfaces.

    Attributes:
        disparity: standard deviation of the matched disparity, pixels of an image 640 pixels wide.
        disparity_step: disparities are rounded to multiples of this, in the same pixels.
        baseline: distance between camera and projector, metres; negative has no meaning, see ``projector_left``.
        projector_left: whether the projector is on the camera's left, so that shadows fall to the right of objects.
        patch: side of the square over which depth errors are correlated, pixels.
        edge_growth: near surfaces grow by up to this many pixels over what is behind them.
        jitter: largest distance between a pixel and the point that it measures, pixels; roughens edges.
        edge_step: jump in depth between neighbours, metres, that counts as an edge.
        edge_loss: share of the pixels at edges that have no return.
        grazing_degrees: angle between ray and surface normal at which half of the returns are missing.
        dark_albedo: albedo at which half of the returns are missing.
        glare_loss: share of the pixels without return on a mirror that faces the camera.
        quantum: depth is rounded to multiples of this, metres; 0 does not round.

    Raises:
        ValueError: a parameter is out of range; the message names it.
    """

    disparity: float = 0.06
    disparity_step: float = 0.125
    baseline: float = 0.075
    projector_left: bool = True
    patch: int = 5
    edge_growth: int = 2
    jitter: int = 1
    edge_step: float = 0.02
    edge_loss: float = 0.25
    grazing_degrees: float = 76.0
    dark_albedo: float = 0.02
    glare_loss: float = 0.9
    quantum: float = 0.001
    misalignment: tuple[int, int] = (2, 1)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.baseline > 0 and self.patch >= 1):
            raise ValueError("sensor: baseline and patch must be positive")

    def scaled(self, factor: float) -> Self:
        """The sensor with ``factor`` times the noise of disparity and colour and the losses at edges.

        Shadows, steps, growth and holes are unchanged, except for factor 0, which gives a noise-free sensor.
        """
        if factor == 0:
            names = ("disparity", "disparity_step", "edge_loss", "dark_albedo", "glare_loss", "quantum")
            off = self._without_noise(names)
            return replace(off, baseline=1e-9, edge_growth=0, jitter=0, grazing_degrees=180.0)
        return replace(
            self,
            disparity=self.disparity * factor,
            edge_loss=min(self.edge_loss * factor, 1.0),
            color=self.color * factor,
        )

    @classmethod
    def random(cls, rng: np.random.Generator) -> Self:
        """A random camera of this kind, for training data."""
        return cls(
            disparity=rng.uniform(0.02, 0.12),
            disparity_step=rng.choice([0.0, 0.0625, 0.125, 0.25]),
            baseline=rng.uniform(0.05, 0.12),
            projector_left=bool(rng.random() < 0.5),
            patch=int(rng.integers(3, 9)),
            edge_growth=int(rng.integers(0, 5)),
            jitter=int(rng.integers(0, 3)),
            edge_loss=rng.uniform(0.0, 0.6),
            grazing_degrees=rng.uniform(68.0, 82.0),
            dark_albedo=rng.choice([0.0, 0.01, 0.03]),
            glare_loss=rng.uniform(0.0, 1.0),
            quantum=rng.choice([0.0001, 0.001, 0.002]),
            color=rng.uniform(0.5, 6.0),
            misalignment=(int(rng.integers(-4, 5)), int(rng.integers(-4, 5))),
        )

    def measure_depth(self, rendered: RenderedView, camera: PinholeCamera, rng: np.random.Generator) -> np.ndarray:
        """See :meth:`.DepthSensor.measure_depth`."""
        missing = rng.random(rendered.depth.shape, np.float32) < self._loss(rendered, camera)
        missing |= projector_shadow(rendered.depth, camera.fx * self.baseline, self.projector_left)
        depth = jittered(self._grown(rendered.depth, rng), self.jitter, rng)
        # Pixels of disparity per inverse metre, in an image 640 pixels wide.
        reach = camera.fx * self.baseline * _VGA_WIDTH / camera.width
        if self.disparity > 0 or self.disparity_step > 0:
            disparity = reach / depth + self.disparity * correlated(depth.shape, self.patch, rng)
            depth = reach / np.maximum(rounded(disparity, self.disparity_step), 1e-3)
        return np.where(missing, np.nan, rounded(depth, self.quantum)).astype(np.float32)

    def _grown(self, depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Depth in which near surfaces cover what is behind them, here more and there less."""
        if self.edge_growth == 0:
            return depth
        filled = np.nan_to_num(depth, nan=np.inf)
        grown = minimum_filter(filled, 2 * self.edge_growth + 1)
        patches = gaussian_filter(rng.standard_normal(depth.shape, np.float32), 2 * self.edge_growth) > 0
        nearest = np.where(patches, grown, filled)
        return np.where(np.isfinite(nearest), nearest, np.nan)

    def _loss(self, rendered: RenderedView, camera: PinholeCamera) -> np.ndarray:
        """(H, W) probability that a pixel has no return."""
        albedo, gloss = rendered.reflectance()
        kept = grazing_share(rendered, camera, self.grazing_degrees, 3.0)
        kept *= 1 - self.edge_loss * at_edge(rendered.depth, self.edge_step)
        if self.dark_albedo > 0:
            kept *= expit((np.log(np.maximum(albedo, 1e-4)) - np.log(self.dark_albedo)) / 0.3)
        if self.glare_loss > 0:
            # The projector is so near the camera that a surface mirrors it where it faces the camera.
            kept *= 1 - self.glare_loss * gloss * np.maximum(facing(rendered, camera), 0) ** 60
        return 1 - kept


def projector_shadow(depth: np.ndarray, reach: float, projector_left: bool) -> np.ndarray:
    """(H, W) bool, where something nearer keeps the projector's light away.

    A surface at depth z is at column ``u - reach / z`` of a projector on the right, ``u + reach / z`` of one on the
    left. Light reaches only the nearest surface at each column of the projector.

    Args:
        depth: (H, W) metres, NaN without surface.
        reach: focal length in pixels times distance to the projector in metres.
        projector_left: side of the projector.
    """
    image = depth[:, ::-1] if projector_left else depth
    column = np.arange(image.shape[1]) - reach / np.nan_to_num(image, nan=100.0)
    # Seen from the projector, surfaces that follow to the right may lie before this one.
    nearest = np.minimum.accumulate(column[:, ::-1], axis=1)[:, ::-1]
    following = np.pad(nearest[:, 1:], ((0, 0), (0, 1)), constant_values=np.inf)
    shadow = following < column - 0.5
    return shadow[:, ::-1] if projector_left else shadow


@register_sensor("structured_light")
def structured_light(model: ObjectModel, scale_error: float = 0.0, offset_error: float = 0.0) -> StructuredLight:
    """Factory of the sensor ``structured_light``; it is the same for every model."""
    return StructuredLight(scale_error=scale_error, offset_error=offset_error)
