"""Refinement, evidence and masks of pose candidates from a depth image, used by all estimators.

All functions use only the part of the model's surface that the camera can see. With hidden surface, the iterative
closest point method would pull the far side of a thin-walled object onto measurements of the near side.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from active6d_core.camera import PinholeCamera, project
from active6d_perception.model.model_views import ModelViews
from active6d_perception.registration import point_to_plane_step


@dataclass(frozen=True, eq=False)
class Evidence:
    """Evidence of a depth image for k poses, as fractions of the model surface that the camera would see.

    Attributes:
        fitting: (k,) fraction measured where the pose puts it, with a similar normal.
        violated: (k,) fraction that the camera looked through: something behind it was measured.
        occluded: (k,) fraction behind something else.
    """

    fitting: np.ndarray
    violated: np.ndarray
    occluded: np.ndarray


def weigh_evidence(
    views: ModelViews,
    T_camera_object: np.ndarray,
    depth: np.ndarray,
    normals: np.ndarray,
    camera: PinholeCamera,
    *,
    samples: int = 128,
    tolerance: float = 0.006,
) -> Evidence:
    """Compare the visible model surface of each pose with the depth measured at its pixels.

    Args:
        views: the object's precomputed views.
        T_camera_object: (k, 4, 4) poses in the optical frame, metres.
        depth: (H, W) metres along z, NaN invalid.
        normals: (H, W, 3) unit normals facing the camera, NaN unknown.
        camera: intrinsics of both images.
        samples: number of visible model points compared per pose.
        tolerance: metres in depth within which a point fits; from twice that on it is violated or occluded.
    """
    index, used = views.visible_subset(samples)
    direction = views.nearest_direction(T_camera_object)
    chosen, used = index[direction], used[direction]
    R = T_camera_object[:, :3, :3].astype(np.float32)
    points = views.points[chosen] @ np.swapaxes(R, 1, 2) + T_camera_object[:, None, :3, 3].astype(np.float32)
    surface_normals = views.normals[chosen] @ np.swapaxes(R, 1, 2)
    z = np.maximum(points[..., 2], 1e-3)
    u = np.rint(points[..., 0] / z * camera.fx + camera.cx).astype(np.intp)
    v = np.rint(points[..., 1] / z * camera.fy + camera.cy).astype(np.intp)
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    pixel = np.where(inside, v * camera.width + u, 0)
    behind = z - depth.ravel()[pixel]
    alike = np.einsum("ksi,ksi->ks", normals.reshape(-1, 3)[pixel], surface_normals) > 0.7
    used &= np.isfinite(behind) | ~inside
    total = np.maximum(used.sum(axis=1), 1)

    def fraction(mask: np.ndarray) -> np.ndarray:
        return (mask & used).sum(axis=1) / total

    return Evidence(
        fitting=fraction(inside & (np.abs(behind) < tolerance) & alike),
        violated=fraction(inside & (behind < -2 * tolerance)),
        occluded=fraction(inside & (behind > 2 * tolerance)),
    )


def refine(
    views: ModelViews,
    T_camera_object: np.ndarray,
    scene: cKDTree,
    scene_normals: np.ndarray,
    *,
    gates: tuple[float, ...] = (0.008, 0.004),
    iterations: int = 5,
    samples: int = 192,
) -> np.ndarray:
    """Point-to-plane ICP of many poses at once, each with only the model points visible from the camera.

    A visible model point corresponds to the nearest scene point if that is within the gate and has a similar normal.
    The planes are the model's, which have no noise.

    Args:
        views: the object's precomputed views.
        T_camera_object: (k, 4, 4) initial poses in the optical frame, metres.
        scene: search tree over (n, 3) measured points in the optical frame, metres.
        scene_normals: (n, 3) unit normals facing the camera.
        gates: largest distance of correspondences in each stage, metres.
        iterations: number of iterations per stage.
        samples: number of model points per pose.

    Returns:
        (k, 4, 4) refined poses; a pose with fewer than 6 correspondences is unchanged.
    """
    T = np.array(T_camera_object, float)
    index, used = views.visible_subset(samples)
    for gate in gates:
        direction = views.nearest_direction(T)
        chosen, valid = index[direction], used[direction]
        for _ in range(iterations):
            R = T[:, :3, :3]
            points = views.points[chosen] @ np.swapaxes(R, 1, 2) + T[:, None, :3, 3]
            normals = views.normals[chosen] @ np.swapaxes(R, 1, 2)
            distance, nearest = scene.query(points, distance_upper_bound=gate)
            matched = valid & np.isfinite(distance)
            nearest = np.where(matched, nearest, 0)
            matched &= np.einsum("ksi,ksi->ks", scene_normals[nearest], normals) > 0.5
            T = point_to_plane_step(T, points, normals, scene.data[nearest], matched)
    return T


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
