"""Rectification of colour and of depth registered to it, through OpenCV."""

import re

import cv2
import numpy as np

from active6d_core.calibration import Calibration
from active6d_core.camera import PinholeCamera, pixel_rays

#: ROS distortion model to the numbers of coefficients that it may have. Drivers call every model of Brown and Conrady
#: plumb_bob, with as many coefficients as OpenCV takes in the same order; some fill up with zeros.
_BROWN_CONRADY = (4, 5, 8, 12, 14)
_MODELS = {
    "plumb_bob": _BROWN_CONRADY,
    "rational_polynomial": _BROWN_CONRADY,
    "brown_conrady": _BROWN_CONRADY,
    "": _BROWN_CONRADY,
    "equidistant": (4,),
}

#: Values of the nodes' parameter ``rectified``; None is for what the name of the topic says.
RECTIFIED: dict[str, bool | None] = {"auto": None, "yes": True, "no": False}
#: A word of a topic's name, such as image_rect_color/compressed or rect/image, and not corrected or direct.
_WORD = re.compile(r"(^|[/_])rect(ified)?($|[/_])")


def are_rectified(setting: bool | None, topic: str) -> bool:
    """Whether images are rectified already: what the user says, else what the name of their topic says."""
    return bool(_WORD.search(topic)) if setting is None else setting


class Rectifier:
    """Maps raw images of one calibration to the images of a pinhole camera.

    Images of a calibration without distortion and rotation count as rectified, and so does everything if
    ``rectified`` says so; these pass unchanged.

    Args:
        calibration: of the images.
        rectified: whether the images are rectified already, whatever the calibration says of the raw ones.

    Raises:
        ValueError: an unknown distortion model, or numbers that make no camera.
    """

    def __init__(self, calibration: Calibration, rectified: bool = False) -> None:
        self.camera: PinholeCamera = calibration.rectified_camera()
        self._maps: tuple[np.ndarray, np.ndarray] | None = None
        self._depth_factor: np.ndarray | None = None
        if rectified or not calibration.distorted:
            return
        if not calibration.knows_raw:
            raise ValueError("camera_info has distortion but no K; calibrate the camera")
        distort = _undistort_function(calibration)
        raw, size = calibration.in_image(calibration.K), calibration.image_size
        maps = distort(raw, _coefficients(calibration), calibration.R, self.camera.matrix, size, cv2.CV_32FC1)
        self._maps = (maps[0], maps[1])
        if not np.allclose(calibration.R, np.eye(3), atol=1e-6):
            # Depth lies along the raw camera's axis; R maps its rays to those of the rectified camera.
            self._depth_factor = (1.0 / (pixel_rays(self.camera) @ calibration.R)[..., 2]).astype(np.float32)

    def color(self, image: np.ndarray) -> np.ndarray:
        """(H, W, 3) uint8 raw to rectified, black where the raw image has nothing."""
        if self._maps is None:
            return image
        return cv2.remap(image, *self._maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)

    def depth(self, depth: np.ndarray) -> np.ndarray:
        """(H, W) float32 metres raw to rectified, NaN where the raw image has nothing; never mixes two surfaces."""
        if self._maps is None:
            return depth
        nan = float("nan")
        nearest = cv2.remap(depth, *self._maps, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=nan)
        return nearest if self._depth_factor is None else nearest * self._depth_factor


def _undistort_function(calibration: Calibration):  # type: ignore[no-untyped-def]  # OpenCV has no types
    sizes = _MODELS.get(calibration.model)
    if sizes is None:
        known = ", ".join(filter(None, _MODELS))
        raise ValueError(f"distortion model '{calibration.model}' is not one of {known}")
    if len(_coefficients(calibration)) not in sizes:
        expected = " or ".join(map(str, sizes))
        raise ValueError(f"{calibration.model} has {expected} coefficients, camera_info has {len(calibration.D)}")
    return cv2.fisheye.initUndistortRectifyMap if calibration.model == "equidistant" else cv2.initUndistortRectifyMap


def _coefficients(calibration: Calibration) -> np.ndarray:
    """The distortion, of a fisheye lens without the zeros with which a driver fills it up."""
    fisheye = calibration.model == "equidistant" and not calibration.D[4:].any()
    return calibration.D[:4] if fisheye else calibration.D
