"""An object's solid as a grid of signed distances, to find overlaps and points on its surface."""

from typing import NamedTuple

import numpy as np
import open3d as o3d

from active6d_core.object_model import ObjectModel
from active6d_core.se3 import invert, transform_points
from active6d_perception.compiled import compiled
from active6d_perception.model.model_views import ray_caster

_CELL = 1 / 64  # diameters
_MARGIN = 4  # cells around the object


class Solid(NamedTuple):
    """Signed distances at the corners of the cells of a grid."""

    low: np.ndarray
    """(3,) first corner, object frame, metres"""
    cell: float
    """edge of a cell, metres"""
    distance: np.ndarray
    """(nx, ny, nz) float32 metres, negative inside"""
    reach: float
    """no solid point is farther than this from the object's origin, metres"""


def solid_of(model: ObjectModel, rotations: np.ndarray) -> Solid:
    """What is solid however the object is rotated.

    A neighbour whose rotation is not known excludes only this part: the body of a mug, without its handle.

    Args:
        model: the object.
        rotations: (r, 4, 4) ``T_object_rotated``; the solid is common to all of them.
    """
    cell = _CELL * model.diameter
    low, high = model.mesh.bounds
    shape = np.ceil((high - low) / cell).astype(int) + 1 + 2 * _MARGIN
    low = low - _MARGIN * cell
    corners = low + cell * np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1).reshape(-1, 3)
    scene = ray_caster(model.mesh, 1)
    distance = np.full(len(corners), -np.inf, np.float32)
    for T in invert(rotations):
        rotated = o3d.core.Tensor(transform_points(T, corners).astype(np.float32))
        distance = np.maximum(distance, scene.compute_signed_distance(rotated).numpy())
    inside = corners[distance <= 0]
    reach = float(np.linalg.norm(inside, axis=1).max(initial=0.0)) + cell
    return Solid(low, cell, distance.reshape(shape), reach)


@compiled
def signed_distances(points: np.ndarray, solid: Solid) -> np.ndarray:
    """(n,) signed distances of (n, 3) points in the object frame, metres; ``inf`` outside of the grid."""
    result = np.full(len(points), np.inf)
    d, (nx, ny, nz) = solid.distance, solid.distance.shape
    for index in range(len(points)):
        i = (points[index, 0] - solid.low[0]) / solid.cell
        j = (points[index, 1] - solid.low[1]) / solid.cell
        k = (points[index, 2] - solid.low[2]) / solid.cell
        if not (0 <= i < nx - 1 and 0 <= j < ny - 1 and 0 <= k < nz - 1):
            continue
        a, b, c = int(i), int(j), int(k)
        u, v, w = i - a, j - b, k - c
        near = (d[a, b, c] * (1 - w) + d[a, b, c + 1] * w) * (1 - v)
        near += (d[a, b + 1, c] * (1 - w) + d[a, b + 1, c + 1] * w) * v
        a += 1
        far = (d[a, b, c] * (1 - w) + d[a, b, c + 1] * w) * (1 - v)
        far += (d[a, b + 1, c] * (1 - w) + d[a, b + 1, c + 1] * w) * v
        result[index] = near * (1 - u) + far * u
    return result
