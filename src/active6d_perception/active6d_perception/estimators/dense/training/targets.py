"""Targets of the network's output, in closed form from true depth, instances and poses."""

from dataclasses import dataclass

import numpy as np

from active6d_core.camera import pixel_rays
from active6d_core.training_view import TrainingView
from active6d_perception.estimators.dense.canonical_frame import AxisRotation, CanonicalFrame
from active6d_perception.estimators.dense.network import DIRECTION_BINS
from active6d_perception.estimators.dense.network_input import output_camera, ray_frames, ray_rotation
from active6d_perception.estimators.dense.sphere_bins import kernel


@dataclass(frozen=True, eq=False)
class Targets:
    """Targets of one view; p pixels lie on objects.

    Attributes:
        mask: (h, w) float32, 1 on objects.
        pixel: (p,) flat indices into (h, w).
        weight: (p,) float32, mean 1. The weight of an instance grows with the root of its number of pixels, so that
            distant ones matter, and with its visible fraction, because a sliver does not show the orientation.
        centre: (p, 3) float32, see the network's head of this name.
        axis: (p, 3) float32, see the head of this name.
        direction: (p, DIRECTION_BINS) float32 distribution over the bins; zero where nothing shows the rotation.
    """

    mask: np.ndarray
    pixel: np.ndarray
    weight: np.ndarray
    centre: np.ndarray
    axis: np.ndarray
    direction: np.ndarray


def make_targets(sample: TrainingView, canonical_frame: CanonicalFrame, diameter: float) -> Targets:
    """Compute the targets of one training view.

    Args:
        sample: training view at the network's resolution.
        canonical_frame: the object's.
        diameter: the object's, metres.
    """
    camera = output_camera(sample.view.camera)
    pixel = np.flatnonzero((sample.instance >= 0) & np.isfinite(sample.surface_depth))
    instance = sample.instance.ravel()[pixel]
    points = pixel_rays(camera).reshape(-1, 3)[pixel] * sample.surface_depth.ravel()[pixel, None]
    T_axis = canonical_frame.axis_pose(sample.T_camera_object)
    R_camera_ray = ray_frames(camera).reshape(-1, 3, 3)[pixel]
    R_ray_camera = np.swapaxes(ray_rotation(T_axis[:, :3, 3]), 1, 2)
    direction = np.zeros((len(T_axis), DIRECTION_BINS), np.float32)
    if canonical_frame.axis_rotation is not AxisRotation.INVISIBLE:
        direction = kernel(np.einsum("nij,nj->ni", R_ray_camera, T_axis[:, :3, 0]))
    count = np.bincount(instance, minlength=len(T_axis))
    weight = (sample.visible_fraction / np.sqrt(np.maximum(count, 1)))[instance]
    return Targets(
        mask=(sample.instance >= 0).astype(np.float32),
        pixel=pixel,
        weight=(weight / weight.mean() if len(weight) else weight).astype(np.float32),
        centre=(np.einsum("pij,pi->pj", R_camera_ray, T_axis[instance, :3, 3] - points) / diameter).astype(np.float32),
        axis=np.einsum("nij,nj->ni", R_ray_camera, T_axis[:, :3, 2]).astype(np.float32)[instance],
        direction=direction[instance],
    )
