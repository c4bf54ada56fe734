"""The doctor looks at a running graph of stub nodes: silence, mismatches, and who waits for whom."""

import json
import threading

import pytest
from geometry_msgs.msg import PoseStamped
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2
from typer.testing import CliRunner

from active6d_core.ros import topics
from active6d_core.ros.heartbeat import Awaited
from active6d_core.ros.node import GraphNode
from active6d_tools import graph_doctor
from active6d_tools.cli import app
from active6d_tools.graph_doctor import PARTS, examine_graph, verdict
from active6d_tools.machine_doctor import Check

FAST = {"heartbeat": 0.2}


class Camera(GraphNode):
    """Publishes poses and never an image."""

    def __init__(self, **arguments):
        super().__init__("camera", overrides=FAST, **arguments)
        self.pose = self.output(topics.CAMERA_POSE)
        self.color = self.output(topics.CAMERA_COLOR)
        self.input(topics.VIEW_GOAL, lambda message: None)

    def begin(self):
        self.pose.publish(PoseStamped())

    def awaited(self):
        return Awaited(("view_goal",))


class Viewer(GraphNode):
    """Waits for the image of a view."""

    def __init__(self, **arguments):
        super().__init__("viewer", overrides=FAST, **arguments)
        self.input(topics.CAMERA_COLOR, lambda message: None)
        self.input(topics.CAMERA_INFO, lambda message: None)
        self.input(topics.OBJECTS, lambda message: None)

    def awaited(self):
        return Awaited(("camera/color/image_raw",), 12_400_000_000)


@pytest.fixture
def spinning(graph):
    """The harness, spun by a thread while the doctor listens."""
    end = threading.Event()

    def spin():
        while not end.is_set():
            graph.executor.spin_once(timeout_sec=0.05)

    thread = threading.Thread(target=spin)
    yield graph, thread
    end.set()
    if thread.ident is not None:
        thread.join()


def test_silence_and_who_waits_for_whom(spinning):
    graph, thread = spinning
    graph.add(Camera(context=graph.context))
    graph.add(Viewer(context=graph.context))
    thread.start()
    checks = {check.name: check for check in examine_graph(graph.domain, seconds=3.0)}
    assert checks["/viewer"].detail.startswith("waiting for camera/color/image_raw of 12.400 s for ")
    assert checks["/viewer"].detail.endswith("(published by camera)")
    assert checks["/viewer"].ok
    pose, color, info = (checks[f"/camera/{name}"] for name in ("pose", "color/image_raw", "color/camera_info"))
    assert (pose.ok, pose.detail) == (True, "published by camera, subscribed by nobody")
    assert (color.ok, color.detail) == (False, "published by camera, silent for 3 s")
    assert (info.ok, info.detail) == (False, "nobody publishes it; subscribed by viewer")
    assert checks["/view_goal"].detail == "nobody publishes it; subscribed by camera"
    assert "/attention" not in checks


def test_the_verdict_names_what_a_whole_graph_has_beside_the_one_node(spinning):
    graph, thread = spinning
    graph.add(Viewer(context=graph.context))
    thread.start()
    checks = list(examine_graph(graph.domain, seconds=2.0))
    missing = ["a camera", "attention_policy", "hypothesis_fusion", "pose_estimator"]
    assert sorted(check.name for check in checks if check.group == PARTS) == missing
    assert verdict(checks).startswith("The graph is not whole: no fault in the 1 node seen; missing: a camera, ")


def test_a_graph_of_which_nothing_is_missing_works():
    nodes = [Check("Nodes", name, True, False, "idle") for name in ("/a", "/b")]
    assert verdict(nodes) == "The graph works: no fault in the 2 nodes seen."


def test_a_mismatch_is_needed_and_named(spinning):
    graph, thread = spinning
    graph.add(Viewer(context=graph.context))
    driver = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.VOLATILE)
    graph.node.create_publisher(PointCloud2, "objects", driver)
    thread.start()
    checks = {check.name: check for check in examine_graph(graph.domain, seconds=2.0)}
    check = checks["/objects"]
    assert (check.ok, check.needed) == (False, True)
    assert check.detail.startswith("tester does not reach viewer: ")
    assert "transient local" in check.detail
    assert "qos_overrides" in check.fix


def test_the_cause_that_a_node_knows_is_passed_on(spinning):
    graph, thread = spinning
    camera = graph.add(Camera(context=graph.context))
    camera._watch._since -= 60.0
    camera._watch._awaited = camera.awaited()
    thread.start()
    checks = {check.name: check for check in examine_graph(graph.domain, seconds=2.0)}
    assert (checks["/camera"].ok, checks["/camera"].needed) == (False, True)
    assert "nobody publishes view_goal in namespace / and domain" in checks["/camera"].detail


def test_namespaces_are_kept_apart(spinning):
    graph, thread = spinning
    graph.add(Camera(context=graph.context, namespace="cell"))
    thread.start()
    inside = [check.name for check in examine_graph(graph.domain, "cell", seconds=2.0)]
    assert {"/cell/camera", "/cell/camera/pose"} <= set(inside)
    outside = [check for check in examine_graph(graph.domain, "other", seconds=1.0) if check.group == "Nodes"]
    assert [(check.ok, check.needed) for check in outside] == [(False, True)]
    assert f"in domain {graph.domain}, namespace /other" in outside[0].detail


def test_the_command_prints_it_and_fails_without_a_graph(graph, tmp_path):
    path = tmp_path / "graph.json"
    arguments = ["doctor", "--graph", "--domain", str(graph.domain), "--seconds", "1", "--json", str(path)]
    result = CliRunner().invoke(app, arguments, env={"COLUMNS": "200"})
    assert result.exit_code == 1
    assert "no node publishes diagnostics" in result.stdout
    assert "The graph does not work: heartbeats." in result.stdout
    assert json.loads(path.read_text())["ok"] is False


def test_a_domain_needs_the_graph_option(monkeypatch):
    monkeypatch.setattr(graph_doctor, "examine_graph", None)
    result = CliRunner().invoke(app, ["doctor", "--domain", "3"])
    assert result.exit_code == 2
    assert "--domain and --namespace need --graph" in result.output
