"""A camera's parts matched by stamp, with the pose from camera/pose or from /tf (tf2_ros is stubbed: not on PyPI)."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, TransformStamped
from rclpy.task import Future
from sensor_msgs.msg import CameraInfo

from active6d_core.camera import PinholeCamera
from active6d_core.ros.conversions import camera_to_info, ns_to_stamp, transform_to_pose, transform_to_pose_stamped
from active6d_core.ros.heartbeat import Awaited
from active6d_core.ros.node import GraphNode
from active6d_core.ros.transform_input import TransformInput
from active6d_core.ros.view_inputs import ViewInputs
from active6d_core.view_sphere import ViewSphere

SECOND = 1_000_000_000
CAMERA = PinholeCamera.from_field_of_view(64, 48, 60.0)
POSES = [ViewSphere().pose(position) for position in ViewSphere().positions[:3]]


class Viewer(GraphNode):
    """Keeps the views that are complete."""

    def __init__(self, **arguments):
        super().__init__("viewer", **arguments)
        self.views = []
        self.inputs = ViewInputs(self, ["camera", "pose"], lambda stamp, view: self.views.append((stamp, view)))

    def awaited(self):
        return self.inputs.awaited()


def send_info(graph, stamp):
    graph.publish("camera/color/camera_info", camera_to_info(CAMERA, stamp, "camera_optical_frame"), latched=True)


class StubBuffer:
    """tf2_ros.Buffer's part that is used: transforms arrive by :meth:`set`."""

    def __init__(self, node):
        self.transforms, self.waiting = {}, []

    def wait_for_transform_async(self, target, source, time):
        future = Future()
        key = target, source, time.nanoseconds
        self.waiting.append((key, future))
        self._settle()
        return future

    def can_transform(self, target, source, time, return_debug_tuple):
        assert return_debug_tuple
        return False, "two trees"

    def lookup_transform(self, target, source, time):
        return self.transforms[target, source, time.nanoseconds]

    def set(self, T, stamp):
        message, pose = TransformStamped(), transform_to_pose(T)
        p = pose.position
        for axis in "xyz":
            setattr(message.transform.translation, axis, getattr(p, axis))
        message.transform.rotation = pose.orientation
        self.transforms["world", "camera_optical_frame", stamp] = message
        self._settle()

    def _settle(self):
        for key, future in self.waiting:
            if key in self.transforms and not future.done():
                future.set_result(True)


@pytest.fixture
def buffers(monkeypatch):
    """Installs the stub; the buffers that were made."""
    made = []

    def make(node):
        made.append(StubBuffer(node))
        return made[-1]

    stub = SimpleNamespace(Buffer=make, TransformListener=lambda buffer, node: (buffer, node))
    monkeypatch.setitem(sys.modules, "tf2_ros", stub)
    return made


def test_the_pose_comes_from_its_topic_by_default(graph, buffers):
    viewer = graph.add(Viewer(context=graph.context))
    send_info(graph, SECOND)
    graph.spin_until(lambda: viewer.awaited() == Awaited(("camera/pose",), SECOND))
    graph.publish("camera/pose", transform_to_pose_stamped(POSES[0], SECOND, "world"), latched=True)
    graph.spin_until(lambda: viewer.views)
    assert viewer.views[0][0] == SECOND
    np.testing.assert_allclose(viewer.views[0][1]["pose"], POSES[0], atol=1e-9)
    assert buffers == []


def test_the_pose_comes_from_tf_before_or_after_its_view(graph, buffers):
    viewer = graph.add(Viewer(context=graph.context, overrides={"pose_source": "tf"}))
    (buffer,) = buffers
    assert viewer.awaited() == Awaited(("camera/color/camera_info", "/tf"))
    assert not [s for s in viewer.subscriptions if s.msg_type is PoseStamped]
    send_info(graph, SECOND)
    graph.spin_until(lambda: viewer.awaited() == Awaited(("/tf",), SECOND))
    buffer.set(POSES[0], SECOND)
    assert [stamp for stamp, _ in viewer.views] == [SECOND]
    buffer.set(POSES[1], 2 * SECOND)
    send_info(graph, 2 * SECOND)
    graph.spin_until(lambda: len(viewer.views) == 2)
    for (_, view), expected in zip(viewer.views, POSES, strict=False):
        np.testing.assert_allclose(view["pose"], expected, atol=1e-9)


def test_a_view_without_transform_is_lost_with_its_cause(graph, buffers):
    viewer = graph.add(Viewer(context=graph.context, overrides={"pose_source": "tf"}))
    diagnostics = graph.mailbox(DiagnosticArray, "/diagnostics")
    send_info(graph, SECOND)
    graph.spin_until(lambda: buffers[0].waiting)
    buffers[0].set(POSES[1], 2 * SECOND)
    send_info(graph, 2 * SECOND)
    text = "lost (1 so far): view of 1.000 s, no /tf came for it (two trees)"
    graph.spin_until(lambda: text in [d.status[0].message for d in diagnostics])
    assert [stamp for stamp, _ in viewer.views] == [2 * SECOND]


def test_requests_that_wait_are_limited(graph, buffers):
    node = graph.add(GraphNode("viewer", context=graph.context))
    transforms, found = TransformInput(node), []
    for stamp in range(1, 201):
        transforms.request(stamp, found.append)
    waiting = [key for key, future in buffers[0].waiting if not future.cancelled()]
    assert [stamp for *_, stamp in waiting] == list(range(101, 201))
    buffers[0].set(POSES[0], 1)
    buffers[0].set(POSES[0], 101)
    assert len(found) == 1


def test_a_bad_transform_is_refused_and_the_node_lives(graph, buffers):
    viewer = graph.add(Viewer(context=graph.context, overrides={"pose_source": "tf"}))
    diagnostics = graph.mailbox(DiagnosticArray, "/diagnostics")
    send_info(graph, SECOND)
    graph.spin_until(lambda: buffers[0].waiting)
    damaged = POSES[0].copy()
    damaged[0, 3] = np.nan
    buffers[0].set(damaged, SECOND)
    graph.spin_until(lambda: any(d.status[0].level == DiagnosticStatus.ERROR for d in diagnostics))
    assert "/tf: a pose holds a number that is not finite" in [d.status[0].message for d in diagnostics]
    assert not viewer.views
    buffers[0].set(POSES[1], 2 * SECOND)
    send_info(graph, 2 * SECOND)
    graph.spin_until(lambda: viewer.views)


def test_without_tf2_the_parameter_is_refused(graph, monkeypatch):
    for package in ("tf2_ros", "tf2_msgs"):
        monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ValueError, match="viewer: poses from /tf need tf2_msgs, which is not installed"):
        Viewer(context=graph.context, overrides={"pose_source": "tf"})


def test_a_view_is_under_way_when_anything_of_it_has_come(graph):
    viewer = graph.add(Viewer(context=graph.context))
    assert not viewer.inputs.under_way
    send_info(graph, SECOND)
    graph.spin_until(lambda: viewer.inputs.under_way)
    info = [s for s in viewer.subscriptions if s.msg_type is CameraInfo]
    assert len(info) == 1


# Stamps that no camera of this episode would send, given to the callbacks as an executor would


class Follower(GraphNode):
    """Keeps the views of the announced episode."""

    def __init__(self, **arguments):
        super().__init__("follower", **arguments)
        self.views = []
        self.inputs = ViewInputs(self, ["camera", "pose"], lambda stamp, view: self.views.append(stamp), None, self.on)

    def on(self, start, new):
        first = self.views.index(start.stamp) if not new else len(self.views)
        self.views = self.views[first:]

    def take(self, topic, message):
        (subscription,) = [s for s in self.subscriptions if s.topic_name == f"/{topic}"]
        subscription.callback(message)

    def info(self, stamp):
        self.take("camera/color/camera_info", restamped(camera_to_info(CAMERA, 0, "camera_optical_frame"), stamp))

    def pose(self, stamp):
        self.take("camera/pose", restamped(transform_to_pose_stamped(POSES[0], 0, "world"), stamp))

    def view(self, stamp):
        self.info(stamp)
        self.pose(stamp)

    def announce(self, stamp):
        self.take("episode/start", restamped(DiagnosticArray(status=[DiagnosticStatus()]), stamp))


def restamped(message, stamp):
    message.header.stamp = stamp if isinstance(stamp, Time) else ns_to_stamp(stamp)
    return message


@pytest.fixture
def follower(graph):
    return graph.add(Follower(context=graph.context))


FUTURE = 2_000_000_000 * SECOND
BAD = [Time(sec=-5), Time(sec=8, nanosec=10**9), Time(sec=2**31 - 1, nanosec=2**32 - 1), Time()]
ATTACKS = {
    "one lone info": lambda node: node.info(FUTURE),
    "sixteen lone infos": lambda node: [node.info(FUTURE + step) for step in range(16)],
    "a hundred lone poses": lambda node: [node.pose(FUTURE + step) for step in range(100)],
    "a whole view": lambda node: node.view(FUTURE),
    "a start": lambda node: Follower.announce(node, FUTURE),
    "a start and its view": lambda node: (Follower.announce(node, FUTURE), node.view(FUTURE)),
    "a view and its start": lambda node: (node.view(FUTURE), Follower.announce(node, FUTURE)),
    "a start of the past": lambda node: Follower.announce(node, SECOND),
    "stamps that are no time": lambda node: [
        take(node, bad) for bad in BAD for take in (Follower.info, Follower.pose, Follower.announce)
    ],
}


@pytest.mark.parametrize("attack", ATTACKS.values(), ids=ATTACKS)
def test_no_stamp_makes_a_node_deaf(follower, attack):
    follower.view(10 * SECOND)
    attack(follower)
    follower.views.clear()
    for second in range(11, 31):
        follower.view(second * SECOND)
    assert follower.views == [second * SECOND for second in range(11, 31)]


def test_stamps_that_are_no_time_are_refused(follower):
    for bad in BAD:
        follower.view(bad)
    assert follower._rejected == 2 * len(BAD)
    assert follower.views == []


def test_an_episode_may_begin_earlier_than_the_last(follower):
    for stamp in (FUTURE, FUTURE + SECOND):
        follower.view(stamp)
    follower.announce(SECOND)
    for stamp in (SECOND, 2 * SECOND):
        follower.view(stamp)
    assert follower.views == [SECOND, 2 * SECOND]


@pytest.mark.parametrize("announced_first", [True, False])
def test_a_restarted_camera_may_repeat_its_stamps(follower, announced_first):
    follower.announce(SECOND)
    for stamp in (SECOND, 2 * SECOND):
        follower.view(stamp)
    if announced_first:
        follower.announce(SECOND)
        follower.view(SECOND)
    else:
        follower.view(SECOND)
        follower.announce(SECOND)
    follower.view(2 * SECOND)
    assert follower.views == [SECOND, 2 * SECOND]


def test_a_late_announcement_ends_only_what_came_before_its_view(follower):
    for stamp in (SECOND, 2 * SECOND, 3 * SECOND):
        follower.view(stamp)
    follower.announce(2 * SECOND)
    assert follower.views == [2 * SECOND, 3 * SECOND]


def test_a_late_announcement_keeps_a_view_that_has_begun_since(follower):
    """So a restarted node gets latched messages: each topic in order, the topics in any order."""
    follower.info(SECOND // 2)
    follower.view(SECOND)
    follower.info(2 * SECOND)
    follower.announce(SECOND)
    follower.pose(2 * SECOND)
    follower.pose(SECOND // 2)
    assert follower.views == [SECOND, 2 * SECOND]


def test_an_announcement_of_a_view_of_an_earlier_episode_changes_nothing(follower):
    for stamp in (SECOND, 2 * SECOND):
        follower.view(stamp)
    for stamp in (2 * SECOND, SECOND):
        follower.announce(stamp)
    follower.view(3 * SECOND)
    assert follower.views == [2 * SECOND, 3 * SECOND]


def test_what_is_left_incomplete_is_counted_and_reported_once(graph, follower):
    diagnostics = graph.mailbox(DiagnosticArray, "/diagnostics")
    follower.info(SECOND)
    for _ in range(3):
        follower.view(2 * SECOND)
    graph.spin_until(lambda: any("lost" in {v.key for v in d.status[0].values} for d in diagnostics))
    follower.beat()
    graph.spin_until(lambda: diagnostics[-1].status[0].message.startswith(("ready", "waiting")))
    assert {v.key: v.value for v in diagnostics[-1].status[0].values}["lost"] == "1"
    reports = [d.status[0].message for d in diagnostics if "came for it" in d.status[0].message]
    assert reports == ["lost (1 so far): view of 1.000 s, no camera/pose came for it"]
