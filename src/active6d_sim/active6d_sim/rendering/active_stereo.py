"""Model of an active stereo camera: noise, missing depth, rough edges and rounding of a noise-free view."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from active6d_core.camera import PinholeCamera
from active6d_core.object_model import ObjectModel
from active6d_sim.rendering.depth_sensor import DepthSensor, at_edge, correlated, grazing_share, jittered, rounded
from active6d_sim.rendering.renderer import RenderedView
from active6d_sim.rendering.sensor_registry import DEFAULT_SENSOR, register_sensor


@dataclass(frozen=True)
class ActiveStereo(DepthSensor):
    """A short-range active stereo camera.

    The model of disparity follows Ahn et al., "Analysis and Noise Modeling of the Intel RealSense D435 for Mobile
    Robots" (2019): the depth error grows with the square of the distance, and is correlated over matching windows.

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

    Raises:
        ValueError: a parameter is out of range; the message names it.
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

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.baseline > 0 and self.patch >= 1 and self.grazing_width_degrees > 0):
            raise ValueError("sensor: baseline, patch and grazing_width_degrees must be positive")

    def scaled(self, factor: float) -> Self:
        """The sensor with ``factor`` times the noise of disparity and colour and the losses at edges and of speckle.

        Jitter, grazing angle and quantum are unchanged, except for factor 0, which gives a noise-free sensor.
        """
        if factor == 0:
            off = self._without_noise(("disparity", "edge_loss", "speckle_loss", "quantum"))
            return replace(off, jitter=0, grazing_degrees=180.0)
        return replace(
            self,
            disparity=self.disparity * factor,
            edge_loss=min(self.edge_loss * factor, 1.0),
            speckle_loss=min(self.speckle_loss * factor, 1.0),
            color=self.color * factor,
        )

    @classmethod
    def random(cls, rng: np.random.Generator) -> Self:
        """A random camera of this kind, for training data: up to twice the noise, other baselines and windows."""
        return cls(
            disparity=rng.uniform(0.02, 0.14),
            baseline=rng.uniform(0.045, 0.075),
            patch=int(rng.integers(2, 7)),
            jitter=int(rng.integers(0, 3)),
            grazing_degrees=rng.uniform(74.0, 84.0),
            edge_loss=rng.uniform(0.1, 0.9),
            speckle_loss=rng.choice([0.002, 0.01, 0.03]),
            quantum=rng.choice([0.0001, 0.0005, 0.001]),
            color=rng.uniform(0.5, 5.0),
        )

    def depth_sigma(self, depth: np.ndarray, camera: PinholeCamera) -> np.ndarray:
        """Standard deviation in metres of a depth (...,) in metres."""
        return depth**2 * (self.disparity / (camera.fx * self.baseline))

    def measure_depth(self, rendered: RenderedView, camera: PinholeCamera, rng: np.random.Generator) -> np.ndarray:
        """See :meth:`.DepthSensor.measure_depth`."""
        missing = rng.random(rendered.depth.shape, np.float32) < self._loss(rendered, camera)
        depth = jittered(rendered.depth, self.jitter, rng)
        if self.disparity > 0:
            depth = depth + self.depth_sigma(depth, camera) * correlated(depth.shape, self.patch, rng)
        return np.where(missing, np.nan, rounded(depth, self.quantum)).astype(np.float32)

    def _loss(self, rendered: RenderedView, camera: PinholeCamera) -> np.ndarray:
        """(H, W) probability that a pixel has no return."""
        kept = grazing_share(rendered, camera, self.grazing_degrees, self.grazing_width_degrees)
        if self.edge_loss > 0:
            kept *= 1 - self.edge_loss * at_edge(rendered.depth, self.edge_step)
        return 1 - kept * (1 - self.speckle_loss)


@register_sensor(DEFAULT_SENSOR)
def active_stereo(model: ObjectModel, scale_error: float = 0.0, offset_error: float = 0.0) -> ActiveStereo:
    """Factory of the sensor ``active_stereo``; it is the same for every model."""
    return ActiveStereo(scale_error=scale_error, offset_error=offset_error)
