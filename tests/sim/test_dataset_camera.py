"""The camera of a recorded scene: goals move it between the recorded views, whose images and poses it publishes."""

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseArray, PoseStamped
from hand_made_scenes import CAMERA, SPHERE, three_mugs
from sensor_msgs.msg import CameraInfo, Image
from std_srvs.srv import Trigger

from active6d_core.object_model import load_object
from active6d_core.ros.conversions import (
    image_to_color,
    image_to_depth,
    info_to_camera,
    pose_stamped_to_transform,
    poses_from_array,
    stamp_to_ns,
    transform_to_pose_stamped,
)
from active6d_core.ros.episode_messages import GoalState, GoalStatus
from active6d_core.se3 import look_at
from active6d_sim.datasets.bop import write_bop_scene
from active6d_sim.nodes.dataset_camera import DatasetCameraNode
from active6d_sim.rendering.simulator import Simulator

SECOND = 1_000_000_000
#: Recorded by hand: not on the grid, not at the hemisphere's radius, not facing its centre.
AZIMUTHS = np.radians([0.0, 90.0, 200.0])
VIEWS = ("camera/pose", "camera/color/image_raw", "camera/depth/image_raw", "camera/color/camera_info")
KINDS = (PoseStamped, Image, Image, CameraInfo)


@pytest.fixture(scope="module")
def recorded():
    simulator = Simulator(three_mugs(), CAMERA)
    poses = [look_at(0.95 * SPHERE.position(azimuth, np.radians(50)), (0.02, 0.01, 0)) for azimuth in AZIMUTHS]
    return [simulator.capture(pose, number) for number, pose in enumerate(poses)]


@pytest.fixture
def folder(recorded, tmp_path):
    T_world_mesh = load_object("mug").T_camera_mesh(three_mugs().T_world_object)
    write_bop_scene(tmp_path / "scene", recorded, T_world_mesh, 3)
    return tmp_path / "scene"


class Watched:
    """The node and all that it says."""

    def __init__(self, graph, folder, **parameters):
        self.graph = graph
        self.boxes = {topic: graph.mailbox(kind, topic, True) for topic, kind in zip(VIEWS, KINDS, strict=True)}
        self.truth = graph.mailbox(PoseArray, "ground_truth/poses", True)
        self.starts = graph.mailbox(DiagnosticArray, "episode/start", True)
        self.diagnostics = graph.mailbox(DiagnosticArray, "/diagnostics")
        self.answers = graph.mailbox(DiagnosticArray, "view_goal/status", True)
        overrides = {"scene": str(folder), "start_view": 0, **parameters}
        self.node = graph.add(DatasetCameraNode(context=graph.context, overrides=overrides))
        self.wait(1)

    def wait(self, count):
        self.graph.spin_until_filled(self.boxes.values(), count)

    def goal(self, azimuth, elevation=50.0, stamp=0, radius=0.8):
        position = radius / 0.8 * SPHERE.position(np.radians(azimuth), np.radians(elevation))
        goal = transform_to_pose_stamped(look_at(position, (0, 0, 0)), stamp, "world")
        self.graph.publish("view_goal", goal)

    def poses(self):
        return [pose_stamped_to_transform(message, "world") for message in self.boxes["camera/pose"]]

    def stamps(self):
        return [stamp_to_ns(message.header.stamp) for message in self.boxes["camera/pose"]]

    def errors(self):
        return [d.status[0].message for d in self.diagnostics if d.status[0].level == DiagnosticStatus.ERROR]


def test_views_are_published_as_recorded(graph, folder, recorded):
    watched = Watched(graph, folder)
    watched.goal(97.0, elevation=20.0, stamp=SECOND)
    watched.wait(2)
    watched.goal(-120.0)
    watched.wait(3)
    for index, view in enumerate(recorded):
        np.testing.assert_allclose(watched.poses()[index], view.T_world_camera, atol=1e-9)
        color, depth, info = (watched.boxes[topic][index] for topic in VIEWS[1:])
        np.testing.assert_array_equal(image_to_color(color), view.color)
        np.testing.assert_allclose(image_to_depth(depth), view.depth, atol=0.5e-4 + 1e-7)
        assert info_to_camera(info) == CAMERA
        assert {stamp_to_ns(message.header.stamp) for message in (color, depth, info)} == {watched.stamps()[index]}


def test_moves_take_the_time_of_their_arc(graph, folder, recorded):
    watched = Watched(graph, folder, camera_speed=0.5)
    watched.goal(90.0)
    watched.wait(2)
    directions = [view.T_world_camera[:3, 3] / np.linalg.norm(view.T_world_camera[:3, 3]) for view in recorded]
    seconds = 0.8 * np.arccos(directions[0] @ directions[1]) / 0.5
    assert watched.stamps() == [SECOND, pytest.approx(SECOND * (1 + seconds), abs=2)]
    watched.goal(80.0)  # where it is already
    watched.wait(3)
    assert watched.stamps()[2] == watched.stamps()[1] + SECOND // 10
    np.testing.assert_array_equal(watched.poses()[2], watched.poses()[1])


def test_episode_and_ground_truth(graph, folder):
    watched = Watched(graph, folder, object="mug", object_id=3, seed=4)
    graph.spin_until_filled([watched.starts, watched.truth])
    values = {item.key: item.value for item in watched.starts[0].status[0].values}
    assert values.pop("id").startswith(str(folder))
    assert values == {"object": "mug", "scene": str(folder), "seed": "4", "start_view": "0"}
    np.testing.assert_allclose(poses_from_array(watched.truth[0], "world"), three_mugs().T_world_object, atol=1e-9)
    watched.goal(90.0)
    watched.wait(2)
    assert graph.call(Trigger, "dataset_camera/reset").message == f"episode in {folder}"
    watched.wait(3)
    graph.spin_until_filled([watched.starts, watched.truth], 2)
    np.testing.assert_array_equal(watched.poses()[2], watched.poses()[0])
    assert watched.stamps()[2] == watched.stamps()[1] + SECOND // 10


def test_recordings_without_ground_truth_have_none(graph, folder):
    (folder / "scene_gt.json").unlink()
    watched = Watched(graph, folder)
    graph.spin_until_filled([watched.starts])
    watched.goal(90.0)
    watched.wait(2)
    assert not watched.truth


def test_bad_goals_are_refused_and_the_camera_stays(graph, folder):
    watched = Watched(graph, folder)
    for number, (reason, goal) in enumerate(
        {
            "below the table": {"azimuth": 90.0, "elevation": -20.0},
            "off the hemisphere": {"azimuth": 90.0, "radius": 0.9},
            "stale goal": {"azimuth": 90.0, "stamp": SECOND // 2},
        }.items(),
        start=1,
    ):
        watched.goal(**goal)
        graph.spin_until(lambda number=number: len(watched.answers) == number, what=reason)
        answer = GoalStatus.from_message(watched.answers[-1])
        assert answer.state == GoalState.REFUSED
        assert reason in answer.reason
    message = transform_to_pose_stamped(SPHERE.pose(SPHERE.positions[45]), 0, "world")
    message.pose.orientation.w = float("nan")
    graph.publish("view_goal", message)
    graph.spin_until(lambda: len(watched.answers) == 4)
    assert len(watched.poses()) == 1
    watched.goal(90.0)
    watched.wait(2)


def test_an_image_that_broke_is_reported_and_the_camera_stays(graph, folder, recorded):
    watched = Watched(graph, folder)
    (folder / "depth" / "000001.png").write_bytes(b"broken")
    watched.goal(90.0, stamp=SECOND)
    graph.spin_until(watched.errors)
    assert "depth/000001.png: not a readable image" in watched.errors()[0]
    graph.spin_until(lambda: len(watched.answers) == 2)
    states = [GoalStatus.from_message(message).state for message in watched.answers]
    assert states == [GoalState.ACCEPTED, GoalState.REFUSED]
    watched.goal(200.0, stamp=SECOND)  # not stale: nothing has moved
    watched.wait(2)
    assert len(watched.poses()) == 2
    np.testing.assert_allclose(watched.poses()[1], recorded[2].T_world_camera, atol=1e-9)
    (folder / "depth" / "000000.png").unlink()
    response = graph.call(Trigger, "dataset_camera/reset")
    assert not response.success
    assert "depth/000000.png" in response.message


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"scene": ""}, "parameter 'scene' must name the folder"),
        ({"scene": "/nowhere"}, r"/nowhere: no such folder"),
        ({"start_view": 3}, "parameter 'start_view' is 3, the last is 2"),
        ({"object_id": -1}, "parameter 'object_id' is -1, must be >= 0"),
    ],
)
def test_bad_parameters_are_named(graph, folder, parameters, message):
    with pytest.raises(ValueError, match=message):
        graph.add(DatasetCameraNode(context=graph.context, overrides={"scene": str(folder), **parameters}))


def test_start_is_drawn_by_seed(graph, folder, recorded):
    first = Watched(graph, folder, start_view=-1, seed=11).poses()[0]
    drawn = np.random.default_rng(11).integers(3)
    np.testing.assert_allclose(first, recorded[drawn].T_world_camera, atol=1e-9)
