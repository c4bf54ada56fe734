"""Distributions of a direction over bins that are spread evenly on the sphere."""

import numpy as np

from active6d_perception.estimators.dense.network import DIRECTION_BINS

#: Concentration of the kernel: about 13 degrees, half of the distance between neighbouring bins.
_CONCENTRATION = 20.0


def _fibonacci_sphere(count: int) -> np.ndarray:
    """(count, 3) float32 unit vectors, evenly spread on a spiral from pole to pole."""
    index = np.arange(count) + 0.5
    polar, azimuth = np.arccos(1 - 2 * index / count), np.pi * (1 + 5**0.5) * index
    points = np.stack([np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)], axis=1)
    return points.astype(np.float32)


#: (DIRECTION_BINS, 3) unit vectors, the centres of the bins.
CENTRES = _fibonacci_sphere(DIRECTION_BINS)


def kernel(directions: np.ndarray) -> np.ndarray:
    """Distributions concentrated on (..., 3) unit vectors: (..., DIRECTION_BINS) float32 shares that sum to 1."""
    share = np.exp(_CONCENTRATION * (directions.astype(np.float32) @ CENTRES.T - 1))
    return share / share.sum(axis=-1, keepdims=True)


def density(probability: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Probability of directions under distributions over the bins.

    Args:
        probability: (n, DIRECTION_BINS).
        directions: (n, m, 3) unit vectors.

    Returns:
        (n, m), each row summing to 1.
    """
    value = np.einsum("nb,nmb->nm", probability, kernel(directions))
    return value / np.maximum(value.sum(axis=1, keepdims=True), 1e-12)
