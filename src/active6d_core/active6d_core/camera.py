"""The pinhole camera, one registered RGB-D view, and what follows from a depth image."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np


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
        # numpy promotes float32 images by an np.float64 and not by a float: results must not depend on where the
        # numbers came from.
        for name in ("fx", "fy", "cx", "cy"):
            object.__setattr__(self, name, float(getattr(self, name)))

    @classmethod
    def from_field_of_view(cls, width: int, height: int, horizontal_degrees: float) -> "PinholeCamera":
        """Square pixels, principal point at the image's centre."""
        focal = 0.5 * width / np.tan(0.5 * np.radians(horizontal_degrees))
        return cls(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)

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


#: The simulator's default: VGA with 60 degrees across, an Intel D415-like field of view.
DEFAULT_CAMERA = PinholeCamera.from_field_of_view(640, 480, 60.0)


@dataclass(frozen=True, eq=False)
class View:
    """One registered RGB-D view.

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
