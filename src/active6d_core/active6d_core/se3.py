"""Rigid transforms as 4x4 matrices.

Notation: ``T_a_b`` maps coordinates of frame b into frame a, so ``T_world_object = T_world_camera @ T_camera_object``.
Every function broadcasts over leading dimensions. Quaternions are scalar-last (x, y, z, w), as in ROS messages.
"""

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation


def make_transform(rotation: ArrayLike, translation: ArrayLike) -> np.ndarray:
    """(..., 3, 3) rotation and (..., 3) translation in metres to a (..., 4, 4) transform."""
    R, t = np.asarray(rotation, float), np.asarray(translation, float)
    T = np.zeros((*np.broadcast_shapes(R.shape[:-2], t.shape[:-1]), 4, 4))
    T[..., :3, :3] = R
    T[..., :3, 3] = t
    T[..., 3, 3] = 1.0
    return T


def invert(T: np.ndarray) -> np.ndarray:
    """Inverse of (..., 4, 4) rigid transforms: ``invert(T_a_b)`` is ``T_b_a``."""
    R_t = np.swapaxes(T[..., :3, :3], -1, -2)
    return make_transform(R_t, -(R_t @ T[..., :3, 3:])[..., 0])


def transform_points(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Transform (..., n, 3) points by (..., 4, 4) ``T_a_b`` from frame b to frame a."""
    return points @ np.swapaxes(T[..., :3, :3], -1, -2) + T[..., None, :3, 3]


def transform_from_quaternion(quaternion: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """(..., 4) xyzw quaternions (normalised here) and (..., 3) translations to (..., 4, 4) transforms.

    Raises:
        ValueError: a quaternion has zero norm.
    """
    quaternion = np.asarray(quaternion, float)
    matrices = Rotation.from_quat(quaternion.reshape(-1, 4)).as_matrix()
    return make_transform(matrices.reshape(*quaternion.shape[:-1], 3, 3), translation)


def quaternion_from_transform(T: np.ndarray) -> np.ndarray:
    """(..., 4, 4) transforms to unit quaternions (..., 4) xyzw with w >= 0."""
    quaternions = Rotation.from_matrix(T[..., :3, :3].reshape(-1, 3, 3)).as_quat(canonical=True)
    return quaternions.reshape(*T.shape[:-2], 4)


def rotation_angle(R_a: np.ndarray, R_b: np.ndarray) -> np.ndarray:
    """Angle in radians of the rotation between (..., 3, 3) matrices, in [0, pi].

    Uses the chord ``||R_a - R_b||_F = 2 sqrt(2) sin(angle / 2)``, which stays accurate near zero where arccos does not.
    """
    chord = np.linalg.norm(np.asarray(R_a) - np.asarray(R_b), axis=(-2, -1))
    return 2.0 * np.arcsin(np.clip(chord / (2.0 * np.sqrt(2.0)), 0.0, 1.0))


def is_rigid(T: np.ndarray, tolerance: float = 1e-6) -> bool:
    """Whether all (..., 4, 4) matrices are finite, orthonormal and right-handed, with bottom row 0 0 0 1."""
    T = np.asarray(T, float)
    if T.shape[-2:] != (4, 4) or not np.isfinite(T).all():
        return False
    R = T[..., :3, :3]
    orthonormal = np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3)).max(initial=0.0) < tolerance
    right_handed = (np.linalg.det(R) > 0).all()
    return bool(orthonormal and right_handed and np.abs(T[..., 3, :] - [0, 0, 0, 1]).max(initial=0.0) < tolerance)


def look_at(eye: np.ndarray, target: np.ndarray, up: ArrayLike = (0.0, 0.0, 1.0)) -> np.ndarray:
    """``T_world_camera`` (4, 4) of an optical frame (z forward, x right, y down; REP-103) at ``eye`` facing ``target``.

    If the view is along ``up``, the image's top points to world +y. Positions are in metres.

    Raises:
        ValueError: ``eye`` and ``target`` coincide.
    """
    eye, target = np.asarray(eye, float), np.asarray(target, float)
    forward = target - eye
    distance = np.linalg.norm(forward)
    if distance < 1e-9:
        raise ValueError("look_at needs an eye that differs from its target")
    forward /= distance
    right = np.cross(forward, np.asarray(up, float))
    if np.linalg.norm(right) < 1e-6:
        right = np.cross(forward, (0.0, 1.0, 0.0))
    right /= np.linalg.norm(right)
    return make_transform(np.stack([right, np.cross(forward, right), forward], axis=-1), eye)
