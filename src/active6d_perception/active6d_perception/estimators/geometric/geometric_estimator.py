"""The training-free estimator, which needs only a mesh and a depth image."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from active6d_core.camera import View
from active6d_core.hypotheses import Hypotheses
from active6d_core.object_model import ObjectModel
from active6d_perception.estimators.geometric.foreground import Surface, measure_surface
from active6d_perception.estimators.geometric.pair_voting import PairVoting
from active6d_perception.estimators.refinement import Evidence, claim_pixels, refine, weigh_evidence
from active6d_perception.estimators.registry import register_estimator
from active6d_perception.model.model_views import model_views
from active6d_perception.model.symmetric_distance import SymmetricDistance
from active6d_perception.suppression import suppress


@dataclass(frozen=True)
class GeometricParameters:
    """Settings of :class:`GeometricEstimator`.

    Attributes:
        references: largest number of scene points that vote; the run time grows with it.
        refined: largest number of candidates that are refined.
        min_score: hypotheses with a lower score are not reported, in [0, 1].

    Raises:
        ValueError: a value is out of range.
    """

    references: int = 300
    refined: int = 120
    min_score: float = 0.3

    def __post_init__(self) -> None:
        if self.references < 1 or self.refined < 1:
            raise ValueError("references and refined must be at least 1")
        if not 0 <= self.min_score <= 1:
            raise ValueError(f"min_score must be in [0, 1], got {self.min_score}")


class GeometricEstimator:
    """Estimates poses by point-pair voting and visible-surface ICP, and scores them by inliers and free space.

    It is deterministic and single-threaded, and uses only the depth image and its intrinsics.
    """

    def __init__(self, model: ObjectModel, parameters: GeometricParameters | None = None) -> None:
        self.model = model
        self.parameters = parameters or GeometricParameters()
        self._views = model_views(model)
        self._voting = PairVoting(model)
        self._distance = SymmetricDistance(model)

    def estimate(self, view: View) -> Hypotheses:
        """See :meth:`active6d_perception.estimators.registry.Estimator.estimate`."""
        surface = measure_surface(view.depth, view.camera, self.model.diameter)
        poses = self._propose(surface)
        if len(poses):
            poses = self._refine(surface, poses)
        return self._report(surface, poses, view)

    def _propose(self, surface: Surface) -> np.ndarray:
        """(k, 4, 4) distinct candidates with the best evidence in the depth image, best first."""
        usable = surface.foreground & np.isfinite(surface.normals).all(axis=-1)
        index = _thin_out(surface, usable, 0.05 * self.model.diameter)
        if len(index) < 10:
            return np.zeros((0, 4, 4))
        points = surface.points.reshape(-1, 3)[index].astype(float)
        normals = surface.normals.reshape(-1, 3)[index].astype(float)
        count = min(self.parameters.references, len(points))
        references = np.linspace(0, len(points) - 1, count).astype(np.intp)
        poses, _ = self._voting.candidates(points, normals, references, peaks=3)
        value = _value(self._weigh(surface, poses, samples=64, tolerance=0.010))
        best = np.argsort(-value, kind="stable")[: 5 * self.parameters.refined]
        poses, value = poses[best], value[best]
        kept = suppress(self._distance.between(poses, poses), value, 0.08 * self.model.diameter)
        return poses[kept[: self.parameters.refined]]

    def _refine(self, surface: Surface, poses: np.ndarray) -> np.ndarray:
        """(k, 4, 4) refined poses without duplicates, best first."""
        usable = np.isfinite(surface.normals).all(axis=-1) & surface.foreground
        usable[1::2] = usable[:, 1::2] = False
        scene, normals = cKDTree(surface.points[usable]), surface.normals[usable]
        poses = refine(self._views, poses, scene, normals, gates=(0.012, 0.008), iterations=4, samples=96)
        value = _value(self._weigh(surface, poses))
        kept = suppress(self._distance.between(poses, poses), value, 0.08 * self.model.diameter)
        kept = kept[value[kept] > 0.1]
        poses = refine(self._views, poses[kept], scene, normals, gates=(0.008, 0.004), iterations=4)
        value = _value(self._weigh(surface, poses))
        kept = suppress(self._distance.between(poses, poses), value, 0.1 * self.model.diameter)
        return poses[kept[value[kept] > 0.1]]

    def _report(self, surface: Surface, poses: np.ndarray, view: View) -> Hypotheses:
        """The hypotheses that explain pixels which no better one explains."""
        if not len(poses):
            return Hypotheses.empty(view.camera.height, view.camera.width)
        score = _value(self._weigh(surface, poses, samples=512))
        # Ranked by the area that a pose explains and not by its share. A mug rotated so that its handle would be hidden
        # fits perfectly, but leaves the measured handle unexplained.
        area = score * self._views.visible.sum(axis=1)[self._views.nearest_direction(poses)]
        best = np.argsort(-area, kind="stable")
        best = best[score[best] >= self.parameters.min_score]
        label = claim_pixels(self._views, poses[best], surface.points, surface.foreground, view.camera)
        claimed = np.unique(label[label > 0])
        reported = best[claimed.astype(np.intp) - 1]
        relabel = np.zeros(len(best) + 1, np.uint16)
        relabel[claimed] = np.arange(1, len(claimed) + 1)
        return Hypotheses.from_masks(poses[reported], score[reported], relabel[claimed], relabel[label], view.depth)

    def _weigh(self, surface: Surface, poses: np.ndarray, **settings) -> Evidence:
        return weigh_evidence(self._views, poses, surface.depth, surface.normals, surface.camera, **settings)


def _value(evidence: Evidence) -> np.ndarray:
    return np.clip(evidence.fitting - evidence.violated, 0.0, 1.0)


def _thin_out(surface: Surface, usable: np.ndarray, spacing: float) -> np.ndarray:
    """Flat indices of usable pixels, one per cube of edge ``spacing`` metres."""
    index = np.flatnonzero(usable)
    cell = np.floor(surface.points.reshape(-1, 3)[index] / spacing).astype(np.int64)
    key = (cell[:, 0] * 4096 + cell[:, 1]) * 4096 + cell[:, 2]
    _, first = np.unique(key, return_index=True)
    return index[np.sort(first)]


@register_estimator("geometric")
def create_geometric(
    model: ObjectModel,
    references: int = GeometricParameters.references,
    refined: int = GeometricParameters.refined,
    min_score: float = GeometricParameters.min_score,
) -> GeometricEstimator:
    """Factory of the estimator ``geometric``; see :class:`GeometricParameters` for the settings.

    Raises:
        ValueError: a value is out of range.
    """
    return GeometricEstimator(model, GeometricParameters(references, refined, min_score))
