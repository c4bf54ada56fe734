"""Predicts how much of each known object a camera would see from other views.

Objects hide each other. Points are spread over an object's outline, and the silhouettes of the objects in between show
which points are hidden. Silhouettes are precomputed for directions all around the model, which is much faster than
rendering a hundred views.

The outline is the mean over all directions and does not depend on the object's orientation. An object that needs
another view has no hypothesis or a wrong one. Then the mean outline predicts more than the outline of a wrong pose.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import open3d as o3d
import trimesh

from active6d_core.object_model import ObjectModel
from active6d_perception.compiled import compiled
from active6d_perception.model.model_views import ray_caster

_SUBDIVISIONS = 2  # of an icosahedron: 162 directions
_PIXELS = 24  # across a silhouette
# Number of points per object; a multiple of sixteen, which suits vector instructions.
_POINTS = 32
# An object farther than this off the ray hides little; in units of the model's largest radius.
_SIDEWAYS = 1.5
# Surface less than this fraction of the diameter in front of a point does not hide it, because poses are not exact.
_CLEARANCE = 0.02


@lru_cache(maxsize=16)
def expected_visibility(model: ObjectModel) -> "ExpectedVisibility":
    """The expected visibility of ``model``, computed once per process."""
    return ExpectedVisibility(model)


class Tray(NamedTuple):
    """The walls of a rectangular bin around the world's origin."""

    width: float
    """between the inner walls, along world x, metres"""
    depth: float
    """likewise along world y"""
    wall_height: float
    """above the floor at z = 0, metres"""

    @classmethod
    def for_model(cls, model: ObjectModel) -> "Tray":
        """The bin that the object's heaps usually lie in."""
        return cls(model.bin_width, model.bin_width, model.wall_height)


#: A table without walls.
OPEN_TABLE = Tray(0.0, 0.0, -np.inf)


class _Stand(NamedTuple):
    """The objects relative to V camera positions."""

    centres: np.ndarray
    """(n, 3) origins of the objects, world, metres"""
    rays: np.ndarray
    """(n, V, 3) unit vectors from the objects to the cameras, world"""
    distance: np.ndarray
    """(n, V) distances to the cameras, metres"""
    right: np.ndarray
    """(n, V, 3) unit vectors along the silhouette's rows, world"""
    up: np.ndarray
    """(n, V, 3) unit vectors along the silhouette's columns, world"""
    nearest: np.ndarray
    """(n, V) index of the nearest precomputed direction"""


class _Silhouettes(NamedTuple):
    """Silhouettes of a model from m directions, and the tolerances for being hidden behind it."""

    front: np.ndarray
    """(m, 1 + pixels * pixels) height of the surface towards the camera, metres; -inf without surface"""
    pixels_per_metre: np.float32
    sideways: np.float32
    """an object hides nothing from a ray that passes its origin farther away than this, metres"""
    clearance: np.float32
    """an object hides nothing less than this behind its surface, metres"""


@compiled
def _shares(
    disc: np.ndarray, eyes: np.ndarray, tray: Tray, stand: _Stand, hiding: int, silhouettes: _Silhouettes
) -> np.ndarray:
    """Compute the visible shares of the objects' outlines; all numbers are float32.

    Args:
        disc: (3, p) points of an outline: along the silhouette's rows, its columns and towards the camera, metres.
        eyes: (V, 3) camera positions, world, metres.
        tray: the walls.
        stand: the objects relative to the cameras.
        hiding: only the first ``hiding`` objects hide others.
        silhouettes: of the model.

    Returns:
        (n, V) shares of the points that neither a wall nor another object hides.
    """
    (n, V), p = stand.nearest.shape, _POINTS
    shares, hidden, outlines = np.empty((n, V)), np.zeros((V, p), np.bool_), np.zeros((V, 3, p), np.float32)
    nearer, pixel, between = np.empty(p, np.float32), np.empty(p, np.uint32), np.empty(V, np.bool_)
    for target in range(n):
        _outline(target, disc, eyes, tray, stand, outlines, hidden)
        # The loop over views is the inner one: neighbouring views take the same branch, which a processor can predict.
        for hider in range(hiding):
            _find_between(target, hider, stand, silhouettes.sideways, between)
            for view in range(V):
                if between[view]:
                    _project(outlines, hider, view, stand, silhouettes, nearer, pixel)
                    direction = stand.nearest[hider, view]
                    for index in range(p):
                        hidden[view, index] |= silhouettes.front[direction, pixel[index]] > nearer[index]
        for view in range(V):
            shares[target, view] = 1.0 - hidden[view].sum() / p
    return shares


@compiled
def _outline(
    target: int,
    disc: np.ndarray,
    eyes: np.ndarray,
    tray: Tray,
    stand: _Stand,
    outlines: np.ndarray,
    hidden: np.ndarray,
) -> None:
    """Set (V, 3, p) ``outlines`` to the object's points in the world, and (V, p) ``hidden`` where walls hide them."""
    for view in range(len(eyes)):
        for axis in range(3):
            right, up = stand.right[target, view, axis], stand.up[target, view, axis]
            centre, ray = stand.centres[target, axis], stand.rays[target, view, axis]
            for index in range(_POINTS):
                beside = right * disc[0, index] + up * disc[1, index] + ray * disc[2, index]
                outlines[view, axis, index] = centre + beside
        for index in range(_POINTS):
            hidden[view, index] = walled(outlines[view, :, index], eyes[view], tray)


@compiled
def walled(point: np.ndarray, eye: np.ndarray, tray: Tray) -> bool:
    """Whether the ray from a (3,) point to a (3,) camera position leaves the bin through a wall; world, float32."""
    # Parameter along the ray: 0 at the point, 1 at the camera.
    leaves = np.float32(np.inf)
    for axis in range(2):
        ray = eye[axis] - point[axis]
        side = tray.width if axis == 0 else tray.depth
        to_wall = np.float32(0.5) * side - np.copysign(np.float32(1.0), ray) * point[axis]
        leaves = min(leaves, to_wall / max(abs(ray), np.float32(1e-9)))
    return point[2] + leaves * (eye[2] - point[2]) < tray.wall_height


@compiled
def _find_between(target: int, hider: int, stand: _Stand, sideways: np.float32, between: np.ndarray) -> None:
    """Set (V,) ``between`` where object ``hider`` is near the ray from ``target`` to the camera."""
    x = stand.centres[hider, 0] - stand.centres[target, 0]
    y = stand.centres[hider, 1] - stand.centres[target, 1]
    z = stand.centres[hider, 2] - stand.centres[target, 2]
    square, rays = x * x + y * y + z * z, stand.rays
    for view in range(len(between)):
        along = x * rays[target, view, 0] + y * rays[target, view, 1] + z * rays[target, view, 2]
        between[view] = (along > np.float32(0)) & (square - along * along < sideways * sideways)


@compiled
def _project(
    points: np.ndarray,
    hider: int,
    view: int,
    stand: _Stand,
    silhouettes: _Silhouettes,
    nearer: np.ndarray,
    pixel: np.ndarray,
) -> None:
    """Project the points (V, 3, p) of one view into the silhouette of object ``hider``.

    Sets (p,) ``nearer`` to the height above which surface hides the point, and (p,) ``pixel`` to the index into the
    silhouette, 0 outside.
    """
    # Scalars and no branches, so that the compiler can use vector instructions.
    x0, y0, z0 = stand.centres[hider, 0], stand.centres[hider, 1], stand.centres[hider, 2]
    right_x, right_y, right_z = stand.right[hider, view, 0], stand.right[hider, view, 1], stand.right[hider, view, 2]
    up_x, up_y, up_z = stand.up[hider, view, 0], stand.up[hider, view, 1], stand.up[hider, view, 2]
    ray_x, ray_y, ray_z = stand.rays[hider, view, 0], stand.rays[hider, view, 1], stand.rays[hider, view, 2]
    distance, pixels = stand.distance[hider, view], np.float32(_PIXELS)
    zero, one, middle = np.float32(0), np.float32(1), np.float32(_PIXELS / 2)
    for index in range(_POINTS):
        x, y, z = points[view, 0, index] - x0, points[view, 1, index] - y0, points[view, 2, index] - z0
        depth = x * ray_x + y * ray_y + z * ray_z
        scale = silhouettes.pixels_per_metre * distance / (distance - depth)
        row = (x * right_x + y * right_y + z * right_z) * scale + middle
        column = (x * up_x + y * up_y + z * up_z) * scale + middle
        inside = (row >= zero) & (row < pixels) & (column >= zero) & (column < pixels)
        pixel[index] = np.uint32(one + np.floor(row) * pixels + np.floor(column) if inside else zero)
        nearer[index] = depth + silhouettes.clearance


@compiled
def _look(centres: np.ndarray, eyes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n, V, 3) unit vectors from (n, 3) centres to (V, 3) camera positions, and (n, V) distances."""
    rays, distance = np.empty((len(centres), *eyes.shape), np.float32), np.empty((len(centres), len(eyes)), np.float32)
    for target, view in np.ndindex(distance.shape):
        x = eyes[view, 0] - centres[target, 0]
        y = eyes[view, 1] - centres[target, 1]
        z = eyes[view, 2] - centres[target, 2]
        length = np.sqrt(x * x + y * y + z * z)
        distance[target, view] = length
        rays[target, view, 0], rays[target, view, 1], rays[target, view, 2] = x / length, y / length, z / length
    return rays, distance


@compiled
def _square(right: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Make (n, V, 3) ``right`` unit vectors orthogonal to the rays, in place; returns their cross products."""
    up = np.empty_like(right)
    for index in np.ndindex(right.shape[:2]):
        x, y, z = rays[index]
        off = right[index][0] * x + right[index][1] * y + right[index][2] * z
        i, j, k = right[index][0] - off * x, right[index][1] - off * y, right[index][2] - off * z
        length = np.sqrt(i * i + j * j + k * k)
        i, j, k = i / length, j / length, k / length
        right[index] = i, j, k
        up[index] = y * k - z * j, z * i - x * k, x * j - y * i
    return up


class ExpectedVisibility:
    """Predicts the visible shares of objects in views.

    Args:
        model: the object that all poses belong to.
    """

    def __init__(self, model: ObjectModel) -> None:
        mesh = model.mesh
        self._reach = float(np.linalg.norm(mesh.vertices, axis=1).max())
        directions = np.asarray(trimesh.creation.icosphere(_SUBDIVISIONS).vertices)
        up = np.where(np.abs(directions[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
        right = np.cross(up, directions)
        right /= np.linalg.norm(right, axis=1, keepdims=True)
        frames = np.stack([right, np.cross(directions, right), directions], axis=1)
        front = self._look_from(mesh, frames)
        self._directions = directions.astype(np.float32)
        self._right = right.astype(np.float32)
        self._silhouettes = _Silhouettes(
            np.pad(front.astype(np.float32).reshape(len(front), -1), [(0, 0), (1, 0)], constant_values=-np.inf),
            np.float32(_PIXELS / (2 * self._reach)),
            np.float32(_SIDEWAYS * self._reach),
            np.float32(_CLEARANCE * model.diameter),
        )
        self._disc = self._spread_points(front)
        # Compile now, so that no decision has to wait.
        self.shares(np.eye(4)[None], np.array([[0.0, 0.0, 4 * self._reach]]))

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

    def _spread_points(self, front: np.ndarray) -> np.ndarray:
        """(3, p) points spread over the mean of all silhouettes, at the mean depth of what is there."""
        seen = np.isfinite(front)
        covered = seen.mean(axis=0)
        height = np.where(seen, front, 0.0).sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
        radius = np.hypot(*np.meshgrid(self._pixel_centres, self._pixel_centres))
        order = np.argsort(radius, axis=None)
        inner = np.cumsum(covered.ravel()[order])
        # A sunflower pattern, in which each point represents the same area of the silhouette.
        seed = np.arange(_POINTS)
        r = np.interp((seed + 0.5) / _POINTS, inner / inner[-1], radius.ravel()[order])
        near = covered * np.exp(-((radius - r[:, None, None]) ** 2) * (_PIXELS / (2 * self._reach)) ** 2)
        towards = (near * height).sum(axis=(1, 2)) / near.sum(axis=(1, 2))
        angle = seed * np.pi * (3 - np.sqrt(5))
        return np.stack([r * np.cos(angle), r * np.sin(angle), towards]).astype(np.float32)

    def shares(
        self, T_world_object: np.ndarray, eyes: np.ndarray, tray: Tray | None = None, hiding: int | None = None
    ) -> np.ndarray:
        """Predict the visible share of each object from each camera position.

        Args:
            T_world_object: (n, 4, 4) poses in the world, metres.
            eyes: (V, 3) camera positions outside the objects, world, metres.
            tray: the bin that the objects lie in, None for an open table.
            hiding: only the first ``hiding`` objects hide others; all when None.

        Returns:
            (n, V) in [0, 1]: share of each object's silhouette that no other object and no wall hides.
        """
        eyes = np.ascontiguousarray(eyes, np.float32)
        stand = self._stand(T_world_object, eyes)
        walls = Tray(*np.array(OPEN_TABLE if tray is None else tray, np.float32))
        hiding = len(T_world_object) if hiding is None else hiding
        return _shares(self._disc, eyes, walls, stand, hiding, self._silhouettes)

    def _stand(self, T_world_object: np.ndarray, eyes: np.ndarray) -> "_Stand":
        R = T_world_object[:, :3, :3].astype(np.float32)
        centres = T_world_object[:, :3, 3].astype(np.float32)
        rays, distance = _look(centres, eyes)
        nearest = ((rays @ R).reshape(-1, 3) @ self._directions.T).argmax(axis=1).reshape(distance.shape)
        # The silhouette is that of the nearest precomputed direction, but it is placed along the camera's own ray.
        # Otherwise it would be shifted against objects far behind.
        right = self._right[nearest] @ R.transpose(0, 2, 1)
        up = _square(right, rays)
        return _Stand(centres, rays, distance, right, up, nearest)
