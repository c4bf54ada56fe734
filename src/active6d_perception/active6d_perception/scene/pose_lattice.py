"""Rounds poses, so that a pose that hardly moved is the same as before and what was computed for it stays valid."""

import numpy as np

from active6d_core.se3 import quaternion_from_transform, transform_from_quaternion

# Poses are rounded by at most 0.5 mm along each axis, and by at most half a degree.
_METRES = 0.001
_QUATERNION = 1 / 256


def round_poses(T: np.ndarray) -> tuple[np.ndarray, list[bytes]]:
    """Round (k, 4, 4) poses in metres: (k, 4, 4) poses on a lattice, and a key of each."""
    quaternion = np.rint(quaternion_from_transform(T) / _QUATERNION) if len(T) else np.zeros((0, 4))
    steps = np.concatenate([np.rint(T[:, :3, 3] / _METRES), quaternion], axis=1).astype(np.int32)
    rounded = transform_from_quaternion(steps[:, 3:] * _QUATERNION, steps[:, :3] * _METRES) if len(T) else np.array(T)
    return rounded, [row.tobytes() for row in steps]
