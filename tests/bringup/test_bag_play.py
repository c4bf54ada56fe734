"""What `ros2 bag play` does with a bag of this project, and that it drives the graph.

The player below is independent of the project: it reads with rosbags, and publishes the recorded bytes with the
recorded quality of service at the recorded times.
"""

import time
from importlib import import_module

import pytest
import rclpy.qos
import stub_camera  # noqa: F401  registers the estimator
from geometry_msgs.msg import PoseStamped
from rosbags.rosbag2 import Reader
from sensor_msgs.msg import PointCloud2

from active6d_agent.nodes.attention_policy import AttentionPolicyNode
from active6d_bringup.graph.episode import EpisodeSettings, run_episode
from active6d_core.ros.conversions import pose_stamped_to_transform, stamp_to_ns
from active6d_core.ros.graph_nodes import NODES, NodeEntry
from active6d_perception.nodes.hypothesis_fusion import HypothesisFusionNode
from active6d_perception.nodes.pose_estimator import PoseEstimatorNode

#: As in docs/bags.md: what the graph itself publishes is left out.
PLAYED = ("/camera/", "/episode/start")


def offered(profile) -> rclpy.qos.QoSProfile:
    """A recorded profile, as rosbag2 publishes with."""
    return rclpy.qos.QoSProfile(
        depth=profile.depth or 10,
        reliability=rclpy.qos.ReliabilityPolicy(profile.reliability.value),
        durability=rclpy.qos.DurabilityPolicy(profile.durability.value),
    )


def message_class(name):
    """``sensor_msgs/msg/Image`` to its class."""
    package, _, kind = name.split("/")
    return getattr(import_module(f"{package}.msg"), kind)


def play(graph, bag, speed=1.0):
    """Publish the recorded bytes in their order and at their times."""
    with Reader(bag) as reader:
        wanted = [connection for connection in reader.connections if connection.topic.startswith(PLAYED)]
        publishers = {
            each.topic: graph.node.create_publisher(
                message_class(each.msgtype), each.topic, offered(each.ext.offered_qos_profiles[0])
            )
            for each in wanted
        }
        for publisher in publishers.values():
            graph.spin_until(publisher.get_subscription_count, what=f"a subscriber of {publisher.topic_name}")
        first = None
        for connection, stamp, raw in reader.messages(wanted):
            first = first or (stamp, time.monotonic())
            while time.monotonic() < first[1] + (stamp - first[0]) * 1e-9 / speed:
                graph.executor.spin_once(timeout_sec=0.01)
            publishers[connection.topic].publish(bytes(raw))
    return len(wanted)


@pytest.fixture
def recorded(tmp_path, monkeypatch):
    """An episode of the graph with stubs for camera and estimator, and its bag."""
    monkeypatch.setitem(NODES, "camera_simulator", NodeEntry("stub_camera", "StubCameraNode"))
    settings = EpisodeSettings("mug", 4, policy="random", steps=2, estimator="stub", bag=tmp_path / "bag")
    return run_episode(settings)


def test_a_played_bag_drives_the_graph(graph, recorded):
    overrides = {"object": "mug"}
    for node in (
        AttentionPolicyNode(context=graph.context, overrides={**overrides, "policy": "random", "seed": 4, "steps": 2}),
        HypothesisFusionNode(context=graph.context, overrides=overrides),
        PoseEstimatorNode(context=graph.context, overrides={**overrides, "estimator": "stub"}),
    ):
        graph.add(node)
    objects, goals = graph.mailbox(PointCloud2, "objects", True), graph.mailbox(PoseStamped, "view_goal")
    graph.spin_until(lambda: graph.node.count_publishers("view_goal"), what="the publisher of goals")
    assert play(graph, recorded.settings.bag) == 5
    graph.spin_until(lambda: len({stamp_to_ns(each.header.stamp) for each in objects}) == 3, what="all objects")
    # The same objects and the same decisions as those of the recorded episode.
    found = {stamp_to_ns(each.header.stamp): each.width for each in objects}
    assert found == {step.stamp: len(step.objects) for step in recorded.steps}
    # A goal that no camera answers is published again every few seconds.
    graph.spin_until(lambda: len({stamp_to_ns(each.header.stamp) for each in goals}) == 2, what="both goals")
    different = {stamp_to_ns(each.header.stamp): each for each in goals}
    for goal, step in zip(different.values(), recorded.steps, strict=False):
        assert pose_stamped_to_transform(goal, "world") == pytest.approx(step.goal)
