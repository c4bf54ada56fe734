"""Rounding of poses: a pose that hardly moved keeps its rounded pose, and results cached for that stay valid."""

import numpy as np

from active6d_core.se3 import invert
from active6d_perception.compiled import compiled

# Steps of a quaternion per metre: rotations are rounded by half a degree where positions are by 1 mm.
_QUATERNION = 1 / 0.256


def round_poses(T: np.ndarray, origin: np.ndarray, step: float) -> tuple[np.ndarray, list[bytes]]:
    """Round poses to lattices around their origins.

    Args:
        T: (k, 4, 4) metres.
        origin: (k, 4, 4) poses that are on the lattices, such as those that refinement started from.
        step: of positions, metres.

    Returns:
        (k, 4, 4) rounded poses, and a key of each.
    """
    offset, steps = _round(invert(origin) @ T, step)
    names = np.ascontiguousarray(origin[:, :3], float)
    return origin @ offset, [name.tobytes() + row.tobytes() for name, row in zip(names, steps, strict=True)]


@compiled
def _round(T: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """(k, 4, 4) rounded poses, and (k, 7) int32 numbers of steps of position and quaternion."""
    rounded, steps = np.zeros(T.shape), np.empty((len(T), 7), np.int32)
    for k in range(len(T)):
        for axis in range(3):
            steps[k, axis] = np.rint(T[k, axis, 3] / step)
            rounded[k, axis, 3] = steps[k, axis] * step
        x, y, z, w = _quaternion(T[k])
        quaternion_step = step * _QUATERNION
        a, b, c, d = (
            np.rint(x / quaternion_step),
            np.rint(y / quaternion_step),
            np.rint(z / quaternion_step),
            np.rint(w / quaternion_step),
        )
        steps[k, 3], steps[k, 4], steps[k, 5], steps[k, 6] = a, b, c, d
        length = np.sqrt(a * a + b * b + c * c + d * d)
        x, y, z, w = a / length, b / length, c / length, d / length
        R = rounded[k]
        R[0, 0], R[0, 1], R[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
        R[1, 0], R[1, 1], R[1, 2] = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
        R[2, 0], R[2, 1], R[2, 2] = 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)
        R[3, 3] = 1.0
    return rounded, steps


@compiled
def _quaternion(R: np.ndarray) -> tuple[float, float, float, float]:
    """x, y, z, w of a rotation; the largest of them is positive (Shepperd's method)."""
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    if trace >= max(R[0, 0], R[1, 1], R[2, 2]):
        w = 1 + trace
        x, y, z = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    elif R[0, 0] >= max(R[1, 1], R[2, 2]):
        x = 1 + R[0, 0] - R[1, 1] - R[2, 2]
        y, z, w = R[0, 1] + R[1, 0], R[0, 2] + R[2, 0], R[2, 1] - R[1, 2]
    elif R[1, 1] >= R[2, 2]:
        y = 1 + R[1, 1] - R[0, 0] - R[2, 2]
        x, z, w = R[0, 1] + R[1, 0], R[1, 2] + R[2, 1], R[0, 2] - R[2, 0]
    else:
        z = 1 + R[2, 2] - R[0, 0] - R[1, 1]
        x, y, w = R[0, 2] + R[2, 0], R[1, 2] + R[2, 1], R[1, 0] - R[0, 1]
    length = np.sqrt(x * x + y * y + z * z + w * w)
    return x / length, y / length, z / length, w / length
