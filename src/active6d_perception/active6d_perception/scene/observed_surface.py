"""The surface that depth images have shown, and the unexplained part of it: surface that belongs to no known object.

An object that the estimator misses in every view is usually still seen in part. Its surface is unexplained, and a
policy can look there again. Surface is stored as cells of a grid over the inside of the bin. A view is then a row of
bits, a scene is the union of its views, and a bank of many views is small.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import product

import numpy as np

from active6d_core.camera import PinholeCamera, pixel_rays, project
from active6d_core.episode_views import views_from
from active6d_core.object_model import ObjectModel
from active6d_core.se3 import invert, transform_points
from active6d_perception.compiled import compiled
from active6d_perception.model.model_views import ray_caster

# Images are subsampled to about this focal length in pixels (every second row and column of a VGA image), so that the
# result depends little on their resolution. A cell counts as seen if it holds this many pixels.
_FOCAL = 277.0
_LEAST_POINTS = 3
# Edge of a voxel of the distance field, in diameters.
_VOXEL = 1 / 48
#: Default of the distance within which an object explains surface, in diameters. A larger distance would explain
#: surface of the object's neighbours; with a smaller one a slightly wrong pose would leave surface unexplained.
EXPLAINED_WITHIN = 0.08


@dataclass(frozen=True)
class WorkspaceGrid:
    """A grid of axis-aligned cells over the workspace, centred above the world's origin.

    Cells are numbered ``(ix * ny + iy) * nz + iz``, each index rising along its axis.

    Attributes:
        width: of the grid along world x and y, metres; the bin's walls should be outside.
        floor: lower end of the grid along world z, metres; the bin's floor should be below.
        height: upper end of the grid along world z, metres.
        cell: edge of a cell, metres.

    Raises:
        ValueError: a size is not finite, or the grid has no cell or more than a million.
    """

    width: tuple[float, float]
    floor: float
    height: float
    cell: float

    def __post_init__(self) -> None:
        sizes = (*self.width, self.floor, self.height, self.cell)
        if len(self.width) != 2 or not np.isfinite(sizes).all() or not self.cell > 0:
            raise ValueError(f"surface grid: sizes must be finite and the cell positive, got {self}")
        if min(self.shape) < 1 or np.prod(self.shape, dtype=float) > 1e6:
            raise ValueError(f"surface grid: {self} has {self.shape} cells, expected one to a million")

    @classmethod
    def for_model(cls, model: ObjectModel) -> "WorkspaceGrid":
        """The grid over the bin that the object's heaps usually lie in.

        Margins exclude the sensor's noise on walls and floor (measured in ``docs/perception.md``).
        """
        width = model.bin_width - 0.08 * model.diameter
        return cls((width, width), 0.05 * model.diameter, 1.5 * model.diameter, model.diameter / 12)

    @cached_property
    def shape(self) -> tuple[int, int, int]:
        """Number of cells along x, y and z."""
        x, y, z = (int(size / self.cell + 1e-6) for size in (*self.width, self.height - self.floor))
        return x, y, z

    def __len__(self) -> int:
        return int(np.prod(self.shape))

    @cached_property
    def low(self) -> np.ndarray:
        """(3,) corner of the first cell, world, metres."""
        return np.array([-0.5 * self.shape[0] * self.cell, -0.5 * self.shape[1] * self.cell, self.floor])

    @cached_property
    def centres(self) -> np.ndarray:
        """(cells, 3) centres of the cells, world, metres; rounded to float32, as in messages."""
        centres = self.low + (np.indices(self.shape).reshape(3, -1).T + 0.5) * self.cell
        return centres.astype(np.float32).astype(float)

    def holds(self, points: np.ndarray) -> np.ndarray:
        """(n,) bool, whether (n, 3) points are inside of the grid; world, metres."""
        high = self.low + np.array(self.shape) * self.cell
        return np.all((points >= self.low) & (points <= high), axis=1)

    def observe(self, depth: np.ndarray, camera: PinholeCamera, T_world_camera: np.ndarray) -> np.ndarray:
        """Find the cells in which a view shows surface.

        Args:
            depth: (H, W) metres along z, NaN where invalid.
            camera: intrinsics of ``depth``.
            T_world_camera: (4, 4) pose of the optical frame.

        Returns:
            (cells,) bool.

        Raises:
            ValueError: the depth image and the camera differ in size.
        """
        if depth.shape != (camera.height, camera.width):
            raise ValueError(f"depth image is {depth.shape}, the camera's are {(camera.height, camera.width)}")
        stride, (rows, columns) = _stride(camera), self._window(camera, T_world_camera)
        z = depth[::stride, ::stride][rows, columns].ravel()
        rays = _rays(camera)[:, rows, columns].reshape(3, -1)
        along = (T_world_camera[:3, :3] / self.cell).astype(np.float32) @ rays * z
        along += ((T_world_camera[:3, 3:] - self.low[:, None]) / self.cell).astype(np.float32)
        return _count(along, self.shape) >= _LEAST_POINTS

    def _window(self, camera: PinholeCamera, T_world_camera: np.ndarray) -> tuple[slice, slice]:
        """Rows and columns of the subsampled image that can show the grid; all if it reaches behind the camera."""
        corners = self.low + np.array(list(product((0, 1), repeat=3))) * self.shape * self.cell
        corners = (corners - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
        if corners[:, 2].min() <= 0:
            return slice(None), slice(None)
        stride, pixels = _stride(camera), project(corners, camera)
        # One pixel of margin for rounding.
        low = np.maximum(np.floor(pixels.min(axis=0) / stride) - 1, 0).astype(int)
        high = np.maximum(np.ceil(pixels.max(axis=0) / stride) + 2, 0).astype(int)
        return slice(low[1], high[1]), slice(low[0], high[0])


@compiled
def _count(along: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
    """(cells,) number of points in each cell, of (3, k) points in units of cells from the corner, NaN where invalid."""
    counts = np.zeros(shape[0] * shape[1] * shape[2], np.int32)
    for index in range(along.shape[1]):
        x, y, z = along[0, index], along[1, index], along[2, index]
        if 0 <= x < shape[0] and 0 <= y < shape[1] and 0 <= z < shape[2]:
            counts[(int(x) * shape[1] + int(y)) * shape[2] + int(z)] += 1
    return counts


@lru_cache(maxsize=4)
def _rays(camera: PinholeCamera) -> np.ndarray:
    """(3, h, w) rays with z = 1 through the pixels of the subsampled image."""
    stride = _stride(camera)
    return np.ascontiguousarray(np.moveaxis(pixel_rays(camera)[::stride, ::stride], -1, 0))


def _stride(camera: PinholeCamera) -> int:
    return max(1, round(camera.fx / _FOCAL))


class Explainer:
    """Decides which points lie near the surface of an object in given poses, by looking them up in a voxel table.

    Args:
        model: the object.
        within: points at most this far from the surface are explained, in diameters. Exact to half the diagonal of a
            voxel, 2 % of the diameter.
    """

    def __init__(self, model: ObjectModel, within: float) -> None:
        self._voxel = _VOXEL * model.diameter
        reach = within * model.diameter
        low, high = model.mesh.bounds + [[-reach - self._voxel], [reach + self._voxel]]
        shape = np.ceil((high - low) / self._voxel).astype(int) + 1
        self._low = low
        scene = ray_caster(model.mesh, threads=1)
        centres = low + (np.indices(shape).reshape(3, -1).T + 0.5) * self._voxel
        near = scene.compute_distance(centres.astype(np.float32), nthreads=1).numpy().reshape(shape) <= reach
        # Points outside of the table are looked up in its outermost layer.
        self._near = np.zeros(shape, bool)
        self._near[1:-1, 1:-1, 1:-1] = near[1:-1, 1:-1, 1:-1]
        self.explains(np.zeros((1, 3)), np.eye(4)[None])  # compile now, so that no view has to wait

    def explains(self, points: np.ndarray, T_world_object: np.ndarray) -> np.ndarray:
        """(n, k) bool, whether (k, 3) points are near the surface of the object in (n, 4, 4) poses; world, metres."""
        R = T_world_object[:, :3, :3] / self._voxel
        origin = -np.einsum("ni,nij->nj", T_world_object[:, :3, 3], R) - self._low / self._voxel
        return _look_up(np.ascontiguousarray(np.transpose(points), float), R, origin, self._near)


@compiled
def _look_up(points: np.ndarray, rotation: np.ndarray, origin: np.ndarray, table: np.ndarray) -> np.ndarray:
    """Look up points in a table, after mapping them into the frames of n poses.

    Args:
        points: (3, k) in the world, metres.
        rotation: (n, 3, 3) rotations of the poses, divided by the edge of a voxel.
        origin: (n, 3) the world's origin in each table, voxels.
        table: (nx, ny, nz) bool.

    Returns:
        (n, k) entries; the first entry for points outside of the table.
    """
    found, entry = np.empty((len(rotation), points.shape[1]), np.bool_), np.empty(points.shape[1], np.uint32)
    (nx, ny, nz), flat = table.shape, table.ravel()
    for pose in range(len(rotation)):
        R, o = rotation[pose], origin[pose]
        # Two loops, so that the compiler can use vector instructions in the first one.
        for index in range(points.shape[1]):
            x, y, z = points[0, index], points[1, index], points[2, index]
            i = x * R[0, 0] + y * R[1, 0] + z * R[2, 0] + o[0]
            j = x * R[0, 1] + y * R[1, 1] + z * R[2, 1] + o[1]
            k = x * R[0, 2] + y * R[1, 2] + z * R[2, 2] + o[2]
            inside = (i >= 0) & (i < nx) & (j >= 0) & (j < ny) & (k >= 0) & (k < nz)
            place = np.uint32((np.int32(i) * ny + np.int32(j)) * nz + np.int32(k))
            entry[index] = place if inside else np.uint32(0)
        for index in range(points.shape[1]):
            found[pose, index] = flat[entry[index]]
    return found


@lru_cache(maxsize=8)
def explainer(model: ObjectModel, within: float) -> Explainer:
    """The explainer of an object, computed once per process."""
    return Explainer(model, within)


class ObservedSurface:
    """Accumulates the surface that views show in the workspace, and finds the part that no object explains.

    Args:
        model: the object.
        grid: cells of the workspace; those over the object's usual bin when None.
        within: see :class:`Explainer`.
    """

    def __init__(self, model: ObjectModel, grid: WorkspaceGrid | None = None, within: float = EXPLAINED_WITHIN) -> None:
        self.grid = grid or WorkspaceGrid.for_model(model)
        self._explainer = explainer(model, within)
        _count(np.zeros((3, 0), np.float32), self.grid.shape)  # compile now, so that no view has to wait
        self.reset()

    def reset(self) -> None:
        """Forget all views."""
        self._seen: dict[int, np.ndarray] = {}

    def add_view(self, stamp: int, depth: np.ndarray, camera: PinholeCamera, T_world_camera: np.ndarray) -> None:
        """Add a view, identified by its stamp (nanoseconds); other arguments as for :meth:`WorkspaceGrid.observe`."""
        self._seen[stamp] = self.grid.observe(depth, camera, T_world_camera)

    def forget_before(self, stamp: int) -> None:
        """Forget the views that were added before the one of ``stamp`` (nanoseconds); all without that one."""
        self._seen = views_from(self._seen, stamp)

    def unexplained(self, T_world_object: np.ndarray, T_world_anchor: np.ndarray | None = None) -> np.ndarray:
        """(k, 3) centres of the unexplained cells: seen, and not near any of (n, 4, 4) poses; world, metres.

        (4, 4) ``T_world_anchor`` is from the frame in which views were added to the world, see
        :attr:`.CameraAlignment.T_world_anchor`; the identity when None. What that moves out of the grid is left out.
        """
        anchor = np.eye(4) if T_world_anchor is None else T_world_anchor
        seen = np.logical_or.reduce([np.zeros(len(self.grid), bool), *self._seen.values()])
        points = self.grid.centres[seen]
        explained = self._explainer.explains(points, invert(anchor) @ T_world_object)
        left = transform_points(anchor, points[~explained.any(axis=0)])
        return left[self.grid.holds(left)]
