"""The camera's pose from /tf: through tf2_ros where it is installed, else from the messages themselves."""

from collections import deque
from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np
from geometry_msgs.msg import Pose
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.time import Time

from active6d_core.ros.conversions import MessageError, pose_to_transform, stamp_to_ns
from active6d_core.ros.node import GraphNode
from active6d_core.ros.optional_outputs import import_optional
from active6d_core.ros.transform_tree import TransformTree

_KEPT_SECONDS, _MOST_REQUESTS, _MOST_MESSAGES = 10, 100, 100
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


class TransformListener:
    """Listens to /tf and /tf_static without tf2_ros, keeps ten seconds, and interpolates.

    Args:
        node: the node that listens.
        message_type: ``tf2_msgs.msg.TFMessage``; None for a listener that is fed by :meth:`take` alone.
    """

    def __init__(self, node: GraphNode, message_type: Any = None) -> None:
        self._node, self._tree, self._newest = node, TransformTree(), 0
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
        stamps = [stamp_to_ns(each.header.stamp) for each in message.transforms]
        if not static and stamps and max(stamps) < self._newest - _KEPT_SECONDS * 10**9:
            # The clock went back, as when a bag begins again.
            self._tree.forget_moving()
            self._newest = 0
        self._tree.add(message, static)
        if not static:
            self._newest = max([self._newest, *stamps])
            self._tree.forget_before(self._newest - _KEPT_SECONDS * 10**9)
        waiting, self._waiting = self._waiting, deque(maxlen=_MOST_REQUESTS)
        for request in waiting:
            self.request(*request)

    def request(self, target: str, source: str, stamp: int, callback: _Callback) -> None:
        """As :meth:`TransformInput.request`."""
        try:
            found = self._tree.lookup(target, source, stamp or _FOR_EVER, None if stamp else _FOR_EVER)
        except MessageError:
            self._waiting.append((target, source, stamp, callback))
            return
        self._node.guard("/tf", lambda: callback(found))


class _Tf2Source:
    """The buffer of tf2_ros."""

    def __init__(self, node: GraphNode, tf2_ros: Any) -> None:
        self._node, self._buffer = node, tf2_ros.Buffer(node=node)
        self._listener = tf2_ros.TransformListener(self._buffer, node)

    def request(self, target: str, source: str, stamp: int, callback: _Callback) -> None:
        """As :meth:`TransformInput.request`."""
        time = Time(nanoseconds=stamp)

        def take() -> None:
            found = self._buffer.lookup_transform(target, source, time).transform
            pose = Pose(orientation=found.rotation)
            pose.position.x, pose.position.y, pose.position.z = (getattr(found.translation, axis) for axis in "xyz")
            callback(pose_to_transform(pose))

        future = self._buffer.wait_for_transform_async(target, source, time)
        future.add_done_callback(lambda done: self._node.guard("/tf", take))
