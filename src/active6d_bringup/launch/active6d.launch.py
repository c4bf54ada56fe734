"""The whole graph, one process a node: `ros2 launch active6d_bringup active6d.launch.py object:=mug record:=true`."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

SHARE = Path(get_package_share_directory("active6d_bringup"))

# name: (default, choices, description). An empty default leaves the choice to the parameter file.
ARGUMENTS = {
    "params_file": (str(SHARE / "config" / "active6d.yaml"), None, "parameters of all nodes"),
    "namespace": ("", None, "prefix of every node and topic"),
    "camera": ("simulator", ["simulator", "dataset", "none"], "what feeds the camera topics; none for a real driver"),
    "object": ("", None, "object that fills the bin; empty: as in params_file"),
    "seed": ("", None, "of the heap, the sensor's noise and the policy; empty: as in params_file"),
    "scene": ("", None, "stored scene such as mug/test/3 instead of a heap by seed; empty: as in params_file"),
    "estimator": ("", None, "which pose estimator; empty: as in params_file"),
    "policy": ("", None, "which policy chooses the views; empty: as in params_file"),
    "steps": ("", None, "moves in an episode; empty: as in params_file"),
    "metres": ("", None, "of travel in an episode, 0.0 for any; empty: as in params_file"),
    "latched_camera": ("", ["", "true", "false"], "false for a driver that keeps no views; empty: as in params_file"),
    "autostart": ("true", ["true", "false"], "nodes configure and activate themselves; false: `ros2 lifecycle set`"),
    "use_sim_time": ("false", ["true", "false"], "take the nodes' clock from /clock; stamps of views never do"),
    "record": ("false", ["true", "false"], "record every topic of the graph"),
    "bag": ("", None, "folder of the recorded bag, with record:=true; empty: as in params_file"),
    "rviz": ("false", ["true", "false"], "show the graph in RViz"),
}

# executable: (package, arguments that it takes as parameters of the same name)
NODES = {
    "camera_simulator": ("active6d_sim", ["object", "seed", "scene"]),
    "dataset_camera": ("active6d_sim", ["object", "scene"]),
    "pose_estimator": ("active6d_perception", ["object", "estimator", "latched_camera"]),
    "hypothesis_fusion": ("active6d_perception", ["object", "latched_camera"]),
    "attention_policy": ("active6d_agent", ["object", "policy", "seed", "steps", "metres", "latched_camera"]),
    "episode_recorder": ("active6d_bringup", ["bag", "latched_camera"]),
}
CAMERAS = {"simulator": ["camera_simulator"], "dataset": ["dataset_camera"], "none": []}
TYPES = {
    "seed": int,
    "steps": int,
    "metres": float,
    "latched_camera": bool,
    "autostart": bool,
    "use_sim_time": bool,
}


def _node(executable: str, given: dict[str, str], **process_options) -> Node:
    package, takes = NODES[executable]
    parameters = {
        name: ParameterValue(LaunchConfiguration(name), value_type=TYPES.get(name, str))
        for name in [*takes, "autostart", "use_sim_time"]
        if given[name]
    }
    return Node(
        package=package,
        executable=executable,
        name=executable,
        namespace=given["namespace"],
        parameters=[given["params_file"], parameters],
        output="screen",
        **process_options,
    )


def _graph(context: LaunchContext) -> list[Node]:
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    # Who listens starts first. The estimator is the node that a driver or a network can bring down: it comes back, and
    # takes the last view again from the latched camera topics.
    nodes = [_node("episode_recorder", given)] if given["record"] == "true" else []
    nodes.append(_node("pose_estimator", given, respawn=True, respawn_delay=1.0, respawn_max_retries=3))
    nodes += [_node(executable, given) for executable in ("hypothesis_fusion", "attention_policy")]
    nodes += [_node(executable, given) for executable in CAMERAS[given["camera"]]]
    if given["rviz"] == "true":
        layout = str(SHARE / "rviz" / "active6d.rviz")
        nodes.append(Node(package="rviz2", executable="rviz2", namespace=given["namespace"], arguments=["-d", layout]))
    return nodes


def generate_launch_description() -> LaunchDescription:
    """Arguments and nodes for `ros2 launch`."""
    arguments = [
        DeclareLaunchArgument(name, default_value=default, choices=choices, description=description)
        for name, (default, choices, description) in ARGUMENTS.items()
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=_graph)])
