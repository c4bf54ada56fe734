"""Multi-view fusion: clusters the hypotheses of all views in the world; the best of each cluster is an object.

:func:`.cluster`, :func:`select` and :func:`project_features` keep no state, so that a training environment calls the
same functions on precomputed tables. :class:`SceneFusion` keeps the hypotheses of all views. The method is that of the
paper, "Multi-view hypotheses fusion" and "Objects feature representation".
"""

from dataclasses import dataclass

import numpy as np

from active6d_core.camera import PinholeCamera
from active6d_core.hypotheses import Hypotheses, SceneObjects
from active6d_core.object_model import ObjectModel
from active6d_core.se3 import invert
from active6d_perception.compiled import compiled
from active6d_perception.model.model_views import ModelViews, model_views
from active6d_perception.model.symmetric_distance import SymmetricDistance
from active6d_perception.scene.clustering import cluster
from active6d_perception.scene.hypothesis_table import HypothesisTable, confidence
from active6d_perception.scene.observed_surface import EXPLAINED_WITHIN
from active6d_perception.suppression import suppress_neighbours

#: How views are fused, the default first: all depth images together (:class:`.JointFusion`), or as in the paper, by the
#: best hypothesis of a single view (:class:`SceneFusion`).
METHODS = ("all-views", "best-view")
#: Ways to rank hypotheses, see :class:`FusionParameters`.
RANKINGS = ("evidence", "confidence", "verification", "score")


@dataclass(frozen=True)
class FusionParameters:
    """Settings of the fusion.

    Attributes:
        cut: clusters are merged while their mean distance is at most this fraction of the diameter.
        exclusion: of two objects whose origins are closer than this fraction of the diameter, only the better one is
            kept. Solid objects cannot share a centre, but a pose that is ambiguous in some views (a mug with a hidden
            handle) gives several clusters there. 0 keeps all.
        min_verification: hypotheses with a lower verification score are not used. The paper uses all: -1, the default.
        rank_by: the criterion for the best hypothesis of a cluster, and for the best of clusters at one place.
            ``verification`` is equation 1, as in the paper. ``score`` is the estimator's score.
            ``confidence`` is the product of both, because equation 1 cannot see everything: a mug with a hidden handle
            fits its pixels at every rotation. With these three a cluster is ranked by its best hypothesis, so that one
            overconfident wrong view can win. ``evidence`` takes the hypothesis with the highest confidence, and ranks
            clusters by the sum of their squared confidences, so that views which agree win.
        confirmed: objects with at least this probability count; the others are shown, and worth another view.
        least_probability: objects less probable than this are withdrawn. Only :class:`.JointFusion` withdraws.
        explained_within: an object explains surface at most this fraction of the diameter away, see
            :class:`~active6d_perception.scene.observed_surface.Explainer`.

    Raises:
        ValueError: a value is out of range.
    """

    cut: float = 0.2
    exclusion: float = 0.2
    min_verification: float = -1.0
    rank_by: str = "evidence"
    confirmed: float = 0.5
    least_probability: float = 0.02
    explained_within: float = EXPLAINED_WITHIN

    def __post_init__(self) -> None:
        if not self.cut > 0:
            raise ValueError(f"fusion: cut must be positive, got {self.cut}")
        if not self.exclusion >= 0:
            raise ValueError(f"fusion: exclusion must not be negative, got {self.exclusion}")
        if not -1 <= self.min_verification <= 1:
            raise ValueError(f"fusion: min_verification must be in [-1, 1], got {self.min_verification}")
        for name in ("confirmed", "least_probability"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"fusion: {name} must be in [0, 1], got {getattr(self, name)}")
        if not 0 < self.explained_within <= 1:
            raise ValueError(f"fusion: explained_within must be in (0, 1], got {self.explained_within}")
        if self.rank_by not in RANKINGS:
            raise ValueError(f"fusion: rank_by must be one of {', '.join(RANKINGS)}, got {self.rank_by!r}")


def select(labels: np.ndarray, weight: np.ndarray | None, positions: np.ndarray, exclusion: float) -> np.ndarray:
    """Select the best hypothesis of each cluster, without clusters that are too close to a better one.

    Args:
        labels: (k,) clusters of hypotheses in order of preference, each named by the index of its first hypothesis.
        weight: (k,) evidence of each hypothesis for its cluster; None ranks clusters by their best hypothesis.
        positions: (k, 3) of the hypotheses in the world, metres.
        exclusion: smallest distance between two objects, metres.

    Returns:
        (n,) indices of the selected hypotheses, best first.
    """
    best = np.flatnonzero(labels == np.arange(len(labels)))
    if weight is not None:
        best = best[np.argsort(-np.bincount(labels, weight)[best], kind="stable")]
    return best[suppress_neighbours(positions[best][None], np.ones((1, len(best)), bool), exclusion)[0]]


@compiled
def summarise(
    labels: np.ndarray, chosen: np.ndarray, stamps: np.ndarray, distance: np.ndarray, stamp: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute support, spread and current hypothesis of clusters.

    Args:
        labels: (k,) clusters of hypotheses in order of preference.
        chosen: (n,) index of one hypothesis in each of n clusters.
        stamps: (k,) stamps of the hypotheses' views, nanoseconds.
        distance: (k, k) between the hypotheses, metres.
        stamp: of the current view, nanoseconds.

    Returns:
        (n,) support: number of views with a hypothesis in the cluster; (n,) spread: largest distance within the
        cluster, metres; (n,) index of the cluster's best hypothesis from the current view, -1 without one.
    """
    support, spread, current = np.zeros(len(chosen), np.int64), np.zeros(len(chosen)), np.full(len(chosen), -1)
    for index in range(len(chosen)):
        members = np.flatnonzero(labels == labels[chosen[index]])
        for place in range(len(members)):
            member, known = members[place], False
            for earlier in members[:place]:
                known |= stamps[earlier] == stamps[member]
                spread[index] = max(spread[index], distance[earlier, member])
            support[index] += not known
            if stamps[member] == stamp and not known:
                current[index] = member
    return support, spread, current


def evidence(verification: np.ndarray, score: np.ndarray, parameters: FusionParameters) -> np.ndarray | None:
    """(k,) evidence of each hypothesis for its cluster; None if clusters are ranked by their best hypothesis."""
    return confidence(verification, score) ** 2 if parameters.rank_by == "evidence" else None


def preference(
    verification: np.ndarray, score: np.ndarray, T_world_object: np.ndarray, parameters: FusionParameters
) -> np.ndarray:
    """Order hypotheses by preference, and leave out those that are verified too badly.

    Args:
        verification: (k,) verification scores (equation 1).
        score: (k,) scores of the estimator.
        T_world_object: (k, 4, 4) poses in the world, metres.
        parameters: how to rank and what to leave out.

    Returns:
        (h,) indices, best first. Equal hypotheses are ordered by pose, so that the order of views does not matter.
    """
    worth = {"verification": verification, "score": score}.get(parameters.rank_by, confidence(verification, score))
    entries = T_world_object[:, :3].reshape(len(verification), 12)
    order = np.lexsort([*entries.T, -worth])
    return order[verification[order] >= parameters.min_verification]


def project_features(
    views: ModelViews, T_camera_object: np.ndarray, camera: PinholeCamera
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the box and depth of objects in a camera, as if nothing hid them.

    Args:
        views: the object's precomputed views.
        T_camera_object: (n, 4, 4) poses in the optical frame, metres.
        camera: intrinsics.

    Returns:
        (n, 4) boxes, normalised and clipped to the image, and (n,) mean depths of the visible surface, metres.
    """
    R, t = T_camera_object[:, :3, :3], T_camera_object[:, :3, 3]
    # Each coordinate is one contiguous row, which is several times faster than one row per point.
    points = (R.reshape(-1, 3) @ views.outline.T).reshape(len(R), 3, len(views.outline)) + t[..., None]
    ratio = points[:, :2] / np.maximum(points[:, 2:], 1e-3)
    # Pixel coordinates grow with the ratios, so that only the extremes are needed.
    least, most = ratio.min(axis=2), ratio.max(axis=2)
    focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx + 0.5, camera.cy + 0.5])
    size = np.array([camera.width, camera.height])
    box = ((focal * np.concatenate([least, most], axis=1).reshape(-1, 2, 2) + centre) / size).reshape(-1, 4)
    box = np.minimum(np.maximum(box, 0.0), 1.0)
    centroid = views.centroids[views.nearest_direction(T_camera_object)]
    return box, np.einsum("nj,nj->n", R[:, 2], centroid) + t[:, 2]


class SceneFusion:
    """Accumulates the hypotheses of views and computes the objects of the scene from them.

    Results depend on the set of views but not on their order. A view that is added twice counts once.
    """

    def __init__(self, model: ObjectModel, parameters: FusionParameters | None = None) -> None:
        self.parameters = parameters or FusionParameters()
        self._diameter = model.diameter
        self._views = model_views(model)
        self._known = HypothesisTable(SymmetricDistance(model).between)
        # Compile now, so that no view has to wait.
        nothing = np.zeros(0, np.int64)
        summarise(nothing, nothing, nothing, np.zeros((0, 0)), 0)
        suppress_neighbours(np.zeros((1, 0, 3)), np.zeros((1, 0), bool), 0.0)

    def reset(self) -> None:
        """Forget all views."""
        self._known.reset()

    def forget_before(self, stamp: int) -> None:
        """Forget the views that were added before the one of ``stamp`` (nanoseconds); all without that one."""
        self._known.forget_before(stamp)

    def add_view(
        self,
        stamp: int,
        T_world_camera: np.ndarray,
        hypotheses: Hypotheses,
        verification: np.ndarray,
        depth: np.ndarray | None = None,
        camera: PinholeCamera | None = None,
    ) -> bool:
        """Add the hypotheses of one view, see :meth:`.HypothesisTable.add_view`; fusion of all views also needs the
        depth image."""
        return self._known.add_view(stamp, T_world_camera, hypotheses, verification)

    def objects(self, stamp: int, T_world_camera: np.ndarray, camera: PinholeCamera) -> SceneObjects:
        """The objects of all views so far, best first, with features in one camera.

        An object with a hypothesis in view ``stamp`` has the box and depth of that hypothesis's mask; with several, of
        the preferred one. Box and depth of other objects are projected from their poses.

        Args:
            stamp: of the current view, nanoseconds.
            T_world_camera: (4, 4) pose of the current camera's optical frame, metres.
            camera: its intrinsics.
        """
        known = self._known
        order = preference(known.table[:, 0], known.table[:, 1], known.T_world_object, self.parameters)
        if not len(order):
            return SceneObjects.empty()
        T, table, stamps = known.T_world_object[order], known.table[order], known.stamp[order]
        distance = known.distances.take(order, axis=0).take(order, axis=1)
        labels = cluster(distance, self.parameters.cut * self._diameter)
        weight = evidence(table[:, 0], table[:, 1], self.parameters)
        chosen = select(labels, weight, T[:, :3, 3], self.parameters.exclusion * self._diameter)
        box, depth = project_features(self._views, invert(T_world_camera) @ T[chosen], camera)
        support, spread, seen = summarise(labels, chosen, stamps, distance, stamp)
        box[seen >= 0], depth[seen >= 0] = table[seen[seen >= 0], 2:6], table[seen[seen >= 0], 6]
        score = table[chosen, 1]
        nothing = np.zeros(len(chosen))
        return SceneObjects(T[chosen], table[chosen, 0], score, box, depth, support, spread, score, nothing)
