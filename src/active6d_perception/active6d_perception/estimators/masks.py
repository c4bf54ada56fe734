"""Masks of poses: the measured pixels that lie on the visible surface of each."""

import numpy as np

from active6d_core.camera import PinholeCamera, project
from active6d_perception.model.model_views import ModelViews


def claim_pixels(
    views: ModelViews,
    T_camera_object: np.ndarray,
    points: np.ndarray,
    candidates: np.ndarray,
    camera: PinholeCamera,
    *,
    gate: float = 0.006,
    min_new: float = 0.5,
    min_pixels: int = 30,
) -> np.ndarray:
    """Compute the masks of poses: the measured pixels that lie on the visible surface of each pose.

    Poses claim pixels in the given order, best first. A pose is left out if less than ``min_new`` of its pixels are
    unclaimed, because better poses explain the same pixels. Among the poses kept, a pixel belongs to the nearest one.

    Args:
        views: the object's precomputed views.
        T_camera_object: (k, 4, 4) poses in the optical frame, metres, best first.
        points: (H, W, 3) measured points in the optical frame, metres, NaN invalid.
        candidates: (H, W) bool, which pixels may belong to an object.
        camera: intrinsics of the images.
        gate: metres; a pose does not claim pixels farther than this from its surface.
        min_new: smallest unclaimed fraction of a pose's pixels.
        min_pixels: smallest number of pixels of a mask.

    Returns:
        (H, W) uint16: 1 + index of the pose, 0 without a pose.
    """
    label = np.zeros(candidates.shape, np.uint16)
    nearest = np.full(candidates.shape, gate)
    for index, (T, direction) in enumerate(zip(T_camera_object, views.nearest_direction(T_camera_object), strict=True)):
        crop = _box_of_pose(views, T, camera)
        rows, columns = np.nonzero(candidates[crop])
        local = (points[crop][rows, columns] - T[:3, 3]) @ T[:3, :3]
        distance, _ = views.visible_tree(int(direction))[1].query(local, distance_upper_bound=gate)
        near = distance < gate
        rows, columns, distance = rows[near], columns[near], distance[near]
        if (label[crop][rows, columns] == 0).sum() < max(min_new * len(rows), min_pixels):
            continue
        closer = distance < nearest[crop][rows, columns]
        nearest[crop][rows[closer], columns[closer]] = distance[closer]
        label[crop][rows[closer], columns[closer]] = index + 1
    too_small = np.bincount(label.ravel()) < min_pixels
    label[too_small[label]] = 0
    return label


def _box_of_pose(views: ModelViews, T_camera_object: np.ndarray, camera: PinholeCamera) -> tuple[slice, slice]:
    outline = views.outline @ T_camera_object[:3, :3].T + T_camera_object[:3, 3]
    uv = project(np.maximum(outline, (-np.inf, -np.inf, 1e-3)), camera)
    low = np.clip(np.floor(uv.min(axis=0)).astype(int) - 2, 0, (camera.width, camera.height))
    high = np.clip(np.ceil(uv.max(axis=0)).astype(int) + 3, 0, (camera.width, camera.height))
    return slice(low[1], high[1]), slice(low[0], high[0])
