"""Search for the orientations of an instance that fit its measured surface.

Averaged votes give one orientation, which may be wrong, and refinement only corrects errors up to about 15 degrees. The
search compares many orientations with the instance's points instead: thousands, or 162 for an object that looks the
same at every rotation about its axis. A grid of precomputed distances makes each comparison cheap. The network's
output selects the orientations to try.
"""

from typing import NamedTuple

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from active6d_core.object_model import ObjectModel
from active6d_core.se3 import invert, make_transform, transform_points
from active6d_perception.compiled import compiled
from active6d_perception.estimators.dense.canonical_frame import AxisRotation, CanonicalFrame, rotation_about_z
from active6d_perception.estimators.dense.decoding import Instances
from active6d_perception.estimators.dense.measured_surface import MeasuredSurface
from active6d_perception.estimators.dense.network_input import ray_rotation
from active6d_perception.estimators.dense.sphere_bins import kernel
from active6d_perception.model.model_views import model_views

_SUBDIVISIONS = 2  # of an icosahedron: 162 axes, 18 degrees apart
# By what shows the rotation about the axis: the number of rotations tried about each of the axes, and rounds of
# (orientations per instance, points of the instance). The orientations of a round are the best so far; at first those
# that the network finds likeliest.
_ROUNDS = {
    AxisRotation.VISIBLE: (24, ((2000, 24), (500, 64))),
    AxisRotation.SHOWN_BY_FEATURE: (8, ((300, 48),)),
    AxisRotation.INVISIBLE: (1, ((162, 48),)),
}
_CELL = 0.02  # diameters, of the grid of distances
_REACH = 0.1  # diameters: a point farther than this from the surface does not fit
_APART = np.radians(25.0)
_AXIS_TRUST = 3.0  # concentration of the distribution of the axis about the network's vote
_NETWORK_TRUST = 0.05  # weight of the network's log-probability beside the mean fit of the points


class OrientationSearch:
    """Compares orientations of an object with the measured points of its instances.

    All orientations are of the axis frame.
    """

    def __init__(self, model: ObjectModel, canonical_frame: CanonicalFrame) -> None:
        self._by_axis = canonical_frame.axis_rotation is AxisRotation.INVISIBLE
        rotations, self._rounds = _ROUNDS[canonical_frame.axis_rotation]
        axes = trimesh.creation.icosphere(_SUBDIVISIONS).vertices
        about_axis = rotation_about_z(np.linspace(0, 2 * np.pi, rotations, endpoint=False))[:, :3, :3]
        self._R = (ray_rotation(_off_pole(axes))[:, None] @ about_axis).reshape(-1, 3, 3).astype(np.float32)
        self._bins = kernel(self._R[:, :, 0])
        views = model_views(model)
        T_axis_object = invert(canonical_frame.T_object_axis)
        points = transform_points(T_axis_object, views.points)
        normals = (views.normals @ T_axis_object[:3, :3].T).astype(np.float32)
        cell, reach = _CELL * model.diameter, _REACH * model.diameter
        half = np.ceil((np.abs(points).max(axis=0) + reach) / cell).astype(int) + 1
        steps = [cell * np.arange(-count, count + 1) for count in half]
        middles = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1)
        distance, nearest = cKDTree(points).query(middles, distance_upper_bound=reach)
        nearness = np.where(np.isfinite(distance), 1 - distance / reach, 0).astype(np.float32)
        self._grid = _Grid(cell, half, nearness, np.append(normals, np.zeros((1, 3), np.float32), axis=0)[nearest])

    def candidates(self, instances: Instances, surface: MeasuredSurface, count: int) -> np.ndarray:
        """The orientations that fit best, at the centres that the network voted for.

        Args:
            instances: the decoded instances.
            surface: what the view measured.
            count: number of orientations per instance.

        Returns:
            (n, count, 4, 4) ``T_camera_axis``, metres, best first, those of one instance at least 25 degrees apart.
        """
        centre = instances.T_camera_axis[:, :3, 3]
        # All in the frame of the ray through the instance's centre, like the network's output.
        R_camera_ray = ray_rotation(centre)
        axis = np.einsum("nij,ni->nj", R_camera_ray, instances.T_camera_axis[:, :3, 2])
        predicted = _AXIS_TRUST * axis @ self._R[:, :, 2].T
        if not self._by_axis:
            predicted += np.log(instances.direction @ self._bins.T + 1e-3)
        worth, tried = predicted, np.broadcast_to(np.arange(len(self._R)), predicted.shape)
        for number, points in self._rounds:
            kept = np.argsort(-worth, axis=1, kind="stable")[:, :number]
            tried = np.take_along_axis(tried, kept, axis=1)
            R = self._R[tried]
            fit = self._fit(R, R_camera_ray, centre, surface, points)
            worth = fit + _NETWORK_TRUST * np.take_along_axis(predicted, tried, axis=1)
        rows, best = np.arange(len(instances)), np.zeros((len(instances), count), np.intp)
        for rank in range(count):
            best[:, rank] = worth.argmax(axis=1)
            chosen = R[rows, best[:, rank]]
            if self._by_axis:
                cosine = np.einsum("nki,ni->nk", R[..., 2], chosen[..., 2])
            else:
                cosine = (np.einsum("nkij,nij->nk", R, chosen) - 1) / 2
            worth = np.where(cosine > np.cos(_APART), -np.inf, worth)
        R_camera_axis = R_camera_ray[:, None] @ R[rows[:, None], best]
        return make_transform(R_camera_axis, np.broadcast_to(centre[:, None], (*best.shape, 3)))

    def _fit(
        self,
        R_ray_axis: np.ndarray,
        R_camera_ray: np.ndarray,
        centre: np.ndarray,
        surface: MeasuredSurface,
        points: int,
    ) -> np.ndarray:
        """(n, k) fit in [0, 1]: mean over points of nearness to the model's surface times agreement of the normals."""
        measured, normals, number = surface.points_of_instances(points)
        if len(number) != len(centre):  # compiled loops do not check indices
            raise ValueError(f"the surface has {len(number)} instances, not {len(centre)}")
        from_centre = np.ascontiguousarray((measured - centre[:, None]) @ R_camera_ray, np.float32)
        normals = np.ascontiguousarray(normals @ R_camera_ray, np.float32)
        return _fit_of_points(R_ray_axis, from_centre, normals, number, self._grid)


class _Grid(NamedTuple):
    """Cells around the model's surface."""

    cell: float
    """edge of a cell, metres"""
    half: np.ndarray
    """(3,) number of cells from the middle one to the first"""
    nearness: np.ndarray
    """(x, y, z) float32, 1 at the surface and 0 out of reach"""
    normals: np.ndarray
    """(x, y, z, 3) float32 of the nearest surface"""


@compiled
def _fit_of_points(
    R_ray_axis: np.ndarray, points: np.ndarray, normals: np.ndarray, number: np.ndarray, grid: _Grid
) -> np.ndarray:
    """(n, k) fit of (n, k, 3, 3) orientations to the first ``number`` of (n, p, 3) points and normals."""
    shape = grid.nearness.shape
    fit = np.zeros((len(R_ray_axis), R_ray_axis.shape[1]), np.float32)
    for n in range(len(fit)):
        for k in range(fit.shape[1]):
            R = R_ray_axis[n, k]
            for index in range(number[n]):
                x, y, z = points[n, index]
                i = int(np.rint((R[0, 0] * x + R[1, 0] * y + R[2, 0] * z) / grid.cell)) + grid.half[0]
                j = int(np.rint((R[0, 1] * x + R[1, 1] * y + R[2, 1] * z) / grid.cell)) + grid.half[1]
                m = int(np.rint((R[0, 2] * x + R[1, 2] * y + R[2, 2] * z) / grid.cell)) + grid.half[2]
                if i < 0 or j < 0 or m < 0 or i >= shape[0] or j >= shape[1] or m >= shape[2]:
                    continue
                nearness = grid.nearness[i, j, m]
                if nearness > 0:
                    x, y, z = normals[n, index]
                    a, b, c = grid.normals[i, j, m]
                    alike = (
                        a * (R[0, 0] * x + R[1, 0] * y + R[2, 0] * z)
                        + b * (R[0, 1] * x + R[1, 1] * y + R[2, 1] * z)
                        + c * (R[0, 2] * x + R[1, 2] * y + R[2, 2] * z)
                    )
                    fit[n, k] += nearness * max(alike, 0.0)
            fit[n, k] /= max(number[n], 1)
    return fit


def _off_pole(axes: np.ndarray) -> np.ndarray:
    """The axes, tilted slightly, because the shortest rotation from +z to -z is not defined."""
    return axes + np.array([1e-4, 2e-4, 0.0])
