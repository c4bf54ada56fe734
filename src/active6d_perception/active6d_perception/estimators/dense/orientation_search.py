"""Search for the orientations of an instance that fit its measured surface.

Averaged votes give one orientation, which may be wrong, and refinement only corrects errors up to about 15 degrees. For
objects without (near) symmetry, the search compares thousands of orientations with the instance's points instead. A
grid of precomputed distances makes each comparison cheap. The network's output selects the orientations to try.
"""

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from active6d_core.object_model import ObjectModel
from active6d_core.se3 import make_transform
from active6d_perception.estimators.dense.canonical_frame import rotation_about_z
from active6d_perception.estimators.dense.decoding import Instances, member_table
from active6d_perception.estimators.dense.measured_surface import MeasuredSurface
from active6d_perception.estimators.dense.network_input import ray_rotation
from active6d_perception.estimators.dense.sphere_bins import kernel
from active6d_perception.model.model_views import model_views

_SUBDIVISIONS = 2  # of an icosahedron: 162 axes, 18 degrees apart
_ANGLES_PER_AXIS = 24
# Rounds of (orientations per instance, points of the instance): first the orientations that the network finds likeliest
# on few points, then the best of these on more points.
_ROUNDS = ((2000, 24), (500, 64))
_CELL = 0.02  # diameters, of the grid of distances
_REACH = 0.1  # diameters: a point farther than this from the surface does not fit
_APART = np.radians(25.0)
_AXIS_TRUST = 3.0  # concentration of the distribution of the axis about the network's vote
_NETWORK_TRUST = 0.05  # weight of the network's log-probability beside the mean fit of the points


class OrientationSearch:
    """Compares orientations of an object with the measured points of its instances."""

    def __init__(self, model: ObjectModel) -> None:
        axes = trimesh.creation.icosphere(_SUBDIVISIONS).vertices
        about_axis = rotation_about_z(np.linspace(0, 2 * np.pi, _ANGLES_PER_AXIS, endpoint=False))[:, :3, :3]
        self._R = (ray_rotation(_off_pole(axes))[:, None] @ about_axis).reshape(-1, 3, 3).astype(np.float32)
        self._bins = kernel(self._R[:, :, 0])
        views = model_views(model)
        self._cell, reach = _CELL * model.diameter, _REACH * model.diameter
        extent = np.abs(views.points).max(axis=0) + reach
        self._half = np.ceil(extent / self._cell).astype(int) + 1
        axes = [self._cell * np.arange(-half, half + 1) for half in self._half]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        distance, nearest = cKDTree(views.points).query(grid.reshape(-1, 3), distance_upper_bound=reach)
        self._shape = 2 * self._half + 1
        self._nearness = np.where(np.isfinite(distance), 1 - distance / reach, 0).astype(np.float32)
        self._normals = np.append(views.normals, np.zeros((1, 3), np.float32), axis=0)[nearest]

    def candidates(self, instances: Instances, surface: MeasuredSurface, count: int) -> np.ndarray:
        """The orientations that fit best, at the centres that the network voted for.

        Args:
            instances: the decoded instances; their axis frame is the object's frame.
            surface: what the view measured.
            count: number of orientations per instance.

        Returns:
            (n, count, 4, 4) ``T_camera_object``, metres, best first, those of one instance at least 25 degrees apart.
        """
        centre = instances.T_camera_axis[:, :3, 3]
        # All in the frame of the ray through the instance's centre, like the network's output.
        R_camera_ray = ray_rotation(centre)
        axis = np.einsum("nij,ni->nj", R_camera_ray, instances.T_camera_axis[:, :3, 2])
        predicted = np.log(instances.direction @ self._bins.T + 1e-3) + _AXIS_TRUST * axis @ self._R[:, :, 2].T
        worth, tried = predicted, np.broadcast_to(np.arange(len(self._R)), predicted.shape)
        for number, points in _ROUNDS:
            kept = np.argpartition(-worth, number, axis=1)[:, :number]
            tried = np.take_along_axis(tried, kept, axis=1)
            R = self._R[tried]
            fit = self._fit(R, R_camera_ray, centre, surface, points)
            worth = fit + _NETWORK_TRUST * np.take_along_axis(predicted, tried, axis=1)
        rows, best = np.arange(len(instances)), np.zeros((len(instances), count), np.intp)
        for rank in range(count):
            best[:, rank] = worth.argmax(axis=1)
            cosine = (np.einsum("nkij,nij->nk", R, R[rows, best[:, rank]]) - 1) / 2
            worth = np.where(cosine > np.cos(_APART), -np.inf, worth)
        chosen = R_camera_ray[:, None] @ R[rows[:, None], best]
        return make_transform(chosen, np.broadcast_to(centre[:, None], (*best.shape, 3)))

    def _fit(
        self,
        R_ray_object: np.ndarray,
        R_camera_ray: np.ndarray,
        centre: np.ndarray,
        surface: MeasuredSurface,
        points: int,
    ) -> np.ndarray:
        """(n, k) fit in [0, 1]: mean over points of nearness to the model's surface times agreement of the normals."""
        normals = surface.normals.reshape(-1, 3)
        pixel = np.flatnonzero((surface.owner.ravel() >= 0) & np.isfinite(normals).all(axis=1))
        table, used = member_table(surface.owner.ravel()[pixel], len(centre), points)
        pixel = pixel[table] if len(pixel) else table
        from_centre = ((surface.points.reshape(-1, 3)[pixel] - centre[:, None]) @ R_camera_ray).astype(np.float32)
        normals = (np.nan_to_num(normals[pixel]) @ R_camera_ray).astype(np.float32)
        cell = np.rint(from_centre[:, None] @ R_ray_object / self._cell).astype(np.int32) + self._half
        inside = ((cell >= 0) & (cell < self._shape)).all(axis=-1) & used[:, None]
        flat = np.where(inside, np.ravel_multi_index(np.moveaxis(cell, -1, 0), self._shape, mode="clip"), 0)
        alike = np.einsum("nkpi,nkpi->nkp", normals[:, None] @ R_ray_object, self._normals[flat])
        fit = np.where(inside, self._nearness[flat] * np.maximum(alike, 0), 0)
        return fit.sum(axis=2) / np.maximum(used.sum(axis=1), 1)[:, None]


def _off_pole(axes: np.ndarray) -> np.ndarray:
    """The axes, tilted slightly, because the shortest rotation from +z to -z is not defined."""
    return axes + np.array([1e-4, 2e-4, 0.0])
