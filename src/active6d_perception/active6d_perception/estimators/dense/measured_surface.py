"""The surface that a view measured, and the instance that each pixel belongs to."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from active6d_core.camera import PinholeCamera, View, backproject, normals_from_points
from active6d_perception.estimators.dense.decoding import Instances
from active6d_perception.estimators.dense.network_input import OUTPUT_STRIDE


@dataclass(frozen=True, eq=False)
class MeasuredSurface:
    """The surface that a view measured, at the network's input resolution.

    Attributes:
        depth: (h, w) metres along z, NaN invalid.
        points: (h, w, 3) in the optical frame, metres.
        normals: (h, w, 3) facing the camera, NaN unknown.
        owner: (h, w) index of the pixel's instance, -1 without an instance or without depth.
        camera: intrinsics.
        tree: search tree over the instances' points that have normals; None if there are too few.
        tree_normals: (p, 3) of the tree's points.
    """

    depth: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    owner: np.ndarray
    camera: PinholeCamera
    tree: cKDTree | None
    tree_normals: np.ndarray

    @classmethod
    def of(cls, view: View, instances: Instances) -> "MeasuredSurface":
        """The surface of a view at the network's resolution in which ``instances`` were found."""
        # Reduced depth is already a mean of pixels. More smoothing would round edges off and let poses slide.
        points = backproject(view.depth, view.camera)
        normals = normals_from_points(points, reach=1)
        height, width = view.depth.shape
        coarse = np.full((height // OUTPUT_STRIDE, width // OUTPUT_STRIDE), -1)
        coarse.ravel()[instances.pixel] = instances.label
        enlarged = coarse.repeat(OUTPUT_STRIDE, axis=0).repeat(OUTPUT_STRIDE, axis=1)
        owner = np.full((height, width), -1)
        owner[: enlarged.shape[0], : enlarged.shape[1]] = enlarged
        owner[np.isnan(view.depth)] = -1
        usable = (owner >= 0) & np.isfinite(normals).all(axis=-1)
        tree = cKDTree(points[usable]) if np.count_nonzero(usable) > 6 else None
        return cls(view.depth, points, normals, owner, view.camera, tree, normals[usable])
