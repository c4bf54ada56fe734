"""The part of a view that fusion stores: measured surface at low resolution, its instances, and the camera's pose."""

from typing import NamedTuple

import numpy as np

from active6d_core.camera import PinholeCamera, pool_depth
from active6d_core.hypotheses import Hypotheses
from active6d_core.se3 import invert, transform_points
from active6d_perception.compiled import compiled
from active6d_perception.model.ambiguity import Ambiguity

#: Length of the stored normals.
NORMAL = 127
# Images are reduced by an integer factor to about this width in pixels.
_WIDTH = 320


class MeasuredView(NamedTuple):
    """A view for compiled loops."""

    depth: np.ndarray
    """(h, w) float32 metres along z, NaN invalid"""
    normals: np.ndarray
    """(h, w, 3) int8 normals facing the camera, of length :data:`NORMAL`; 0 unknown"""
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
    z = np.ascontiguousarray(z)
    return MeasuredView(z, _normals(z, intrinsics), instance, middles, invert(T_world_camera), *intrinsics)


def move_view(view: MeasuredView, T_world_camera: np.ndarray) -> MeasuredView:
    """The same view from another (4, 4) pose of the camera; what is in the camera's frame stays."""
    middles = transform_points(T_world_camera @ view.T_camera_world, view.middles)
    return view._replace(T_camera_world=invert(T_world_camera), middles=middles)


@compiled
def _normals(depth: np.ndarray, intrinsics: tuple[float, float, float, float]) -> np.ndarray:
    """(h, w, 3) int8 normals, as :func:`active6d_core.camera.normals_from_points` over one pixel."""
    height, width = depth.shape
    normals = np.zeros((height, width, 3), np.int8)
    for v in range(1, height - 1):
        for u in range(1, width - 1):
            ax, ay, az = _difference(depth, v + 1, u, v - 1, u, intrinsics)
            bx, by, bz = _difference(depth, v, u + 1, v, u - 1, intrinsics)
            x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
            length = np.sqrt(x * x + y * y + z * z)
            if length > 0 and np.isfinite(depth[v, u]):
                fx, fy, cx, cy = intrinsics
                facing = x * (u - cx) / fx + y * (v - cy) / fy + z
                scale = (-NORMAL if facing > 0 else NORMAL) / length
                normals[v, u, 0], normals[v, u, 1] = np.rint(x * scale), np.rint(y * scale)
                normals[v, u, 2] = np.rint(z * scale)
    return normals


@compiled
def _difference(
    depth: np.ndarray, v: int, u: int, from_v: int, from_u: int, intrinsics: tuple[float, float, float, float]
) -> tuple[float, float, float]:
    """The vector between the points of two pixels."""
    fx, fy, cx, cy = intrinsics
    z, from_z = float(depth[v, u]), float(depth[from_v, from_u])
    return (
        (u - cx) / fx * z - (from_u - cx) / fx * from_z,
        (v - cy) / fy * z - (from_v - cy) / fy * from_z,
        z - from_z,
    )
