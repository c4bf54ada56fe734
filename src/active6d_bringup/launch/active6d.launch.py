"""The whole graph, one process a node: `ros2 launch active6d_bringup active6d.launch.py object:=mug record:=true`."""

from pathlib import Path

from ament_index_python.packages import PackageNotFoundError, get_package_share_directory
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, EmitEvent, OpaqueFunction, RegisterEventHandler
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.events.process import ProcessExited
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from active6d_core.object_model import load_object
from active6d_core.ros.graph_nodes import BAD_PARAMETERS, MAX_RESTARTS, NODES
from active6d_core.ros.network import keep_on_this_machine, open_to_network

SHARE = Path(get_package_share_directory("active6d_bringup"))

# name: (default, choices, description). An empty default leaves the choice to the parameter file.
ARGUMENTS = {
    "params_file": (str(SHARE / "config" / "active6d.yaml"), None, "parameters of all nodes"),
    "defaults_file": ("", None, "parameters that those of params_file replace; empty: none"),
    "namespace": ("", None, "prefix of every node and topic"),
    "camera": (
        "simulator",
        ["simulator", "dataset", "bag", "adapter", "none"],
        "source of the camera topics; adapter: your driver, through camera_adapter; none: your driver as it is",
    ),
    "object": ("", None, "object that fills the bin; empty: as in params_file"),
    "seed": ("", None, "seed of the pile, the sensor noise and the policy; empty: as in params_file"),
    "scene": ("", None, "stored scene such as mug/test/3 instead of a simulated pile; empty: as in params_file"),
    "estimator": ("", None, "which pose estimator; empty: as in params_file"),
    "policy": ("", None, "which policy chooses the views; empty: as in params_file"),
    "steps": ("", None, "moves in an episode; empty: as in params_file"),
    "metres": ("", None, "travel budget of an episode in metres, 0.0: none; empty: as in params_file"),
    "autostart": (
        "",
        ["", "true", "false"],
        "nodes configure and activate themselves; false: `ros2 lifecycle set`; empty: as in params_file",
    ),
    "use_sim_time": (
        "",
        ["", "true", "false"],
        "take the nodes' clock from /clock; stamps of views never do; empty: as in params_file",
    ),
    "play": ("", None, "folder of the bag to play, with camera:=bag"),
    "rate": ("", None, "speed of playing against the recording; 0.0: as fast as perception; empty: as in params_file"),
    "record": ("false", ["true", "false"], "record every topic of the graph"),
    "bag": ("", None, "folder of the recorded bag, with record:=true; empty: as in params_file"),
    "network": ("false", ["true", "false"], "let other machines reach the nodes; false: 127.0.0.1 only"),
    "rviz": ("false", ["true", "false"], "show the graph in RViz"),
}

CAMERAS = {
    "simulator": ["camera_simulator"],
    "dataset": ["dataset_camera"],
    "bag": ["bag_player"],
    "adapter": ["camera_adapter"],
    "none": [],
}
TYPES = {
    "seed": int,
    "steps": int,
    "metres": float,
    "rate": float,
    "autostart": bool,
    "use_sim_time": bool,
}


def _node(executable: str, given: dict[str, str]) -> Node:
    entry = NODES[executable]
    arguments = {"bag": "play"} if executable == "bag_player" else {}
    parameters = {
        name: ParameterValue(LaunchConfiguration(arguments.get(name, name)), value_type=TYPES.get(name, str))
        for name in [*entry.launch_parameters, "autostart", "use_sim_time"]
        if given[arguments.get(name, name)]
    }
    files = [given[name] for name in ("defaults_file", "params_file") if given[name]]
    if executable == "episode_recorder":
        parameters["resume"] = True
    return Node(
        package=entry.package,
        executable=executable,
        name=executable,
        namespace=given["namespace"],
        # The last one that has a parameter counts.
        parameters=[*files, *([parameters] if parameters else [])],
        output="screen",
        respawn=entry.restarted,
        # Longer than the shutdown takes that _end_on_bad_parameters asks for.
        respawn_delay=1.0,
        respawn_max_retries=MAX_RESTARTS,
    )


def _end_on_bad_parameters(event: ProcessExited, context: LaunchContext) -> list[EmitEvent]:
    """End the launch when a node refuses its parameters: starting it again cannot succeed."""
    if event.returncode != BAD_PARAMETERS:
        return []
    return [EmitEvent(event=Shutdown(reason=f"{event.process_name} refuses its parameters, see its message above"))]


def _refuse_what_cannot_work(given: dict[str, str]) -> None:
    """Raise before any node starts.

    Raises:
        RuntimeError: an argument names something that is not there; the text says what to do.
    """
    if given["rviz"] == "true":
        try:
            get_package_share_directory("rviz2")
        except PackageNotFoundError as error:
            raise RuntimeError("rviz:=true needs rviz2: apt install ros-jazzy-rviz2, or rviz:=false") from error
    if given["object"]:
        try:
            load_object(given["object"])
        except ValueError as error:
            raise RuntimeError(f"object:={given['object']}: {error}") from error
    if given["camera"] == "bag" and not given["play"]:
        raise RuntimeError("camera:=bag needs play:=FOLDER, the folder of a recorded bag")
    if not Path(given["params_file"]).is_file():
        raise RuntimeError(f"params_file:={given['params_file']} does not exist")


def _wanted(given: dict[str, str]) -> set[str]:
    """Names of the nodes to start. A bag refuses every goal, so there is no policy with it."""
    wanted = {"pose_estimator", "hypothesis_fusion", *CAMERAS[given["camera"]]}
    if given["camera"] != "bag":
        wanted.add("attention_policy")
    if given["record"] == "true":
        wanted.add("episode_recorder")
    return wanted


def _graph(context: LaunchContext) -> list[Node]:
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    _refuse_what_cannot_work(given)
    reach = open_to_network if given["network"] == "true" else keep_on_this_machine
    reach(context.environment)
    nodes = [_node(executable, given) for executable in NODES if executable in _wanted(given)]
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
    handler = RegisterEventHandler(OnProcessExit(on_exit=_end_on_bad_parameters))
    return LaunchDescription([*arguments, handler, OpaqueFunction(function=_graph)])
