"""A camera driver's topics as ``camera_adapter`` takes them, whatever their types and quality of service."""

from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from active6d_core.ros.adaptive_subscription import AdaptiveSubscription
from active6d_core.ros.node import GraphNode
from active6d_core.ros.topics import Per, Topic

_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_INFO = ("sensor_msgs/msg/CameraInfo",)
_POSES = ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")
#: Input to its message types, the default of its topic, and what it is.
_INPUTS = {
    "color": (_IMAGES, "/camera/camera/color/image_raw", "colour images, raw or compressed"),
    "depth": (
        _IMAGES,
        "/camera/camera/aligned_depth_to_color/image_raw",
        "depth images, raw or compressedDepth",
    ),
    "info": (_INFO, "/camera/camera/color/camera_info", "camera_info of the colour images"),
    "depth_info": (_INFO, "", "camera_info of depth that is not registered to colour; empty: it is registered"),
    "pose": (_POSES, "", "camera poses in the world frame; empty: from /tf (needs tf2_msgs)"),
}
_LOOK_SECONDS = 0.2


class DriverInputs:
    """Subscribes to each topic as soon as it appears: its type says how its images are coded.

    Args:
        node: the node that subscribes; it gets a parameter ``NAME_topic`` for each input.
        callback: called with the name of the input and the message, while the node is active.
    """

    def __init__(self, node: GraphNode, callback: Callable[[str, Any], None]) -> None:
        self._node, self._callback = node, callback
        for name, (_, default, description) in _INPUTS.items():
            node.declare(f"{name}_topic", default, description, fixed=True)
        #: Input to the name of its topic, of those that are set.
        self.topics = {name: node.value(f"{name}_topic") for name in _INPUTS if node.value(f"{name}_topic")}
        self._subscribed: dict[str, AdaptiveSubscription] = {}
        node.wall_timer(_LOOK_SECONDS, self._look)

    def _look(self) -> None:
        missing = {name: topic for name, topic in self.topics.items() if name not in self._subscribed}
        if not missing:
            return
        known = dict(self._node.get_topic_names_and_types())
        for name, topic in missing.items():
            wanted, found = _INPUTS[name][0], known.get(self._node.resolve_topic_name(topic), [])
            usable = [kind for kind in found if kind in wanted]
            if usable:
                declared = Topic(topic, usable[0], Per.WHENEVER, "driver")
                qos = QoSProfile(
                    depth=declared.depth,
                    reliability=ReliabilityPolicy.RELIABLE,
                    durability=DurabilityPolicy.TRANSIENT_LOCAL,
                )
                take = partial(self._take, name, topic)
                self._subscribed[name] = AdaptiveSubscription(self._node, declared, take, qos)
            elif found:
                expected = " or ".join(wanted)
                self._node.say_once(f"{topic} has the type {found[0]}, but {name}_topic must be a {expected}")

    def _take(self, name: str, topic: str, message: Any) -> None:
        if self._node.active:
            self._node.guard(topic, partial(self._callback, name, message))
