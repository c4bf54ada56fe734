"""From an RGB-D view to the network's input features.

Distances are in diameters of the object and directions in the frame of each pixel's ray. So an object gives the same
features wherever it is in the image; only its apparent size shows how far away it is.
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np
from scipy.ndimage import uniform_filter

from active6d_core.camera import PinholeCamera, View, backproject, normals_from_points, pixel_rays, pool_depth

#: Width in pixels that views are reduced to, by an integer factor.
INPUT_WIDTH = 320
#: Sides of the input are padded to multiples of this.
MULTIPLE = 16
#: Colour (3), normal (3), depth relative to a small and a large neighbourhood (2), validity, apparent size, and second
#: moments of the neighbouring normals (6). The moments show how the surface curves: the axis of a cylinder, unsigned.
CHANNELS = 16
#: The output's resolution is the input's divided by this.
OUTPUT_STRIDE = 2

_WINDOWS = (13, 61)  # pixels: a detail of an object, and more than an object
_MOMENT_WINDOW = 17  # pixels: half of an object


def reduction(camera: PinholeCamera) -> int:
    """The integer factor by which views of ``camera`` are reduced."""
    return max(1, round(camera.width / INPUT_WIDTH))


def reduce_view(view: View) -> View:
    """Reduce a view to the network's resolution; pixels that the factor does not divide are cut at right and bottom."""
    factor = reduction(view.camera)
    color = _pool_color(view.color, factor)
    return replace(view, color=color, depth=pool_depth(view.depth, factor), camera=view.camera.reduced(factor))


def _pool_color(color: np.ndarray, factor: int) -> np.ndarray:
    """(H, W, 3) uint8 to (H // factor, W // factor, 3) uint8, the rounded mean of each block."""
    height, width = (size // factor * factor for size in color.shape[:2])
    total = np.full((height // factor, width // factor, 3), factor * factor // 2, np.uint32)
    for row in range(factor):
        for column in range(factor):
            total += color[row:height:factor, column:width:factor]
    return (total // (factor * factor)).astype(np.uint8)


def network_input(view: View, diameter: float) -> np.ndarray:
    """The (CHANNELS, h, w) float32 input features of one view, without padding.

    Args:
        view: a view at the network's resolution, see :func:`reduce_view`.
        diameter: the object's, metres.
    """
    valid = np.isfinite(view.depth)
    z = np.where(valid, view.depth, 0)
    points = backproject(view.depth, view.camera)
    normals = np.einsum("hwij,hwi->hwj", ray_frames(view.camera), np.nan_to_num(normals_from_points(points)))
    channels = np.empty((CHANNELS, *z.shape), np.float32)
    channels[:3] = np.moveaxis(view.color, -1, 0) / np.float32(255) - np.float32(0.5)
    channels[3:6] = np.moveaxis(normals, -1, 0)
    for channel, window in zip((6, 7), _WINDOWS, strict=True):
        share = uniform_filter(valid.astype(np.float32), window, mode="nearest")
        around = uniform_filter(z, window, mode="nearest") / np.maximum(share, 1e-3)
        channels[channel] = np.where(valid, np.clip((z - around) / diameter, -1.5, 1.5), 0)
    channels[8] = valid
    # A pixel without depth takes the mean depth of the large neighbourhood.
    channels[9] = view.camera.fx * diameter / np.maximum(np.where(valid, z, around), 0.1) / 64
    channels[10:] = _normal_moments(channels[3:6])
    return channels


def _normal_moments(normals: np.ndarray) -> np.ndarray:
    """(6, h, w) neighbourhood means of xx, yy, zz, xy, yz, zx of (3, h, w) normals, which are 0 where invalid."""
    products = np.concatenate([normals * normals, normals * np.roll(normals, -1, axis=0)])
    moments = uniform_filter(products, (0, _MOMENT_WINDOW, _MOMENT_WINDOW), mode="nearest")
    return moments / np.maximum(moments[:3].sum(axis=0), 1e-2)


def pad(tensor: np.ndarray) -> np.ndarray:
    """(c, h, w) padded with zeros at the right and bottom, so that both sides are multiples of :data:`MULTIPLE`."""
    height, width = tensor.shape[1:]
    return np.pad(tensor, ((0, 0), (0, -height % MULTIPLE), (0, -width % MULTIPLE)))


def output_camera(input_camera: PinholeCamera) -> PinholeCamera:
    """Intrinsics of the network's output, from those of its input; sides that the stride does not divide are cut."""
    return input_camera.reduced(OUTPUT_STRIDE)


@lru_cache(maxsize=8)
def ray_frames(camera: PinholeCamera) -> np.ndarray:
    """(h, w, 3, 3) ``R_camera_ray`` of every pixel: :func:`ray_rotation` of its ray. Read-only."""
    frames = ray_rotation(pixel_rays(camera))
    frames.flags.writeable = False
    return frames


def ray_rotation(direction: np.ndarray) -> np.ndarray:
    """(..., 3, 3) float32 shortest rotations from the optical axis to (..., 3) directions."""
    x, y, w = np.moveaxis(direction / np.linalg.norm(direction, axis=-1, keepdims=True), -1, 0)
    share = 1 / (1 + w)
    rows = [[1 - x * x * share, -x * y * share, x], [-x * y * share, 1 - y * y * share, y], [-x, -y, w]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2).astype(np.float32)
