"""Transforms from /tf without tf2_ros: chains, interpolation, requests that wait, clocks that go back."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Vector3
from rclpy.qos import DurabilityPolicy, QoSProfile
from scipy.spatial.transform import Rotation, Slerp

from active6d_core.ros.conversions import MessageError, make_header
from active6d_core.ros.node import GraphNode
from active6d_core.ros.transform_input import TransformInput, TransformListener
from active6d_core.se3 import make_transform

SECOND = 1_000_000_000
BASE = make_transform(Rotation.from_euler("z", 90, degrees=True).as_matrix(), [1.0, 0.0, 0.5])
HAND = make_transform(Rotation.from_euler("xyz", [10, -20, 30], degrees=True).as_matrix(), [0.02, 0.01, 0.06])
TURNS = Rotation.from_euler("xyz", [[0, 10, 20], [30, -20, 60], [90, 5, -40]], degrees=True)
PLACES = np.array([[0.3, 0.1, 0.5], [0.4, -0.1, 0.6], [0.2, 0.0, 0.4]])


def stamped(T, parent, child, stamp):
    q, t = Rotation.from_matrix(T[:3, :3]).as_quat(), T[:3, 3]
    rotation = Quaternion(**dict(zip("xyzw", map(float, q), strict=True)))
    transform = Transform(translation=Vector3(**dict(zip("xyz", map(float, t), strict=True))), rotation=rotation)
    return TransformStamped(header=make_header(stamp, parent), child_frame_id=child, transform=transform)


def flange(index, stamp):
    return [stamped(make_transform(TURNS[index].as_matrix(), PLACES[index]), "base", "flange", stamp)]


def static():
    return [
        stamped(BASE, "world", "base", 0),
        stamped(HAND, "flange", "camera_optical_frame", 0),
    ]


def message(transforms):
    return SimpleNamespace(transforms=transforms)


@pytest.fixture
def listener(graph):
    node = graph.add(GraphNode("viewer", context=graph.context), start=False)
    listener = TransformListener(node)
    listener.take(message(static()), static=True)
    return listener


def test_poses_are_interpolated_along_the_chain_between_the_transforms_around_a_stamp(listener):
    found = []
    listener.take(message(flange(0, 5 * SECOND)), static=False)
    listener.request("world", "camera_optical_frame", 5 * SECOND + SECOND // 4, found.append)
    assert not found  # the arm may still turn until then
    listener.take(message(flange(1, 6 * SECOND)), static=False)
    (T,) = found
    turn = Slerp([0, 1], TURNS[:2])(0.25).as_matrix()
    expected = BASE @ make_transform(turn, 0.75 * PLACES[0] + 0.25 * PLACES[1]) @ HAND
    np.testing.assert_allclose(T, expected, atol=1e-9)
    listener.request("world", "camera_optical_frame", 6 * SECOND, found.append)  # known to the nanosecond
    np.testing.assert_allclose(found[1], BASE @ make_transform(TURNS[1].as_matrix(), PLACES[1]) @ HAND, atol=1e-9)


def test_the_latest_transform_and_any_pair_of_frames_can_be_asked_for(listener):
    found = []
    listener.request("camera_optical_frame", "base", 0, found.append)
    assert not found
    listener.take(message(flange(2, 5 * SECOND)), static=False)
    expected = np.linalg.inv(make_transform(TURNS[2].as_matrix(), PLACES[2]) @ HAND)
    np.testing.assert_allclose(found[0], expected, atol=1e-9)


def test_a_clock_that_goes_back_begins_again_and_old_transforms_are_forgotten(listener):
    found = []
    for second in range(1, 60):
        listener.take(message(flange(second % 3, second * SECOND)), static=False)
    listener.request("world", "camera_optical_frame", 20 * SECOND, found.append)
    assert not found
    listener.take(message(flange(0, 2 * SECOND)), static=False)
    listener.request("world", "camera_optical_frame", 2 * SECOND, found.append)
    assert len(found) == 1


@pytest.mark.parametrize("clock", [0, 500 * SECOND])
def test_the_clock_of_another_frame_does_not_matter(listener, clock):
    found = []
    for second in range(1, 40):
        listener.take(message(flange(0, second * SECOND)), static=False)
        listener.take(message([stamped(BASE, "map", "odom", clock)]), static=False)
        listener.request("world", "camera_optical_frame", second * SECOND, found.append)
    assert len(found) == 39


def test_requests_of_a_time_before_the_first_transform_do_not_block_later_ones(listener):
    early, late = [], []
    for frame in range(200):
        listener.request("world", "camera_optical_frame", SECOND + frame, early.append)
    listener.take(message(flange(0, 5 * SECOND)), static=False)
    listener.request("world", "camera_optical_frame", 5 * SECOND, late.append)
    assert (len(early), len(late)) == (0, 1)


def test_why_there_is_no_transform_is_said(listener):
    assert (
        listener.problem("world", "camera_optical_frame", SECOND) == "no transform from world to camera_optical_frame"
    )
    listener.take(message(flange(0, 5 * SECOND)), static=False)
    expected = "the nearest transform of flange is 4000 ms from the image"
    assert listener.problem("world", "camera_optical_frame", SECOND) == expected
    assert listener.problem("world", "camera_optical_frame", 0) == ""


def test_a_transform_that_is_not_rigid_is_refused(listener):
    bad = flange(0, SECOND)
    bad[0].transform.rotation.w = 3.0
    with pytest.raises(MessageError, match="from base to flange is not rigid"):
        listener.take(message(bad), static=False)


def test_tf_is_heard_without_tf2_ros(graph, monkeypatch):
    """Where tf2_msgs was generated ('make transforms')."""
    messages = pytest.importorskip("tf2_msgs.msg")
    monkeypatch.setitem(sys.modules, "tf2_ros", None)
    node = graph.add(GraphNode("viewer", context=graph.context))
    listening, found = TransformInput(node), []
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    fixed = graph.node.create_publisher(messages.TFMessage, "/tf_static", latched)
    fixed.publish(messages.TFMessage(transforms=static()))
    listening.request(5 * SECOND, found.append)
    graph.publish("/tf", messages.TFMessage(transforms=flange(1, 5 * SECOND)))
    graph.spin_until(lambda: found)
    np.testing.assert_allclose(found[0], BASE @ make_transform(TURNS[1].as_matrix(), PLACES[1]) @ HAND, atol=1e-9)
