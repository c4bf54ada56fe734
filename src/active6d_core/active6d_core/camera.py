"""The pinhole camera, one registered RGB-D view, and points and normals from a depth image."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

# Focal lengths over the longer side of the image: from fields of view of 136 degrees to those of 3 degrees.
_FOCAL_LENGTHS = (0.2, 20.0)
# How far the centre of a larger image may be beside the part of it, in widths and heights of the part.
_CROPPED = 2
_SAME_SURFACE = 0.02  # relative difference of depth


@dataclass(frozen=True)
class PinholeCamera:
    """Intrinsics of a rectified camera; all in pixels. Pixel (0, 0) is the centre of the top-left pixel.

    Raises:
        ValueError: sizes or focal lengths are not positive and finite.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        if self.width <= 0 or self.height <= 0:
            raise ValueError(f"camera size must be positive, got {self.width}x{self.height}")
        if not np.isfinite([self.fx, self.fy, self.cx, self.cy]).all() or self.fx <= 0 or self.fy <= 0:
            raise ValueError(f"camera focal lengths must be positive and finite, got fx={self.fx} fy={self.fy}")
        # NumPy promotes float32 images by an np.float64 but not by a float. With plain floats results do not depend on
        # the type that the caller had.
        for name in ("fx", "fy", "cx", "cy"):
            object.__setattr__(self, name, float(getattr(self, name)))

    @classmethod
    def from_field_of_view(cls, width: int, height: int, horizontal_degrees: float) -> "PinholeCamera":
        """A camera with square pixels and the principal point at the image's centre; sizes in pixels."""
        focal = 0.5 * width / np.tan(0.5 * np.radians(horizontal_degrees))
        return cls(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)

    @classmethod
    def from_matrix(cls, matrix: np.ndarray, width: int, height: int, *, cropped: bool = False) -> "PinholeCamera":
        """The camera of a (3, 3) intrinsic matrix K in pixels, for images of ``width`` x ``height`` pixels.

        Args:
            matrix: K.
            width: of the image.
            height: of the image.
            cropped: whether the image may be part of a larger one, whose centre need not be in it.

        Raises:
            ValueError: K is not an intrinsic matrix without skew, or does not belong to images of this size.
        """
        K = np.asarray(matrix, float)
        if K.shape != (3, 3) or not np.isfinite(K).all():
            raise ValueError(f"K must be a finite (3, 3) intrinsic matrix, got shape {K.shape}")
        expected = np.array([[K[0, 0], 0.0, K[0, 2]], [0.0, K[1, 1], K[1, 2]], [0.0, 0.0, 1.0]])
        if not np.allclose(K, expected, atol=1e-6 * max(1.0, np.abs(K).max())):
            raise ValueError("K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] without skew; is it transposed?")
        camera = cls(width, height, K[0, 0], K[1, 1], K[0, 2], K[1, 2])
        low, high = (share * max(width, height) for share in _FOCAL_LENGTHS)
        if not (low <= camera.fx <= high and low <= camera.fy <= high):
            raise ValueError(
                f"K has focal lengths {camera.fx:g} and {camera.fy:g} pixels, impossible for {width}x{height} images; "
                "is K the identity, in millimetres, or of another image size?"
            )
        beside = _CROPPED if cropped else 0
        if not all(
            -beside * side < centre < (1 + beside) * side for centre, side in ((camera.cx, width), (camera.cy, height))
        ):
            raise ValueError(
                f"K has its centre at ({camera.cx:g}, {camera.cy:g}), outside the {width}x{height} image; is K of "
                "another image size? If the image is part of a larger one, give a PinholeCamera in place of K"
            )
        return camera

    @property
    def matrix(self) -> np.ndarray:
        """The (3, 3) intrinsic matrix K."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def scaled(self, factor: float) -> "PinholeCamera":
        """The camera of an image resized by ``factor`` (0.5 halves the resolution)."""
        return PinholeCamera(
            round(self.width * factor),
            round(self.height * factor),
            self.fx * factor,
            self.fy * factor,
            (self.cx + 0.5) * factor - 0.5,
            (self.cy + 0.5) * factor - 0.5,
        )

    def reduced(self, factor: int) -> "PinholeCamera":
        """The camera of an image whose blocks of ``factor`` x ``factor`` pixels became one; sides are cut."""
        exact = self.scaled(1 / factor)
        return PinholeCamera(self.width // factor, self.height // factor, exact.fx, exact.fy, exact.cx, exact.cy)


#: The simulator's default: VGA with 60 degrees across, an Intel D415-like field of view.
DEFAULT_CAMERA = PinholeCamera.from_field_of_view(640, 480, 60.0)


@dataclass(frozen=True, eq=False)
class View:
    """One registered RGB-D view.

    :func:`active6d_core.rgbd.make_view` makes one from arrays of many kinds.

    Attributes:
        stamp: nanoseconds; identifies the view on every topic.
        color: (H, W, 3) uint8 RGB.
        depth: (H, W) float32 metres along z (REP-118), NaN where invalid.
        camera: intrinsics of both images.
        T_world_camera: (4, 4) pose of the optical frame in the world.
    """

    stamp: int
    color: np.ndarray
    depth: np.ndarray
    camera: PinholeCamera
    T_world_camera: np.ndarray


@lru_cache(maxsize=8)
def pixel_rays(camera: PinholeCamera) -> np.ndarray:
    """(H, W, 3) float32 rays with z = 1 through every pixel centre, in the optical frame. Read-only."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u, float)], axis=-1)
    rays = rays.astype(np.float32)
    rays.flags.writeable = False
    return rays


def backproject(depth: np.ndarray, camera: PinholeCamera) -> np.ndarray:
    """(H, W) depth in metres to (H, W, 3) float32 points in the optical frame; NaN depth gives NaN points."""
    return pixel_rays(camera) * depth[..., None].astype(np.float32)


def project(points: np.ndarray, camera: PinholeCamera) -> np.ndarray:
    """(..., 3) points in the optical frame to (..., 2) pixel coordinates (u, v); undefined for z <= 0."""
    uv = points[..., :2] / points[..., 2:]
    return uv * (camera.fx, camera.fy) + (camera.cx, camera.cy)


def normals_from_points(points: np.ndarray, reach: int = 2) -> np.ndarray:
    """Surface normals of an organised cloud by central differences over ``reach`` pixels each way.

    Args:
        points: (H, W, 3) points in the optical frame, NaN where invalid.
        reach: half the width of the difference, in pixels; larger smooths sensor noise.

    Returns:
        (H, W, 3) float32 unit normals that face the camera; NaN at the border and where a neighbour is invalid.
    """
    normals = np.full(points.shape, np.nan, np.float32)
    horizontal = points[reach:-reach, 2 * reach :] - points[reach:-reach, : -2 * reach]
    vertical = points[2 * reach :, reach:-reach] - points[: -2 * reach, reach:-reach]
    cross = np.cross(vertical, horizontal)
    length = np.linalg.norm(cross, axis=-1, keepdims=True)
    inner = np.divide(cross, length, out=np.full_like(cross, np.nan), where=length > 0)
    facing = np.einsum("...i,...i", inner, points[reach:-reach, reach:-reach]) > 0
    inner[facing] *= -1
    normals[reach:-reach, reach:-reach] = inner
    return normals


def pool_depth(depth: np.ndarray, factor: int) -> np.ndarray:
    """Reduce a depth image: each block becomes the mean of its nearest surface, never a mean of two surfaces.

    Args:
        depth: (H, W) metres, NaN where invalid.
        factor: side of a block in pixels; pixels that it does not divide are cut at the right and bottom.

    Returns:
        (H // factor, W // factor) float32, NaN for a block without a valid pixel.
    """
    if factor == 1:
        return depth.astype(np.float32)
    height, width = (size // factor for size in depth.shape)
    layers = [
        depth[row : height * factor : factor, column : width * factor : factor]
        for row in range(factor)
        for column in range(factor)
    ]
    nearest = layers[0]
    for layer in layers[1:]:
        nearest = np.fmin(nearest, layer)
    limit = nearest * np.float32(1 + _SAME_SURFACE)
    total, count = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
    for layer in layers:
        near = layer <= limit
        np.add(total, layer, out=total, where=near)
        count += near
    return np.divide(total, count, out=np.full((height, width), np.nan, np.float32), where=count > 0)
