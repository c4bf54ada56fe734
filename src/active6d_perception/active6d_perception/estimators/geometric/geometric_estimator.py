"""The training-free estimator, which needs only a mesh and a depth image."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from active6d_core.camera import PinholeCamera, View
from active6d_core.hypotheses import Hypotheses
from active6d_core.object_model import ObjectModel
from active6d_core.rgbd import check_view
from active6d_perception.estimators.geometric.foreground import Surface, measure_surface
from active6d_perception.estimators.geometric.multi_start import Starts, thin_out
from active6d_perception.estimators.geometric.pair_voting import PairVoting
from active6d_perception.estimators.image_registration import register
from active6d_perception.estimators.masks import claim_pixels
from active6d_perception.estimators.pose_evidence import (
    CONFIRMED,
    CONTINUED,
    FITTING,
    NEAR,
    UNMEASURED,
    VIOLATED,
    comparable_share,
    weigh_poses,
)
from active6d_perception.estimators.pose_selection import judge_of
from active6d_perception.estimators.registry import register_estimator
from active6d_perception.estimators.score_model import ScoreModel
from active6d_perception.model.length_scale import length_scale
from active6d_perception.model.model_views import model_views
from active6d_perception.model.symmetric_distance import SymmetricDistance
from active6d_perception.model.visible_samples import visible_samples

# Gates of the two registrations in metres, for an object of 0.14 m.
_ROUGH_GATES = np.array([0.02, 0.012])
_FINE_GATES = np.array([0.012, 0.008, 0.006])
# Weight of a sample that the camera looked through against one that fits.
_VIOLATION = 1.5
# Measured points that are paired with others. A heap shows under four thousand; noise fills all space.
_MOST_POINTS = 8000
# Starts kept at each measured point.
_STARTS_PER_POINT = 24
# Starts that are refined, those that fit best; it bounds the time of images that no pile shows.
_MOST_STARTS = 5000
# A start or candidate that fits less than this, net of violations, is dropped.
_LEAST_VALUE = 0.05
#: Features of :meth:`GeometricEstimator.candidates`.
FEATURES = (
    "fitting",
    "violated",
    "fitting_comparable",
    "near_comparable",
    "confirmed",
    "continued",
    "log_area",
    "area_share",
    "area_excess",
    "log_pixels",
)
#: Features that can only lower the score.
AGAINST = ("violated", "continued", "area_excess")
#: The score's regression, fitted by active6d_tools.studies.fit_geometric_score on validation views of all objects.
SCORE_FILE = Path(__file__).parent / "score.json"


@dataclass(frozen=True)
class GeometricParameters:
    """Settings of :class:`GeometricEstimator`.

    Attributes:
        references: most measured points that poses start from; time grows with it.
        refined: most candidates that are refined in full.
        min_score: hypotheses scoring less are not reported, in [0, 1].

    Raises:
        ValueError: a value is out of range.
    """

    references: int = 600
    refined: int = 1000
    min_score: float = 0.1

    def __post_init__(self) -> None:
        if self.references < 1 or self.refined < 1:
            raise ValueError("references and refined must be at least 1")
        if not 0 <= self.min_score <= 1:
            raise ValueError(f"min_score must be in [0, 1], got {self.min_score}")


class GeometricEstimator:
    """Many starts near the measured surface and from point-pair voting, projective ICP, a judge that knows free space.

    It is deterministic and single-threaded, and uses only the depth image and its intrinsics.
    """

    def __init__(self, model: ObjectModel, parameters: GeometricParameters | None = None) -> None:
        self.model = model
        self.parameters = parameters or GeometricParameters()
        self._views = model_views(model)
        self._voting = PairVoting(model)
        self._starts = Starts(self._views)
        self._distance = SymmetricDistance(model)
        # The fewer poses are left, the more samples each is judged by, and the more strictly.
        self._first = judge_of(model, samples=32, tolerance=0.010, alike=0.5)
        self._second = judge_of(model, samples=64, tolerance=0.008, alike=0.6)
        self._last = judge_of(model)
        everything = np.ones(len(self._views.points), bool)
        self._samples = visible_samples(self._views, everything, 128, model.mesh.area)
        self._score = ScoreModel.from_dict(json.loads(SCORE_FILE.read_text()), FEATURES)
        self._scale = length_scale(model)

    def estimate(self, view: View) -> Hypotheses:
        """See :meth:`active6d_perception.estimators.registry.Estimator.estimate`."""
        view = check_view(view)
        surface = measure_surface(view.depth, view.camera, self.model.diameter)
        poses, label, features = self.candidates(surface)
        score = self._score.probability(features)
        reported = np.flatnonzero(score >= self.parameters.min_score)
        relabel = np.zeros(len(poses) + 1, np.uint16)
        relabel[reported + 1] = np.arange(1, len(reported) + 1)
        if not len(reported):
            return Hypotheses.empty(view.camera.height, view.camera.width)
        numbers = np.arange(1, len(reported) + 1)
        return Hypotheses.from_masks(poses[reported], score[reported], numbers, relabel[label], view.depth)

    def candidates(self, surface: Surface) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Poses that explain pixels which no better one explains.

        Returns:
            poses: (k, 4, 4) ``T_camera_object``, metres.
            label: (H, W) uint16, 1 + index of the pose and 0 for none.
            features: (k, f) :data:`FEATURES`. Comparable is the surface that is neither occluded nor unmeasured nor
                outside of the image. The area of the pose's pixels is given over the diameter squared, and over the
                silhouette's comparable part.
        """
        image = surface.image
        poses = self._propose(surface)
        if len(poses):
            poses = register(poses, self._second.samples, image, self._scale * _ROUGH_GATES, 4, 0)
            value = _value(weigh_poses(poses, self._second, image, False))
            poses = self._thin_out(poses, value, 0.06, self.parameters.refined, 15)
            poses = register(poses, self._samples, image, self._scale * _FINE_GATES, 5, 0)
            poses = self._thin_out(poses, _value(weigh_poses(poses, self._last, image, False)), 0.1, 300, 3)
        evidence = weigh_poses(poses, self._last, image)
        value = _value(evidence)
        # By the area that a pose explains, not by its share: a mug turned so that its handle would be hidden fits
        # perfectly, and leaves the handle that was measured unexplained.
        area = value * self._views.visible.sum(axis=1)[self._views.nearest_direction(poses)]
        best = np.argsort(-area, kind="stable")
        best = best[value[best] > _LEAST_VALUE]
        label = claim_pixels(self._views, poses[best], image.points, surface.foreground, surface.camera)
        pixels = np.bincount(label.ravel(), minlength=len(best) + 1)[1:]
        claimed = np.flatnonzero(pixels)
        relabel = np.zeros(len(best) + 1, np.uint16)
        relabel[claimed + 1] = np.arange(1, len(claimed) + 1)
        best = best[claimed]
        return poses[best], relabel[label], self._features(poses[best], evidence[best], pixels[claimed], surface.camera)

    def _features(
        self, poses: np.ndarray, evidence: np.ndarray, pixels: np.ndarray, camera: PinholeCamera
    ) -> np.ndarray:
        """(k, f) :data:`FEATURES` of (k, 4, 4) poses that claim (k,) pixels."""
        # The area that its pixels cover at the object's distance, in squares of the diameter: the same for all cameras.
        covered = pixels * poses[:, 2, 3] ** 2 / (camera.fx * camera.fy)
        comparable = comparable_share(evidence)
        area_share = covered / (self._silhouette_area(poses) * comparable)
        return np.column_stack(
            [
                evidence[:, FITTING],
                evidence[:, VIOLATED],
                evidence[:, FITTING] / comparable,
                evidence[:, NEAR] / comparable,
                evidence[:, CONFIRMED],
                evidence[:, CONTINUED],
                np.log(covered / self.model.diameter**2),
                np.minimum(area_share, 1.0),
                np.maximum(area_share - 1.0, 0.0),
                np.log(pixels),
            ]
        )

    def _propose(self, surface: Surface) -> np.ndarray:
        """(k, 4, 4) starting poses that the depth image does not contradict."""
        image = surface.image
        usable = surface.foreground & np.isfinite(image.normals).all(axis=-1)
        index = _one_a_cube(image.points, usable, 0.05 * self.model.diameter)
        if len(index) < 10:
            return np.zeros((0, 4, 4))
        index = index[:: -(-len(index) // _MOST_POINTS)]
        points = image.points.reshape(-1, 3)[index].astype(float)
        normals = image.normals.reshape(-1, 3)[index].astype(float)
        count = min(self.parameters.references, len(points))
        references = np.linspace(0, len(points) - 1, count).astype(np.intp)
        voted = self._voting.candidates(points, normals, references, peaks=3)
        starts = self._starts.at(points[references], normals[references])
        value = _value(weigh_poses(starts.reshape(-1, 4, 4), self._first, image, False)).reshape(starts.shape[:2])
        best = np.argsort(-value, axis=1, kind="stable")[:, :_STARTS_PER_POINT]
        near = np.take_along_axis(starts, best[..., None, None], axis=1).reshape(-1, 4, 4)
        fit = np.take_along_axis(value, best, axis=1).ravel()
        kept = np.flatnonzero(fit > _LEAST_VALUE)
        kept = kept[np.sort(np.argsort(-fit[kept], kind="stable")[:_MOST_STARTS])]
        voted = voted[_value(weigh_poses(voted, self._first, image, False)) > _LEAST_VALUE]
        return np.concatenate([near[kept], voted])

    def _silhouette_area(self, poses: np.ndarray) -> np.ndarray:
        """(k,) area of the model's silhouette at its distance, without occlusion, square metres."""
        direction = self._views.nearest_direction(poses)
        cosine = np.maximum(self._views.directions[direction] @ self._views.normals.T, 0.0)
        return (self._views.visible[direction] * cosine).sum(axis=1) * np.pi * self._views.spacing**2

    def _thin_out(self, poses: np.ndarray, value: np.ndarray, radius: float, most: int, quota: int) -> np.ndarray:
        radius *= self.model.diameter
        return poses[thin_out(poses, value, self._distance, radius, most=most, quota=quota)]


def _value(evidence: np.ndarray) -> np.ndarray:
    """(k,) net fit of poses, of the measured part of their visible surface, or of half of it if less is measured."""
    measured = np.maximum(1.0 - evidence[:, UNMEASURED], 0.5)
    return (evidence[:, FITTING] - _VIOLATION * evidence[:, VIOLATED]) / measured


def _one_a_cube(points: np.ndarray, usable: np.ndarray, spacing: float) -> np.ndarray:
    """Flat indices of usable pixels, about one for each cube of that edge in metres."""
    index = np.flatnonzero(usable)
    cell = np.floor(points.reshape(-1, 3)[index] / spacing).astype(np.int64)
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
