"""A camera's topics as subscribers take them: read, checked, and matched by stamp with all else of a view."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from active6d_core.bounds import FARTHEST, PLAUSIBLE_DEPTH, check_camera_pose, limit_depth
from active6d_core.ros.conversions import (
    MessageError,
    OutdatedError,
    image_to_color,
    image_to_depth,
    info_to_camera,
    pose_to_transform,
    refusing,
    require_frame,
    stamp_to_ns,
)
from active6d_core.ros.episode_messages import EpisodeStart
from active6d_core.ros.heartbeat import Awaited
from active6d_core.ros.node import GraphNode
from active6d_core.ros.synchronizer import StampSynchronizer
from active6d_core.ros.topics import (
    CAMERA_COLOR,
    CAMERA_DEPTH,
    CAMERA_INFO,
    CAMERA_POSE,
    EPISODE_START,
    TRANSFORMS,
    Topic,
)
from active6d_core.ros.transform_input import TransformInput

# part of a view: (topic, reader)
_CAMERA: dict[str, tuple[Topic, Callable[[Any], Any]]] = {
    "color": (CAMERA_COLOR, image_to_color),
    "depth": (CAMERA_DEPTH, image_to_depth),
    "camera": (CAMERA_INFO, info_to_camera),
    "pose": (CAMERA_POSE, lambda message: pose_to_transform(message.pose)),
}
_IMAGES = ("color", "depth", "segmentation")
#: Views remembered as seen, of which an announcement of their episode may still come.
_REMEMBERED = 256


class ViewInputs:
    """Subscribes to a camera and hands on complete views, whose images have the size that ``camera_info`` says.

    With ``on_start`` it also follows ``episode/start``. An announced episode begins when the camera shows a view with
    the announced stamp, whether that stamp is later or earlier than those before: an announcement alone changes
    nothing, so that a wrong one cannot lock the node.

    Args:
        node: the node that subscribes; it gets the parameter ``pose_source``, and with ``depth`` ``depth_min`` and
            ``depth_max``.
        parts: what it needs of the camera: of ``camera``, ``color``, ``depth`` and ``pose``.
        callback: called with the stamp in ns and {part: value}.
        others: what else belongs to a view, as {part: topic}; the node hands it to :meth:`add`.
        on_start: called when an episode begins, with whether it is all new. If not, its first view overtook the
            announcement, and the views that came before that one are over.
    """

    def __init__(
        self,
        node: GraphNode,
        parts: Sequence[str],
        callback: Callable[[int, dict[str, Any]], None],
        others: Mapping[str, str] | None = None,
        on_start: Callable[[EpisodeStart, bool], None] | None = None,
    ) -> None:
        self._node, self._callback, self._on_start = node, callback, on_start
        self._topics = {**{part: _CAMERA[part][0].name for part in parts}, **(others or {})}
        node.declare(
            "pose_source",
            "topic",
            "topic: the camera's pose comes from camera/pose; tf: from /tf (needs tf2_msgs)",
            choices=("topic", "tf"),
            fixed=True,
        )
        if "depth" in parts:
            low, high = PLAUSIBLE_DEPTH
            node.declare("depth_min", low, "smaller depths are invalid, in metres", minimum=0.0)
            node.declare("depth_max", high, "larger depths are invalid, in metres", minimum=0.0, maximum=FARTHEST)
        self._transforms: TransformInput | None = None
        if "pose" in parts and node.value("pose_source") == "tf":
            self._transforms = TransformInput(node)
            self._topics["pose"] = TRANSFORMS.name
        if on_start is not None:
            # First, for the executor calls back in this order: an episode is announced before its first view.
            node.input(EPISODE_START, self._announce)
        for part in parts:
            if part != "pose" or self._transforms is None:
                topic, _ = _CAMERA[part]
                node.input(topic, partial(self._take, part))
        self.reset()

    def reset(self) -> None:
        """Forget all that has come, and read the parameters.

        Raises:
            ValueError: no depth is between ``depth_min`` and ``depth_max``.
        """
        if "depth" in self._topics:
            low, high = self._depth_range = self._node.value("depth_min"), self._node.value("depth_max")
            if not low < high:
                raise ValueError(f"{self._node.get_name()}: parameter 'depth_min' must be below 'depth_max'")
        self._announced: dict[int, None] = {}
        self._expected: EpisodeStart | None = None
        self._repeated: tuple[int, dict[str, Any]] = -1, {}
        self._restart()

    def _restart(self) -> None:
        """Forget all views."""
        self._views = StampSynchronizer(list(self._topics), self._on_complete, self._on_loss)
        self._latest = -1
        self._known: dict[int, None] = {}
        self._requested: set[int] = set()
        self._left: set[int] = set()

    def add(self, part: str, stamp: int, value: Any) -> None:
        """Take a part that is not the camera's.

        Raises:
            OutdatedError: its view is over.
            MessageError: the stamp is not set.
        """
        if stamp == 0:
            raise MessageError("stamp is 0; the publisher does not set it")
        self._views.add(part, stamp, value)
        if self._transforms is not None and stamp not in self._requested:
            self._requested = (self._requested & self._views.missing().keys()) | {stamp}
            self._transforms.request(stamp, partial(self._add_pose, stamp))

    @property
    def under_way(self) -> bool:
        """Whether a view has begun to come after the last complete one."""
        return not self._views.missing().keys() <= self._left

    def began_before(self, stamp: int) -> bool:
        """Whether an episode was announced that began before the view of ``stamp``, and whose first view has not come.

        So it is for a node that starts in the middle of an episode of more views than are kept for late subscribers.
        """
        return self._expected is not None and self._expected.stamp < stamp

    def awaited(self) -> Awaited:
        """What the view that began last lacks; between two views, the first topic of the next one."""
        missing = self._views.missing()
        if missing:
            newest = list(missing)[-1]
            return Awaited(tuple(sorted(self._topics[part] for part in missing[newest])), newest)
        topics = tuple(self._topics.values())
        return Awaited(topics if self._latest < 0 else topics[:1])

    def _announce(self, message: Any) -> None:
        start = EpisodeStart.from_message(message)
        stamp, again = start.stamp, start.stamp in self._announced
        _remember(self._announced, stamp)
        if again and stamp == self._repeated[0]:
            repeated = self._repeated[1]
            self._begin(start, again)
            for part, value in repeated.items():
                self.add(part, stamp, value)
        elif not again and (stamp in self._known or stamp in self._views.missing()):
            self._begin(start, again)  # its first view overtook the announcement
        else:
            self._expected = start

    def _begin(self, start: EpisodeStart, again: bool) -> None:
        """Begin the announced episode; ``again``: the camera has begun with the same stamp before."""
        self._expected, self._repeated = None, (-1, {})
        new = again or start.stamp not in self._known
        if again:
            self._restart()
        else:
            self._views.end_before(start.stamp)
            known = list(self._known)
            self._known = {} if new else dict.fromkeys(known[known.index(start.stamp) :])
        if self._on_start is not None:
            self._on_start(start, new)

    def _add_pose(self, stamp: int, T_world_camera: np.ndarray) -> None:
        with refusing():
            check_camera_pose(T_world_camera)
        self._views.add("pose", stamp, T_world_camera)

    def _take(self, part: str, message: Any) -> None:
        require_frame(message.header, self._node.world_frame if part == "pose" else self._node.camera_frame)
        stamp, value = stamp_to_ns(message.header.stamp), _CAMERA[part][1](message)
        with refusing():
            if part == "depth":
                value = limit_depth(value, self._depth_range)
            elif part == "pose":
                check_camera_pose(value)
        if self._expected is not None and stamp == self._expected.stamp:
            self._begin(self._expected, again=self._views.over(stamp))
        try:
            self.add(part, stamp, value)
        except OutdatedError:
            # A restarted camera begins with the same stamps; its announcement may come after its view.
            before = self._repeated[1] if self._repeated[0] == stamp else {}
            self._repeated = stamp, {**before, part: value}
            raise

    def _on_loss(self, stamp: int, absent: list[str]) -> None:
        topics = ", ".join(self._topics[part] for part in absent)
        why = self._transforms.problem(stamp) if self._transforms is not None and "pose" in absent else ""
        self._node.lose(f"view of {stamp * 1e-9:.3f} s, no {topics} came for it{why and f' ({why})'}")

    def _on_complete(self, stamp: int, values: dict[str, Any]) -> None:
        self._latest = stamp
        self._left = set(self._views.missing())
        _remember(self._known, stamp)
        if "camera" in values:
            size = (values["camera"].height, values["camera"].width)
            for part in _IMAGES:
                if part in values and values[part].shape[:2] != size:
                    raise MessageError(f"camera_info says {size}, {part} is {values[part].shape[:2]}")
        self._callback(stamp, values)


def _remember(stamps: dict[int, None], stamp: int) -> None:
    stamps[stamp] = None
    if len(stamps) > _REMEMBERED:
        del stamps[next(iter(stamps))]
