"""A depth image as points and normals, smoothed within surfaces, as compiled loops take it."""

from typing import NamedTuple

import numpy as np

from active6d_core.camera import PinholeCamera
from active6d_perception.compiled import compiled

_GATE = 0.008  # metres between depths that are smoothed together
_SMOOTHED = 2  # pixels to either side
_REACH = 3 / 640  # half the width of the differences that normals come from, image widths


class MeasuredImage(NamedTuple):
    """What a depth image measured, in the optical frame."""

    points: np.ndarray
    """(H, W, 3) float32 metres, NaN invalid"""
    normals: np.ndarray
    """(H, W, 3) float32 unit normals facing the camera, NaN unknown"""
    fx: float
    fy: float
    cx: float
    cy: float


def measure_image(depth: np.ndarray, camera: PinholeCamera) -> MeasuredImage:
    """Points and normals of a depth image.

    Args:
        depth: (H, W) metres along z, NaN invalid.
        camera: intrinsics.
    """
    reach = max(1, round(_REACH * camera.width))
    smooth = _smooth_within_surfaces(np.ascontiguousarray(depth, np.float32))
    intrinsics = float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy)
    points = _backproject(smooth, *intrinsics)
    return MeasuredImage(points, _normals(points, reach), *intrinsics)


def _smooth_within_surfaces(depth: np.ndarray) -> np.ndarray:
    """(H, W) float32 depth in metres, smoothed along rows and columns; edges stay sharp, invalid pixels invalid."""
    along = _smooth_rows(depth)
    return np.ascontiguousarray(_smooth_rows(np.ascontiguousarray(along.T)).T)


@compiled
def _smooth_rows(depth: np.ndarray) -> np.ndarray:
    """Means along rows over neighbours at most 8 mm nearer or farther; NaN stays."""
    height, width = depth.shape
    result = np.empty_like(depth)
    for v in range(height):
        for u in range(width):
            own, total, count = depth[v, u], np.float32(0), 0
            for other in range(max(0, u - _SMOOTHED), min(width, u + _SMOOTHED + 1)):
                if abs(depth[v, other] - own) < _GATE:
                    total += depth[v, other]
                    count += 1
            result[v, u] = total / count if count else np.nan
    return result


@compiled
def _backproject(depth: np.ndarray, fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    height, width = depth.shape
    points = np.empty((height, width, 3), np.float32)
    for v in range(height):
        for u in range(width):
            z = depth[v, u]
            points[v, u, 0] = (u - cx) / fx * z
            points[v, u, 1] = (v - cy) / fy * z
            points[v, u, 2] = z
    return points


@compiled
def _normals(points: np.ndarray, reach: int) -> np.ndarray:
    """(H, W, 3) central differences over ``reach`` pixels each way; NaN at the border and beside invalid pixels."""
    height, width = points.shape[:2]
    normals = np.full(points.shape, np.nan, np.float32)
    for v in range(reach, height - reach):
        for u in range(reach, width - reach):
            left, right = points[v, u - reach], points[v, u + reach]
            above, below = points[v - reach, u], points[v + reach, u]
            hx, hy, hz = right[0] - left[0], right[1] - left[1], right[2] - left[2]
            vx, vy, vz = below[0] - above[0], below[1] - above[1], below[2] - above[2]
            x, y, z = vy * hz - vz * hy, vz * hx - vx * hz, vx * hy - vy * hx
            own = points[v, u]
            length = np.sqrt(x * x + y * y + z * z)
            if not length > 0:
                continue
            if x * own[0] + y * own[1] + z * own[2] > 0:
                length = -length
            normals[v, u, 0], normals[v, u, 1], normals[v, u, 2] = x / length, y / length, z / length
    return normals
