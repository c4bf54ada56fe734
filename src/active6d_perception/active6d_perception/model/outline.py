"""The outline of an object as a camera sees it, precomputed for view directions all around the object.

Where an object ends in the image, a depth image shows an edge: what lies beyond is farther away. A pose beyond whose
outline the measured surface simply continues is wrong, however well the surface inside fits: it may lie in a wall, or
on a larger object.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import open3d as o3d
from scipy.ndimage import binary_erosion, gaussian_filter, sobel

from active6d_core.object_model import ObjectModel
from active6d_perception.model.model_views import model_views, ray_caster

_POINTS = 48  # of an outline, for each direction
_PIXELS = 56  # along each side of the images that outlines are taken from
_MARGIN = 1.1  # side of those images, diameters
_EYE_DISTANCE = 6.0  # diameters


class Outline(NamedTuple):
    """Points on the outline for each of the m view directions of :class:`.ModelViews`."""

    points: np.ndarray
    """(m, c, 3) float32 on the surface just inside the outline, object frame, metres"""
    outward: np.ndarray
    """(m, c, 3) float32 unit vectors across the line of sight that point out of the silhouette, object frame"""
    number: np.ndarray
    """(m,) how many of the c are used"""


@lru_cache(maxsize=16)
def outline_of(model: ObjectModel) -> Outline:
    """The outlines of ``model``, computed once per process."""
    directions = model_views(model).directions
    scene = ray_caster(model.mesh, threads=1)
    points = np.zeros((len(directions), _POINTS, 3), np.float32)
    outward = np.zeros_like(points)
    number = np.zeros(len(directions), np.int64)
    middles = _MARGIN * model.diameter * ((np.arange(_PIXELS) + 0.5) / _PIXELS - 0.5)
    for index, direction in enumerate(directions):
        x = np.cross(direction, np.eye(3)[np.abs(direction).argmin()])
        x /= np.linalg.norm(x)
        y = np.cross(direction, x)
        start = middles[:, None, None] * y + middles[None, :, None] * x + _EYE_DISTANCE * model.diameter * direction
        rays = np.concatenate([start, np.broadcast_to(-direction, start.shape)], axis=-1).astype(np.float32)
        reach = scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()
        hit = np.isfinite(reach)
        row, column = np.nonzero(hit & ~binary_erosion(hit))
        soft = gaussian_filter(hit.astype(float), 1.5)
        across, down = -sobel(soft, axis=1)[row, column], -sobel(soft, axis=0)[row, column]
        # Evenly along the outline: by the angle about its middle, which is in order for most shapes.
        order = np.argsort(np.arctan2(middles[row], middles[column]), kind="stable")
        chosen = order[np.linspace(0, len(order) - 1, min(_POINTS, len(order))).astype(np.intp)]
        away = across[chosen, None] * x + down[chosen, None] * y
        used = len(chosen)
        number[index] = used
        points[index, :used] = start[row[chosen], column[chosen]] - reach[row[chosen], column[chosen], None] * direction
        outward[index, :used] = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
    return Outline(points, outward, number)
