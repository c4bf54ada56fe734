"""Candidates for the bodies in a scene: one for each cluster of hypotheses, and its near-symmetric twins."""

from dataclasses import dataclass, replace

import numpy as np

from active6d_core.se3 import transform_points
from active6d_perception.model.ambiguity import Ambiguity

#: Bodies whose middles are nearer than this exclude each other, fraction of :attr:`.Ambiguity.spacing`.
SAME_PLACE = 0.2
_DUPLICATE = 0.1  # refined bodies nearer than this are one, diameters
# Bodies of a place beyond the most evident ones are hardly ever right: with all 100 views there are many.
_MOST_BODIES = 4
# Of all places, the most evident ones: 15 mugs propose half as many with all 100 views. Without a limit, scattered
# hypotheses cost time that grows with their square.
_MOST_CLUSTERS = 200


@dataclass(frozen=True, eq=False)
class BodyCandidates:
    """K poses of bodies. Those of one place exclude each other.

    Attributes:
        T_world_object: (K, 4, 4) metres; the rotation about an axis of near symmetry is arbitrary.
        T_world_start: (K, 4, 4) where refinement started, metres.
        place: (K,) number of the place, from 0, by falling evidence of the first candidate there.
        evidence: (K,) sum of the squared confidences of the hypotheses for this body.
        twin: (K,) bool, no hypothesis was there, only for a near-symmetric twin.
    """

    T_world_object: np.ndarray
    T_world_start: np.ndarray
    place: np.ndarray
    evidence: np.ndarray
    twin: np.ndarray

    def take(self, index: np.ndarray) -> "BodyCandidates":
        """The candidates at ``index``, in that order."""
        poses = self.T_world_object[index], self.T_world_start[index]
        return BodyCandidates(*poses, self.place[index], self.evidence[index], self.twin[index])

    def heads(self) -> np.ndarray:
        """(places,) index of the candidate with the most evidence at each place."""
        order = np.lexsort([-self.evidence, self.place])
        return order[np.unique(self.place[order], return_index=True)[1]]


def gather_candidates(
    labels: np.ndarray, T_world_object: np.ndarray, evidence: np.ndarray, ambiguity: Ambiguity
) -> BodyCandidates:
    """The best hypothesis of each cluster, with its twins.

    Args:
        labels: (h,) clusters of hypotheses by body, each named by the index of its first hypothesis.
        T_world_object: (h, 4, 4) hypotheses of all views, best first, metres.
        evidence: (h,) of each hypothesis.
        ambiguity: of the object.
    """
    gathered = np.bincount(labels, evidence, len(labels))
    leaders = np.flatnonzero(labels == np.arange(len(labels)))
    leaders = leaders[np.argsort(-gathered[leaders], kind="stable")][:_MOST_CLUSTERS]
    T, gathered = T_world_object[leaders], gathered[leaders]
    place = number_places(transform_points(T, ambiguity.middle[None])[:, 0], SAME_PLACE * ambiguity.spacing)
    rank = _rank_within(place)
    kept = rank < _MOST_BODIES
    T, gathered, place, rank = T[kept], gathered[kept], place[kept], rank[kept]
    count = len(ambiguity.twins)
    T_twin = (T[None] @ ambiguity.twins[:, None]).reshape(-1, 4, 4)
    return BodyCandidates(
        T_twin,
        T_twin,
        np.tile(place, count),
        np.where(np.repeat(np.arange(count) > 0, len(T)), 0.0, np.tile(gathered, count)),
        np.repeat(np.arange(count) > 0, len(T)),
    )


def number_places(middles: np.ndarray, apart: float) -> np.ndarray:
    """(k,) place of each of (k, 3) middles, best first: that of the first better one nearer than ``apart`` metres."""
    place, heads = np.zeros(len(middles), int), np.zeros((0, 3))
    for index, middle in enumerate(middles):
        near = np.flatnonzero(np.linalg.norm(heads - middle, axis=1) < apart)
        place[index] = near[0] if len(near) else len(heads)
        if not len(near):
            heads = np.concatenate([heads, middle[None]])
    return place


def _rank_within(place: np.ndarray) -> np.ndarray:
    """(k,) how many earlier items have the same place."""
    order = np.argsort(place, kind="stable")
    first = np.searchsorted(place[order], place[order])
    rank = np.empty(len(place), int)
    rank[order] = np.arange(len(place)) - first
    return rank


def merge_duplicates(candidates: BodyCandidates, ambiguity: Ambiguity) -> BodyCandidates:
    """Candidates of one place that refinement made the same become the first of them, with their summed evidence."""
    T, place = candidates.T_world_object, candidates.place
    near = ambiguity.body_distance.between(T, T) < _DUPLICATE * ambiguity.diameter
    near &= place[:, None] == place
    kept: list[int] = []
    evidence = candidates.evidence.copy()
    for index in range(len(T)):
        same = [other for other in kept if near[other, index]]
        if same:
            evidence[same[0]] += evidence[index]
        else:
            kept.append(index)
    return replace(candidates, evidence=evidence).take(np.array(kept, np.intp))
