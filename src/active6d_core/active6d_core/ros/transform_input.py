"""The camera's pose from /tf, where tf2_ros is installed (as with apt's ROS 2)."""

from collections.abc import Callable
from importlib import import_module

import numpy as np
from geometry_msgs.msg import Pose
from rclpy.time import Time

from active6d_core.ros.conversions import pose_to_transform
from active6d_core.ros.node import GraphNode


class TransformInput:
    """Looks up the camera's pose in the world at the stamps of views; a transform may come later than its view.

    Args:
        node: the node that listens to /tf.

    Raises:
        ValueError: tf2_ros is not installed.
    """

    def __init__(self, node: GraphNode) -> None:
        try:
            tf2_ros = import_module("tf2_ros")
        except ImportError as error:
            raise ValueError(
                f"{node.get_name()}: poses from /tf need tf2_ros, which is not installed: "
                "install ros-jazzy-tf2-ros-py, or take them from a topic (parameter pose_source or pose_topic)"
            ) from error
        self._node = node
        self._buffer = tf2_ros.Buffer(node=node)
        self._listener = tf2_ros.TransformListener(self._buffer, node)

    def request(
        self,
        stamp: int,
        callback: Callable[[np.ndarray], None],
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
        frames = target or self._node.world_frame, source or self._node.camera_frame
        time = Time(nanoseconds=stamp)

        def take() -> None:
            found = self._buffer.lookup_transform(*frames, time).transform
            pose = Pose(orientation=found.rotation)
            pose.position.x, pose.position.y, pose.position.z = (getattr(found.translation, axis) for axis in "xyz")
            callback(pose_to_transform(pose))

        future = self._buffer.wait_for_transform_async(*frames, time)
        future.add_done_callback(lambda done: self._node.guard("/tf", take))
