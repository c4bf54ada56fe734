"""A camera's calibration as drivers publish it, and the pinhole camera of its rectified images (REP-104)."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from active6d_core.camera import PinholeCamera

_SAME_PIXELS = 1e-3
#: Distortion models that with D = 0 leave an image as it is; a fisheye lens bends rays all the same.
_NONE_WITHOUT_COEFFICIENTS = ("", "none", "plumb_bob", "rational_polynomial", "brown_conrady", "inverse_brown_conrady")


@dataclass(frozen=True, eq=False)
class Calibration:
    """What ``sensor_msgs/CameraInfo`` says of the images that it comes with; all lengths in pixels.

    K, D, R and P are those of the full resolution. Images may be a region of it, and binned.

    Attributes:
        width: of the full resolution.
        height: of the full resolution.
        K: (3, 3) intrinsic matrix of the raw image; the identity or zeros where the driver does not know it.
        D: (k,) distortion of the raw image, empty without any.
        R: (3, 3) rotation from the raw to the rectified optical frame.
        P: (3, 4) projection of the rectified image; zeros where the driver does not know it.
        model: distortion model, such as ``plumb_bob``.
        binning: (horizontal, vertical) pixels of the full resolution that make one of the image.
        region: (x, y, width, height) of the image within the full resolution, zeros for all of it.
    """

    width: int
    height: int
    K: np.ndarray
    D: np.ndarray = field(default_factory=lambda: np.zeros(0))
    R: np.ndarray = field(default_factory=lambda: np.eye(3))
    P: np.ndarray = field(default_factory=lambda: np.zeros((3, 4)))
    model: str = "plumb_bob"
    binning: tuple[int, int] = (1, 1)
    region: tuple[int, int, int, int] = (0, 0, 0, 0)

    @classmethod
    def from_info(cls, message: Any) -> "Calibration":
        """Read a CameraInfo of ROS 1 or ROS 2, or what rosbags makes of one.

        Raises:
            ValueError: a number is not finite.
        """

        def numbers(name: str) -> np.ndarray:
            values = np.asarray(
                getattr(message, name, None) if hasattr(message, name) else getattr(message, name.upper())
            )
            if not np.isfinite(values.astype(float)).all():
                raise ValueError(f"{name} of camera_info holds a number that is not finite")
            return values.astype(float)

        region = message.roi
        R = numbers("r").reshape(3, 3)
        return cls(
            width=int(message.width),
            height=int(message.height),
            K=numbers("k").reshape(3, 3),
            D=numbers("d"),
            R=R if R.any() else np.eye(3),
            P=numbers("p").reshape(3, 4),
            model=message.distortion_model,
            binning=(max(int(message.binning_x), 1), max(int(message.binning_y), 1)),
            region=(int(region.x_offset), int(region.y_offset), int(region.width), int(region.height)),
        )

    @property
    def fingerprint(self) -> str:
        """The same text for the same numbers."""
        matrices = (self.K, self.D, self.R, self.P)
        return f"{self.width, self.height, self.model, self.binning, self.region}{[each.tolist() for each in matrices]}"

    @property
    def image_size(self) -> tuple[int, int]:
        """(width, height) of the images, as region and binning leave them."""
        return (self.region[2] or self.width) // self.binning[0], (self.region[3] or self.height) // self.binning[1]

    @property
    def distorted(self) -> bool:
        """Whether raw and rectified images differ by more than their intrinsics."""
        bent = bool(np.any(self.D)) or self.model not in _NONE_WITHOUT_COEFFICIENTS
        return bent or not np.allclose(self.R, np.eye(3), atol=1e-6)

    @property
    def knows_raw(self) -> bool:
        """Whether K is known; some drivers of stereo cameras leave the identity there."""
        return bool(self.K[0, 0] > 0 and self.K[1, 1] > 0 and not np.allclose(self.K, np.eye(3)))

    @property
    def matrices_differ(self) -> bool:
        """Whether K and P are both known and name different cameras."""
        return self.knows_raw and self.P[0, 0] > 0 and bool(np.abs(self.P[:, :3] - self.K).max() > _SAME_PIXELS)

    def in_image(self, matrix: np.ndarray) -> np.ndarray:
        """A (3, 3) intrinsic matrix of the full resolution as that of the images; (0, 0) is a pixel's centre."""
        (bin_x, bin_y), (x, y, _, _) = self.binning, self.region
        moved = np.array(matrix, float)
        # Halves only where pixels are binned: other cameras stay the same to the last bit.
        moved[0, 2] = (matrix[0, 2] - x + 0.5) / bin_x - 0.5 if bin_x > 1 else matrix[0, 2] - x
        moved[1, 2] = (matrix[1, 2] - y + 0.5) / bin_y - 0.5 if bin_y > 1 else matrix[1, 2] - y
        moved[0, :2] /= bin_x
        moved[1, :2] /= bin_y
        return moved

    def rectified_camera(self) -> PinholeCamera:
        """Intrinsics of the rectified images: P, or K where P is not known.

        Raises:
            ValueError: neither is known, or they do not belong to images of this size.
        """
        if self.P[0, 0] > 0:
            matrix = self.P[:, :3]
        elif self.knows_raw:
            matrix = self.K
        else:
            raise ValueError("neither P nor K holds focal lengths; calibrate the camera")
        return PinholeCamera.from_matrix(self.in_image(matrix), *self.image_size, cropped=any(self.region))
