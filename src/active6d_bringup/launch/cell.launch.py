"""A robot cell: camera_adapter, estimator, fusion, policy and recorder around a camera driver and an arm.

`ros2 launch active6d_bringup cell.launch.py object:=my_part params_file:=my_cell.yaml bag:=bags/first`
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration

SHARE = Path(get_package_share_directory("active6d_bringup"))
DEFAULTS = str(SHARE / "config" / "cell.yaml")

# name: (default, None where it must be given; description).
ARGUMENTS = {
    "object": (None, "object in the bin; `active6d object add` makes one from a mesh"),
    "params_file": (
        None,
        "a copy of config/active6d.yaml: topics, hand_eye and tolerances (camera_adapter), and the views that "
        "the arm reaches (attention_policy: radius, reach_*)",
    ),
    "bag": (None, "folder to create for the recording; the first thing to look at when something went wrong"),
    "policy": (
        "",
        "which policy chooses the views, auto: view-attention if it has weights for the object, else "
        "unidirectional; empty: as in params_file",
    ),
    "estimator": (
        "",
        "which pose estimator; empty: as in params_file, or geometric, which needs no training, where that has none",
    ),
    "steps": ("", "moves in an episode: the arm stands at one view more; empty: as in params_file"),
    "metres": ("", "travel budget of an episode in metres; empty: as in params_file"),
    "namespace": ("", "prefix of every node and topic, for several cells on one network"),
    "network": (
        "false",
        "true: other machines, such as a driver's, reach the nodes; false: 127.0.0.1 only",
    ),
    "rviz": ("false", "show camera, objects and goals in RViz"),
}


def generate_launch_description() -> LaunchDescription:
    """Arguments, and the graph with the adapter as its camera."""
    arguments = [
        DeclareLaunchArgument(name, description=description, **({} if default is None else {"default_value": default}))
        for name, (default, description) in ARGUMENTS.items()
    ]
    given = {name: LaunchConfiguration(name) for name in ARGUMENTS}
    graph = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(str(SHARE / "launch" / "active6d.launch.py")),
        launch_arguments={**given, "defaults_file": DEFAULTS, "camera": "adapter", "record": "true"}.items(),
    )
    return LaunchDescription([*arguments, graph])
