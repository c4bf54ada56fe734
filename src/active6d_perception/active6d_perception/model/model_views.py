"""The visible part of an object's surface, precomputed for view directions all around the object.

Verification, refinement and fusion need the model as a camera sees it: the part of its surface that faces the camera
and that the object itself does not hide. Rendering this part for each hypothesis takes milliseconds, looking it up by
view direction microseconds. Neighbouring directions are at most 9 degrees apart, so that a hypothesis is at most about
5 degrees from one. The visible part then differs only by a sliver at the object's outline.
"""

from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
import open3d as o3d
import trimesh
from scipy.spatial import cKDTree

from active6d_core.object_model import ObjectModel
from active6d_perception.compiled import compiled

_SUBDIVISIONS = 3  # of an icosahedron: 642 directions
_EYE_DISTANCE = 6.0  # in diameters: 0.8 m for an object of 0.14 m, as on the view hemisphere
_SAMPLES = 4096
# Edge of a cell, in multiples of the spacing of the samples: a few samples per cell.
_CELL = 3.0


@lru_cache(maxsize=16)
def model_views(model: ObjectModel) -> "ModelViews":
    """The views of ``model``, computed once per process."""
    return ModelViews(model)


class _Cells(NamedTuple):
    """Samples of a surface sorted into cubes, so that a search for the nearest one compares only a few.

    Cells are numbered ``(ix * ny + iy) * nz + iz``.
    """

    low: np.ndarray
    """(3,) corner of the first cell, object frame, metres"""
    edge: float
    """edge of a cell, metres"""
    shape: tuple[int, int, int]
    """number of cells along x, y and z"""
    start: np.ndarray
    """(cells + 1,) first sample of each cell in the sorted order"""
    order: np.ndarray
    """(s,) index of the sample at each place of the sorted order"""
    points: np.ndarray
    """(s, 3) float32 samples in the sorted order, metres"""
    visible: np.ndarray
    """(m, s) bool, whether a sample is visible from a direction"""


@compiled
def _nearest_visible(
    points: np.ndarray, direction: np.ndarray, bound: float, cells: _Cells
) -> tuple[np.ndarray, np.ndarray]:
    """See :meth:`ModelViews.nearest_visible`; compiled, because each point is compared with different samples."""
    distance, found = np.full(len(points), np.inf), np.full(len(points), -1)
    for index in range(len(points)):
        # Most points are near the surface: search within one cell's edge first.
        for reach in (min(cells.edge, bound), bound):
            point = points[index, 0], points[index, 1], points[index, 2]
            square, place = _nearest_within(point, direction[index], reach, cells)
            if place >= 0:
                distance[index], found[index] = np.sqrt(square), cells.order[place]
                break
    return distance, found


@compiled
def _nearest_within(
    point: tuple[float, float, float], direction: int, reach: float, cells: _Cells
) -> tuple[float, int]:
    """Squared distance of the nearest visible sample, and its place in the sorted order, -1 without one in reach."""
    square, best = reach * reach, -1
    x, y, z = point[0] - cells.low[0], point[1] - cells.low[1], point[2] - cells.low[2]
    first, last = _cell(z - reach, 2, cells), _cell(z + reach, 2, cells)
    for i in range(_cell(x - reach, 0, cells), _cell(x + reach, 0, cells) + 1):
        for j in range(_cell(y - reach, 1, cells), _cell(y + reach, 1, cells) + 1):
            column = (i * cells.shape[1] + j) * cells.shape[2]
            for place in range(cells.start[column + first], cells.start[column + last + 1]):
                dx = point[0] - cells.points[place, 0]
                dy = point[1] - cells.points[place, 1]
                dz = point[2] - cells.points[place, 2]
                # No branches, because a processor could not predict them.
                candidate = dx * dx + dy * dy + dz * dz if cells.visible[direction, place] else np.inf
                best = place if candidate < square else best
                square = min(square, candidate)
    return square, best


@compiled
def _cell(along: float, axis: int, cells: _Cells) -> int:
    """Index along an axis of the cell nearest to a coordinate from the corner, metres; the first cell for NaN."""
    return int(min(along / cells.edge, cells.shape[axis] - 1.0)) if along > 0 else 0


class ModelViews:
    """Surface samples of an object, and which of them are visible from each view direction.

    Attributes:
        points: (s, 3) float32 samples spread evenly over the surface, object frame, metres.
        normals: (s, 3) float32 outward unit normals of the samples.
        spacing: half the typical distance of neighbouring samples, metres; a sample represents a disc of this radius.
        directions: (m, 3) unit vectors from the object to the camera, object frame.
        visible: (m, s) bool, whether a camera 6 diameters away in a direction sees a sample.
        outline: (h, 3) few vertices of the convex hull whose projections bound the object's box, metres.
    """

    def __init__(self, model: ObjectModel) -> None:
        points, faces = trimesh.sample.sample_surface_even(model.mesh, _SAMPLES, seed=0)
        self.points = np.asarray(points, np.float32)
        self.normals = np.asarray(model.mesh.face_normals[faces], np.float32)
        self.spacing = float(np.sqrt(model.mesh.area / len(points) / np.pi))
        self.directions = np.asarray(trimesh.creation.icosphere(_SUBDIVISIONS).vertices)
        self._eye_distance = _EYE_DISTANCE * model.diameter
        self.visible = visible_from(model.mesh, self.directions * self._eye_distance, self.points, self.normals)
        self._trees: dict[int, tuple[np.ndarray, cKDTree]] = {}
        self._subsets: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        hull = np.asarray(model.mesh.convex_hull.vertices)
        self.outline = hull[np.unique((self.directions[:162] @ hull.T).argmax(axis=1))]

    def nearest_direction(self, T_camera_object: np.ndarray) -> np.ndarray:
        """(k,) index of the precomputed direction nearest to the camera, for (k, 4, 4) poses in the optical frame."""
        eye = -np.einsum("kji,kj->ki", T_camera_object[:, :3, :3], T_camera_object[:, :3, 3])
        return (eye @ self.directions.T).argmax(axis=1)

    @cached_property
    def centroids(self) -> np.ndarray:
        """(m, 3) centroid of the visible surface per direction, weighted by area in the image; object frame, metres."""
        eyes = self.directions * self._eye_distance
        facing = eyes @ self.normals.T - np.einsum("si,si->s", self.normals, self.points)
        square_distance = self._eye_distance**2 + (self.points**2).sum(axis=1) - 2 * eyes @ self.points.T
        weight = self.visible * np.maximum(facing, 0.0) / square_distance**1.5
        return weight @ self.points / weight.sum(axis=1, keepdims=True)

    def visible_tree(self, direction: int) -> tuple[np.ndarray, cKDTree]:
        """(v,) indices of the samples visible from a direction, and a search tree over them; cached."""
        if direction not in self._trees:
            index = np.flatnonzero(self.visible[direction])
            self._trees[direction] = index, cKDTree(self.points[index])
        return self._trees[direction]

    def nearest_visible(self, points: np.ndarray, direction: np.ndarray, bound: float) -> tuple[np.ndarray, np.ndarray]:
        """The sample nearest to each point among those visible from the point's direction.

        Args:
            points: (n, 3) in the object frame, metres.
            direction: (n,) indices of view directions.
            bound: metres.

        Returns:
            (n,) distances and (n,) indices of the samples; ``inf`` and -1 where none is within ``bound``.
        """
        return _nearest_visible(np.ascontiguousarray(points, float), direction, bound, self._cells)

    @cached_property
    def _cells(self) -> "_Cells":
        low, edge = self.points.min(axis=0).astype(float), _CELL * self.spacing
        place = ((self.points - low) / edge).astype(np.intp)
        shape = tuple((place.max(axis=0) + 1).tolist())
        number = np.ravel_multi_index(tuple(place.T), shape)
        order = np.argsort(number, kind="stable")
        start = np.searchsorted(number[order], np.arange(np.prod(shape) + 1))
        # 16 bits, so that the table stays in the processor's cache.
        start, small = start.astype(np.int16), order.astype(np.int16)
        return _Cells(low, edge, shape, start, small, self.points[order], self.visible[:, order])

    def visible_subset(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """At most ``count`` evenly spaced visible samples per direction: (m, count) indices, (m, count) bool used."""
        if count not in self._subsets:
            self._subsets[count] = self._take_evenly(count)
        return self._subsets[count]

    def _take_evenly(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        index = np.zeros((len(self.directions), count), np.intp)
        used = np.zeros(index.shape, bool)
        for row, visible in enumerate(self.visible):
            seen = np.flatnonzero(visible)
            taken = seen[np.linspace(0, len(seen) - 1, min(count, len(seen))).astype(np.intp)]
            index[row, : len(taken)] = taken
            used[row, : len(taken)] = True
        return index, used


def visible_from(mesh: trimesh.Trimesh, eyes: np.ndarray, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Determine by ray casting which surface points are visible.

    Args:
        mesh: triangle mesh.
        eyes: (m, 3) camera positions outside the mesh, in its frame.
        points: (s, 3) points on its surface.
        normals: (s, 3) outward normals at the points.

    Returns:
        (m, s) bool, whether a camera sees a point.
    """
    scene = ray_caster(mesh)
    rays = np.empty((len(eyes), len(points), 6), np.float32)
    rays[..., :3] = eyes[:, None]
    rays[..., 3:] = points[None] - rays[..., :3]
    # A hit at parameter 1 is the sample itself; 0.1 % are allowed for rounding.
    unhidden = scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy() > 0.999
    facing = -np.einsum("msi,si->ms", rays[..., 3:], normals) > 0
    return unhidden & facing


def ray_caster(mesh: trimesh.Trimesh, threads: int = 0) -> o3d.t.geometry.RaycastingScene:
    """A scene of one mesh, for ray casting and distances; 0 threads means one per core."""
    scene = o3d.t.geometry.RaycastingScene(nthreads=threads)
    scene.add_triangles(np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.uint32))
    return scene
