"""Upper bounds: searches for views that know the ground truth."""

import numpy as np

from active6d_agent.bank.scene_lookup import SceneLookup
from active6d_core.metrics import DETECTION_FRACTION, MISSED_E_ADD

# Candidates scored in one call: enough to be fast, few enough to stay in memory.
_CHUNK = 4096


def known(lookup: SceneLookup, scene: np.ndarray, views: np.ndarray, certainty: float = 0.0) -> np.ndarray:
    """What is known of every true object after some views.

    Args:
        lookup: of the bank.
        scene: (E,) indices.
        views: (E, v) taken, -1 padding.
        certainty: share of a detection that counts only with the probability of the detected pose.

    Returns:
        (E, o, 2): 1 if the object is detected, with ``certainty`` less where its probability is below 1; and
        1 - ADD / 50 mm. Zeros beyond a scene's own objects.
    """
    parts = []
    for start in range(0, len(scene), _CHUNK):
        part = slice(start, start + _CHUNK)
        fused = lookup.fuse(scene[part], views[part], views[part, -1])
        right = lookup.pair_errors(fused) < DETECTION_FRACTION * lookup.model.diameter
        worth = np.where(right, 1.0 - certainty * (1.0 - fused.probability[..., None]), 0.0)
        errors = lookup.object_errors(fused)
        real = np.arange(errors.shape[1]) < lookup.object_count[scene[part]][:, None]
        parts.append(np.stack([real * worth.max(axis=1, initial=0.0), real * (1.0 - errors / MISSED_E_ADD)], axis=-1))
    return np.concatenate(parts)


def tally(lookup: SceneLookup, scene: np.ndarray, views: np.ndarray) -> np.ndarray:
    """(E, 2) the sums of :func:`known` over the objects."""
    return known(lookup, scene, views).sum(axis=1)


def worth(lookup: SceneLookup, scene: np.ndarray, views: np.ndarray) -> np.ndarray:
    """(E,) number of objects detected after (E, v) views, plus less than one for a small mean error."""
    detected, closeness = tally(lookup, scene, views).T
    return detected + 0.999 * closeness / lookup.object_count[scene]


def search_views(
    lookup: SceneLookup, scene: int, start: int, steps: int, *, width: int = 1, allowed: np.ndarray | None = None
) -> np.ndarray:
    """The best views that a search with the ground truth finds, greedy or with a beam.

    Args:
        lookup: of the bank.
        scene: index of the scene.
        start: first view.
        steps: moves T.
        width: of the beam; 1 is the greedy oracle.
        allowed: (M,) bool, views in reach, all when None.

    Returns:
        (T + 1,) views in the order in which they were chosen, fewer where no view is left.
    """
    allowed = np.ones(len(lookup.sphere), bool) if allowed is None else allowed
    beam = np.array([[start]])
    for _ in range(steps):
        free = np.tile(allowed, (len(beam), 1))
        free[np.arange(len(beam))[:, None], beam] = False
        parent, view = np.nonzero(free)
        if not len(view):
            break
        paths = np.column_stack([beam[parent], view])
        # Order does not change the value of a set of views.
        paths = paths[np.unique(np.sort(paths, axis=1), axis=0, return_index=True)[1]]
        value = worth(lookup, np.full(len(paths), scene), paths)
        beam = paths[np.argsort(-value, kind="stable")[:width]]
    return beam[0]
