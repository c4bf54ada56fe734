"""The hypotheses of all views in the world, with the distances between them."""

from collections.abc import Callable

import numpy as np

from active6d_core.hypotheses import Hypotheses
from active6d_perception.scene.fusion_parameters import FusionParameters

#: (n, 4, 4) and (m, 4, 4) poses in one frame to their (n, m) distances in metres.
Distance = Callable[[np.ndarray, np.ndarray], np.ndarray]
#: Hypotheses kept of all views, the best; 18 objects in 100 views have 1800. Without a limit an episode could use up
#: any time and memory.
MOST_HYPOTHESES = 2500


def confidence(verification: np.ndarray, score: np.ndarray) -> np.ndarray:
    """(k,) in [0, 2]: the verification score plus 1, times the estimator's score."""
    return (1.0 + verification) * score


class HypothesisTable:
    """Accumulates hypotheses view by view; a view that is added twice counts once.

    Attributes:
        stamps: of the views in the order of their arrival, nanoseconds.
        stamp: (h,) nanoseconds, of each hypothesis's view.
        T_world_object: (h, 4, 4) metres.
        table: (h, 7) verification score, score, box (4), depth.
        distances: (h, h) metres.
    """

    def __init__(self, distance: Distance) -> None:
        self._distance = distance
        self.reset()

    def reset(self) -> None:
        """Forget all views."""
        self.stamps: list[int] = []
        self.stamp = np.zeros(0, np.int64)
        self.T_world_object = np.zeros((0, 4, 4))
        self.table = np.zeros((0, 7))
        self.distances = np.zeros((0, 0))

    def forget_before(self, stamp: int) -> None:
        """Forget the views that were added before the one of ``stamp`` (nanoseconds); all without that one."""
        first = self.stamps.index(stamp) if stamp in self.stamps else len(self.stamps)
        self.stamps = self.stamps[first:]
        self._keep(np.flatnonzero(np.isin(self.stamp, self.stamps)))

    def _keep(self, kept: np.ndarray) -> None:
        """Keep the hypotheses at these indices."""
        self.stamp, self.table = self.stamp[kept], self.table[kept]
        self.T_world_object = self.T_world_object[kept]
        self.distances = self.distances[np.ix_(kept, kept)]

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
        if stamp in self.stamps:
            return False
        T = T_world_camera @ hypotheses.T_camera_object
        known = len(self.T_world_object)
        self.T_world_object = np.concatenate([self.T_world_object, T])
        distances = np.empty((len(self.T_world_object),) * 2)
        distances[:known, :known] = self.distances
        distances[known:] = self._distance(T, self.T_world_object)
        distances[:known, known:] = distances[known:, :known].T
        self.distances = distances
        row = np.column_stack([verification, hypotheses.score, hypotheses.box, hypotheses.depth])
        self.stamps.append(stamp)
        self.stamp = np.append(self.stamp, np.full(len(T), stamp))
        self.table = np.concatenate([self.table, row])
        if len(self.table) > MOST_HYPOTHESES:
            worth = confidence(self.table[:, 0], self.table[:, 1])
            self._keep(np.sort(np.argsort(-worth, kind="stable")[:MOST_HYPOTHESES]))
        return True


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
