"""The RViz and Foxglove layouts show topics that the graph has, in ways that fit their types."""

import json
from pathlib import Path

import pytest
import yaml

from active6d_core.ros.topics import CONTRACT

BRINGUP = Path(__file__).parents[2] / "src/active6d_bringup"
TYPES = {topic.name: topic.type for topic in CONTRACT}
LATCHED = {topic.name for topic in CONTRACT if topic.transient_local}
DISPLAYED = {
    "Image": "sensor_msgs/msg/Image",
    "Pose": "geometry_msgs/msg/PoseStamped",
    "PoseArray": "geometry_msgs/msg/PoseArray",
    "PointCloud2": "sensor_msgs/msg/PointCloud2",
    "MarkerArray": "visualization_msgs/msg/MarkerArray",
}


def rviz_displays() -> list[dict]:
    layout = yaml.safe_load((BRINGUP / "rviz/active6d.rviz").read_text())
    return [display for display in layout["Visualization Manager"]["Displays"] if "Topic" in display]


@pytest.mark.parametrize("display", rviz_displays(), ids=lambda display: display["Name"])
def test_rviz_display(display):
    topic = display["Topic"]
    assert TYPES[topic["Value"]] == DISPLAYED[display["Class"].removeprefix("rviz_default_plugins/")]
    # a display that asks for more than is offered stays empty
    assert topic["Durability Policy"] == ("Transient Local" if topic["Value"] in LATCHED else "Volatile")


def test_rviz_fixed_frame_is_the_world():
    layout = yaml.safe_load((BRINGUP / "rviz/active6d.rviz").read_text())
    assert layout["Visualization Manager"]["Global Options"]["Fixed Frame"] == "world"


def _topics(node: object) -> set[str]:
    if isinstance(node, dict):
        return set().union(*({key} | _topics(value) for key, value in node.items()))
    return {node} if isinstance(node, str) else set()


def test_foxglove_topics_are_in_the_contract():
    layout = json.loads((BRINGUP / "foxglove/active6d.json").read_text())
    shown = {name for name in _topics(layout["configById"]) if name.startswith("/")}
    known = {"/" + name.removeprefix("/") for name in TYPES}
    assert shown <= known
    assert known - shown == set()


def test_foxglove_panels_are_all_placed():
    layout = json.loads((BRINGUP / "foxglove/active6d.json").read_text())
    placed, todo = set(), [layout["layout"]]
    while todo:
        part = todo.pop()
        if isinstance(part, str):
            placed.add(part)
        else:
            todo += [part["first"], part["second"]]
    assert placed == set(layout["configById"])
