"""Robust rigid transforms from correspondences with many outliers, for many objects at once."""

import numpy as np

from active6d_core.se3 import make_transform

_TRIPLETS = 48
_REWEIGHTINGS = 6


def kabsch(source: np.ndarray, target: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Rigid transforms that minimise the sum of ``w ||target - T source||^2`` (Kabsch).

    Args:
        source: (..., p, 3) points.
        target: (..., p, 3) corresponding points, in the same unit.
        weight: (..., p) weights w, not negative.

    Returns:
        (..., 4, 4) ``T_target_source``; rotations are proper, also for points in one plane.
    """
    share = (weight / np.maximum(weight.sum(axis=-1, keepdims=True), 1e-12))[..., None]
    mean_source, mean_target = (source * share).sum(axis=-2), (target * share).sum(axis=-2)
    covariance = np.swapaxes((target - mean_target[..., None, :]) * share, -1, -2) @ (
        source - mean_source[..., None, :]
    )
    U, _, Vt = np.linalg.svd(covariance)
    U[..., :, 2] *= np.sign(np.linalg.det(U) * np.linalg.det(Vt))[..., None]
    R = U @ Vt
    return make_transform(R, mean_target - (R @ mean_source[..., None])[..., 0])


def robust_fit(
    source: np.ndarray,
    target: np.ndarray,
    weight: np.ndarray,
    tolerance: float,
    rng: np.random.Generator,
    start: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Rigid transforms of n objects by random sampling (RANSAC), then iteratively reweighted least squares.

    Args:
        source: (n, p, 3) points in the object's canonical frame.
        target: (n, p, 3) the same points as measured, in the same unit.
        weight: (n, p) weight of each correspondence, 0 for padding.
        tolerance: in the unit of the points; a correspondence with this residual has half the weight.
        rng: random generator of the samples.
        start: (n, s, 4, 4) additional candidates; s may be 0.

    Returns:
        (n, 4, 4) ``T_target_source``, and (n,) the weighted share of correspondences that agree with it, in [0, 1].
    """
    objects = np.arange(len(source))[:, None, None]
    # Samples are drawn in proportion to the weights, by inverting their cumulative sum.
    cumulative = np.cumsum(weight, axis=1) / weight.sum(axis=1, keepdims=True)
    drawn = rng.random((len(source), 3 * _TRIPLETS))
    triplet = (cumulative[:, None, :] < drawn[..., None]).sum(axis=-1).clip(0, weight.shape[1] - 1)
    triplet = triplet.reshape(len(source), _TRIPLETS, 3)
    candidates = kabsch(source[objects, triplet], target[objects, triplet], np.ones(triplet.shape))
    candidates = np.concatenate([candidates, start], axis=1)
    agreement = _agreement(candidates, source[:, None], target[:, None], tolerance)
    best = np.einsum("nhp,np->nh", agreement, weight).argmax(axis=1)
    T = candidates[np.arange(len(source)), best]
    for _ in range(_REWEIGHTINGS):
        # The square of the Geman-McClure agreement is its weight in reweighted least squares.
        T = kabsch(source, target, weight * _agreement(T, source, target, tolerance) ** 2)
    return T, (weight * _agreement(T, source, target, tolerance)).sum(axis=1) / weight.sum(axis=1)


def _agreement(T: np.ndarray, source: np.ndarray, target: np.ndarray, tolerance: float) -> np.ndarray:
    """(..., p) in [0, 1]: 1 for an exact correspondence, 1/2 at the tolerance (Geman and McClure)."""
    residual = source @ np.swapaxes(T[..., :3, :3], -1, -2) + T[..., None, :3, 3] - target
    return 1 / (1 + np.einsum("...i,...i->...", residual, residual) / tolerance**2)
