"""Near symmetries of any object: rotations after which most of what a camera sees of it looks as before.

A depth image cannot tell a pose from its near-symmetric twin unless it shows the part of the surface that differs:
which end of a cup is wider, where the handle of a mug is. So a decision on a pose must consider the twins.

They are found from the mesh. A grid of rotations is compared with the mesh, and the best are registered to it. A cup
upside down differs from a cup by up to a tenth of its diameter, but the side that a camera sees coincides after a small
tilt. So each rotation is registered once more to the surface that is visible from each of 32 directions, and counts by
the share of that surface which then coincides.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from active6d_core.object_model import ObjectModel
from active6d_core.se3 import invert, make_transform, rotation_angle, transform_points
from active6d_perception.model.model_views import model_views
from active6d_perception.registration import point_to_plane_step

# Share of the visible surface that coincides, mean over the directions. It is .61 for a cup upside down, .79 for a mug
# upside down and turned about its axis, at most .43 for the rotations of the bunny, .35 for a cone upside down.
_LEAST_SHARE = 0.53
_TOLERANCE, _ALIKE = 0.025, 0.9  # diameters, and cosine between normals
# The whole surface coincides less strictly, since nothing adapts to what is visible.
_AXIS_SHARE, _AXIS_TOLERANCE, _AXIS_ALIKE = 0.7, 0.05, 0.8
_AXIS_ANGLES = np.radians(np.arange(30.0, 360.0, 30.0))
_ANGLES_PER_AXIS = 24
_NEIGHBOUR = np.radians(20.0)
_REGISTERED = 60
_GRID_POINTS, _FIT_POINTS, _VISIBLE_POINTS = 100, 200, 64
_LEAST_FIT = 0.45
_APART = np.radians(25.0)  # closer rotations are one twin
_ADAPTS = np.radians(30.0)  # between the rotations that fit different visible sides of one twin
_MOST = 24  # twins of one object; a ball has no end of them
_CELL = 0.025  # diameters


@dataclass(frozen=True, eq=False)
class NearSymmetries:
    """The near symmetries of one object, without those that its description declares to be symmetries.

    A pose ``T_camera_object`` has the twins ``T_camera_object @ T_object_twin``, each also rotated about the axis of
    continuous near symmetry where there is one: ``T_camera_object @ T_object_twin @ rotations_about_axis(angles)``.
    A twin fits a depth image only after refinement, since what coincides depends on what is visible.

    Attributes:
        T_object_twin: (s, 4, 4) metres, the identity first, then by falling share. They are at least 25 degrees apart,
            up to declared symmetries and rotations about the axis.
        share: (s,) share of the visible surface that coincides within 2.5 % of the diameter with a similar normal, mean
            over view directions.
        T_object_axis: (4, 4) frame whose z is the axis of continuous near symmetry, such as that of a mug's body; None
            without one, or if the description declares the symmetry about it. Every declared symmetry keeps the axis
            or reverses it.
        order: how many declared symmetries turn about the axis: 6 for a hexagonal nut, 1 without any.
    """

    T_object_twin: np.ndarray
    share: np.ndarray
    T_object_axis: np.ndarray | None
    order: int

    def rotations_about_axis(self, angles: np.ndarray) -> np.ndarray:
        """(a, 4, 4) rotations by (a,) angles in radians about the axis, in the object's frame; metres.

        Raises:
            ValueError: the object has no axis of continuous near symmetry.
        """
        if self.T_object_axis is None:
            raise ValueError("the object has no axis of continuous near symmetry")
        about_z = make_transform(Rotation.from_rotvec(np.outer(angles, [0.0, 0.0, 1.0])).as_matrix(), np.zeros(3))
        return self.T_object_axis @ about_z @ invert(self.T_object_axis)


@lru_cache(maxsize=16)
def near_symmetries(model: ObjectModel) -> NearSymmetries:
    """The near symmetries of ``model``, computed once per process in about a second."""
    surface, group, axis = _Surface(model), model.symmetry.discrete, model.symmetry.axis
    T = _registered_rotations(surface)
    T_object_axis, order = _continuous_axis(T, surface, group) if axis is None else None, 1
    if T_object_axis is not None:
        axis = T_object_axis[:3, 2]
        order = int(np.count_nonzero(group @ axis @ axis > 0))
    T = np.concatenate([np.eye(4)[None], T])
    T, share = _adapted_to_views(T[_distinct(T, group, axis)], model, surface)
    best = np.append(0, 1 + np.argsort(-share[1:], kind="stable"))
    best = best[share[best] >= _LEAST_SHARE]
    best = best[_distinct(T[best], group, axis)][: _MOST + 1]
    return NearSymmetries(T[best], share[best], T_object_axis, order)


def telling_surface(
    model: ObjectModel, T_object_twin: np.ndarray, points: np.ndarray, normals: np.ndarray
) -> np.ndarray:
    """Which points of the surface tell a pose from its twins: the twin has no surface there.

    Args:
        model: the object.
        T_object_twin: (s, 4, 4) as :attr:`NearSymmetries.T_object_twin`.
        points: (n, 3) points of the object's surface, object frame, metres.
        normals: (n, 3) their outward unit normals.

    Returns:
        (s, n) bool.
    """
    return ~_Surface(model).coincides(invert(T_object_twin), points, normals, _TOLERANCE, _ALIKE)


class _Surface:
    """The object's surface, to register rotated copies of it to."""

    def __init__(self, model: ObjectModel) -> None:
        self.diameter = model.diameter
        self.points, self.normals = model.surface
        self._cell = _CELL * model.diameter
        self._half = np.ceil((np.abs(self.points).max(axis=0) + 0.1 * model.diameter) / self._cell).astype(int)
        axes = [self._cell * np.arange(-half, half + 1) for half in self._half]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        self._tree = cKDTree(self.points)
        self._nearest = self._tree.query(grid)[1]

    def nearest(self, points: np.ndarray) -> np.ndarray:
        """(...,) index of the surface point nearest to the middle of the cell of each of (..., 3) points."""
        cell = np.clip(np.rint(points / self._cell).astype(int) + self._half, 0, 2 * self._half)
        return self._nearest[cell[..., 0], cell[..., 1], cell[..., 2]]

    def fit(self, T: np.ndarray, count: int) -> np.ndarray:
        """(k,) in [0, 1], how well (k, 4, 4) transforms put ``count`` points onto the surface, by degrees."""
        moved, turned = transform_points(T, self.points[:count]), self.normals[:count] @ np.swapaxes(T[:, :3, :3], 1, 2)
        nearest = self.nearest(moved)
        distance = np.linalg.norm(moved - self.points[nearest], axis=-1) / self.diameter
        alike = np.maximum(np.einsum("kni,kni->kn", turned, self.normals[nearest]), 0.0)
        return (alike / (1 + (distance / 0.1) ** 2)).mean(axis=1)

    def coincides(
        self, T: np.ndarray, points: np.ndarray, normals: np.ndarray, tolerance: float, alike: float
    ) -> np.ndarray:
        """(k, n) bool, which points moved by (k, 4, 4) ``T`` are on the surface and face alike."""
        # Beside an edge, or on a thin wall, the nearest point may belong to another face.
        distance, nearest = self._tree.query(transform_points(T, points), k=4)
        turned = normals @ np.swapaxes(T[:, :3, :3], 1, 2)
        cosine = np.einsum("kni,knqi->knq", turned, self.normals[nearest])
        return ((distance < tolerance * self.diameter) & (cosine > alike)).any(axis=2)

    def register(
        self, T: np.ndarray, points: np.ndarray, normals: np.ndarray, used: np.ndarray, scale: float, iterations: int
    ) -> np.ndarray:
        """(k, 4, 4) transforms that bring (k, n, 3) points onto the surface; one ``scale`` off has a quarter weight."""
        for _ in range(iterations):
            moved, turned = transform_points(T, points), normals @ np.swapaxes(T[:, :3, :3], 1, 2)
            nearest = self.nearest(moved)
            apart = np.linalg.norm(moved - self.points[nearest], axis=-1)
            # A part that has no counterpart, such as a handle, must not pull.
            weight = used / (1 + (apart / (scale * self.diameter)) ** 2) ** 2
            weight *= np.einsum("kni,kni->kn", turned, self.normals[nearest]) > 0.5
            T = point_to_plane_step(T, moved, turned, self.points[nearest], weight)
        return T


def _registered_rotations(surface: _Surface) -> np.ndarray:
    """(k, 4, 4) transforms that nearly put the whole surface onto itself, with repetitions, best first."""
    T = make_transform(_rotation_grid(), np.zeros(3))
    fit = surface.fit(T, _GRID_POINTS)
    flat = T[:, :3, :3].reshape(-1, 9).astype(np.float32)
    near = flat @ flat.T > 1 + 2 * np.cos(_NEIGHBOUR)
    peaks = np.flatnonzero(fit >= np.where(near, fit, 0.0).max(axis=1))
    T = T[peaks[np.argsort(-fit[peaks], kind="stable")[:_REGISTERED]]]
    points, normals = (
        np.broadcast_to(part[:_FIT_POINTS], (len(T), _FIT_POINTS, 3)) for part in (surface.points, surface.normals)
    )
    T = surface.register(T, points, normals, np.ones((1, 1)), 0.1, 10)
    fit = surface.fit(T, _FIT_POINTS)
    order = np.argsort(-fit, kind="stable")
    return T[order[fit[order] > _LEAST_FIT]]


def _rotation_grid() -> np.ndarray:
    """(g, 3, 3) rotations: 162 directions of the z axis, 18 degrees apart, and 24 angles about each."""
    axes = np.asarray(trimesh.creation.icosphere(2).vertices)
    across = np.where(np.abs(axes[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    x = np.cross(across, axes)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    frames = np.stack([x, np.cross(axes, x), axes], axis=-1)
    angles = np.linspace(0, 2 * np.pi, _ANGLES_PER_AXIS, endpoint=False)
    about_z = Rotation.from_rotvec(np.outer(angles, [0.0, 0.0, 1.0])).as_matrix()
    return (frames[:, None] @ about_z).reshape(-1, 3, 3)


def _continuous_axis(T: np.ndarray, surface: _Surface, group: np.ndarray) -> np.ndarray | None:
    """(4, 4) frame whose z is a line about which every rotation is a near symmetry; None without one.

    Lines that a declared symmetry of (s, 3, 3) ``group`` moves elsewhere are left out: rotations about them and about
    their images make up all rotations, as of a ball, and no body is left that they keep.
    """
    best, found = _AXIS_SHARE, None
    points, normals = surface.points[:_FIT_POINTS], surface.normals[:_FIT_POINTS]
    for rotation in T[rotation_angle(T[:, :3, :3], np.eye(3)) > _APART]:
        axis = Rotation.from_matrix(rotation[:3, :3]).as_rotvec()
        axis /= np.linalg.norm(axis)
        if (np.abs(group @ axis @ axis) < np.cos(_NEIGHBOUR)).any():
            continue
        # The points that a rotation about a line leaves in place solve (1 - R) x = t.
        point = np.linalg.pinv(np.eye(3) - rotation[:3, :3], rcond=1e-3) @ rotation[:3, 3]
        R = Rotation.from_rotvec(np.outer(_AXIS_ANGLES, axis)).as_matrix()
        about_line = make_transform(R, point - R @ point)
        coincides = surface.coincides(about_line, points, normals, _AXIS_TOLERANCE, _AXIS_ALIKE)
        if coincides.mean(axis=1).min() > best + 0.01:
            best = coincides.mean(axis=1).min()
            axis, point = _kept_line(axis, point, group)
            to_axis, _ = Rotation.align_vectors(axis[None], [[0.0, 0.0, 1.0]])
            found = make_transform(to_axis.as_matrix(), point)
    return found


def _kept_line(axis: np.ndarray, point: np.ndarray, group: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The line nearest to one along (3,) ``axis`` through (3,) ``point`` that the declared symmetries keep exactly."""
    if len(group) == 1:
        return axis, point
    # The mean over a group is what the group keeps; flips reverse the axis.
    kept = (np.sign(group @ axis @ axis)[:, None] * (group @ axis)).mean(axis=0)
    return kept / np.linalg.norm(kept), (group @ point).mean(axis=0)


def _adapted_to_views(T: np.ndarray, model: ObjectModel, surface: _Surface) -> tuple[np.ndarray, np.ndarray]:
    """(k, 4, 4) transforms, mean of those registered to what is visible from each direction, and (k,) their shares."""
    views = model_views(model)
    faces = trimesh.creation.icosahedron()
    towards = np.concatenate([faces.vertices, faces.triangles_center])
    index, used = views.visible_subset(_VISIBLE_POINTS)
    seen = (towards @ views.directions.T).argmax(axis=1)
    count = len(T), len(seen)
    chosen = np.tile(index[seen], (len(T), 1))
    points, normals, used = views.points[chosen], views.normals[chosen], np.tile(used[seen], (len(T), 1))
    start = np.repeat(T, len(seen), axis=0)
    adapted = surface.register(start, points, normals, used, 0.04, 8)
    coincides = surface.coincides(adapted, points, normals, _TOLERANCE, _ALIKE) & used
    share = coincides.sum(axis=1) / np.maximum(used.sum(axis=1), 1)
    share, adapted = share.reshape(count), adapted.reshape(*count, 4, 4)
    weight = share**2 + 1e-9
    weight /= weight.sum(axis=1, keepdims=True)
    mean = [Rotation.from_matrix(R).mean(w).as_matrix() for R, w in zip(adapted[..., :3, :3], weight, strict=True)]
    result = make_transform(np.stack(mean), np.einsum("kd,kdi->ki", weight, adapted[..., :3, 3]))
    share *= rotation_angle(adapted[..., :3, :3], result[:, None, :3, :3]) < _ADAPTS
    result[0] = np.eye(4)
    return result, share.mean(axis=1)


def _distinct(T: np.ndarray, group: np.ndarray, axis: np.ndarray | None) -> np.ndarray:
    """Indices of those of (k, 4, 4) transforms that are not one twin with an earlier one.

    Two are one twin if a declared symmetry or a rotation about the axis makes the rest of the rotation small.
    """
    kept: list[int] = []
    for index, R in enumerate(T[:, :3, :3]):
        symmetric = T[kept, None, :3, :3] @ group
        near = rotation_angle(symmetric, R) < _APART if axis is None else symmetric @ axis @ (R @ axis) > np.cos(_APART)
        if not near.any():
            kept.append(index)
    return np.array(kept)
