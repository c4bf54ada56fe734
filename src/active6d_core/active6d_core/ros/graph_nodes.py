"""The nodes of the graph, each declared once: where its class is, whether it is restarted, what a launch sets.

Needs no ROS to import. The composed graph, the supervised processes, the launch file and the documentation use it.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class NodeEntry:
    """One node of the graph. Its executable has the node's name.

    Attributes:
        module: the Python module that has the class; ``python -m`` runs it as well.
        type_name: name of the class.
        launch_parameters: parameters that ``active6d.launch.py`` sets from its arguments of the same name.
        restarted: whether an episode survives the node's death; if so, it is started again.
    """

    module: str
    type_name: str
    launch_parameters: tuple[str, ...] = ()
    restarted: bool = False

    @property
    def package(self) -> str:
        """The ROS package that the node belongs to."""
        return self.module.split(".")[0]


#: Node name to entry. Their order is the order of starting: a subscriber comes before what it listens to.
NODES = {
    # It goes on in the next file of its bag.
    "episode_recorder": NodeEntry(
        "active6d_bringup.nodes.episode_recorder", "EpisodeRecorderNode", ("bag",), restarted=True
    ),
    # These three get their inputs back when they start again: they are transient local.
    "attention_policy": NodeEntry(
        "active6d_agent.nodes.attention_policy",
        "AttentionPolicyNode",
        ("object", "policy", "seed", "steps", "metres"),
        restarted=True,
    ),
    "hypothesis_fusion": NodeEntry(
        "active6d_perception.nodes.hypothesis_fusion",
        "HypothesisFusionNode",
        ("object",),
        restarted=True,
    ),
    "pose_estimator": NodeEntry(
        "active6d_perception.nodes.pose_estimator",
        "PoseEstimatorNode",
        ("object", "estimator"),
        restarted=True,
    ),
    "bag_player": NodeEntry("active6d_bringup.nodes.bag_player", "BagPlayerNode", ("bag", "rate")),
    "dataset_camera": NodeEntry("active6d_sim.nodes.dataset_camera", "DatasetCameraNode", ("object", "scene")),
    "camera_adapter": NodeEntry("active6d_bringup.nodes.camera_adapter", "CameraAdapterNode", ("object",)),
    "camera_simulator": NodeEntry(
        "active6d_sim.nodes.camera_simulator", "CameraSimulatorNode", ("object", "seed", "scene")
    ),
}
#: How often a restarted node may die before the episode is given up, in ``ros2 launch`` and under the supervisor.
MAX_RESTARTS = 5
#: A node ends with this code on bad parameters; starting it again cannot succeed.
BAD_PARAMETERS = 2
