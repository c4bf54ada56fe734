"""The frame in which a network learns an object's pose: equal images give equal targets.

A cup looks the same at every rotation about its axis. Targets in the cup's own frame would be arbitrary, and a network
trained on them predicts their mean. So the targets are in a frame that rotates about the axis with the camera.

A mug is a cup with a handle. Its body uses the same frame. The rotation of the handle about the axis is learned
separately, as a distribution, which is wide where the handle is hidden.
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

#: (72,) angles about the axis, radians, at which the distribution of the rotation is evaluated.
AXIS_ANGLES = np.linspace(0, 2 * np.pi, 72, endpoint=False)
# An object is near-symmetric if this share of its body's samples, rotated about the axis, lies on its surface.
_BODY_SHARE = 0.9
_BODY_TOLERANCE = 0.025  # diameters
_BODY_ANGLES = np.radians([60.0, 120.0, 180.0, 240.0, 300.0])
# A direction in general position: rotations of the usual finite groups change every camera position's product with it.
_REFERENCE = np.array([0.2672612, 0.5345225, 0.8017837])


class AxisRotation(StrEnum):
    """Which part of the object's surface shows its rotation about the axis."""

    VISIBLE = "visible"  #: the whole surface: the object looks different at every angle
    SHOWN_BY_FEATURE = "feature"  #: only a named part, such as a handle
    INVISIBLE = "invisible"  #: nothing: the object is symmetric about the axis


@dataclass(frozen=True, eq=False)
class CanonicalFrame:
    """The axis frame and the canonical frame of one object.

    The axis frame has its origin on the axis of (near) symmetry, z along that axis, and x towards the named part. The
    canonical frame is the axis frame rotated about z until the camera lies in the half plane y = 0, x > 0. Without an
    axis of symmetry both are the object's frame.

    Attributes:
        axis_rotation: which part of the surface shows the rotation about the axis.
        T_object_axis: (4, 4) pose of the axis frame in the object's frame, metres.
        group: (s, 3, 3) finite symmetry group of the object, including the identity.
    """

    axis_rotation: AxisRotation
    T_object_axis: np.ndarray
    group: np.ndarray

    def axis_pose(self, T_camera_object: np.ndarray) -> np.ndarray:
        """(n, 4, 4) ``T_camera_axis`` of (n, 4, 4) object poses; poses equal by the finite group give the same one."""
        equals = T_camera_object[:, None] @ make_transform(self.group, np.zeros(3))
        eye = -np.einsum("nsji,nsj->nsi", equals[..., :3, :3], equals[..., :3, 3])
        chosen = (eye @ _REFERENCE).argmax(axis=1)
        return equals[np.arange(len(chosen)), chosen] @ self.T_object_axis

    def object_pose(self, T_camera_axis: np.ndarray) -> np.ndarray:
        """(n, 4, 4) ``T_camera_object`` of (n, 4, 4) poses of the axis frame."""
        return T_camera_axis @ invert(self.T_object_axis)


def rotation_about_z(angle: np.ndarray) -> np.ndarray:
    """(..., 4, 4) rotations about z by (...,) angles in radians."""
    angle = np.asarray(angle, float)
    c, s, zero, one = np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)
    rows = [[c, -s, zero], [s, c, zero], [zero, zero, one]]
    return make_transform(np.stack([np.stack(row, axis=-1) for row in rows], axis=-2), np.zeros(3))


def facing_camera(T_camera_axis: np.ndarray) -> np.ndarray:
    """(n, 4, 4) poses, each rotated about its z axis until the camera lies in its half plane y = 0, x > 0."""
    eye = invert(T_camera_axis)[:, :3, 3]
    return T_camera_axis @ rotation_about_z(np.arctan2(eye[:, 1], eye[:, 0]))


@lru_cache(maxsize=16)
def canonical_frame_of(model: ObjectModel) -> CanonicalFrame:
    """Find the canonical frame of an object from its symmetry and its named parts.

    An object is near-symmetric if all of it but one named part is a body of revolution about a line parallel to a
    coordinate axis. The line is searched for, because the part moves the object's origin (its centroid) off the line.
    """
    symmetry = model.symmetry
    if symmetry.axis is not None:
        R, _ = Rotation.align_vectors(symmetry.axis[None], [[0.0, 0.0, 1.0]])
        return CanonicalFrame(AxisRotation.INVISIBLE, make_transform(R.as_matrix(), np.zeros(3)), symmetry.discrete)
    for feature in model.features:
        T_object_axis = _axis_frame_beside(model, feature)
        if T_object_axis is not None:
            return CanonicalFrame(AxisRotation.SHOWN_BY_FEATURE, T_object_axis, symmetry.discrete)
    return CanonicalFrame(AxisRotation.VISIBLE, np.eye(4), symmetry.discrete)


def _axis_frame_beside(model: ObjectModel, feature: str) -> np.ndarray | None:
    """(4, 4) ``T_object_axis`` of the body without the part, x towards the part; None without a body of revolution."""
    points = model.surface[0]
    part = model.feature_mask(feature, points)
    body, tree = points[~part][:2000], cKDTree(points)
    tolerance = _BODY_TOLERANCE * model.diameter
    for axis in np.eye(3):
        in_plane = np.eye(3) - np.outer(axis, axis)

        def distances(offset: np.ndarray, axis: np.ndarray = axis, in_plane: np.ndarray = in_plane) -> np.ndarray:
            rotations = Rotation.from_rotvec(_BODY_ANGLES[:, None] * axis).as_matrix()
            centre = in_plane @ offset
            return tree.query((body - centre) @ np.swapaxes(rotations, 1, 2) + centre)[0]

        found = minimize(
            lambda offset: np.minimum(distances(offset), 4 * tolerance).mean(), body.mean(axis=0), method="Nelder-Mead"
        )
        if (distances(found.x) < tolerance).mean() >= _BODY_SHARE:
            origin = in_plane @ found.x
            x = in_plane @ (points[part].mean(axis=0) - origin)
            x /= np.linalg.norm(x)
            return make_transform(np.stack([x, np.cross(axis, x), axis], axis=1), origin)
    return None
