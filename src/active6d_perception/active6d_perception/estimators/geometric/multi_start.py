"""Many starting poses near the measured surface, and a selection of distinct poses among many.

Every start puts a point of the model onto a measured point, with its normal along the measured one.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from active6d_core.se3 import invert
from active6d_perception.model.model_views import ModelViews
from active6d_perception.model.symmetric_distance import SymmetricDistance


def surface_frames(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(n, 4, 4) frames at (n, 3) points with z along (n, 3) unit normals."""
    helper = np.where(np.abs(normals[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    x = np.cross(helper, normals)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    T = np.tile(np.eye(4), (len(points), 1, 1))
    T[:, :3, 0], T[:, :3, 1], T[:, :3, 2], T[:, :3, 3] = x, np.cross(normals, x), normals, points
    return T


class Starts:
    """Starting poses at a measured surface.

    Args:
        views: of the model.
        places: points of the model that are put onto a measured point.
        angles: rotations about the normal tried for each.
    """

    def __init__(self, views: ModelViews, places: int = 40, angles: int = 8) -> None:
        seen = np.flatnonzero(views.visible.any(axis=0))
        points, normals = views.points[seen].astype(float), views.normals[seen].astype(float)
        # Spread over places and normals together: a thin wall has two sides.
        chosen = _farthest_points(np.hstack([points / np.ptp(points, axis=0).max(), 0.35 * normals]), places)
        turns = np.tile(np.eye(4), (angles, 1, 1))
        about_z = Rotation.from_rotvec(np.outer(np.arange(angles) * 2 * np.pi / angles, [0.0, 0.0, 1.0]))
        turns[:, :3, :3] = about_z.as_matrix()
        frames = surface_frames(points[chosen], normals[chosen])
        self._T_start_object = (turns[None] @ invert(frames)[:, None]).reshape(-1, 4, 4)

    def at(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """(n, starts, 4, 4) ``T_camera_object`` at (n, 3) measured points with (n, 3) unit normals."""
        return surface_frames(points, normals)[:, None] @ self._T_start_object[None]


def thin_out(
    T: np.ndarray, value: np.ndarray, distance: SymmetricDistance, radius: float, *, most: int, quota: int
) -> np.ndarray:
    """Indices of the best poses, best first: none near a better one, and few at each place.

    Args:
        T: (k, 4, 4).
        value: (k,) higher is better.
        distance: between poses.
        radius: metres, least distance between two kept poses.
        most: kept at most.
        quota: poses kept at most whose origins are within two radii of each other.
    """
    free, crowd, kept = np.ones(len(T), bool), np.zeros(len(T), int), []
    positions = np.ascontiguousarray(T[:, :3, 3])
    for index in np.argsort(-value, kind="stable"):
        if not free[index] or crowd[index] >= quota:
            continue
        kept.append(index)
        if len(kept) == most:
            break
        apart = np.linalg.norm(positions - positions[index], axis=1)
        crowd += apart < 2 * radius
        # No pose is nearer than its points on average; far poses need no comparison.
        near = np.flatnonzero(free & (apart < 2 * radius))
        free[near[distance.between(T[near], T[index][None])[:, 0] < radius]] = False
    return np.array(kept, np.intp)


def _farthest_points(points: np.ndarray, count: int) -> np.ndarray:
    """Indices of ``count`` of (n, d) points, each the farthest from those before."""
    chosen = [0]
    apart = np.linalg.norm(points - points[0], axis=1)
    for _ in range(min(count, len(points)) - 1):
        chosen.append(int(apart.argmax()))
        apart = np.minimum(apart, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.array(chosen)
