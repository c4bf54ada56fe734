"""The simulator node: what it publishes after which goal, and that bad goals leave the camera where it was."""

from dataclasses import dataclass, field

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseArray, PoseStamped
from hand_made_scenes import SPHERE, store_mugs
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image, JointState
from std_srvs.srv import Trigger

from active6d_core.camera import PinholeCamera
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
from active6d_core.se3 import look_at, make_transform
from active6d_sim.nodes.camera_simulator import CameraSimulatorNode
from active6d_sim.rendering.active_stereo import ActiveStereo
from active6d_sim.rendering.pose_error import PoseError
from active6d_sim.rendering.sensor_registry import list_sensors, register_sensor
from active6d_sim.rendering.simulator import Simulator
from active6d_sim.robot.arm import CameraArm, hand_eye_error

SECOND = 1_000_000_000
TOPICS = {
    "camera/pose": PoseStamped,
    "camera/color/image_raw": Image,
    "camera/depth/image_raw": Image,
    "camera/color/camera_info": CameraInfo,
    "ground_truth/poses": PoseArray,
    "episode/start": DiagnosticArray,
}
STATUS = "view_goal/status"
VIEW = list(TOPICS)[:4]


@pytest.fixture(autouse=True)
def mugs(tmp_path, monkeypatch):
    return store_mugs(tmp_path, monkeypatch)


@dataclass
class Watched:
    """A camera node and all that it says."""

    graph: object
    namespace: str = ""
    boxes: dict = field(init=False)

    def __post_init__(self):
        self.boxes = {topic: self.graph.mailbox(kind, self.namespace + topic, True) for topic, kind in TOPICS.items()}
        self.diagnostics = self.graph.mailbox(DiagnosticArray, "/diagnostics")
        self.answers = self.graph.mailbox(DiagnosticArray, self.namespace + STATUS, True)

    def start(self, **parameters):
        settings = {"scene": "mug/test/0", "width": 64, "height": 48, "start_view": 45, **parameters}
        namespace = self.namespace.rstrip("/")
        self.node = self.graph.add(
            CameraSimulatorNode(context=self.graph.context, namespace=namespace, overrides=settings)
        )
        self.graph.spin_until_filled(self.boxes.values())
        return self

    def wait(self, count):
        """Until ``count`` views are complete."""
        self.graph.spin_until_filled([self.boxes[topic] for topic in VIEW], count)

    def goal(self, T, stamp=0, frame="world"):
        self.publish(transform_to_pose_stamped(T, stamp, frame))

    def publish(self, message):
        self.graph.publish(self.namespace + "view_goal", message)

    def poses(self):
        return [pose_stamped_to_transform(message, "world") for message in self.boxes["camera/pose"]]

    def stamps(self, topic="camera/pose"):
        return [stamp_to_ns(message.header.stamp) for message in self.boxes[topic]]

    def statuses(self):
        return [GoalStatus.from_message(message) for message in self.answers]

    def errors(self):
        return [d.status[0].message for d in self.diagnostics if d.status[0].level == DiagnosticStatus.ERROR]


@pytest.fixture
def watched(graph):
    return Watched(graph)


def same_pose(a, b):
    np.testing.assert_allclose(a, b, atol=1e-9)


def test_first_view_comes_by_itself(watched, mugs):
    watched.start()
    assert {stamp for topic in TOPICS for stamp in watched.stamps(topic)} == {SECOND}
    same_pose(watched.poses()[0], SPHERE.pose(SPHERE.positions[45]))
    camera = PinholeCamera.from_field_of_view(64, 48, 60.0)
    assert info_to_camera(watched.boxes["camera/color/camera_info"][0]) == camera
    expected = Simulator(mugs, camera, seed=0).capture(SPHERE.pose(SPHERE.positions[45]), SECOND)
    np.testing.assert_array_equal(image_to_depth(watched.boxes["camera/depth/image_raw"][0]), expected.depth)
    np.testing.assert_array_equal(image_to_color(watched.boxes["camera/color/image_raw"][0]), expected.color)
    for topic in VIEW[1:]:
        assert watched.boxes[topic][0].header.frame_id == "camera_optical_frame"


def test_ground_truth_and_episode_are_told_once(watched, mugs):
    watched.start(seed=3)
    (truth,), (start,) = watched.boxes["ground_truth/poses"], watched.boxes["episode/start"]
    np.testing.assert_allclose(poses_from_array(truth, "world"), mugs.T_world_object, atol=1e-9)
    values = {item.key: item.value for item in start.status[0].values}
    assert values.pop("id") == "mug/test/0, view 45, seed 3, 1.000 s"
    assert values == {"object": "mug", "scene": "mug/test/0", "seed": "3", "start_view": "45"}
    watched.goal(SPHERE.pose(SPHERE.positions[46]))
    watched.wait(2)
    assert len(watched.boxes["ground_truth/poses"]) == len(watched.boxes["episode/start"]) == 1


def test_move_snaps_to_the_grid_and_takes_its_time(watched):
    watched.start()
    beside = SPHERE.position(np.radians(8.0), np.radians(58.0))
    watched.goal(look_at(1.01 * beside, (0.1, 0, 0)), stamp=SECOND)
    watched.wait(2)
    same_pose(watched.poses()[1], SPHERE.pose(SPHERE.position(0.0, np.radians(60.0))))
    # From azimuth 90, elevation 45 (view 45) to 0, 60: the cosine of the angle is sin 45 sin 60.
    arc = 0.8 * np.arccos(np.sin(np.pi / 4) * np.sin(np.pi / 3))
    assert watched.stamps() == [SECOND, pytest.approx(SECOND * (1 + arc / 0.25), abs=2)]
    assert {stamp for topic in VIEW for stamp in watched.stamps(topic)[1:]} == {watched.stamps()[1]}


def test_exact_goals_are_reached_exactly(watched):
    watched.start(snap_to_grid=False, camera_speed=10.0)
    goal = look_at(SPHERE.position(1.234, 0.567) * 1.02, (0.05, -0.03, 0.02))
    watched.goal(goal)
    watched.wait(2)
    same_pose(watched.poses()[1], goal)
    assert watched.stamps()[1] == SECOND + SECOND // 10  # faster than the least time between two views


def test_an_arm_refuses_what_it_cannot_reach_and_takes_its_time(watched, mugs):
    watched.start(carrier="arm", hand_eye_mm=20.0, hand_eye_degrees=0.0, noise_scale=0.0)
    watched.goal(SPHERE.pose(SPHERE.positions[5]), stamp=SECOND)
    watched.graph.spin_until(lambda: watched.answers)
    assert watched.statuses()[0].state == GoalState.REFUSED
    assert watched.statuses()[0].reason == "the arm cannot take the view goal: out of reach"
    watched.goal(SPHERE.pose(SPHERE.positions[48]), stamp=SECOND)
    watched.wait(2)
    told = watched.poses()[1]
    np.testing.assert_allclose(told, SPHERE.pose(SPHERE.positions[48]), atol=1e-3)
    arm = CameraArm(mugs)
    arm.place(SPHERE.pose(SPHERE.positions[45]))
    seconds = arm.plan(SPHERE.pose(SPHERE.positions[48])).seconds
    assert watched.stamps()[1] - SECOND == pytest.approx(seconds * SECOND, abs=2)
    # What it sees is seen from 20 mm beside where it says that it is.
    camera = PinholeCamera.from_field_of_view(64, 48, 60.0)
    depth = image_to_depth(watched.boxes["camera/depth/image_raw"][1])
    exact = Simulator(mugs, camera, ActiveStereo().scaled(0.0))
    true = exact.capture(told @ hand_eye_error(20.0, 0.0, 0), watched.stamps()[1]).depth
    np.testing.assert_array_equal(depth, true)
    assert not np.array_equal(depth, exact.capture(told, watched.stamps()[1]).depth, equal_nan=True)


def test_an_arm_publishes_its_joints_with_every_view(watched, mugs):
    states = watched.graph.mailbox(JointState, "joint_states", latched=True)
    watched.start(carrier="arm")
    watched.graph.spin_until(lambda: states)
    arm = CameraArm(mugs)
    arm.place(SPHERE.pose(SPHERE.positions[45]))
    assert states[0].name == [f"lbr_iiwa_joint_{number}" for number in range(1, 8)]
    np.testing.assert_allclose(states[0].position, arm.joints, atol=1e-9)
    assert stamp_to_ns(states[0].header.stamp) == watched.stamps()[0]


def test_poses_are_said_with_errors_when_asked_for(watched, mugs):
    """Every view is seen from beside where it says that it is, by an error of its own that the seed repeats."""
    watched.start(pose_error_mm=8.0, pose_error_degrees=0.5, noise_scale=0.0)
    watched.goal(SPHERE.pose(SPHERE.positions[48]), stamp=SECOND)
    watched.wait(2)
    camera = PinholeCamera.from_field_of_view(64, 48, 60.0)
    exact, errors = Simulator(mugs, camera, ActiveStereo().scaled(0.0)), []
    for pose, stamp, image in zip(
        watched.poses(), watched.stamps(), watched.boxes["camera/depth/image_raw"], strict=False
    ):
        errors.append(PoseError(8.0, 0.5).draw(np.random.default_rng([0, mugs.seed, stamp])))
        np.testing.assert_array_equal(image_to_depth(image), exact.capture(pose @ errors[-1], stamp).depth)
    same_pose(watched.poses()[1], SPHERE.pose(SPHERE.positions[48]))
    assert np.abs(errors[0] - errors[1]).max() > 1e-3


def test_an_arm_that_cannot_take_the_start_view_says_so(graph):
    node = CameraSimulatorNode(
        context=graph.context, overrides={"scene": "mug/test/0", "carrier": "arm", "start_view": 5, "autostart": False}
    )
    with pytest.raises(ValueError, match="out of reach"):
        node.setup()
    node.destroy_node()


def test_staying_is_a_new_view_with_new_noise(watched):
    watched.start()
    watched.goal(SPHERE.pose(SPHERE.positions[45]), stamp=SECOND)
    watched.wait(2)
    assert watched.stamps() == [SECOND, SECOND + SECOND // 10]
    first, second = (image_to_depth(message) for message in watched.boxes["camera/depth/image_raw"])
    assert not np.array_equal(first, second, equal_nan=True)


def goal_message(position=(0.8 * np.cos(0.5), 0.0, 0.8 * np.sin(0.5)), quaternion=None, frame="world"):
    message = transform_to_pose_stamped(look_at((0.5, 0, 0.5), (0, 0, 0)), 0, frame)
    p, q = message.pose.position, message.pose.orientation
    p.x, p.y, p.z = map(float, position)
    if quaternion is not None:
        q.x, q.y, q.z, q.w = map(float, quaternion)
    return message


@pytest.mark.parametrize("snap", [True, False])
def test_bad_goals_are_refused_and_the_camera_stays(watched, snap):
    bad = {
        "below the table": goal_message((0.7, 0.0, -0.38)),
        "off the hemisphere": goal_message((0.62, 0.0, 0.62)),
        "a quaternion has length 0": goal_message(quaternion=(0, 0, 0, 0)),
        "a quaternion has length 2": goal_message(quaternion=(0, 0, 0, 2)),
        "not finite": goal_message((np.nan, 0.0, 0.5)),
        "a number that is not finite": goal_message(quaternion=(0, 0, np.inf, 1)),
        "frame_id is 'map'": goal_message(frame="map"),
    }
    watched.start(snap_to_grid=snap)
    for number, (reason, message) in enumerate(bad.items(), start=1):
        watched.publish(message)
        watched.graph.spin_until(lambda number=number: len(watched.errors()) == number, what=reason)
        assert reason in watched.errors()[-1]
        watched.graph.spin_until(lambda number=number: len(watched.answers) == number)
        assert watched.statuses()[-1].state == GoalState.REFUSED
        assert reason in watched.statuses()[-1].reason
    assert len(watched.poses()) == 1
    watched.publish(goal_message())
    watched.wait(2)
    assert len(watched.poses()) == 2
    assert watched.poses()[1][0, 3] == pytest.approx(0.8 * np.cos(np.radians(30)) if snap else 0.8 * np.cos(0.5))


def test_goals_decided_on_older_views_are_stale(watched):
    watched.start()
    watched.goal(SPHERE.pose(SPHERE.positions[60]), stamp=SECOND)
    watched.wait(2)
    watched.goal(SPHERE.pose(SPHERE.positions[10]), stamp=SECOND)
    watched.graph.spin_until(lambda: len(watched.answers) == 3)
    assert watched.statuses()[2].state == GoalState.REFUSED
    assert "stale goal, decided at 1.000 s" in watched.statuses()[2].reason
    watched.goal(SPHERE.pose(SPHERE.positions[80]), stamp=watched.stamps()[1])
    watched.wait(3)
    same_pose(watched.poses()[2], SPHERE.pose(SPHERE.positions[80]))
    assert len(watched.poses()) == 3


def test_a_repeated_goal_is_answered_once(watched):
    """A second refusal would be taken for the answer to the goal that the policy chose instead, of the same stamp."""
    watched.start()
    below = make_transform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, -0.8]))
    for T in (below, below, SPHERE.pose(SPHERE.positions[60])):
        watched.goal(T, stamp=SECOND)
    watched.wait(2)
    watched.graph.spin_until(lambda: len(watched.answers) >= 3)
    states = [status.state for status in watched.statuses()]
    assert states == [GoalState.REFUSED, GoalState.ACCEPTED, GoalState.REACHED]


def test_every_goal_is_answered_with_its_own_stamp(watched):
    watched.start()
    watched.goal(SPHERE.pose(SPHERE.positions[60]), stamp=SECOND)
    watched.wait(2)
    watched.goal(SPHERE.pose(SPHERE.positions[10]), stamp=watched.stamps()[1])
    watched.wait(3)
    watched.graph.spin_until(lambda: len(watched.answers) == 4)
    expected = [
        GoalStatus(stamp, "world", state, "", "mug/test/0, view 45, seed 0, 1.000 s")
        for stamp in watched.stamps()[:2]
        for state in (GoalState.ACCEPTED, GoalState.REACHED)
    ]
    assert watched.statuses() == expected


def test_the_clock_is_the_stamp_of_the_last_view(watched):
    clock = watched.graph.mailbox(Clock, "/clock")
    watched.start(publish_clock=True)
    watched.graph.spin_until(lambda: clock and stamp_to_ns(clock[-1].clock) == SECOND)
    watched.goal(SPHERE.pose(SPHERE.positions[60]))
    watched.wait(2)
    watched.graph.spin_until(lambda: stamp_to_ns(clock[-1].clock) == watched.stamps()[1])


def test_without_the_parameter_there_is_no_clock(watched):
    watched.start()
    assert watched.graph.node.count_publishers("/clock") == 0


def test_same_seed_same_messages(graph):
    cameras = [Watched(graph, f"{name}/") for name in ("first", "second", "other")]
    for camera, seed in zip(cameras, (7, 7, 8), strict=True):
        camera.start(seed=seed, start_view=-1)
        camera.goal(SPHERE.pose(SPHERE.positions[33]))
        camera.wait(2)
    first, again, other = (camera.boxes for camera in cameras)
    assert first == again
    assert first["camera/depth/image_raw"] != other["camera/depth/image_raw"]
    assert first["ground_truth/poses"] == other["ground_truth/poses"]


def test_start_view_is_drawn_by_seed(graph):
    starts = []
    for seed in range(3):
        camera = Watched(graph, f"seed{seed}/").start(seed=seed, start_view=-1)
        starts.append(tuple(camera.poses()[0][:3, 3].round(6)))
    assert len(set(starts)) > 1


def test_reset_starts_another_episode_in_the_same_scene(watched):
    watched.start()
    watched.goal(SPHERE.pose(SPHERE.positions[60]))
    watched.wait(2)
    response = watched.graph.call(Trigger, "camera_simulator/reset")
    assert (response.success, response.message) == (True, "episode in mug/test/0")
    watched.wait(3)
    watched.graph.spin_until_filled([watched.boxes["episode/start"], watched.boxes["ground_truth/poses"]], 2)
    same_pose(watched.poses()[2], watched.poses()[0])
    assert watched.stamps()[2] == watched.stamps()[1] + SECOND // 10
    assert watched.stamps("episode/start") == watched.stamps("ground_truth/poses") == [SECOND, watched.stamps()[2]]


def test_next_scene_goes_through_the_split(watched, mugs):
    watched.start()
    assert watched.graph.call(Trigger, "camera_simulator/next_scene").message == "episode in mug/test/1"
    watched.graph.spin_until_filled([watched.boxes["ground_truth/poses"]], 2)
    truth = poses_from_array(watched.boxes["ground_truth/poses"][1], "world")
    np.testing.assert_allclose(truth, mugs.T_world_object[:2], atol=1e-9)
    response = watched.graph.call(Trigger, "camera_simulator/next_scene")  # mug/test/2, which is not stored
    assert not response.success
    assert "active6d scenes generate" in response.message
    assert watched.graph.call(Trigger, "camera_simulator/reset").message == "episode in mug/test/1"
    watched.wait(3)


def test_next_scene_after_a_dropped_heap_is_the_next_seed(watched, mugs, monkeypatch):
    asked = []

    def find(object_name, name, seed):
        asked.append((object_name, name, seed))
        return type(mugs)(object_name, f"mug/seed/{seed}", seed, mugs.T_world_object, mugs.bin, mugs.visible_fraction)

    monkeypatch.setattr("active6d_sim.nodes.camera_simulator.find_scene", find)
    watched.start(scene="", seed=7)
    assert watched.graph.call(Trigger, "camera_simulator/next_scene").message == "episode in mug/seed/8"
    assert watched.graph.call(Trigger, "camera_simulator/next_scene").message == "episode in mug/seed/9"
    assert asked == [("mug", "", 7), ("mug", "", 8), ("mug", "", 9)]


def test_before_it_is_active_it_says_so_and_ignores_goals(watched):
    node = CameraSimulatorNode(context=watched.graph.context, overrides={"scene": "mug/test/0"})
    watched.graph.add(node, start=False)
    watched.goal(SPHERE.pose(SPHERE.positions[3]))
    response = watched.graph.call(Trigger, "camera_simulator/reset")
    assert (response.success, response.message) == (False, "camera_simulator is not active")
    assert not watched.poses()
    assert not watched.errors()


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"start_view": 100}, "'start_view' is 100, the last is 99"),
        ({"start_view": -2}, "'start_view' is -2, must be >= -1"),
        ({"noise_scale": -1.0}, "'noise_scale'"),
        ({"sensor": "sonar"}, "'sensor' is 'sonar', must be one of auto, active_stereo"),
        ({"field_of_view": 180.0}, "'field_of_view'"),
        ({"camera_speed": 0.0}, "'camera_speed'"),
        ({"seed": "seven"}, "'seed' must be a int"),
        ({"scene": "mug/test/99"}, "no scene 'mug/test/99'"),
        ({"object": "teapot", "scene": ""}, "unknown object 'teapot'"),
    ],
)
def test_bad_parameters_are_named(graph, parameters, message):
    with pytest.raises(ValueError, match=message):
        graph.add(CameraSimulatorNode(context=graph.context, overrides=parameters))


def test_noise_can_be_off(watched, mugs):
    watched.start(noise_scale=0.0)
    camera = PinholeCamera.from_field_of_view(64, 48, 60.0)
    clean = Simulator(mugs, camera, ActiveStereo().scaled(0)).capture(SPHERE.pose(SPHERE.positions[45]), SECOND)
    np.testing.assert_array_equal(image_to_depth(watched.boxes["camera/depth/image_raw"][0]), clean.depth)


@register_sensor("constant-depth")
class ConstantDepth:
    """Measures the same depth everywhere, and counts its scale into it."""

    def __init__(self, model, scale=1.0):
        self.model, self.scale = model, scale

    def scaled(self, factor):
        return ConstantDepth(self.model, factor)

    def measure(self, rendered, camera, rng):
        return rendered.color, np.full(rendered.depth.shape, 0.5 * self.scale, np.float32)


def test_another_sensor_measures(watched):
    assert list_sensors() == ["active_stereo", "constant-depth", "structured_light", "time_of_flight"]
    watched.start(sensor="constant-depth", noise_scale=3.0)
    depth = image_to_depth(watched.boxes["camera/depth/image_raw"][0])
    np.testing.assert_array_equal(depth, np.full((48, 64), 1.5, np.float32))
