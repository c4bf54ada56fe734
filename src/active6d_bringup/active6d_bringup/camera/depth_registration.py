"""Registration of depth to the colour camera."""

import numpy as np

from active6d_core.camera import PinholeCamera, backproject
from active6d_core.se3 import transform_points


def register_depth(
    depth: np.ndarray, depth_camera: PinholeCamera, color_camera: PinholeCamera, T_color_depth: np.ndarray
) -> np.ndarray:
    """Depth as the colour camera would measure it.

    Each depth pixel covers as many colour pixels as its own size projects to, and the nearest surface wins.

    Args:
        depth: (h, w) float32 metres of the rectified depth camera, NaN where invalid.
        depth_camera: its intrinsics.
        color_camera: intrinsics of the rectified colour camera.
        T_color_depth: (4, 4) pose of the depth camera's optical frame in the colour camera's.

    Returns:
        (H, W) float32 metres along the colour camera's axis, NaN where nothing projects to.
    """
    valid = np.isfinite(depth) & (depth > 0)
    points = transform_points(T_color_depth, backproject(depth, depth_camera)[valid].astype(float))
    z = points[:, 2]
    points, z, before = points[z > 0], z[z > 0], depth[valid][z > 0]
    u = color_camera.fx * points[:, 0] / z + color_camera.cx
    v = color_camera.fy * points[:, 1] / z + color_camera.cy
    # Half the size of a depth pixel in the colour image.
    half_u = 0.5 * color_camera.fx / depth_camera.fx * before / z
    half_v = 0.5 * color_camera.fy / depth_camera.fy * before / z
    left, right = np.ceil(u - half_u).astype(int), np.ceil(u + half_u).astype(int)
    top, bottom = np.ceil(v - half_v).astype(int), np.ceil(v + half_v).astype(int)
    right, bottom = np.maximum(right, left + 1), np.maximum(bottom, top + 1)
    nearest = np.full(color_camera.height * color_camera.width, np.inf)
    for row in range(int((bottom - top).max(initial=0))):
        for column in range(int((right - left).max(initial=0))):
            x, y = left + column, top + row
            covered = (x < right) & (y < bottom) & (x >= 0) & (y >= 0)
            covered &= (x < color_camera.width) & (y < color_camera.height)
            np.minimum.at(nearest, y[covered] * color_camera.width + x[covered], z[covered])
    nearest[np.isinf(nearest)] = np.nan
    return nearest.reshape(color_camera.height, color_camera.width).astype(np.float32)
