"""A camera's parts matched by stamp, with the pose from camera/pose or from /tf (tf2_ros is stubbed: not on PyPI)."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, TransformStamped
from rclpy.task import Future
from sensor_msgs.msg import CameraInfo

from active6d_core.camera import PinholeCamera
from active6d_core.ros.conversions import camera_to_info, transform_to_pose, transform_to_pose_stamped
from active6d_core.ros.heartbeat import Awaited
from active6d_core.ros.node import GraphNode
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
    monkeypatch.setitem(sys.modules, "tf2_ros", None)
    with pytest.raises(ValueError, match="viewer: parameter 'pose_source' is 'tf', but tf2_ros is not installed"):
        Viewer(context=graph.context, overrides={"pose_source": "tf"})


def test_the_newest_view_is_the_one_of_which_anything_came(graph):
    viewer = graph.add(Viewer(context=graph.context))
    assert viewer.inputs.newest == -1
    send_info(graph, SECOND)
    graph.spin_until(lambda: viewer.inputs.newest == SECOND)
    info = [s for s in viewer.subscriptions if s.msg_type is CameraInfo]
    assert len(info) == 1
