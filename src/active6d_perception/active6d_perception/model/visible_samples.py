"""Few samples of a model's surface per view direction, as tables for compiled loops."""

from typing import NamedTuple

import numpy as np

from active6d_perception.compiled import compiled
from active6d_perception.model.model_views import ModelViews

# Cells along each side of the map from directions to the nearest precomputed one: 3 degrees, directions are 9 apart.
_MAP = 64


class VisibleSamples(NamedTuple):
    """Samples of part of a model's surface that a camera sees from each of m directions."""

    points: np.ndarray
    """(s, 3) float32 samples of the surface, object frame, metres"""
    normals: np.ndarray
    """(s, 3) float32 outward unit normals"""
    chosen: np.ndarray
    """(m, c) the samples visible from a direction"""
    number: np.ndarray
    """(m,) how many of the c are used"""
    area: np.ndarray
    """(m,) float32 surface that a sample stands for, square metres"""
    nearest: np.ndarray
    """(g, g) direction nearest to the middle of each cell of an octahedral map, see :func:`nearest_direction`"""


def visible_samples(views: ModelViews, part: np.ndarray, count: int, area: float) -> VisibleSamples:
    """At most ``count`` visible samples per direction, evenly spaced.

    Args:
        views: the object's precomputed views.
        part: (s,) bool, the samples of ``views`` to choose from.
        count: largest number per direction.
        area: of the whole surface, square metres.
    """
    index = np.zeros((len(views.directions), count), np.int64)
    used, areas = np.zeros(len(index), np.int64), np.zeros(len(index), np.float32)
    for row, visible in enumerate(views.visible):
        seen = np.flatnonzero(visible & part)
        used[row] = min(count, len(seen))
        index[row, : used[row]] = seen[np.linspace(0, len(seen) - 1, used[row]).astype(np.intp)]
        areas[row] = area / len(views.points) * len(seen) / max(used[row], 1)
    return VisibleSamples(views.points, views.normals, index, used, areas, _direction_map(views.directions))


def _direction_map(directions: np.ndarray) -> np.ndarray:
    middles = (np.arange(_MAP) + 0.5) * 2 / _MAP - 1
    x, y = np.meshgrid(middles, middles, indexing="ij")
    z = 1 - np.abs(x) - np.abs(y)
    # The lower half of the octahedron is folded over the outer triangles of the square.
    folded_x, folded_y = (1 - np.abs(y)) * np.copysign(1.0, x), (1 - np.abs(x)) * np.copysign(1.0, y)
    ray = np.stack([np.where(z < 0, folded_x, x), np.where(z < 0, folded_y, y), z], axis=-1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    return (ray.reshape(-1, 3) @ directions.T).argmax(axis=1).reshape(_MAP, _MAP)


@compiled
def nearest_direction(x: float, y: float, z: float, nearest: np.ndarray) -> int:
    """The direction nearest to (x, y, z), of any length but not 0, up to the width of a cell of the map."""
    total = abs(x) + abs(y) + abs(z)
    u, v = x / total, y / total
    if z < 0:
        u, v = (1 - abs(v)) * np.copysign(1.0, u), (1 - abs(u)) * np.copysign(1.0, v)
    size = nearest.shape[0]
    row, column = int((u + 1) * (0.5 * size)), int((v + 1) * (0.5 * size))
    return nearest[min(max(row, 0), size - 1), min(max(column, 0), size - 1)]


@compiled
def direction_of(T: np.ndarray, nearest: np.ndarray) -> int:
    """The precomputed direction in which the camera lies, for a (4, 4) pose in the optical frame."""
    x = -(T[0, 0] * T[0, 3] + T[1, 0] * T[1, 3] + T[2, 0] * T[2, 3])
    y = -(T[0, 1] * T[0, 3] + T[1, 1] * T[1, 3] + T[2, 1] * T[2, 3])
    z = -(T[0, 2] * T[0, 3] + T[1, 2] * T[1, 3] + T[2, 2] * T[2, 3])
    return nearest_direction(x, y, z, nearest)
