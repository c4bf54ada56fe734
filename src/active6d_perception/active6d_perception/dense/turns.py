"""How far an object is turned about its axis of near symmetry, by what the depth image forbids.

The network says how likely each turn is by how the object looks. The depth image says more: the named part (the
handle) cannot be where the camera looked through. What remains possible is told as a distribution.
"""

import numpy as np

from active6d_core.camera import PinholeCamera, project
from active6d_core.se3 import transform_points

_SAMPLES = 96
_TOLERANCE = 0.006  # metres
_AGAINST = 12.0  # log-likelihood of a part that is wholly where the camera looked through, negative
_FOR = 3.0  # log-likelihood of a part that is wholly measured where it should be


def feature_samples(points: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """At most 96 of the (n, 3) ``points`` that ``mask`` selects, evenly taken."""
    selected = points[mask]
    return selected[np.linspace(0, len(selected) - 1, min(_SAMPLES, len(selected))).astype(np.intp)]


def turn_evidence(T_camera_part: np.ndarray, part: np.ndarray, depth: np.ndarray, camera: PinholeCamera) -> np.ndarray:
    """Log-likelihood of depth measurements, up to a constant, for the part being at each of many poses.

    Args:
        T_camera_part: (n, t, 4, 4) poses, t turns of n objects.
        part: (s, 3) points of the part.
        depth: (H, W) metres, NaN invalid.
        camera: intrinsics.

    Returns:
        (n, t).
    """
    points = transform_points(T_camera_part, part)
    z = np.maximum(points[..., 2], 1e-3)
    u, v = np.moveaxis(
        np.rint(project(np.concatenate([points[..., :2], z[..., None]], axis=-1), camera)).astype(np.intp), -1, 0
    )
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    behind = np.where(inside, z - depth[np.where(inside, v, 0), np.where(inside, u, 0)], np.inf)
    through = (behind < -2 * _TOLERANCE).mean(axis=-1)
    measured = (np.abs(behind) < _TOLERANCE).mean(axis=-1)
    return _FOR * measured - _AGAINST * through
