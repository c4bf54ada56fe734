"""The camera's pose from /tf: through tf2_ros where it is installed, else from the messages themselves."""

from collections import deque
from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np
from geometry_msgs.msg import Pose
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.time import Time

from active6d_core.ros.conversions import MessageError, pose_to_transform
from active6d_core.ros.node import GraphNode
from active6d_core.ros.optional_outputs import import_optional
from active6d_core.ros.transform_tree import TransformTree

_KEPT = 10 * 10**9  # nanoseconds
#: Requests that wait; a further one takes the place of the oldest, which may be of a time before the first transform.
_MOST_REQUESTS, _MOST_MESSAGES = 100, 100
_FOR_EVER = 2**62
_Callback = Callable[[np.ndarray], None]


class TransformInput:
    """Looks up the camera's pose in the world at the stamps of views; a transform may come later than its view.

    Args:
        node: the node that listens to /tf.

    Raises:
        ValueError: neither tf2_ros nor tf2_msgs is installed.
    """

    def __init__(self, node: GraphNode) -> None:
        self._node = node
        self._source: _Tf2Source | TransformListener
        try:
            self._source = _Tf2Source(node, import_module("tf2_ros"))
        except ImportError as error:
            messages = import_optional("tf2_msgs")
            if messages is None:
                raise ValueError(
                    f"{node.get_name()}: poses from /tf need tf2_msgs, which is not installed: install "
                    "ros-jazzy-tf2-msgs with apt's ROS 2, else run 'make transforms'; or take poses from a topic "
                    "(parameter pose_source or pose_topic)"
                ) from error
            self._source = TransformListener(node, messages.TFMessage)

    def request(
        self,
        stamp: int,
        callback: _Callback,
        source: str | None = None,
        target: str | None = None,
    ) -> None:
        """Call back once with a (4, 4) transform at the stamp (ns), now or as soon as /tf has it.

        Args:
            stamp: nanoseconds; 0 for the latest.
            callback: called with ``T_target_source``.
            source: frame, None for the camera's.
            target: frame, None for the world.
        """
        self._source.request(target or self._node.world_frame, source or self._node.camera_frame, stamp, callback)

    def problem(self, stamp: int, source: str | None = None) -> str:
        """Why /tf does not have the camera's pose at a stamp (ns; 0: at any time), in words; empty if it does."""
        return self._source.problem(self._node.world_frame, source or self._node.camera_frame, stamp)


class TransformListener:
    """Listens to /tf and /tf_static without tf2_ros, keeps ten seconds of each frame, and interpolates.

    Args:
        node: the node that listens.
        message_type: ``tf2_msgs.msg.TFMessage``; None for a listener that is fed by :meth:`take` alone.
    """

    def __init__(self, node: GraphNode, message_type: Any = None) -> None:
        self._node, self._tree = node, TransformTree(_KEPT)
        self._waiting: deque[tuple[str, str, int, _Callback]] = deque(maxlen=_MOST_REQUESTS)
        if message_type is None:
            return
        live = QoSProfile(depth=_MOST_MESSAGES)
        latched = QoSProfile(depth=_MOST_MESSAGES, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        for topic, qos, static in (("/tf", live, False), ("/tf_static", latched, True)):
            node.create_subscription(
                message_type, topic, lambda message, static=static: self._hear(message, static), qos
            )

    def _hear(self, message: Any, static: bool) -> None:
        self._node.guard("/tf_static" if static else "/tf", lambda: self.take(message, static))

    def take(self, message: Any, static: bool) -> None:
        """Take a message, and answer the requests that it completes.

        Raises:
            MessageError: a transform is not rigid.
        """
        self._tree.add(message, static)
        waiting, self._waiting = self._waiting, deque(maxlen=_MOST_REQUESTS)
        for request in waiting:
            self.request(*request)

    def request(self, target: str, source: str, stamp: int, callback: _Callback) -> None:
        """As :meth:`TransformInput.request`."""
        try:
            found = self._look_up(target, source, stamp)
        except MessageError:
            self._waiting.append((target, source, stamp, callback))
            return
        self._node.guard("/tf", lambda: callback(found))

    def problem(self, target: str, source: str, stamp: int) -> str:
        """Why there is no transform between two frames, see :meth:`TransformInput.problem`."""
        try:
            self._look_up(target, source, stamp)
        except MessageError as error:
            return str(error)
        return ""

    def _look_up(self, target: str, source: str, stamp: int) -> np.ndarray:
        return self._tree.lookup(target, source, stamp or _FOR_EVER, None if stamp else _FOR_EVER)


class _Tf2Source:
    """The buffer of tf2_ros."""

    def __init__(self, node: GraphNode, tf2_ros: Any) -> None:
        self._node, self._buffer = node, tf2_ros.Buffer(node=node)
        self._listener = tf2_ros.TransformListener(self._buffer, node)
        self._waiting: deque[Any] = deque()

    def request(self, target: str, source: str, stamp: int, callback: _Callback) -> None:
        """As :meth:`TransformInput.request`."""
        time = Time(nanoseconds=stamp)

        def take() -> None:
            if future not in self._waiting:
                return  # it gave its place to another one
            self._waiting.remove(future)
            found = self._buffer.lookup_transform(target, source, time).transform
            pose = Pose(orientation=found.rotation)
            pose.position.x, pose.position.y, pose.position.z = (getattr(found.translation, axis) for axis in "xyz")
            callback(pose_to_transform(pose))

        future = self._buffer.wait_for_transform_async(target, source, time)
        self._waiting.append(future)
        if len(self._waiting) > _MOST_REQUESTS:
            self._waiting.popleft().cancel()
        future.add_done_callback(lambda done: self._node.guard("/tf", take))

    def problem(self, target: str, source: str, stamp: int) -> str:
        """As :meth:`TransformListener.problem`."""
        _, text = self._buffer.can_transform(target, source, Time(nanoseconds=stamp), return_debug_tuple=True)
        return str(text)
