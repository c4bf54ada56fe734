"""Multi-view fusion: all hypotheses so far, clustered in the world; the best of each cluster is an object.

:func:`cluster`, :func:`select` and :func:`project_features` are pure and know nothing of messages or history, so a
training environment calls the same ones on precomputed tables. :class:`SceneFusion` keeps the history.
Paper, "Multi-view hypotheses fusion" and "Objects feature representation".
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

#: Ways to rank hypotheses, see :attr:`FusionParameters.rank_by`.
RANKINGS = ("evidence", "confidence", "verification", "score")


@dataclass(frozen=True)
class FusionParameters:
    """Settings of the fusion.

    Attributes:
        cut: clusters are cut where the distance between them exceeds this fraction of the diameter.
        exclusion: of two objects whose origins are closer than this fraction of the diameter only the better one
            stays: solid objects cannot share their centre, but a pose that is ambiguous in some views (a mug with its
            handle hidden) puts several clusters there. 0 keeps all.
        min_verification: objects verified worse are not reported; the paper reports all, so -1 by default.
        rank_by: which hypothesis of a cluster is best, and which of the clusters that claim one place. ``verification``
            is equation 1 alone, the paper's; ``score`` the estimator's score; ``confidence`` the product of both: the
            score knows of what equation 1 cannot see, since a mug fits its pixels whichever way its hidden handle
            points. With these three a cluster is as good as its best hypothesis, so among many views one that is
            wrong and sure of itself prevails. ``evidence`` takes the hypothesis of the highest confidence, and the
            cluster whose squared confidences have the largest sum: views that agree outvote the one.
        explained_within: surface at most this fraction of the diameter away from an object is that object's, see
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
    """The best of each cluster that shares its place with no better one.

    Args:
        labels: (k,) clusters of hypotheses in order of preference, best first; each named by its first.
        weight: (k,) what each hypothesis adds to its cluster's evidence; None ranks clusters by their best.
        positions: (k, 3) metres.
        exclusion: metres.

    Returns:
        (n,) indices, best first.
    """
    best = np.flatnonzero(labels == np.arange(len(labels)))
    if weight is not None:
        best = best[np.argsort(-np.bincount(labels, weight)[best], kind="stable")]
    return best[suppress_neighbours(positions[best][None], np.ones((1, len(best)), bool), exclusion)[0]]


@compiled
def summarise(
    labels: np.ndarray, chosen: np.ndarray, stamps: np.ndarray, distance: np.ndarray, stamp: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What the clusters of the chosen hypotheses consist of.

    Args:
        labels: (k,) clusters of hypotheses in order of preference.
        chosen: (n,) one hypothesis of each cluster in question.
        stamps: (k,) views that the hypotheses are from.
        distance: (k, k) metres.
        stamp: the current view.

    Returns:
        (n,) number of views with a hypothesis in the cluster, (n,) largest distance within it, and (n,) its best
        hypothesis from the current view, -1 without one.
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
    """(k,) from 0 to 2: equation 1, counted from -1, its least, times the estimator's score."""
    return (1.0 + verification) * score


def evidence(verification: np.ndarray, score: np.ndarray, parameters: FusionParameters) -> np.ndarray | None:
    """(k,) what each hypothesis adds to its cluster's evidence; None where a cluster is as good as its best."""
    return confidence(verification, score) ** 2 if parameters.rank_by == "evidence" else None


def preference(
    verification: np.ndarray, score: np.ndarray, T_world_object: np.ndarray, parameters: FusionParameters
) -> np.ndarray:
    """Hypotheses in the order in which fusion prefers them.

    Args:
        verification: (k,) equation 1.
        score: (k,) the estimator's.
        T_world_object: (k, 4, 4).
        parameters: how to rank, and what to leave out.

    Returns:
        (h,) indices, best first; ties by pose, so that the order of arrival never matters.
    """
    worth = {"verification": verification, "score": score}.get(parameters.rank_by, confidence(verification, score))
    entries = T_world_object[:, :3].reshape(len(verification), 12)
    order = np.lexsort([*entries.T, -worth])
    return order[verification[order] >= parameters.min_verification]


def project_features(
    views: ModelViews, T_camera_object: np.ndarray, camera: PinholeCamera
) -> tuple[np.ndarray, np.ndarray]:
    """Box and depth that objects would have in a camera if nothing hid them.

    Args:
        views: the object's precomputed views.
        T_camera_object: (n, 4, 4).
        camera: intrinsics.

    Returns:
        (n, 4) boxes, normalised and clipped to the image, and (n,) mean depths of the visible surface, metres.
    """
    R, t = T_camera_object[:, :3, :3], T_camera_object[:, :3, 3]
    # Coordinates before points, so that each is one contiguous row: several times faster than the other way round.
    points = (R.reshape(-1, 3) @ views.outline.T).reshape(len(R), 3, len(views.outline)) + t[..., None]
    ratio = points[:, :2] / np.maximum(points[:, 2:], 1e-3)
    # Pixels rise with the ratios, so that only the outermost need be computed.
    least, most = ratio.min(axis=2), ratio.max(axis=2)
    focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx + 0.5, camera.cy + 0.5])
    size = np.array([camera.width, camera.height])
    box = ((focal * np.concatenate([least, most], axis=1).reshape(-1, 2, 2) + centre) / size).reshape(-1, 4)
    box = np.minimum(np.maximum(box, 0.0), 1.0)
    centroid = views.centroids[views.nearest_direction(T_camera_object)]
    return box, np.einsum("nj,nj->n", R[:, 2], centroid) + t[:, 2]


class SceneFusion:
    """Accumulates the hypotheses of views and says what objects they amount to.

    Results depend on the set of views only, not on their order; a view that is known already adds nothing.
    """

    def __init__(self, model: ObjectModel, parameters: FusionParameters | None = None) -> None:
        self.parameters = parameters or FusionParameters()
        self._diameter = model.diameter
        self._distance = SymmetricDistance(model)
        self._views = model_views(model)
        self.reset()
        # Now, so that no view waits for the compiler.
        nothing = np.zeros(0, np.int64)
        summarise(nothing, nothing, nothing, np.zeros((0, 0)), 0)

    def reset(self) -> None:
        """Forget all views."""
        self._stamps: set[int] = set()
        self._stamp = np.zeros(0, np.int64)
        self._T_world_object = np.zeros((0, 4, 4))
        # The columns are verification and score, the four of the box, and depth.
        self._table = np.zeros((0, 7))
        self._distances = np.zeros((0, 0))

    def forget_before(self, stamp: int) -> None:
        """Forget the views older than ``stamp`` in nanoseconds."""
        kept = self._stamp >= stamp
        self._stamps = {known for known in self._stamps if known >= stamp}
        self._stamp, self._table = self._stamp[kept], self._table[kept]
        self._T_world_object = self._T_world_object[kept]
        self._distances = self._distances[np.ix_(kept, kept)]

    def add_view(
        self, stamp: int, T_world_camera: np.ndarray, hypotheses: Hypotheses, verification: np.ndarray
    ) -> bool:
        """Take in the hypotheses of one view.

        Args:
            stamp: nanoseconds; identifies the view.
            T_world_camera: (4, 4).
            hypotheses: k hypotheses.
            verification: (k,) their verification scores (equation 1).

        Returns:
            False when the view was known, and nothing was added.

        Raises:
            ValueError: another number of scores than of hypotheses.
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
        self._stamps.add(stamp)
        self._stamp = np.append(self._stamp, np.full(len(T), stamp))
        self._table = np.concatenate([self._table, row])
        return True

    def objects(self, stamp: int, T_world_camera: np.ndarray, camera: PinholeCamera) -> SceneObjects:
        """The accumulated objects, best first, with features in the camera of view ``stamp``.

        An object hypothesised in that view has the box and depth of its own mask there (of the best verified
        hypothesis in its cluster); for the others they are projected from the pose.
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
