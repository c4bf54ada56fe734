"""How much of every known object a camera would see from places where it has not been.

Objects hide each other. For a few points of each object's outline as a view sees it, the silhouettes of the objects
between say whether they are hidden there. Silhouettes are looked up among those of directions all around the model, so
that a hundred views of fifteen objects cost a millisecond, where rendering them would cost a hundred.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import open3d as o3d
import trimesh
from scipy.cluster.vq import kmeans2

from active6d_core.object_model import ObjectModel

_SUBDIVISIONS = 2  # of an icosahedron: 162 directions
_PIXELS = 24  # across a silhouette
#: Points of an object, and of a patch, that are looked for.
POINTS = 10
# Farther off the ray than this, in reaches of the model from its origin, no object hides much of another.
_SIDEWAYS = 1.6
# Nothing closer in front of a point than this fraction of the diameter hides it: poses are not exact.
_CLEARANCE = 0.02


@lru_cache(maxsize=16)
def expected_visibility(model: ObjectModel) -> "ExpectedVisibility":
    """That of ``model``, made once per process."""
    return ExpectedVisibility(model)


class _Hiders(NamedTuple):
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
    """Shares of posed objects, and of patches of surface, that views would see past the other objects.

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
        self._points = np.stack([self._spread_points(*pair) for pair in zip(frames, front, strict=True)])

    def _look_from(self, mesh: trimesh.Trimesh, frames: np.ndarray) -> np.ndarray:
        scene = o3d.t.geometry.RaycastingScene()
        scene.add_triangles(np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.uint32))
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
        centres = kmeans2(pixels.astype(float), POINTS, minit="++", seed=0)[0]
        row, column = pixels[((pixels[:, None] - centres) ** 2).sum(axis=-1).argmin(axis=0)].T
        seen = np.column_stack([self._pixel_centres[row], self._pixel_centres[column], front[row, column]])
        return (seen @ frame).astype(np.float32)

    def shares(self, T_world_object: np.ndarray, eyes: np.ndarray, patches: np.ndarray | None = None) -> np.ndarray:
        """What the eyes would see of the objects, and of patches of surface that belong to none of them.

        Args:
            T_world_object: (n, 4, 4), world, metres.
            eyes: (V, 3) positions of cameras, world, metres, outside the objects.
            patches: (k, POINTS, 3) points of k patches, world, metres.

        Returns:
            (n + k, V) in [0, 1]: share of each object's silhouette, and of each patch's points, that no other object
            hides. Walls are not known here, nor is what else may stand in between.
        """
        hiders = self._stand(T_world_object, np.asarray(eyes, np.float32))
        R = T_world_object[:, :3, :3].astype(np.float32)
        own = self._points[hiders.nearest].reshape(len(R), len(eyes) * POINTS, 3) @ R.transpose(0, 2, 1)
        own = own.reshape(*hiders.nearest.shape, POINTS, 3) + hiders.centres[:, None, None]
        if patches is None or not len(patches):
            return self._unhidden(own, hiders.centres, hiders.rays, hiders)
        patches = np.asarray(patches, np.float32)
        middles = patches.mean(axis=1)
        rays = np.asarray(eyes, np.float32) - middles[:, None]
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        everywhere = np.broadcast_to(patches[:, None], (len(patches), len(eyes), *patches.shape[1:]))
        pairs = (own, everywhere), (hiders.centres, middles), (hiders.rays, rays)
        return self._unhidden(*(np.concatenate(pair) for pair in pairs), hiders)

    def _stand(self, T_world_object: np.ndarray, eyes: np.ndarray) -> "_Hiders":
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
        return _Hiders(centres, rays, distance, right, nearest)

    def _unhidden(self, points: np.ndarray, middles: np.ndarray, rays: np.ndarray, hiders: "_Hiders") -> np.ndarray:
        """(k, V) share of (k, V, p, 3) points, about (k, 3) middles with (k, V, 3) rays to the eyes, that no object
        hides; the first are the objects' own, which do not hide them."""
        k, V, p = points.shape[:3]
        apart = hiders.centres - middles[:, None]
        along = apart @ rays.transpose(0, 2, 1)
        beside = (apart**2).sum(axis=-1)[..., None] - along**2
        may_hide = (along > 0) & (beside < (_SIDEWAYS * self._reach) ** 2)
        np.einsum("iiv->iv", may_hide[: len(hiders.centres)])[:] = False
        target, hider, view = np.nonzero(may_hide)
        pair, image = target * V + view, hider * V + view
        # Coordinates first, so that each is one long row.
        x, y, z = np.moveaxis(points.reshape(-1, p, 3)[pair] - hiders.centres[hider][:, None], -1, 0)
        right, towards = (axes.reshape(-1, 3)[image].T[..., None] for axes in (hiders.right, hiders.rays))
        up = np.cross(towards, right, axis=0)
        across, along, nearer = (x * axis[0] + y * axis[1] + z * axis[2] for axis in (right, up, towards))
        eye = hiders.distance.ravel()[image][:, None]
        scale = (_PIXELS / (2 * self._reach)) * eye / (eye - nearer)
        row, column = across * scale + _PIXELS / 2, along * scale + _PIXELS / 2
        inside = (row >= 0) & (row < _PIXELS) & (column >= 0) & (column < _PIXELS)
        pixel = row.astype(np.int32) * _PIXELS + column.astype(np.int32)
        silhouette = hiders.nearest.ravel()[image][:, None] * _PIXELS**2
        front = self._front.ravel().take(silhouette + pixel, mode="clip")
        hides, point = np.nonzero(inside & (front > nearer + self._clearance))
        hidden = np.zeros((k * V, p), bool)
        hidden[pair[hides], point] = True
        return 1.0 - hidden.mean(axis=1).reshape(k, V)
