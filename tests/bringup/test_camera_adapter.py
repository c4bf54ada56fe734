"""The adapter against a simulated driver with each trait that real ones have."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, Transform, TransformStamped
from sensor_msgs.msg import CameraInfo, Image
from simulated_driver import FRAME, SECOND, TOPICS, SimulatedDriver, Traits, look, plane_view
from std_srvs.srv import Trigger

from active6d_bringup.nodes.camera_adapter import CameraAdapterNode
from active6d_core.camera import PinholeCamera, View, backproject
from active6d_core.ros import topics, transform_input
from active6d_core.ros.conversions import (
    camera_to_info,
    image_to_color,
    image_to_depth,
    info_to_camera,
    make_header,
    pose_to_transform,
    stamp_to_ns,
    transform_to_pose,
    transform_to_pose_stamped,
)
from active6d_core.ros.episode_messages import GoalState, GoalStatus
from active6d_core.se3 import make_transform
from active6d_core.view_sphere import ViewSphere

CAMERA = PinholeCamera(160, 120, 150.0, 150.0, 79.5, 59.5)
SPHERE = ViewSphere()
POSES = [SPHERE.pose(SPHERE.positions[index]) for index in (63, 70, 25)]
POSE_TOPIC = {"pose_topic": "driver/pose"}


class Cell:
    """Adapter, driver, and mailboxes for what the adapter says."""

    def __init__(self, graph, traits=None, parameters=None, view=None):
        traits = traits or Traits()
        self.graph = graph
        overrides = {**TOPICS, **POSE_TOPIC, **traits.parameters, **(parameters or {})}
        self.adapter = graph.add(CameraAdapterNode(context=graph.context, overrides=overrides))
        self.driver = SimulatedDriver(graph, view or plane_view(CAMERA, POSES[0]), traits)
        self.color = graph.mailbox(Image, "camera/color/image_raw", latched=True)
        self.depth = graph.mailbox(Image, "camera/depth/image_raw", latched=True)
        self.info = graph.mailbox(CameraInfo, "camera/color/camera_info", latched=True)
        self.pose = graph.mailbox(PoseStamped, "camera/pose", latched=True)
        self.starts = graph.mailbox(DiagnosticArray, "episode/start", latched=True)
        self.answers = graph.mailbox(DiagnosticArray, "view_goal/status", latched=True)
        self.diagnostics = graph.mailbox(DiagnosticArray, "/diagnostics")

    @property
    def boxes(self):
        return self.color, self.depth, self.info, self.pose

    def first_view(self):
        self.driver.run_until(lambda: all(self.boxes))

    def ask(self, T):
        stamp = stamp_to_ns(self.pose[-1].header.stamp)
        self.graph.publish(topics.VIEW_GOAL.name, transform_to_pose_stamped(T, stamp, "world"))
        self.graph.spin_until(lambda: self.states()[-1:] == [GoalState.ACCEPTED])

    def states(self):
        return [GoalStatus.from_message(message).state for message in self.answers]

    def said(self, words):
        return [d.status[0].message for d in self.diagnostics if words in d.status[0].message]

    def stands_at(self, T):
        self.driver.view = plane_view(CAMERA, T)


TRAITS = {
    "reliable, volatile": Traits(),
    "best effort": Traits(best_effort=True),
    "compressed": Traits(compressed=True, unit=1e-3),
    "16UC1": Traits(unit=1e-3),
    "tenths of millimetres": Traits(unit=1e-4, parameters={"depth_scale": 1e-4}),
    "stamps 5 ms apart": Traits(skew=5_000_000, pose_lag=3_000_000),
    "pose with covariance": Traits(covariance=True),
    "info once": Traits(info_once=True),
    "slow": Traits(rate_hz=8.0),
}


@pytest.mark.parametrize("traits", TRAITS.values(), ids=TRAITS)
def test_every_driver_becomes_one_view_of_the_graph(graph, traits):
    cell = Cell(graph, traits)
    cell.first_view()
    cell.driver.run(8)
    assert [len(box) for box in cell.boxes] == [1, 1, 1, 1]  # a free-running stream, one view
    assert len({stamp_to_ns(box[0].header.stamp) for box in cell.boxes}) == 1
    assert {box[0].header.frame_id for box in cell.boxes[:3]} == {"camera_optical_frame"}
    assert info_to_camera(cell.info[0]) == CAMERA
    np.testing.assert_allclose(pose_to_transform(cell.pose[0].pose), POSES[0], atol=1e-9)
    np.testing.assert_allclose(image_to_depth(cell.depth[0]), cell.driver.view.depth, atol=6e-4)
    difference = np.abs(image_to_color(cell.color[0]).astype(int) - cell.driver.view.color)
    assert difference.mean() < 3
    assert not cell.said("lost")


def test_a_goal_is_answered_by_one_fresh_view_from_there(graph):
    cell = Cell(graph)
    cell.first_view()
    cell.ask(POSES[1])
    asked = cell.driver.stamp
    cell.driver.run(5)  # still at the old place
    cell.stands_at(POSES[1])
    cell.driver.run_until(lambda: len(cell.depth) == 2)
    cell.driver.run(8)
    assert len(cell.depth) == 2
    assert stamp_to_ns(cell.depth[1].header.stamp) > asked + 0.3 * SECOND
    np.testing.assert_allclose(pose_to_transform(cell.pose[1].pose), POSES[1], atol=1e-9)
    np.testing.assert_allclose(image_to_depth(cell.depth[1]), cell.driver.view.depth, atol=1e-6)
    assert cell.states() == [GoalState.ACCEPTED, GoalState.REACHED]
    assert len(cell.starts) == 1


def test_a_repeated_goal_and_one_of_an_older_view_move_nothing(graph):
    cell = Cell(graph)
    cell.first_view()
    first = stamp_to_ns(cell.pose[0].header.stamp)
    cell.ask(POSES[1])
    goal = transform_to_pose_stamped(POSES[1], first, "world")
    graph.publish(topics.VIEW_GOAL.name, goal)
    cell.stands_at(POSES[1])
    cell.driver.run_until(lambda: len(cell.depth) == 2)
    graph.publish(topics.VIEW_GOAL.name, goal)
    graph.publish(topics.VIEW_GOAL.name, transform_to_pose_stamped(POSES[2], first, "world"))
    graph.spin_until(lambda: cell.said("stale goal"))
    cell.driver.run(30)
    assert len(cell.depth) == 2
    assert cell.states() == [GoalState.ACCEPTED, GoalState.REACHED]


def test_a_camera_that_stops_elsewhere_refuses_and_names_the_distance(graph):
    cell = Cell(graph, parameters={"settle_seconds": 1.0})
    cell.first_view()
    cell.ask(POSES[1])
    cell.stands_at(POSES[2])
    cell.driver.run_until(lambda: GoalState.REFUSED in cell.states())
    assert "the camera stopped" in cell.answers[-1].status[0].message
    assert len(cell.depth) == 1
    cell.ask(POSES[2])  # the policy chooses another
    cell.driver.run_until(lambda: cell.states()[-1] is GoalState.REACHED)
    assert len(cell.depth) == 2


def test_distorted_colour_and_depth_are_rectified(graph):
    d = np.array([-0.12, 0.05, 0.002, -0.001, 0.01])
    info = camera_to_info(CAMERA, SECOND, FRAME)
    info.d = d.tolist()
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    target = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy])
    x, y = target
    for _ in range(50):  # the ray of each distorted pixel
        r2 = x * x + y * y
        radial = 1 + d[0] * r2 + d[1] * r2**2 + d[4] * r2**3
        bent = (
            x * radial + 2 * d[2] * x * y + d[3] * (r2 + 2 * x * x),
            y * radial + d[2] * (r2 + 2 * y * y) + 2 * d[3] * x * y,
        )
        x, y = x - (bent[0] - target[0]), y - (bent[1] - target[1])
    color, depth = look(np.stack([x, y, np.ones(x.shape)], axis=-1), POSES[0])
    cell = Cell(graph, Traits(info=info), view=View(0, color, depth, CAMERA, POSES[0]))
    cell.first_view()
    found = image_to_depth(cell.depth[0])
    valid = np.isfinite(found)
    assert valid.mean() > 0.9
    assert np.abs(found - plane_view(CAMERA, POSES[0]).depth)[valid].max() < 0.012


@pytest.mark.parametrize(
    ("name", "rectified"), [("image_rect_color/compressed", True), ("image_color_corrected", False)]
)
def test_images_are_rectified_unless_the_name_of_their_topic_says_that_they_are(graph, name, rectified):
    info = camera_to_info(CAMERA, SECOND, FRAME)
    info.d = [-0.12, 0.05, 0.002, -0.001, 0.01]
    cell = Cell(graph, Traits(info=info), parameters={"color_topic": f"driver/{name}"})
    cell.driver.color = graph.node.create_publisher(Image, f"driver/{name}", 10)
    cell.first_view()
    graph.spin_for(0.1)
    assert bool(cell.said("camera_info has distortion")) != rectified


def test_unregistered_depth_is_registered_by_the_parameter(graph):
    T_color_depth = make_transform(np.eye(3), np.array([-0.05, 0.0, 0.0]))
    depth_camera = PinholeCamera(212, 120, 110.0, 110.0, 105.5, 59.5)
    color = plane_view(CAMERA, POSES[0])
    _, depth = look(backproject(np.ones((120, 212), np.float32), depth_camera), POSES[0] @ T_color_depth)
    traits = Traits(
        depth_frame="camera_depth_optical_frame",
        depth_info=camera_to_info(depth_camera, SECOND, "camera_depth_optical_frame"),
        parameters={
            "depth_info_topic": "driver/depth_info",
            "depth_to_color": [-0.05, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0],
        },
    )
    assert_registered(graph, traits, color, depth)


def assert_registered(graph, traits, color, depth):
    """The adapter's depth image is that of the colour camera, made from a depth image of another camera."""
    apart = SimpleNamespace(color=color.color, depth=depth, camera=CAMERA, T_world_camera=POSES[0])
    cell = Cell(graph, traits, view=apart)
    cell.first_view()
    found = image_to_depth(cell.depth[0])
    assert np.isfinite(found).mean() > 0.95
    assert np.nanmax(np.abs(found - color.depth)) < 0.02


def test_hand_eye_turns_the_flange_into_the_camera(graph):
    T_flange_camera = make_transform(np.eye(3), np.array([0.03, 0.0, 0.06]))
    view = plane_view(CAMERA, POSES[0])
    T_world_flange = POSES[0] @ np.linalg.inv(T_flange_camera)
    moved = View(0, view.color, view.depth, CAMERA, T_world_flange)
    cell = Cell(graph, parameters={"hand_eye": [0.03, 0.0, 0.06, 0.0, 0.0, 0.0, 1.0]}, view=moved)
    cell.first_view()
    np.testing.assert_allclose(pose_to_transform(cell.pose[0].pose), POSES[0], atol=1e-9)


def wrong_size():
    info = camera_to_info(PinholeCamera(1280, 720, 900.0, 900.0, 640.0, 360.0), SECOND, FRAME)
    return Traits(info=info)


PROBLEMS = {
    "millimetres": (Traits(unit=1e-3, parameters={"depth_scale": 1.0}), "depth looks like millimetres"),
    "ten times": (Traits(unit=1e-4), "depth is 10 times what it can be"),
    "size": (wrong_size(), "camera_info is for 1280x720 images, these are 160x120: set info_topic"),
    "skew": (Traits(skew=24_000_000), "stamps of colour and depth differ by 24 ms: set stamp_tolerance to 0.025"),
    "frames": (
        Traits(depth_frame="camera_depth"),
        "colour is in frame 'camera_color_optical_frame', depth in",
    ),
    "world": (Traits(pose_frame="base_link"), "in the frame 'base_link', not in 'world': set world_frame"),
    "no stamps": (Traits(unstamped=("color",)), "stamps on driver/color are 0"),
    "no stamps of poses": (Traits(unstamped=("pose",)), "stamps on driver/pose are 0"),
    "clocks": (Traits(pose_lag=40 * SECOND), "do both use the same clock"),
    "clocks, poses behind": (
        Traits(pose_lag=-40 * SECOND),
        "the newest camera pose is 40.0 s older than the newest image: their clocks differ, or poses come late",
    ),
    "no info": (Traits(parameters={"info_topic": "driver/other"}), "no camera_info comes on driver/other"),
    "type": (
        Traits(parameters={"color_topic": "driver/pose"}),
        "driver/pose has the type geometry_msgs/msg/",
    ),
}


@pytest.mark.parametrize(("traits", "words"), PROBLEMS.values(), ids=PROBLEMS)
def test_what_is_wrong_is_said_in_words_and_no_view_is_published(graph, traits, words):
    cell = Cell(graph, traits)
    for _ in range(400):
        cell.driver.frame()
        graph.spin_for(0.02)
        if cell.said(words):
            break
    assert cell.said(words)
    assert not cell.depth
    cell.driver.run(5)
    warnings = [d.status[0] for d in cell.diagnostics if words in d.status[0].message]
    assert all(status.name == "/camera_adapter" for status in warnings)


def test_a_warning_whose_numbers_differ_from_image_to_image_is_given_once(graph):
    cell = Cell(graph, Traits(parameters={"depth_scale": 1000.0}))
    for share in np.linspace(1.0, 1.1, 20):
        view = plane_view(CAMERA, POSES[0])
        cell.driver.view = View(0, view.color, (share * view.depth).astype(np.float32), CAMERA, POSES[0])
        cell.driver.run(1)
    cell.driver.run_until(lambda: cell.said("looks like millimetres"))
    cell.driver.run(8)
    assert len(cell.said("looks like millimetres")) == 1


def test_depth_of_another_size_in_the_same_frame_is_registered(graph):
    depth_camera = PinholeCamera(320, 240, 300.0, 300.0, 159.5, 119.5)
    color, depth = plane_view(CAMERA, POSES[0]), plane_view(depth_camera, POSES[0]).depth
    identity = {"depth_info_topic": "driver/depth_info", "depth_to_color": [0.0] * 6 + [1.0]}
    traits = Traits(depth_info=camera_to_info(depth_camera, SECOND, FRAME), parameters=identity)
    assert_registered(graph, traits, color, depth)


def test_a_new_episode_begins_on_request(graph):
    cell = Cell(graph)
    cell.first_view()
    assert graph.call(Trigger, "camera_adapter/reset").success
    cell.driver.run_until(lambda: len(cell.depth) == 2)
    graph.spin_until(lambda: len(cell.starts) == 2)


def test_without_a_pose_topic_tf_is_needed(graph, monkeypatch):
    for package in ("tf2_ros", "tf2_msgs"):
        monkeypatch.setitem(sys.modules, package, None)
    node = CameraAdapterNode(context=graph.context, overrides=TOPICS)
    graph.add(node, start=False)
    with pytest.raises(ValueError, match="poses from /tf need tf2_msgs"):
        node.start()


def test_images_that_come_before_the_transforms_do_not_keep_later_ones_away(graph, monkeypatch):
    monkeypatch.setitem(sys.modules, "tf2_ros", None)
    # A listener without a type is fed by take() alone.
    monkeypatch.setattr(transform_input, "import_optional", lambda name: SimpleNamespace(TFMessage=None))
    cell = Cell(graph, parameters={"pose_topic": ""})
    cell.driver.run(40)
    expected = f"images come, but no camera pose: no transform from world to {FRAME}"
    graph.spin_until(lambda: expected in [d.status[0].message for d in cell.diagnostics])
    listener = cell.adapter._transforms._source

    for _ in range(40):
        cell.driver.run(1)
        header = make_header(cell.driver.stamp, "world")
        stamped = TransformStamped(header=header, child_frame_id=FRAME, transform=transform_of(POSES[0]))
        listener.take(SimpleNamespace(transforms=[stamped]), static=False)
    graph.spin_until(lambda: all(cell.boxes))
    np.testing.assert_allclose(pose_to_transform(cell.pose[0].pose), POSES[0], atol=1e-9)


def test_a_slow_camera_stands_still_by_the_transforms_between_its_images(graph, monkeypatch):
    monkeypatch.setitem(sys.modules, "tf2_ros", None)
    monkeypatch.setattr(transform_input, "import_optional", lambda name: SimpleNamespace(TFMessage=None))
    cell = Cell(graph, Traits(rate_hz=2.0), parameters={"pose_topic": ""})
    listener = cell.adapter._transforms._source
    cell.driver.wait_for_subscribers([cell.driver.color, cell.driver.depth, cell.driver.info])
    for _ in range(6):
        for stamp in range(cell.driver.stamp, cell.driver.stamp + SECOND // 2 + 1, SECOND // 100):
            stamped = TransformStamped(
                header=make_header(stamp, "world"), child_frame_id=FRAME, transform=transform_of(POSES[0])
            )
            listener.take(SimpleNamespace(transforms=[stamped]), static=False)
        cell.driver.run(1)
    graph.spin_until(lambda: all(cell.boxes))


def transform_of(T):
    pose, transform = transform_to_pose(T), Transform()
    transform.rotation = pose.orientation
    for axis in "xyz":
        setattr(transform.translation, axis, getattr(pose.position, axis))
    return transform
