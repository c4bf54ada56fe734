"""The topics of the graph, each declared once: name, type, quality of service, publisher. Needs no ROS to import.

Nodes, recorder, player, replay, layouts and documentation take them from here. Types are strings, so that another
message package is a change of this file alone.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum, auto
from importlib import import_module
from typing import Any


class Per(Enum):
    """How often a topic publishes, and so when a recording of it is complete."""

    VIEW = auto()
    """once for every view of an episode"""
    MOVE = auto()
    """once for every view but the last"""
    EPISODE = auto()
    """once for an episode"""
    WHENEVER = auto()
    """at any time; no recording waits for it"""


@dataclass(frozen=True)
class Topic:
    """A topic of the contract between the nodes. All publishers are reliable.

    Attributes:
        name: relative, so that a namespace or a remap moves it; absolute if it belongs to the whole machine.
        type: such as ``sensor_msgs/msg/Image``.
        per: what one message stands for.
        publisher: the node that publishes it; ``camera`` stands for any camera, empty for every node.
        transient_local: late-joining subscribers get the last messages.
        depth: of the queue of the publisher, and of the subscribers.
        shared: nodes beside the publisher may publish it, too.
    """

    name: str
    type: str
    per: Per
    publisher: str
    transient_local: bool = True
    depth: int = 10
    shared: bool = False

    @property
    def message_type(self) -> Any:
        """The message class; needs the ROS package of the message.

        Raises:
            ImportError: the package is not installed.
        """
        package, _, name = self.type.split("/")
        return getattr(import_module(f"{package}.msg"), name)

    @property
    def from_camera(self) -> bool:
        """Whether a driver or the camera's motion publishes it, with a quality of service that subscribers adapt to."""
        return self.name.startswith(("camera/", "view_goal/status"))


_POSE = "geometry_msgs/msg/PoseStamped"
_POSES = "geometry_msgs/msg/PoseArray"
_IMAGE = "sensor_msgs/msg/Image"
_TABLE = "sensor_msgs/msg/PointCloud2"
_STATUS = "diagnostic_msgs/msg/DiagnosticArray"
_CAMERA, _ESTIMATOR, _FUSION, _POLICY = "camera", "pose_estimator", "hypothesis_fusion", "attention_policy"

CAMERA_COLOR = Topic("camera/color/image_raw", _IMAGE, Per.VIEW, _CAMERA)
CAMERA_DEPTH = Topic("camera/depth/image_raw", _IMAGE, Per.VIEW, _CAMERA)
CAMERA_INFO = Topic("camera/color/camera_info", "sensor_msgs/msg/CameraInfo", Per.VIEW, _CAMERA)
CAMERA_POSE = Topic("camera/pose", _POSE, Per.VIEW, _CAMERA)
GROUND_TRUTH = Topic("ground_truth/poses", _POSES, Per.WHENEVER, _CAMERA)
EPISODE_START = Topic("episode/start", _STATUS, Per.EPISODE, _CAMERA)
HYPOTHESES = Topic("hypotheses", _TABLE, Per.VIEW, _ESTIMATOR)
HYPOTHESES_POSES = Topic("hypotheses/poses", _POSES, Per.VIEW, _ESTIMATOR)
SEGMENTATION = Topic("hypotheses/segmentation", _IMAGE, Per.VIEW, _ESTIMATOR)
OBJECTS = Topic("objects", _TABLE, Per.VIEW, _FUSION)
OBJECTS_POSES = Topic("objects/poses", _POSES, Per.VIEW, _FUSION)
OBJECTS_MARKERS = Topic("objects/markers", "visualization_msgs/msg/MarkerArray", Per.VIEW, _FUSION)
UNEXPLAINED = Topic("objects/unexplained", _TABLE, Per.VIEW, _FUSION)
CAMERA_POSES = Topic("objects/camera_poses", _POSES, Per.VIEW, _FUSION)
ATTENTION = Topic("attention", _TABLE, Per.MOVE, _POLICY, transient_local=False)
VIEW_GOAL = Topic("view_goal", _POSE, Per.MOVE, _POLICY, transient_local=False)
# An arm's node refuses what it cannot plan.
GOAL_STATUS = Topic("view_goal/status", _STATUS, Per.WHENEVER, _CAMERA, shared=True)
EPISODE_END = Topic("episode/end", _STATUS, Per.EPISODE, _POLICY)
DIAGNOSTICS = Topic("/diagnostics", _STATUS, Per.WHENEVER, "", transient_local=False, depth=100)

#: One view of the camera; complete when all four have its stamp.
CAMERA_TOPICS = (CAMERA_COLOR, CAMERA_DEPTH, CAMERA_INFO, CAMERA_POSE)
#: Every topic that is recorded.
CONTRACT = (
    *CAMERA_TOPICS,
    GROUND_TRUTH,
    EPISODE_START,
    HYPOTHESES,
    HYPOTHESES_POSES,
    SEGMENTATION,
    OBJECTS,
    OBJECTS_POSES,
    OBJECTS_MARKERS,
    UNEXPLAINED,
    CAMERA_POSES,
    ATTENTION,
    VIEW_GOAL,
    GOAL_STATUS,
    EPISODE_END,
    DIAGNOSTICS,
)
TOPICS = {topic.name: topic for topic in CONTRACT}
#: What perception makes of a view, in the order in which it is made; a replay compares these.
PERCEPTION_TOPICS = (HYPOTHESES, SEGMENTATION, OBJECTS, UNEXPLAINED)
#: What a recorded camera published; a bag player publishes these again.
REPLAYED_TOPICS = (*CAMERA_TOPICS, GROUND_TRUTH, EPISODE_START)

# Outputs beside the contract, which are not recorded. Those of tf2_msgs and vision_msgs exist where these are found.
CLOCK = Topic("/clock", "rosgraph_msgs/msg/Clock", Per.WHENEVER, "", transient_local=False)
TRANSFORMS = Topic("/tf", "tf2_msgs/msg/TFMessage", Per.VIEW, "", transient_local=False)
JOINT_STATES = Topic("joint_states", "sensor_msgs/msg/JointState", Per.VIEW, _CAMERA)
DETECTIONS = Topic("objects/detections", "vision_msgs/msg/Detection3DArray", Per.VIEW, _FUSION)


def describe_missing(names: Iterable[str], camera: str = "camera_simulator") -> str:
    """Which nodes have not answered, from the names of the topics that are missing.

    Args:
        names: of topics; other texts are kept as they are.
        camera: name of the node that publishes the camera's topics.
    """
    names = list(names)
    publishers = {TOPICS[name].publisher for name in names if name in TOPICS} - {""}
    nodes = sorted(camera if publisher == _CAMERA else publisher for publisher in publishers)
    return f"{', '.join(nodes)} (waiting for {', '.join(names)})" if nodes else ", ".join(names)
