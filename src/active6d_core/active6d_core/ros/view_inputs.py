"""A camera's topics as subscribers take them: read, checked, and matched by stamp with all else of a view."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from active6d_core.ros.conversions import (
    MessageError,
    image_to_color,
    image_to_depth,
    info_to_camera,
    pose_to_transform,
    require_frame,
    stamp_to_ns,
)
from active6d_core.ros.heartbeat import Awaited
from active6d_core.ros.node import GraphNode
from active6d_core.ros.synchronizer import StampSynchronizer
from active6d_core.ros.topics import CAMERA_COLOR, CAMERA_DEPTH, CAMERA_INFO, CAMERA_POSE, TRANSFORMS, Topic
from active6d_core.ros.transform_input import TransformInput

# part of a view: (topic, reader)
_CAMERA: dict[str, tuple[Topic, Callable[[Any], Any]]] = {
    "color": (CAMERA_COLOR, image_to_color),
    "depth": (CAMERA_DEPTH, image_to_depth),
    "camera": (CAMERA_INFO, info_to_camera),
    "pose": (CAMERA_POSE, lambda message: pose_to_transform(message.pose)),
}
_IMAGES = ("color", "depth", "segmentation")


class ViewInputs:
    """Subscribes to a camera and hands on complete views, whose images have the size that ``camera_info`` says.

    Args:
        node: the node that subscribes; it gets the parameter ``pose_source``.
        parts: what it needs of the camera: of ``camera``, ``color``, ``depth`` and ``pose``.
        callback: called with the stamp in ns and {part: value}.
        others: what else belongs to a view, as {part: topic}; the node hands it to :meth:`add`.
    """

    def __init__(
        self,
        node: GraphNode,
        parts: Sequence[str],
        callback: Callable[[int, dict[str, Any]], None],
        others: Mapping[str, str] | None = None,
    ) -> None:
        self._node, self._callback = node, callback
        self._topics = {**{part: _CAMERA[part][0].name for part in parts}, **(others or {})}
        node.declare(
            "pose_source",
            "topic",
            "topic: the camera's pose comes from camera/pose; tf: from /tf (needs tf2_ros)",
            choices=("topic", "tf"),
            fixed=True,
        )
        self._transforms: TransformInput | None = None
        if "pose" in parts and node.value("pose_source") == "tf":
            self._transforms = TransformInput(node)
            self._topics["pose"] = TRANSFORMS.name
        for part in parts:
            if part != "pose" or self._transforms is None:
                topic, _ = _CAMERA[part]
                node.input(topic, partial(self._take, part))
        self.reset()

    def reset(self) -> None:
        """Forget all that has come."""
        self._views = StampSynchronizer(list(self._topics), self._on_complete, self._on_loss)
        self._requested = self._latest = -1

    def add(self, part: str, stamp: int, value: Any) -> None:
        """Take a part that is not the camera's; raises what :meth:`StampSynchronizer.add` raises."""
        self._views.add(part, stamp, value)
        if self._transforms is not None and stamp > self._requested:
            self._requested = stamp
            self._transforms.request(stamp, partial(self._add_pose, stamp))

    @property
    def newest(self) -> int:
        """Stamp (ns) of the newest view of which something has come, -1 before any."""
        return max(self._views.missing(), default=self._latest)

    def awaited(self) -> Awaited:
        """What the newest incomplete view lacks; between two views, the first topic of the next one."""
        missing = self._views.missing()
        if missing:
            newest = max(missing)
            return Awaited(tuple(sorted(self._topics[part] for part in missing[newest])), newest)
        topics = tuple(self._topics.values())
        return Awaited(topics if self._latest < 0 else topics[:1])

    def _add_pose(self, stamp: int, T_world_camera: np.ndarray) -> None:
        self._views.add("pose", stamp, T_world_camera)

    def _take(self, part: str, message: Any) -> None:
        require_frame(message.header, self._node.world_frame if part == "pose" else self._node.camera_frame)
        self.add(part, stamp_to_ns(message.header.stamp), _CAMERA[part][1](message))

    def _on_loss(self, stamp: int, absent: list[str]) -> None:
        topics = ", ".join(self._topics[part] for part in absent)
        self._node.lose(f"view of {stamp * 1e-9:.3f} s, no {topics} came for it")

    def _on_complete(self, stamp: int, values: dict[str, Any]) -> None:
        self._latest = stamp
        if "camera" in values:
            size = (values["camera"].height, values["camera"].width)
            for part in _IMAGES:
                if part in values and values[part].shape[:2] != size:
                    raise MessageError(f"camera_info says {size}, {part} is {values[part].shape[:2]}")
        self._callback(stamp, values)
