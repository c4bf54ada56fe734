"""A registered, rectified view from a driver's messages."""

from typing import Any

import numpy as np

from active6d_bringup.camera.depth_registration import register_depth
from active6d_bringup.camera.driver_images import decode_color, decode_depth
from active6d_bringup.camera.preflight import (
    check_depth_unit,
    check_distance,
    check_matrices,
    check_pose,
    check_sizes,
)
from active6d_bringup.camera.rectification import Rectifier
from active6d_core.calibration import Calibration
from active6d_core.camera import View


class ViewMaker:
    """Decodes, rectifies and registers; keeps what it has computed for a calibration.

    Args:
        depth_scale: metres per unit of depth, 0 for what REP-118 says.
        rectified: whether colour, and depth registered to it, are rectified already.
    """

    def __init__(self, depth_scale: float = 0.0, rectified: bool = False) -> None:
        self._depth_scale, self._rectified = depth_scale, rectified
        self._rectifiers: dict[str, Rectifier] = {}
        #: What is doubtful in the last view, in words.
        self.warnings: list[str] = []

    def make(
        self,
        stamp: int,
        color_message: Any,
        depth_message: Any,
        info: Any,
        T_world_camera: np.ndarray,
        depth_info: Any = None,
        T_color_depth: np.ndarray | None = None,
    ) -> View:
        """A view as the graph uses it.

        Args:
            stamp: of the view, nanoseconds.
            color_message: Image or CompressedImage.
            depth_message: Image or CompressedImage, registered to colour unless ``depth_info`` is given.
            info: CameraInfo of colour.
            T_world_camera: (4, 4) pose of the colour camera's optical frame.
            depth_info: CameraInfo of depth that is not registered.
            T_color_depth: (4, 4) pose of the depth camera's optical frame in the colour camera's.

        Raises:
            ValueError: something cannot be used; the message says what, and what to set.
        """
        color = decode_color(color_message)
        depth = decode_depth(depth_message, self._depth_scale)
        distance = float(np.linalg.norm(T_world_camera[:3, 3]))
        calibration = Calibration.from_info(info)
        doubts = check_matrices(calibration, self._rectified), check_pose(T_world_camera)
        self.warnings = [text for text in doubts if text]
        for problem in (
            check_distance(T_world_camera),
            check_depth_unit(depth, distance),
            check_sizes(calibration, color),
        ):
            if problem:
                raise ValueError(problem)
        rectifier = self._rectifier(calibration, self._rectified)
        if depth_info is not None and T_color_depth is not None:
            depth_rectifier = self._rectifier(Calibration.from_info(depth_info), False)
            if depth.shape != (depth_rectifier.camera.height, depth_rectifier.camera.width):
                raise ValueError("depth_info_topic is of another size than depth: set it to the camera_info of depth")
            rectified = depth_rectifier.depth(depth)
            depth = register_depth(rectified, depth_rectifier.camera, rectifier.camera, T_color_depth)
        else:
            self._require_registered(color_message, depth_message, color, depth)
            depth = rectifier.depth(depth)
        return View(stamp, rectifier.color(color), depth, rectifier.camera, T_world_camera)

    def _rectifier(self, calibration: Calibration, rectified: bool) -> Rectifier:
        key = f"{rectified}{calibration.fingerprint}"
        if key not in self._rectifiers:
            # Those of colour and of depth; a driver that changes its calibration does so rarely.
            if len(self._rectifiers) == 2:
                self._rectifiers.clear()
            self._rectifiers[key] = Rectifier(calibration, rectified)
        return self._rectifiers[key]

    @staticmethod
    def _require_registered(color_message: Any, depth_message: Any, color: np.ndarray, depth: np.ndarray) -> None:
        advice = "use the driver's depth that is aligned to colour, or set depth_info_topic and depth_to_color"
        frames = color_message.header.frame_id, depth_message.header.frame_id
        if frames[0] != frames[1]:
            raise ValueError(f"colour is in frame '{frames[0]}', depth in '{frames[1]}': {advice}")
        if color.shape[:2] != depth.shape:
            sizes = f"colour has {color.shape[1]}x{color.shape[0]} pixels, depth {depth.shape[1]}x{depth.shape[0]}"
            raise ValueError(f"{sizes}: {advice}")
