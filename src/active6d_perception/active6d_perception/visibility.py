"""How much of every known object a camera would see from places where it has not been.

Objects hide each other. For a few points of each object's outline as a view sees it, the silhouettes of the objects
between say whether they are hidden there. Silhouettes are looked up among those of directions all around the model,
which takes a small part of the time that rendering a hundred views would.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import open3d as o3d
import trimesh
from scipy.cluster.vq import kmeans2

from active6d_core.object_model import ObjectModel
from active6d_perception.model_views import ray_caster

_SUBDIVISIONS = 2  # of an icosahedron: 162 directions
_PIXELS = 24  # across a silhouette
# Points of an object that are looked for.
_POINTS = 10
# Farther off the ray than this, in reaches of the model from its origin, no object hides much of another.
_SIDEWAYS = 1.5
# Nothing closer in front of a point than this fraction of the diameter hides it: poses are not exact.
_CLEARANCE = 0.02


@lru_cache(maxsize=16)
def expected_visibility(model: ObjectModel) -> "ExpectedVisibility":
    """That of ``model``, made once per process."""
    return ExpectedVisibility(model)


class Tray(NamedTuple):
    """Walls around the world's origin, metres."""

    width: float
    """between the inner walls, along world x and y"""
    wall_height: float
    """above the floor at z = 0"""

    @classmethod
    def for_model(cls, model: ObjectModel) -> "Tray":
        """The bin that an object's heap usually lies in."""
        return cls(model.bin_width, model.wall_height)


def walled(points: np.ndarray, eyes: np.ndarray, tray: Tray | None) -> np.ndarray:
    """(k, V, p) bool, whether the rays from (3, k, V, p) points to (V, 3) eyes leave the tray through a wall."""
    if tray is None:
        return np.zeros(points.shape[1:], bool)
    x, y, z = eyes.T[:, None, :, None] - points
    # Along the ray, from 0 at the point to 1 at the eye.
    leaves = [
        (0.5 * tray.width - np.copysign(1.0, ray) * start) / np.maximum(np.abs(ray), 1e-9)
        for ray, start in ((x, points[0]), (y, points[1]))
    ]
    return points[2] + np.minimum(*leaves) * z < tray.wall_height


class _Stand(NamedTuple):
    """Objects as V eyes see them."""

    centres: np.ndarray
    """(n, 3) world"""
    rays: np.ndarray
    """(n, V, 3) unit vectors to the eyes, world"""
    distance: np.ndarray
    """(n, V) to the eyes, metres"""
    right: np.ndarray
    """(n, V, 3) unit vectors along the silhouette's rows, world"""
    nearest: np.ndarray
    """(n, V) index of the precomputed direction"""


class ExpectedVisibility:
    """Shares of posed objects that views would see past the other objects.

    Args:
        model: the object that all poses are of.
    """

    def __init__(self, model: ObjectModel) -> None:
        mesh = model.mesh
        self._reach = float(np.linalg.norm(mesh.vertices, axis=1).max())
        self._clearance = _CLEARANCE * model.diameter
        directions = np.asarray(trimesh.creation.icosphere(_SUBDIVISIONS).vertices)
        up = np.where(np.abs(directions[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
        right = np.cross(up, directions)
        right /= np.linalg.norm(right, axis=1, keepdims=True)
        frames = np.stack([right, np.cross(directions, right), directions], axis=1)
        front = self._look_from(mesh, frames)
        self._directions = directions.astype(np.float32)
        self._right = right.astype(np.float32)
        # (m, pixels, pixels): how far towards the eye the surface comes, -inf beside the silhouette.
        self._front = front.astype(np.float32)
        # (3, m, p): points of each direction's outline, in the object's frame.
        points = [self._spread_points(*pair) for pair in zip(frames, front, strict=True)]
        self._points = np.ascontiguousarray(np.moveaxis(points, -1, 0))

    def _look_from(self, mesh: trimesh.Trimesh, frames: np.ndarray) -> np.ndarray:
        scene = ray_caster(mesh)
        eyes = np.stack(np.meshgrid(self._pixel_centres, self._pixel_centres, [2 * self._reach], indexing="ij"), -1)
        origins = eyes.reshape(-1, 3) @ frames
        rays = np.concatenate([origins, np.broadcast_to(-frames[:, 2:], origins.shape)], axis=-1)
        hit = scene.cast_rays(o3d.core.Tensor(rays.astype(np.float32)))["t_hit"].numpy()
        return (2 * self._reach - hit).reshape(-1, _PIXELS, _PIXELS)

    @property
    def _pixel_centres(self) -> np.ndarray:
        return ((np.arange(_PIXELS) + 0.5) / _PIXELS * 2 - 1) * self._reach

    def _spread_points(self, frame: np.ndarray, front: np.ndarray) -> np.ndarray:
        """(p, 3) points of the visible surface, spread evenly over the silhouette, object frame."""
        pixels = np.argwhere(np.isfinite(front))
        centres = kmeans2(pixels.astype(float), _POINTS, minit="++", seed=0)[0]
        row, column = pixels[((pixels[:, None] - centres) ** 2).sum(axis=-1).argmin(axis=0)].T
        seen = np.column_stack([self._pixel_centres[row], self._pixel_centres[column], front[row, column]])
        return (seen @ frame).astype(np.float32)

    def shares(
        self, T_world_object: np.ndarray, eyes: np.ndarray, tray: Tray | None = None, hiding: int | None = None
    ) -> np.ndarray:
        """What the eyes would see of the objects.

        Args:
            T_world_object: (n, 4, 4), world, metres.
            eyes: (V, 3) positions of cameras, world, metres, outside the objects.
            tray: that all of it lies in, None for an open table.
            hiding: only the first so many objects hide others, all when None.

        Returns:
            (n, V) in [0, 1]: share of each object's silhouette that no other object and no wall hides.
        """
        eyes = np.asarray(eyes, np.float32)
        stand = self._stand(T_world_object, eyes)
        n, V = stand.nearest.shape
        points = self._points[:, stand.nearest].transpose(1, 0, 2, 3).reshape(n, 3, V * _POINTS)
        points = T_world_object[:, :3, :3].astype(np.float32) @ points + stand.centres[..., None]
        # Coordinates first, so that each is one long row.
        points = np.ascontiguousarray(points.transpose(1, 0, 2)).reshape(3, n, V, _POINTS)
        hidden = walled(points, eyes, tray)
        self._hide(hidden, points, stand, n if hiding is None else hiding)
        return 1.0 - hidden.mean(axis=-1)

    def _stand(self, T_world_object: np.ndarray, eyes: np.ndarray) -> "_Stand":
        R = T_world_object[:, :3, :3].astype(np.float32)
        centres = T_world_object[:, :3, 3].astype(np.float32)
        rays = eyes - centres[:, None]
        distance = np.linalg.norm(rays, axis=-1)
        rays /= distance[..., None]
        nearest = ((rays @ R).reshape(-1, 3) @ self._directions.T).argmax(axis=1).reshape(distance.shape)
        # The silhouette is that of the nearest direction, its place in the world is the eye's own: what lies far behind
        # would be shifted otherwise.
        right = self._right[nearest] @ R.transpose(0, 2, 1)
        right -= (right * rays).sum(axis=-1, keepdims=True) * rays
        right /= np.linalg.norm(right, axis=-1, keepdims=True)
        return _Stand(centres, rays, distance, right, nearest)

    def _hide(self, hidden: np.ndarray, points: np.ndarray, stand: "_Stand", hiding: int) -> None:
        """Set (n, V, p) ``hidden`` where one of the first ``hiding`` objects hides (3, n, V, p) points of another."""
        n, V, p = hidden.shape
        apart = stand.centres[:hiding] - stand.centres[:, None]
        along = apart @ stand.rays.transpose(0, 2, 1)
        beside = (apart**2).sum(axis=-1)[..., None] - along**2
        may_hide = (along > 0) & (beside < (_SIDEWAYS * self._reach) ** 2)
        target, view, hider = np.nonzero(may_hide.transpose(0, 2, 1))
        pair, image = target * V + view, hider * V + view
        x, y, z = points.reshape(3, n * V, p)[:, pair] - stand.centres[hider].T[..., None]
        right, towards = (axes.reshape(-1, 3)[image].T[..., None] for axes in (stand.right, stand.rays))
        up = np.cross(towards, right, axis=0)
        across, along, nearer = (x * axis[0] + y * axis[1] + z * axis[2] for axis in (right, up, towards))
        eye = stand.distance.ravel()[image][:, None]
        scale = (_PIXELS / (2 * self._reach)) * eye / (eye - nearer)
        row, column = across * scale + _PIXELS / 2, along * scale + _PIXELS / 2
        inside = (row >= 0) & (row < _PIXELS) & (column >= 0) & (column < _PIXELS)
        pixel = row.astype(np.int32) * _PIXELS + column.astype(np.int32)
        silhouette = stand.nearest.ravel()[image][:, None] * _PIXELS**2
        front = self._front.ravel().take(silhouette + pixel, mode="clip")
        hides = inside & (front > nearer + self._clearance)
        first = np.flatnonzero(np.diff(pair, prepend=-1))
        hidden.reshape(n * V, p)[pair[first]] |= np.logical_or.reduceat(hides, first, axis=0)
