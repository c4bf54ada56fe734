"""Assignment of pixels to objects, by clustering the centres that the pixels vote for."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import cdist

from active6d_perception.suppression import suppress

_VOXEL = 0.06  # diameters
_BANDWIDTH = 0.07  # diameters, of the mean shift's Gaussian kernel
_SEED = 0.1  # diameters between the starting points of the mean shift
_MERGE = 0.2  # diameters: closer modes are one object; the centres of touching objects are farther apart
_REACH = 0.25  # diameters: a vote farther than this from every mode belongs to no object
_ITERATIONS = 12
_MOST_VOXELS = 1000  # enough for 40 objects; without a limit the votes of an untrained network would take minutes


@dataclass(frozen=True, eq=False)
class Clusters:
    """Clusters of votes.

    Attributes:
        centre: (n, 3) metres.
        label: (p,) index of the vote's cluster, -1 for none.
    """

    centre: np.ndarray
    label: np.ndarray


def cluster_votes(votes: np.ndarray, weight: np.ndarray, diameter: float, fewest: int = 12) -> Clusters:
    """Find the modes of votes for object centres, by mean shift.

    Votes are first summed up in voxels, so that the cost depends on the number of objects and not of pixels.

    Args:
        votes: (p, 3) centres that the pixels vote for, metres.
        weight: (p,) weight of each vote.
        diameter: the object's, metres.
        fewest: a cluster with fewer votes is dropped.
    """
    if len(votes) < fewest:
        return Clusters(np.zeros((0, 3)), np.full(len(votes), -1))
    cell = np.floor(votes / (_VOXEL * diameter)).astype(np.int64)
    cell -= cell.min(axis=0)
    _, voxel = np.unique(np.ravel_multi_index(cell.T, cell.max(axis=0) + 1), return_inverse=True)
    mass = np.bincount(voxel, weights=weight)
    points = np.stack([np.bincount(voxel, weights=weight * votes[:, i]) for i in range(3)], axis=1) / mass[:, None]
    heaviest = np.argsort(-mass, kind="stable")[:_MOST_VOXELS]
    points, mass = points[heaviest], mass[heaviest]
    density = _affinity(points, points, _BANDWIDTH * diameter) @ mass
    seeds = _separate(points, density, _SEED * diameter)
    modes, density = _mean_shift(seeds, points, mass, _BANDWIDTH * diameter)
    kept = _separate(modes, density, _MERGE * diameter)
    label = _nearest(votes, kept, _REACH * diameter)
    populated = np.bincount(label[label >= 0], minlength=len(kept)) >= fewest
    renumbered = np.append(np.where(populated, np.cumsum(populated) - 1, -1), -1)
    return Clusters(kept[populated], renumbered[label])


def _mean_shift(
    seeds: np.ndarray, points: np.ndarray, mass: np.ndarray, bandwidth: float
) -> tuple[np.ndarray, np.ndarray]:
    """(s, 3) modes that the seeds converge to, and the (s,) density of the weighted points there."""
    for _ in range(_ITERATIONS):
        affinity = _affinity(seeds, points, bandwidth) * mass
        seeds = affinity @ points / affinity.sum(axis=1, keepdims=True)
    return seeds, _affinity(seeds, points, bandwidth) @ mass


def _affinity(a: np.ndarray, b: np.ndarray, bandwidth: float) -> np.ndarray:
    return np.exp(cdist(a, b, "sqeuclidean") * (-0.5 / bandwidth**2))


def _separate(modes: np.ndarray, density: np.ndarray, distance: float) -> np.ndarray:
    """Densest modes first, each at least ``distance`` from those before it."""
    return modes[suppress(cdist(modes, modes, "sqeuclidean"), density, distance**2)]


def _nearest(votes: np.ndarray, centre: np.ndarray, reach: float) -> np.ndarray:
    """(p,) index of the nearest centre, -1 where none is within reach."""
    square = cdist(votes, centre, "sqeuclidean")
    nearest = square.argmin(axis=1)
    return np.where(square[np.arange(len(votes)), nearest] < reach**2, nearest, -1)
