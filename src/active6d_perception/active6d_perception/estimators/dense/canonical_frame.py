"""The frame that object coordinates are learned in, chosen so that what looks alike has like coordinates.

A cup turned about its axis looks the same, so asking for coordinates in its own frame asks for a coin toss, and a
network that must answer gives the mean of all answers. Its coordinates are learned in a frame that turns with the
camera instead. A mug is a cup with a handle: the same frame serves its body, and the turn of the handle is learned
beside it as a distribution, which can say "I cannot see it".
"""

from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache

import numpy as np
from scipy.optimize import minimize
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from active6d_core.object_model import ObjectModel
from active6d_core.se3 import invert, make_transform

#: AxisRotationErrors about the axis, radians, at which the distribution of a turn is evaluated.
TURNS = np.linspace(0, 2 * np.pi, 72, endpoint=False)
# Rotated about the axis, this share of a near-symmetric body's samples must lie within the tolerance of its surface.
_BODY_SHARE = 0.9
_BODY_TOLERANCE = 0.025  # diameters
_BODY_TURNS = np.radians([60.0, 120.0, 180.0, 240.0, 300.0])
# In general position, so that no rotation of a usual finite group leaves an eye's product with it unchanged.
_REFERENCE = np.array([0.2672612, 0.5345225, 0.8017837])


class AxisRotation(StrEnum):
    """What turning the object about its axis does."""

    VISIBLE = "visible"  #: it looks different
    TOLD_BY_FEATURE = "feature"  #: only a named part of it shows the turn
    INVISIBLE = "invisible"  #: nothing shows the turn


@dataclass(frozen=True, eq=False)
class CanonicalFrame:
    """How canonical coordinates are defined for one object.

    The axis frame has its z axis along the axis of (near) symmetry, its origin on it, and its x axis towards the named
    part. The canonical frame is the axis frame turned about z until the camera lies in the xz half plane with x > 0;
    without any symmetry axis it is the axis frame.

    Attributes:
        turn: what a turn about the axis does to the object's look.
        T_object_axis: (4, 4) the axis frame in the object's frame, metres.
        group: (s, 3, 3) the finite symmetry group, the identity among it.
    """

    turn: AxisRotation
    T_object_axis: np.ndarray
    group: np.ndarray

    def axis_pose(self, T_camera_object: np.ndarray) -> np.ndarray:
        """(n, 4, 4) ``T_camera_axis`` of (n, 4, 4) poses; of those that the group makes equal, always the same."""
        equals = T_camera_object[:, None] @ make_transform(self.group, np.zeros(3))
        eye = -np.einsum("nsji,nsj->nsi", equals[..., :3, :3], equals[..., :3, 3])
        chosen = (eye @ _REFERENCE).argmax(axis=1)
        return equals[np.arange(len(chosen)), chosen] @ self.T_object_axis

    def canonical_pose(self, T_camera_object: np.ndarray) -> np.ndarray:
        """(n, 4, 4) ``T_camera_canonical`` of (n, 4, 4) poses."""
        T_camera_axis = self.axis_pose(T_camera_object)
        return T_camera_axis if self.turn is AxisRotation.VISIBLE else facing_camera(T_camera_axis)

    def object_pose(self, T_camera_axis: np.ndarray) -> np.ndarray:
        """(n, 4, 4) ``T_camera_object`` from poses of the axis frame."""
        return T_camera_axis @ invert(self.T_object_axis)


def rotation_about_z(angle: np.ndarray) -> np.ndarray:
    """(..., 4, 4) rotations about z by (...,) radians."""
    angle = np.asarray(angle, float)
    c, s, zero, one = np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)
    rows = [[c, -s, zero], [s, c, zero], [zero, zero, one]]
    return make_transform(np.stack([np.stack(row, axis=-1) for row in rows], axis=-2), np.zeros(3))


def facing_camera(T_camera_axis: np.ndarray) -> np.ndarray:
    """(n, 4, 4) poses, each turned about its z axis until the camera lies in its xz half plane with x > 0."""
    eye = invert(T_camera_axis)[:, :3, 3]
    return T_camera_axis @ rotation_about_z(np.arctan2(eye[:, 1], eye[:, 0]))


@lru_cache(maxsize=16)
def canonical_frame_of(model: ObjectModel) -> CanonicalFrame:
    """The canonical_frame of an object, from its described symmetry and named parts.

    A named part makes an object near-symmetric if the rest of it is a body of revolution about a line parallel to a
    coordinate axis. The line is found, since the part moves the origin (the centroid) off it.
    """
    symmetry = model.symmetry
    if symmetry.axis is not None:
        R, _ = Rotation.align_vectors(symmetry.axis[None], [[0.0, 0.0, 1.0]])
        return CanonicalFrame(AxisRotation.INVISIBLE, make_transform(R.as_matrix(), np.zeros(3)), symmetry.discrete)
    for feature in model.features:
        T_object_axis = _axis_frame_beside(model, feature)
        if T_object_axis is not None:
            return CanonicalFrame(AxisRotation.TOLD_BY_FEATURE, T_object_axis, symmetry.discrete)
    return CanonicalFrame(AxisRotation.VISIBLE, np.eye(4), symmetry.discrete)


def _axis_frame_beside(model: ObjectModel, feature: str) -> np.ndarray | None:
    """(4, 4) axis frame of the body without the part, x towards the part; None unless it is a body of revolution."""
    points = model.surface[0]
    part = model.feature_mask(feature, points)
    body, tree = points[~part][:2000], cKDTree(points)
    tolerance = _BODY_TOLERANCE * model.diameter
    for axis in np.eye(3):
        in_plane = np.eye(3) - np.outer(axis, axis)

        def distances(offset: np.ndarray, axis: np.ndarray = axis, in_plane: np.ndarray = in_plane) -> np.ndarray:
            turns = Rotation.from_rotvec(_BODY_TURNS[:, None] * axis).as_matrix()
            centre = in_plane @ offset
            return tree.query((body - centre) @ np.swapaxes(turns, 1, 2) + centre)[0]

        found = minimize(
            lambda offset: np.minimum(distances(offset), 4 * tolerance).mean(), body.mean(axis=0), method="Nelder-Mead"
        )
        if (distances(found.x) < tolerance).mean() >= _BODY_SHARE:
            origin = in_plane @ found.x
            x = in_plane @ (points[part].mean(axis=0) - origin)
            x /= np.linalg.norm(x)
            return make_transform(np.stack([x, np.cross(axis, x), axis], axis=1), origin)
    return None
