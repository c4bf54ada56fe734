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
from active6d_perception.scene.observed_surface import EXPLAINED_WITHIN
from active6d_perception.suppression import suppress_neighbours

#: Hypotheses kept of all views, the best; 18 objects in 100 views have 1800. Without a limit an episode could use up
#: any time and memory.
MOST_HYPOTHESES = 2500

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
        explained_within: an object explains surface at most this fraction of the diameter away, see
            :class:`~active6d_perception.scene.observed_surface.Explainer`.

    Raises:
        ValueError: a value is out of range.
    """

    cut: float = 0.2
    exclusion: float = 0.2
    min_verification: float = -1.0
    rank_by: str = "evidence"
    explained_within: float = EXPLAINED_WITHIN

    def __post_init__(self) -> None:
        if not self.cut > 0:
            raise ValueError(f"fusion: cut must be positive, got {self.cut}")
        if not self.exclusion >= 0:
            raise ValueError(f"fusion: exclusion must not be negative, got {self.exclusion}")
        if not -1 <= self.min_verification <= 1:
            raise ValueError(f"fusion: min_verification must be in [-1, 1], got {self.min_verification}")
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


def confidence(verification: np.ndarray, score: np.ndarray) -> np.ndarray:
    """(k,) in [0, 2]: the verification score plus 1, times the estimator's score."""
    return (1.0 + verification) * score


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
        self._distance = SymmetricDistance(model)
        self._views = model_views(model)
        self.reset()
        # Compile now, so that no view has to wait.
        nothing = np.zeros(0, np.int64)
        summarise(nothing, nothing, nothing, np.zeros((0, 0)), 0)

    def reset(self) -> None:
        """Forget all views."""
        self._stamps: list[int] = []
        self._stamp = np.zeros(0, np.int64)
        self._T_world_object = np.zeros((0, 4, 4))
        # Columns: verification, score, box (4), depth.
        self._table = np.zeros((0, 7))
        self._distances = np.zeros((0, 0))

    def forget_before(self, stamp: int) -> None:
        """Forget the views that were added before the one of ``stamp`` (nanoseconds); all without that one."""
        first = self._stamps.index(stamp) if stamp in self._stamps else len(self._stamps)
        self._stamps = self._stamps[first:]
        self._keep(np.flatnonzero(np.isin(self._stamp, self._stamps)))

    def _keep(self, kept: np.ndarray) -> None:
        """Keep the hypotheses at these indices."""
        self._stamp, self._table = self._stamp[kept], self._table[kept]
        self._T_world_object = self._T_world_object[kept]
        self._distances = self._distances[np.ix_(kept, kept)]

    def add_view(
        self, stamp: int, T_world_camera: np.ndarray, hypotheses: Hypotheses, verification: np.ndarray
    ) -> bool:
        """Add the hypotheses of one view.

        Args:
            stamp: nanoseconds; identifies the view.
            T_world_camera: (4, 4) pose of the optical frame, metres.
            hypotheses: k hypotheses.
            verification: (k,) verification scores of the hypotheses (equation 1).

        Returns:
            False if the view had been added before, and nothing has changed.

        Raises:
            ValueError: the numbers of scores and hypotheses differ.
        """
        if len(verification) != len(hypotheses):
            raise ValueError(f"fusion: {len(verification)} verification scores for {len(hypotheses)} hypotheses")
        if stamp in self._stamps:
            return False
        T = T_world_camera @ hypotheses.T_camera_object
        known = len(self._T_world_object)
        self._T_world_object = np.concatenate([self._T_world_object, T])
        distances = np.empty((len(self._T_world_object),) * 2)
        distances[:known, :known] = self._distances
        distances[known:] = self._distance.between(T, self._T_world_object)
        distances[:known, known:] = distances[known:, :known].T
        self._distances = distances
        row = np.column_stack([verification, hypotheses.score, hypotheses.box, hypotheses.depth])
        self._stamps.append(stamp)
        self._stamp = np.append(self._stamp, np.full(len(T), stamp))
        self._table = np.concatenate([self._table, row])
        if len(self._table) > MOST_HYPOTHESES:
            worth = confidence(self._table[:, 0], self._table[:, 1])
            self._keep(np.sort(np.argsort(-worth, kind="stable")[:MOST_HYPOTHESES]))
        return True

    def objects(self, stamp: int, T_world_camera: np.ndarray, camera: PinholeCamera) -> SceneObjects:
        """The objects of all views so far, best first, with features in one camera.

        An object with a hypothesis in view ``stamp`` has the box and depth of that hypothesis's mask; with several, of
        the preferred one. Box and depth of other objects are projected from their poses.

        Args:
            stamp: of the current view, nanoseconds.
            T_world_camera: (4, 4) pose of the current camera's optical frame, metres.
            camera: its intrinsics.
        """
        order = preference(self._table[:, 0], self._table[:, 1], self._T_world_object, self.parameters)
        if not len(order):
            return SceneObjects.empty()
        T, table, stamps = self._T_world_object[order], self._table[order], self._stamp[order]
        distance = self._distances.take(order, axis=0).take(order, axis=1)
        labels = cluster(distance, self.parameters.cut * self._diameter)
        weight = evidence(table[:, 0], table[:, 1], self.parameters)
        chosen = select(labels, weight, T[:, :3, 3], self.parameters.exclusion * self._diameter)
        box, depth = project_features(self._views, invert(T_world_camera) @ T[chosen], camera)
        support, spread, seen = summarise(labels, chosen, stamps, distance, stamp)
        box[seen >= 0], depth[seen >= 0] = table[seen[seen >= 0], 2:6], table[seen[seen >= 0], 6]
        return SceneObjects(T[chosen], table[chosen, 0], table[chosen, 1], box, depth, support, spread)
