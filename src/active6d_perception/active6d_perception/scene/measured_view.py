"""What fusion keeps of a view: the measured surface at a low resolution, whose it is, and where the camera was."""

from typing import NamedTuple

import numpy as np

from active6d_core.camera import PinholeCamera, pool_depth
from active6d_core.hypotheses import Hypotheses
from active6d_core.se3 import invert, transform_points
from active6d_perception.compiled import compiled
from active6d_perception.scene.ambiguity import Ambiguity

# Images are reduced by an integer factor to about this width in pixels.
_WIDTH = 320


class MeasuredView(NamedTuple):
    """A view for compiled loops."""

    points: np.ndarray
    """(h, w, 3) float32 measured points in the optical frame, metres, NaN invalid"""
    normals: np.ndarray
    """(h, w, 3) float32 unit normals facing the camera, NaN unknown"""
    instance: np.ndarray
    """(h, w) int16 index of the pixel's instance, -1 without one"""
    middles: np.ndarray
    """(i, 3) middles of the instances' bodies, world, metres"""
    T_camera_world: np.ndarray
    """(4, 4)"""
    fx: float
    fy: float
    cx: float
    cy: float


def measure_view(
    depth: np.ndarray,
    camera: PinholeCamera,
    T_world_camera: np.ndarray,
    hypotheses: Hypotheses,
    ambiguity: Ambiguity,
) -> MeasuredView:
    """Reduce a view to what fusion keeps.

    Args:
        depth: (H, W) metres along z, NaN invalid.
        camera: intrinsics of ``depth``.
        T_world_camera: (4, 4) pose of the optical frame, metres.
        hypotheses: of the view, with masks of the size of ``depth``.
        ambiguity: of the object.

    Raises:
        ValueError: depth image, masks and camera differ in size.
    """
    if depth.shape != (camera.height, camera.width) or depth.shape != hypotheses.segmentation.shape:
        raise ValueError(
            f"depth image is {depth.shape}, masks are {hypotheses.segmentation.shape}, "
            f"the camera's images {(camera.height, camera.width)}"
        )
    factor = max(1, round(camera.width / _WIDTH))
    small, z = camera.reduced(factor), pool_depth(depth, factor)
    # Of alternatives for one instance the first, which is the best, stands for it.
    labels, first = np.unique(hypotheses.label, return_index=True)
    index_of = np.full(int(hypotheses.segmentation.max(initial=0)) + 1, -1, np.int16)
    index_of[labels[labels < len(index_of)]] = np.flatnonzero(labels < len(index_of))
    instance = index_of[hypotheses.segmentation[::factor, ::factor][: small.height, : small.width]]
    middles = transform_points(T_world_camera @ hypotheses.T_camera_object[first], ambiguity.middle[None])[:, 0]
    intrinsics = small.fx, small.fy, small.cx, small.cy
    points, normals = _surface(np.ascontiguousarray(z), intrinsics)
    return MeasuredView(points, normals, instance, middles, invert(T_world_camera), *intrinsics)


@compiled
def _surface(depth: np.ndarray, intrinsics: tuple[float, float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals of a depth image, as :func:`active6d_core.camera.normals_from_points` over one pixel."""
    height, width = depth.shape
    fx, fy, cx, cy = intrinsics
    points = np.empty((height, width, 3), np.float32)
    normals = np.full((height, width, 3), np.nan, np.float32)
    for v in range(height):
        for u in range(width):
            z = depth[v, u]
            points[v, u, 0] = np.float32((u - cx) / fx) * z
            points[v, u, 1] = np.float32((v - cy) / fy) * z
            points[v, u, 2] = z
    for v in range(1, height - 1):
        for u in range(1, width - 1):
            ax, ay, az = _difference(points, v + 1, u, v - 1, u)
            bx, by, bz = _difference(points, v, u + 1, v, u - 1)
            x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
            length = np.sqrt(x * x + y * y + z * z)
            if length > 0:
                facing = x * points[v, u, 0] + y * points[v, u, 1] + z * points[v, u, 2]
                length = -length if facing > 0 else length
                normals[v, u, 0], normals[v, u, 1], normals[v, u, 2] = x / length, y / length, z / length
    return points, normals


@compiled
def _difference(points: np.ndarray, v: int, u: int, from_v: int, from_u: int) -> tuple[float, float, float]:
    """The vector between the points of two pixels."""
    return (
        points[v, u, 0] - points[from_v, from_u, 0],
        points[v, u, 1] - points[from_v, from_u, 1],
        points[v, u, 2] - points[from_v, from_u, 2],
    )
