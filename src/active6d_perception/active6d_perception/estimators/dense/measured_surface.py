"""The surface that a view measured, and the instance that each pixel belongs to."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from active6d_core.camera import PinholeCamera, View, backproject, normals_from_points
from active6d_perception.estimators.dense.decoding import Instances, member_table
from active6d_perception.estimators.dense.network_input import OUTPUT_STRIDE
from active6d_perception.estimators.measured_image import MeasuredImage, measure_image

_COMPARED_POINTS = 64


@dataclass(frozen=True, eq=False)
class MeasuredSurface:
    """The surface that a view measured, at the network's input resolution.

    Attributes:
        depth: (h, w) metres along z, NaN invalid.
        points: (h, w, 3) in the optical frame, metres.
        normals: (h, w, 3) facing the camera, NaN unknown.
        owner: (h, w) index of the pixel's instance, -1 without an instance or without depth.
        camera: intrinsics.
        detail: the whole view at its own resolution, or a multiple of the network's where it is finer.
        instances: number of instances.
    """

    depth: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    owner: np.ndarray
    camera: PinholeCamera
    detail: MeasuredImage
    instances: int

    @classmethod
    def of(cls, view: View, instances: Instances, detail: MeasuredImage | None = None) -> "MeasuredSurface":
        """The surface of a view at the network's resolution in which ``instances`` were found.

        Args:
            view: at the network's resolution.
            instances: found in it.
            detail: see the attribute; None where there is only ``view``.
        """
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
        return cls(
            view.depth,
            points,
            normals,
            owner,
            view.camera,
            detail or measure_image(view.depth, view.camera),
            len(instances),
        )

    @cached_property
    def of_instances(self) -> MeasuredImage:
        """The points of the instances, for registration; other pixels are NaN."""
        usable = (self.owner >= 0) & np.isfinite(self.normals).all(axis=-1)
        points = np.where(usable[..., None], self.points, np.float32(np.nan))
        intrinsics = self.camera.fx, self.camera.fy, self.camera.cx, self.camera.cy
        return MeasuredImage(points, np.ascontiguousarray(self.normals), *map(float, intrinsics))

    @cached_property
    def compared_points(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The points of each instance that its poses are compared with, see :meth:`points_of_instances`."""
        return self.points_of_instances(_COMPARED_POINTS)

    def points_of_instances(self, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Evenly spaced points of each instance.

        Args:
            count: largest number of points of an instance.

        Returns:
            (n, count, 3) float32 points in the optical frame, metres; (n, count, 3) float32 unit normals; and (n,) the
            number of points that each instance has.
        """
        normals = self.normals.reshape(-1, 3)
        pixel = np.flatnonzero((self.owner.ravel() >= 0) & np.isfinite(normals).all(axis=1))
        table, used = member_table(self.owner.ravel()[pixel], self.instances, count)
        pixel = pixel[table] if len(pixel) else table
        return self.points.reshape(-1, 3)[pixel], normals[pixel], used.sum(axis=1)
