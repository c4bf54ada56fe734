"""Greedy non-maximum suppression: of items closer together than a radius, only the best is kept.

:func:`suppress` works on one list and a table of distances, :func:`suppress_neighbours` on many lists of positions.
Fusion and the agent's training environment both call the latter, so that they keep the same objects.
"""

import numpy as np

from active6d_perception.compiled import compiled


def suppress(distance: np.ndarray, score: np.ndarray, radius: float) -> np.ndarray:
    """Greedy non-maximum suppression of one list, from a table of distances.

    Args:
        distance: (k, k) between the items, in any unit.
        score: (k,) higher is better; of equal scores the first item is better.
        radius: in the unit of ``distance``; of two items closer than this only the better one is kept.

    Returns:
        (n,) indices of the items kept, best first.
    """
    free = np.ones(len(score), bool)
    kept = []
    for index in np.argsort(-score, kind="stable"):
        if free[index]:
            kept.append(index)
            free &= distance[index] >= radius
    return np.array(kept, np.intp)


def suppress_neighbours(positions: np.ndarray, valid: np.ndarray, exclusion: float) -> np.ndarray:
    """Greedy non-maximum suppression of B lists at once, from positions.

    Args:
        positions: (B, n, 3) metres, best item first.
        valid: (B, n) bool, which items exist; the others are padding.
        exclusion: metres; an item closer than this to a better one that is kept is dropped.

    Returns:
        (B, n) bool, which items are kept.
    """
    kept = valid.copy()
    norm = (positions**2).sum(axis=-1)
    squared = norm[:, :, None] + norm[:, None] - 2.0 * positions @ np.swapaxes(positions, 1, 2)
    # Of equal positions, rounding may leave less than 0, which would be closer than an exclusion of 0.
    _drop(np.maximum(squared, 0.0) < exclusion**2, kept)
    return kept


@compiled
def _drop(close: np.ndarray, kept: np.ndarray) -> None:
    """Drop, in place, what is close to a better item that is kept; that is known in list order."""
    for b in range(len(kept)):
        for index in range(kept.shape[1]):
            for better in range(index):
                if close[b, index, better] and kept[b, better]:
                    kept[b, index] = False
                    break
