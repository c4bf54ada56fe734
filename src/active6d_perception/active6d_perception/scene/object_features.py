"""Box and depth of known poses in a camera (paper, "Objects feature representation")."""

import numpy as np

from active6d_core.camera import PinholeCamera
from active6d_perception.model.model_views import ModelViews


def project_features(
    views: ModelViews, T_camera_object: np.ndarray, camera: PinholeCamera
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the box and depth of objects in a camera, as if nothing hid them.

    Args:
        views: the object's precomputed views.
        T_camera_object: (n, 4, 4) poses in the optical frame, metres.
        camera: intrinsics.

    Returns:
        (n, 4) boxes, normalised and clipped to the image, and (n,) mean depths of the visible surface, metres.
    """
    R, t = T_camera_object[:, :3, :3], T_camera_object[:, :3, 3]
    # Each coordinate is one contiguous row, which is several times faster than one row per point.
    points = (R.reshape(-1, 3) @ views.outline.T).reshape(len(R), 3, len(views.outline)) + t[..., None]
    ratio = points[:, :2] / np.maximum(points[:, 2:], 1e-3)
    # Pixel coordinates grow with the ratios, so that only the extremes are needed.
    least, most = ratio.min(axis=2), ratio.max(axis=2)
    focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx + 0.5, camera.cy + 0.5])
    size = np.array([camera.width, camera.height])
    box = ((focal * np.concatenate([least, most], axis=1).reshape(-1, 2, 2) + centre) / size).reshape(-1, 4)
    box = np.minimum(np.maximum(box, 0.0), 1.0)
    centroid = views.centroids[views.nearest_direction(T_camera_object)]
    return box, np.einsum("nj,nj->n", R[:, 2], centroid) + t[:, 2]
