"""The nearest surface of an object for any point around it, from a grid: constant time, for compiled loops."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from active6d_core.object_model import ObjectModel
from active6d_perception.compiled import compiled
from active6d_perception.model.model_views import model_views

_CELL = 0.02  # diameters
_REACH = 0.1  # diameters


class SurfaceGrid(NamedTuple):
    """Cells around an object, in its frame, and the sample of its surface nearest to the middle of each."""

    cell: float
    """edge of a cell, metres"""
    half: np.ndarray
    """(3,) number of cells from the first to the one at the origin"""
    nearest: np.ndarray
    """(x, y, z) int16 index of the sample, -1 where none is within a tenth of the diameter"""
    points: np.ndarray
    """(s, 3) float32 samples, metres"""
    normals: np.ndarray
    """(s, 3) float32 their outward unit normals"""


@lru_cache(maxsize=16)
def surface_grid(model: ObjectModel) -> SurfaceGrid:
    """The grid of ``model``, computed once per process."""
    views = model_views(model)
    cell, reach = _CELL * model.diameter, _REACH * model.diameter
    half = np.ceil((np.abs(views.points).max(axis=0) + reach) / cell).astype(int) + 1
    steps = [cell * np.arange(-count, count + 1) for count in half]
    middles = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1)
    distance, nearest = cKDTree(views.points).query(middles, distance_upper_bound=reach)
    nearest = np.where(np.isfinite(distance), nearest, -1).astype(np.int16)
    return SurfaceGrid(float(cell), half, nearest, views.points, views.normals)


@compiled
def nearest_sample(x: float, y: float, z: float, grid: SurfaceGrid) -> int:
    """Index of the sample nearest to the middle of the cell of (x, y, z) in the object's frame, metres; -1 for none."""
    i = int(np.rint(x / grid.cell)) + grid.half[0]
    j = int(np.rint(y / grid.cell)) + grid.half[1]
    k = int(np.rint(z / grid.cell)) + grid.half[2]
    shape = grid.nearest.shape
    if i < 0 or j < 0 or k < 0 or i >= shape[0] or j >= shape[1] or k >= shape[2]:
        return -1
    return grid.nearest[i, j, k]
