"""A camera's topics as the nodes of this package take them: read, checked, matched by stamp with all else of a view."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import CameraInfo, Image

from active6d_core.ros.conversions import (
    MessageError,
    image_to_color,
    image_to_depth,
    info_to_camera,
    pose_to_transform,
    require_frame,
    stamp_to_ns,
)
from active6d_core.ros.node import GraphNode, StampSynchronizer

# part of a view: (message type, topic, reader)
_CAMERA = {
    "color": (Image, "camera/color/image_raw", image_to_color),
    "depth": (Image, "camera/depth/image_raw", image_to_depth),
    "camera": (CameraInfo, "camera/color/camera_info", info_to_camera),
    "pose": (PoseStamped, "camera/pose", lambda message: pose_to_transform(message.pose)),
}
_IMAGES = ("color", "depth", "segmentation")


class ViewInputs:
    """Subscribes to a camera and hands on complete views, whose images have the size that ``camera_info`` says.

    Args:
        node: who listens; it gets the parameter ``latched_camera``.
        parts: what it wants of the camera: ``camera``, and of ``color``, ``depth`` and ``pose`` what it needs.
        callback: called with the stamp in ns and {part: value}.
        others: what else belongs to a view; the node hands it to :meth:`add`.
    """

    def __init__(
        self,
        node: GraphNode,
        parts: Sequence[str],
        callback: Callable[[int, dict[str, Any]], None],
        others: Sequence[str] = (),
    ) -> None:
        self._node, self._names, self._callback = node, (*parts, *others), callback
        latched = node.declare("latched_camera", True, "camera topics are transient-local, false for plain drivers")
        for part in parts:
            message_type, topic, _ = _CAMERA[part]
            node.camera_input(message_type, topic, partial(self._take, part), latched)
        self.reset()

    def reset(self) -> None:
        """Forget all that has come."""
        self._views = StampSynchronizer(self._names, self._on_complete)

    def add(self, part: str, stamp: int, value: Any) -> None:
        """Take a part that is not the camera's; raises what :meth:`StampSynchronizer.add` raises."""
        self._views.add(part, stamp, value)

    def _take(self, part: str, message: Any) -> None:
        require_frame(message.header, self._node.world_frame if part == "pose" else self._node.camera_frame)
        self.add(part, stamp_to_ns(message.header.stamp), _CAMERA[part][2](message))

    def _on_complete(self, stamp: int, values: dict[str, Any]) -> None:
        size = (values["camera"].height, values["camera"].width)
        for part in _IMAGES:
            if part in values and values[part].shape[:2] != size:
                raise MessageError(f"camera_info says {size}, {part} is {values[part].shape[:2]}")
        self._callback(stamp, values)
