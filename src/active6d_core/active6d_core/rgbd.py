"""Checks RGB-D images that come from outside, and converts them to what the estimators expect.

Users bring depth in millimetres, zeros for missing pixels, or intrinsics of another resolution. What has one clear
meaning is converted. What is impossible is refused with its likely cause.
"""

from dataclasses import replace

import numpy as np

from active6d_core.bounds import FARTHEST, PLAUSIBLE_DEPTH, check_image_size, limit_depth
from active6d_core.camera import PinholeCamera, View, backproject
from active6d_core.se3 import is_rigid, transform_points

_MILLIMETRES = 1e-3


def make_view(
    rgb: np.ndarray,
    depth: np.ndarray,
    camera: PinholeCamera | np.ndarray,
    *,
    depth_scale: float | None = None,
    T_world_camera: np.ndarray | None = None,
    stamp: int = 0,
) -> View:
    """One registered RGB-D view from arrays of many kinds.

    Args:
        rgb: (H, W, 3) or (H, W, 4) uint8 RGB, or (H, W) uint8 grey.
        depth: (H, W) along the optical axis; zero, negative and non-finite values are invalid.
        camera: intrinsics of both images, or their (3, 3) matrix K in pixels.
        depth_scale: metres per unit of ``depth``; None for 1 with floating-point depth and 0.001 with integers
            (REP-118).
        T_world_camera: (4, 4) pose of the optical frame in the world, the identity when None.
        stamp: nanoseconds.

    Raises:
        ValueError: an array has a wrong shape or type, or values that cannot be meant; the message says which.
    """
    metres = check_depth(depth, depth_scale)
    height, width = metres.shape
    check_image_size(width, height)
    color = check_color(rgb)
    if color.shape[:2] != metres.shape:
        raise ValueError(
            f"rgb is {color.shape[1]}x{color.shape[0]} pixels, depth {width}x{height}; register them first"
        )
    if not isinstance(camera, PinholeCamera):
        camera = PinholeCamera.from_matrix(camera, width, height)
    if (camera.width, camera.height) != (width, height):
        raise ValueError(f"the camera is for {camera.width}x{camera.height} pixels, the images have {width}x{height}")
    T = np.eye(4) if T_world_camera is None else np.asarray(T_world_camera, float)
    if T.shape != (4, 4) or not np.isfinite(T).all() or not is_rigid(T, 1e-3):
        raise ValueError("T_world_camera must be a rigid (4, 4) transform in metres")
    if np.linalg.norm(T[:3, 3]) > FARTHEST:
        raise ValueError(f"T_world_camera is over {FARTHEST:g} m from the origin; are its metres millimetres?")
    return View(stamp, color, metres, camera, T)


def check_view(view: View) -> View:
    """The view as estimators need it: unchanged if it is so, else as :func:`make_view` converts it.

    A view without a valid pixel stays as it is: nothing is found in it.

    Raises:
        ValueError: the images cannot be meant; see :func:`make_view`.
    """
    if not isinstance(view, View):
        raise ValueError(f"a View is needed, got {type(view).__name__}; estimate views one by one")
    depth, color, size = np.asarray(view.depth), np.asarray(view.color), (view.camera.height, view.camera.width)
    usual = depth.dtype == np.float32 and color.dtype == np.uint8 and depth.shape == size and color.shape == (*size, 3)
    if usual and ((depth > 0) & (depth <= PLAUSIBLE_DEPTH[1]) | np.isnan(depth)).all():
        return view
    if usual and not ((depth > 0) & np.isfinite(depth)).any():
        return replace(view, depth=np.full(size, np.nan, np.float32))
    return make_view(color, depth, view.camera, T_world_camera=view.T_world_camera, stamp=view.stamp)


def check_color(rgb: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8 RGB from grey, RGB or RGBA; see :func:`make_view`.

    Raises:
        ValueError: another shape or type.
    """
    rgb = np.asarray(rgb)
    if rgb.dtype != np.uint8:
        raise ValueError(f"rgb must be uint8 from 0 to 255, got {rgb.dtype}; convert it first")
    if rgb.ndim == 2:
        rgb = np.repeat(rgb[..., None], 3, axis=2)
    if rgb.ndim != 3 or rgb.shape[2] not in (3, 4):
        raise ValueError(f"rgb must be (H, W, 3), (H, W, 4) or (H, W), got {rgb.shape}")
    return np.ascontiguousarray(rgb[..., :3])


def check_depth(depth: np.ndarray, depth_scale: float | None = None) -> np.ndarray:
    """(H, W) float32 metres with NaN for invalid pixels and implausible distances; see :func:`make_view`.

    Raises:
        ValueError: another shape or type, no valid pixel, or distances that cannot be metres.
    """
    depth = np.asarray(depth)
    if depth.ndim == 3 and depth.shape[2] == 1:
        depth = depth[..., 0]
    if depth.ndim != 2 or not depth.size or depth.dtype.kind not in "iuf":
        raise ValueError(f"depth must be (H, W) numbers, got {depth.dtype} of shape {depth.shape}")
    if depth_scale is None:
        depth_scale = 1.0 if depth.dtype.kind == "f" else _MILLIMETRES
    if not 0 < depth_scale < np.inf:
        raise ValueError(f"depth_scale must be positive metres per unit, got {depth_scale}")
    metres = depth.astype(float) * depth_scale
    metres = np.where(np.isfinite(metres) & (metres > 0), metres, np.nan).astype(np.float32)
    if np.isnan(metres).all():
        raise ValueError("depth has no valid pixel: all are zero, negative, NaN or infinite")
    median = float(np.nanmedian(metres))
    low, high = PLAUSIBLE_DEPTH
    if median > high:
        raise ValueError(f"depth has a median of {median:.4g} m; it looks like millimetres, set depth_scale=0.001")
    if median < low:
        raise ValueError(
            f"depth has a median of {median:.4g} m; check depth_scale, which is {depth_scale:g} m per unit"
        )
    return limit_depth(metres)


def crop_depth(
    view: View,
    depth_range: tuple[float, float] | None = None,
    region: tuple[np.ndarray, np.ndarray] | None = None,
    region_in_world: bool = False,
) -> View:
    """The view with its depth invalid outside a range of distances and outside a box.

    Args:
        view: left as it is.
        depth_range: nearest and farthest distance along the optical axis, metres.
        region: (3,) lowest and (3,) highest corner of an axis-aligned box, metres.
        region_in_world: the box is in the world instead of the camera's optical frame.

    Raises:
        ValueError: the range or the box is empty, or leaves no valid pixel.
    """
    keep = np.isfinite(view.depth)
    if depth_range is not None:
        near, far = depth_range
        if not 0 <= near < far:
            raise ValueError(f"depth range must be 0 <= near < far in metres, got {near:g} and {far:g}")
        keep &= (view.depth >= near) & (view.depth <= far)
    if region is not None:
        low, high = np.asarray(region[0], float), np.asarray(region[1], float)
        if low.shape != (3,) or high.shape != (3,) or not (low < high).all():
            raise ValueError("region must be the lowest and the highest corner of a box, metres")
        points = backproject(view.depth, view.camera)
        if region_in_world:
            points = transform_points(view.T_world_camera, points.reshape(-1, 3)).reshape(points.shape)
        keep &= ((points >= low) & (points <= high)).all(axis=-1)
    if not keep.any():
        measured = f"{np.nanmin(view.depth):.2f} to {np.nanmax(view.depth):.2f} m"
        raise ValueError(f"no depth pixel is inside the range and region; the image measures {measured}")
    depth = np.where(keep, view.depth, np.nan).astype(np.float32)
    return View(view.stamp, view.color, depth, view.camera, view.T_world_camera)
