"""The paper's fusion: clusters the hypotheses of all views in the world; the best of each cluster is an object.

:func:`.cluster` and :func:`select` keep no state, so that a training environment calls the same functions on
precomputed tables. The method is that of the paper, "Multi-view hypotheses fusion".
"""

import numpy as np

from active6d_core.camera import PinholeCamera
from active6d_core.hypotheses import Hypotheses, SceneObjects
from active6d_core.object_model import ObjectModel
from active6d_core.se3 import invert
from active6d_perception.compiled import compiled
from active6d_perception.model.length_scale import spacing
from active6d_perception.model.model_views import model_views
from active6d_perception.model.symmetric_distance import SymmetricDistance
from active6d_perception.scene.clustering import cluster
from active6d_perception.scene.fusion_parameters import FusionParameters
from active6d_perception.scene.hypothesis_table import HypothesisTable, evidence, preference
from active6d_perception.scene.object_features import project_features
from active6d_perception.suppression import suppress_neighbours


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


class BestViewFusion:
    """Accumulates the hypotheses of views and computes the objects of the scene from them.

    Results depend on the set of views but not on their order. A view that is added twice counts once.
    """

    def __init__(self, model: ObjectModel, parameters: FusionParameters | None = None) -> None:
        self.parameters = parameters or FusionParameters()
        self._spacing = spacing(model)
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
        labels = cluster(distance, self.parameters.cut * self._spacing)
        weight = evidence(table[:, 0], table[:, 1], self.parameters)
        chosen = select(labels, weight, T[:, :3, 3], self.parameters.exclusion * self._spacing)
        box, depth = project_features(self._views, invert(T_world_camera) @ T[chosen], camera)
        support, spread, seen = summarise(labels, chosen, stamps, distance, stamp)
        box[seen >= 0], depth[seen >= 0] = table[seen[seen >= 0], 2:6], table[seen[seen >= 0], 6]
        score = table[chosen, 1]
        nothing = np.zeros(len(chosen))
        return SceneObjects(T[chosen], table[chosen, 0], score, box, depth, support, spread, score, nothing)
