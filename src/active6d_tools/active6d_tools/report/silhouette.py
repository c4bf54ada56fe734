"""Silhouettes of a posed model in a picture, with what the measured depth hides cut away."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import open3d as o3d
from contourpy import contour_generator
from matplotlib.path import Path as Polygon
from scipy.ndimage import binary_opening, gaussian_filter

from active6d_core.camera import PinholeCamera, pixel_rays, project
from active6d_core.object_model import ObjectModel
from active6d_core.se3 import invert, transform_points
from active6d_perception.model.model_views import ray_caster


@dataclass(frozen=True, eq=False)
class Outline:
    """What one posed model looks like in a picture.

    Attributes:
        full: closed polygons, each (n, 2) pixels (u, v), of the whole silhouette; empty outside the picture.
        visible: the same for the part that the measured depth does not hide.
        visible_fraction: visible over whole silhouette area; 0 for a silhouette outside the picture.
        center: (2,) pixels, of the visible part, else of the whole silhouette; None outside the picture.
        axes: (4, 2) pixels of the object frame's origin and the tips of its x, y and z axes; None behind the camera.
    """

    full: list[np.ndarray]
    visible: list[np.ndarray]
    visible_fraction: float
    center: np.ndarray | None
    axes: np.ndarray | None


class SilhouetteDrawer:
    """Outlines of one model under any pose, by casting the picture's own rays at its mesh (Open3D, Embree).

    Args:
        depth_margin: metres by which a model surface may lie behind the measured depth and still count as seen;
            covers sensor noise and small pose errors.
    """

    def __init__(self, model: ObjectModel, depth_margin: float = 0.008) -> None:
        self._depth_margin = depth_margin
        self._radius = float(np.linalg.norm(model.mesh.vertices, axis=1).max())
        self._corners = np.array(np.meshgrid(*([[-1.0, 1.0]] * 3))).reshape(3, -1).T * self._radius
        self._axis_tips = np.concatenate([np.zeros((1, 3)), np.eye(3) * 0.4 * model.diameter])
        self._scene = ray_caster(model.mesh, threads=1)

    def depth(self, T_camera_object: np.ndarray, camera: PinholeCamera) -> tuple[tuple[slice, slice], np.ndarray]:
        """The model's own depth under (4, 4) ``T_camera_object``.

        Returns:
            The window (rows, columns) of the picture that holds the model, and its depth there in metres, infinite
            beside the model. The window is empty for a model that is not in front of the camera.
        """
        window = self._window(T_camera_object, camera)
        rays = pixel_rays(camera)[window]
        T_object_camera = invert(T_camera_object)
        directions = rays @ T_object_camera[:3, :3].T
        origins = np.broadcast_to(T_object_camera[:3, 3], directions.shape)
        bundle = np.concatenate([origins, directions], axis=-1).astype(np.float32)
        if not bundle.size:
            return window, np.full(bundle.shape[:2], np.inf)
        # Rays have z = 1 in the camera frame, so the parameter at the hit is the depth itself.
        return window, self._scene.cast_rays(o3d.core.Tensor(bundle), nthreads=1)["t_hit"].numpy()

    def outline(
        self, T_camera_object: np.ndarray, camera: PinholeCamera, measured_depth: np.ndarray | None = None
    ) -> Outline:
        """Outline of the model under (4, 4) ``T_camera_object``; parts behind (H, W) ``measured_depth`` are hidden."""
        window, depth = self.depth(T_camera_object, camera)
        whole = np.isfinite(depth)
        seen = whole
        if measured_depth is not None:
            seen = whole & ~(depth > measured_depth[window] + self._depth_margin)
        offset = np.array([window[1].start, window[0].start], float)
        shown = seen if seen.any() else whole
        center = np.argwhere(shown).mean(axis=0)[::-1] + offset if shown.any() else None
        return Outline(
            full=_contours(whole, offset),
            visible=_contours(seen, offset),
            visible_fraction=float(seen.sum() / max(whole.sum(), 1)),
            center=center,
            axes=_project_in_front(transform_points(T_camera_object, self._axis_tips), camera),
        )

    def _window(self, T_camera_object: np.ndarray, camera: PinholeCamera) -> tuple[slice, slice]:
        corners = _project_in_front(T_camera_object[:3, 3] + self._corners, camera)
        if corners is None:
            return slice(0, 0), slice(0, 0)
        size = (camera.width, camera.height)
        low = np.clip(np.floor(corners.min(axis=0)), 0, size).astype(int)
        high = np.clip(np.ceil(corners.max(axis=0)) + 1, 0, size).astype(int)
        return slice(low[1], high[1]), slice(low[0], high[0])


def _project_in_front(points: np.ndarray, camera: PinholeCamera) -> np.ndarray | None:
    if not (points[:, 2] > 0.01).all():
        return None
    return project(points, camera)


def _contours(mask: np.ndarray, offset: np.ndarray) -> list[np.ndarray]:
    """Outer and inner polygons of a mask, specks of noise removed, shifted by (2,) ``offset`` pixels."""
    if not mask.any():
        return []
    padded = np.pad(binary_opening(mask, np.ones((3, 3))), 2)
    lines: Any = contour_generator(z=gaussian_filter(padded.astype(np.float32), 0.7)).lines(0.5)
    polygons = (Polygon(line) for line in lines if _area(line) > 12.0)
    return [_simplify(polygon) - 2.0 + offset for polygon in polygons]


def _simplify(polygon: Polygon) -> np.ndarray:
    """(n, 2) vertices, fewer than the polygon's."""
    polygon.simplify_threshold = 0.35
    simple = polygon.cleaned(simplify=True)
    return np.asarray(simple.vertices)[simple.codes != Polygon.STOP]


def _area(line: np.ndarray) -> float:
    x, y = line.T
    return abs(0.5 * float(x @ np.roll(y, 1) - y @ np.roll(x, 1)))
