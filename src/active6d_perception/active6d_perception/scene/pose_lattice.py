"""Rounds poses, so that a pose that hardly moved is the same as before and what was computed for it stays valid."""

import numpy as np

from active6d_core.se3 import quaternion_from_transform, transform_from_quaternion

# Steps of a quaternion per metre: rotations are rounded by half a degree where positions are by 0.5 mm.
_QUATERNION = 1 / 0.256


def round_poses(T: np.ndarray, step: float) -> tuple[np.ndarray, list[bytes]]:
    """Round (k, 4, 4) poses in metres: (k, 4, 4) poses on a lattice, and a key of each.

    Positions are multiples of ``step``, metres.
    """
    if not len(T):
        return np.array(T), []
    quaternion_step = step * _QUATERNION
    quaternion = quaternion_from_transform(T) / quaternion_step
    steps = np.rint(np.concatenate([T[:, :3, 3] / step, quaternion], axis=1)).astype(np.int32)
    return transform_from_quaternion(steps[:, 3:] * quaternion_step, steps[:, :3] * step), [s.tobytes() for s in steps]
