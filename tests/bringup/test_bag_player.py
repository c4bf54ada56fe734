"""The player sends a bag's camera again, as it was, when its consumers are ready and by the clock that it is given."""

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2
from stub_episode import StubEpisode

from active6d_bringup.bags.replay import _Listener
from active6d_bringup.bags.writer import EpisodeWriter
from active6d_bringup.nodes.bag_player import BagPlayerNode
from active6d_core.ros.conversions import (
    ns_to_stamp,
    objects_to_cloud,
    stamp_to_ns,
    transform_to_pose_stamped,
)
from active6d_core.ros.episode_messages import GoalState, GoalStatus
from active6d_core.ros.topics import CONTRACT

SECOND = 1_000_000_000
EPISODE = StubEpisode(seed=4, moves=1)
STAMPS = [step.view.stamp for step in EPISODE.steps]
#: Seconds between the recorded views.
PAUSE = 4


@pytest.fixture
def player(graph, tmp_path):
    """A player of a bag of two views with the given parameters, and what it says of poses and of the episode's end."""
    names = {topic.name: topic.name if topic.name.startswith("/") else f"/{topic.name}" for topic in CONTRACT}
    writer = EpisodeWriter(tmp_path / "bag", names)
    for topic, message in EPISODE.messages():
        stamp = stamp_to_ns(message.markers[0].header.stamp if hasattr(message, "markers") else message.header.stamp)
        writer.write(topic, serialize_message(message), 10**18 + PAUSE * SECOND * (stamp > STAMPS[0]))
    writer.close()

    def play(now=0, **overrides):
        poses = graph.mailbox(PoseStamped, "camera/pose", True)
        ends = graph.mailbox(DiagnosticArray, "episode/end", True)
        node = BagPlayerNode(context=graph.context, overrides={"bag": str(tmp_path / "bag"), **overrides})
        graph.add(node, start=False)
        if now:
            graph.publish("/clock", Clock(clock=ns_to_stamp(now)))
            graph.spin_until(lambda: node.get_clock().now().nanoseconds == now, what="the clock")
        node.start()
        graph.spin_until_filled([poses])
        return poses, ends

    return play


def test_objects_that_come_again_neither_skip_a_view_nor_end_the_player(graph, player):
    poses, ends = player()
    first, last = STAMPS
    answers = {step.view.stamp: objects_to_cloud(step.objects, step.view.stamp, "world") for step in EPISODE.steps}
    for stamp in (first, first, last):
        graph.publish("objects", answers[stamp], latched=True)
        graph.spin_until_filled([poses], count=2)
    graph.spin_until_filled([ends])
    heard = graph.mailbox(PointCloud2, "objects")
    graph.publish("objects", answers[last], latched=True, subscribers=2)
    graph.spin_until_filled([heard])
    graph.spin_for(0.2)
    assert [stamp_to_ns(pose.header.stamp) for pose in poses] == STAMPS
    assert len(ends) == 1


def test_goals_are_refused_with_the_reason(graph, player):
    poses, _ = player()
    answers = graph.mailbox(DiagnosticArray, "view_goal/status", True)
    graph.publish("view_goal", transform_to_pose_stamped(EPISODE.steps[0].goal, STAMPS[0], "world"))
    graph.spin_until_filled([answers])
    status = GoalStatus.from_message(answers[0], "world")
    assert (status.stamp, status.state) == (STAMPS[0], GoalState.REFUSED)
    assert "order of their recording" in status.reason
    assert len(poses) == 1


def test_it_publishes_the_stamps_of_its_views_as_the_clock_and_does_not_wait_for_that(graph, player):
    """On the clock that it publishes itself, a player would never come to the second view."""
    clock = graph.mailbox(Clock, "/clock")
    poses, ends = player(publish_clock=True, use_sim_time=True, rate=3.0)
    graph.spin_until_filled([ends])
    graph.spin_until(lambda: clock and stamp_to_ns(clock[-1].clock) == STAMPS[1], what="the clock of the last view")
    assert [stamp_to_ns(pose.header.stamp) for pose in poses] == STAMPS
    assert {stamp_to_ns(tick.clock) for tick in clock} <= set(STAMPS)


def test_with_use_sim_time_it_keeps_to_the_clock_of_others(graph, player):
    poses, _ = player(now=100 * SECOND, use_sim_time=True, rate=1.0)
    assert graph._nodes[-1].awaited() is None
    graph.publish("/clock", Clock(clock=ns_to_stamp((100 + PAUSE - 1) * SECOND)))
    graph.spin_for(0.3)
    assert len(poses) == 1
    graph.publish("/clock", Clock(clock=ns_to_stamp((100 + PAUSE + 1) * SECOND)))
    graph.spin_until_filled([poses], count=2)


def test_it_says_that_it_waits_for_the_clock(graph, player, monkeypatch):
    monkeypatch.setattr("active6d_core.ros.heartbeat.CAUSE_AFTER_SECONDS", 0.0)
    events = []
    listener = graph.add(_Listener(graph.context, events.append))
    poses, _ = player(use_sim_time=True, rate=1.0)
    graph.spin_until(lambda: listener.causes, timeout=20, what="the cause")
    text = "use_sim_time needs a publisher of /clock; start one, or set use_sim_time to false"
    assert len(poses) == 1
    assert events[0].startswith("bag_player is waiting for /clock for ")
    assert events[0].endswith(text)
