"""From the network's output to poses: instances from votes for centres, then centre and axis of each instance."""

from dataclasses import dataclass

import numpy as np
from scipy.special import expit, log_softmax, softmax

from active6d_core.camera import PinholeCamera, pixel_rays
from active6d_core.se3 import make_transform
from active6d_perception.estimators.dense.canonical_frame import (
    AXIS_ANGLES,
    AxisRotation,
    CanonicalFrame,
    facing_camera,
    rotation_about_z,
)
from active6d_perception.estimators.dense.network import split
from active6d_perception.estimators.dense.network_input import ray_frames, ray_rotation
from active6d_perception.estimators.dense.sphere_bins import density
from active6d_perception.estimators.dense.votes import cluster_votes


@dataclass(frozen=True)
class DecodingParameters:
    """Thresholds of decoding; lengths in diameters of the object.

    Attributes:
        mask_threshold: probability above which a pixel belongs to an object.
        pixels: largest number of pixels per instance whose votes are averaged.
        fewest_pixels: an instance with fewer pixels is dropped.
    """

    mask_threshold: float = 0.3
    pixels: int = 160
    fewest_pixels: int = 12


@dataclass(frozen=True, eq=False)
class Instances:
    """n instances in the network's output, with p pixels in total.

    Attributes:
        pixel: (p,) flat indices into the output image.
        label: (p,) index of each pixel's instance.
        T_camera_axis: (n, 4, 4) poses of the axis frame, metres. Votes give centre and axis. The rotation about the
            axis is the likeliest one where the whole surface shows it; elsewhere the x axis faces the camera.
        direction: (n, DIRECTION_BINS) distribution of the axis frame's x, in the frame of the ray through its origin.
    """

    pixel: np.ndarray
    label: np.ndarray
    T_camera_axis: np.ndarray
    direction: np.ndarray

    def __len__(self) -> int:
        return len(self.T_camera_axis)


def decode(
    answer: np.ndarray,
    depth: np.ndarray,
    camera: PinholeCamera,
    canonical_frame: CanonicalFrame,
    diameter: float,
    parameters: DecodingParameters = DecodingParameters(),
) -> Instances:
    """Find instances and their poses in the network's output.

    Args:
        answer: (channels, h, w) output of the network.
        depth: (h, w) metres at the same resolution, NaN where invalid.
        camera: intrinsics of both.
        canonical_frame: the frame that the network was trained with.
        diameter: the object's, metres.
        parameters: thresholds.
    """
    probability = expit(answer[0])
    pixel = np.flatnonzero((probability > parameters.mask_threshold) & np.isfinite(depth))
    # The network's memory is channels last, so that this makes no copy and each pixel's channels are contiguous.
    parts = split(np.moveaxis(answer, 0, -1).reshape(-1, len(answer))[pixel])
    points = pixel_rays(camera).reshape(-1, 3)[pixel] * depth.ravel()[pixel, None]
    votes = points + diameter * np.einsum("pij,pj->pi", ray_frames(camera).reshape(-1, 3, 3)[pixel], parts["centre"])
    weight = np.exp(-np.clip(parts["centre_scale"][:, 0], -4.0, 0.0))
    clusters = cluster_votes(votes, weight, diameter, parameters.fewest_pixels)
    member = clusters.label >= 0
    label, pixel = clusters.label[member], pixel[member]
    parts = {name: part[member] for name, part in parts.items()}
    count = len(clusters.centre)
    table, used = member_table(label, count, parameters.pixels)
    R_camera_ray = ray_rotation(clusters.centre)
    direction = softmax(_mean(log_softmax(parts["direction"], axis=1), label, count), axis=1)
    T = _poses_from_axes(parts, table, used, votes[member], R_camera_ray)
    if canonical_frame.axis_rotation is AxisRotation.VISIBLE:
        T = T @ rotation_about_z(AXIS_ANGLES[axis_rotation_probability(T, direction).argmax(axis=1)])
    else:
        T = facing_camera(T)
    return Instances(pixel, label, T, direction)


def axis_rotation_probability(T_camera_axis: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Probability of each rotation about the axis, from the network alone.

    Args:
        T_camera_axis: (n, 4, 4) poses of the axis frame; angles are relative to them.
        direction: (n, DIRECTION_BINS) as :attr:`Instances.direction`.

    Returns:
        (n, len(AXIS_ANGLES)), each row summing to 1.
    """
    x = (T_camera_axis[:, None, :3, :3] @ rotation_about_z(AXIS_ANGLES)[:, :3, :3])[..., 0]
    return density(direction, np.einsum("nij,nti->ntj", ray_rotation(T_camera_axis[:, :3, 3]), x))


def _poses_from_axes(
    parts: dict[str, np.ndarray], table: np.ndarray, used: np.ndarray, votes: np.ndarray, R_camera_ray: np.ndarray
) -> np.ndarray:
    """(n, 4, 4) poses from robust means of the votes for centre and axis; the rotation about the axis is arbitrary."""
    centre = _robust_mean(votes[table], used * np.exp(-np.clip(parts["centre_scale"][:, 0], -4.0, 0.0))[table], 0.01)
    axis = _robust_mean(parts["axis"][table].astype(float), used.astype(float), 0.2)
    z = np.einsum("nij,nj->ni", R_camera_ray, axis)
    z /= np.maximum(np.linalg.norm(z, axis=1, keepdims=True), 1e-9)
    across = np.where(np.abs(z[:, :1]) < 0.9, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    x = across - z * (across * z).sum(axis=1, keepdims=True)
    x /= np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-9)
    return make_transform(np.stack([x, np.cross(z, x), z], axis=-1), centre)


def _robust_mean(values: np.ndarray, weight: np.ndarray, scale: float) -> np.ndarray:
    """(n, 3) reweighted means of (n, p, 3) values; a value one ``scale`` off the mean has a quarter of the weight."""
    trust = weight
    for _ in range(5):
        mean = np.einsum("np,npi->ni", trust, values) / np.maximum(trust.sum(axis=1, keepdims=True), 1e-12)
        trust = weight / (1 + ((values - mean[:, None]) ** 2).sum(axis=-1) / scale**2) ** 2
    return mean


def member_table(label: np.ndarray, count: int, most: int) -> tuple[np.ndarray, np.ndarray]:
    """At most ``most`` evenly spaced members of each label: (count, most) indices, and (count, most) bool used."""
    order = np.argsort(label, kind="stable")
    size = np.bincount(label, minlength=count)
    start = np.cumsum(size) - size
    taken = np.minimum(size, most)
    column = np.arange(most)
    rank = column * size[:, None] // np.maximum(taken, 1)[:, None]
    used = column < taken[:, None]
    position = np.where(used, start[:, None] + rank, 0)
    return (order[position] if len(order) else position), used


def _mean(values: np.ndarray, label: np.ndarray, count: int) -> np.ndarray:
    """(count, k) mean of (p, k) values per label."""
    order = np.argsort(label, kind="stable")
    size = np.bincount(label, minlength=count)
    if not count:
        return np.zeros((0, values.shape[1]))
    return np.add.reduceat(values[order], np.cumsum(size) - size, axis=0) / size[:, None]
