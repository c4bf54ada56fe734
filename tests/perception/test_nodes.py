"""The estimator and fusion nodes: what they publish, and that bad input is refused while they live on."""

from dataclasses import replace

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseArray
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from sensor_msgs.msg import Image, PointCloud2
from visualization_msgs.msg import Marker, MarkerArray

from active6d_core.camera import DEFAULT_CAMERA
from active6d_core.hypotheses import Hypotheses
from active6d_core.object_model import load_object
from active6d_core.ros.conversions import (
    camera_to_info,
    color_to_image,
    depth_to_image,
    hypotheses_from_cloud,
    hypotheses_to_cloud,
    image_to_segmentation,
    ns_to_stamp,
    objects_from_cloud,
    points_from_cloud,
    poses_from_array,
    segmentation_to_image,
    stamp_to_ns,
    transform_to_pose_stamped,
)
from active6d_core.se3 import invert, make_transform
from active6d_core.view_sphere import ViewSphere
from active6d_perception.estimators.registry import register_estimator
from active6d_perception.nodes.hypothesis_fusion import HypothesisFusionNode
from active6d_perception.nodes.pose_estimator import PoseEstimatorNode
from active6d_perception.scene.all_views_fusion import AllViewsFusion
from active6d_perception.scene.belief_weights import BeliefWeights, Scorer, belief_file
from active6d_perception.scene.best_view_fusion import BestViewFusion
from active6d_perception.scene.expected_visibility import Tray
from active6d_perception.scene.object_probability import OBJECT_COLUMNS
from active6d_perception.scene.observed_surface import ObservedSurface, WorkspaceGrid
from active6d_perception.scene.verification import Verifier
from active6d_sim.rendering.active_stereo import ActiveStereo
from active6d_sim.rendering.simulator import Simulator
from active6d_sim.scenes.scene_store import find_scene

FRAME = "camera_optical_frame"
CAMERA = DEFAULT_CAMERA.scaled(0.25)
SPHERE = ViewSphere()
SECOND = 1_000_000_000


@register_estimator("nearest-pixel")
class NearestPixel:
    """One hypothesis at the nearest pixel, so that a node's test does not wait for a real estimator."""

    def __init__(self, model, weight=1.0):
        self.weight = weight

    def estimate(self, view):
        if not np.isfinite(view.depth).any():
            return Hypotheses.empty(view.camera.height, view.camera.width)
        mask = (view.depth < np.nanmin(view.depth) + 0.05).astype(np.uint16)
        T = np.eye(4)
        T[2, 3] = np.nanmin(view.depth)
        return Hypotheses.from_masks(T[None], np.array([self.weight]), np.ones(1), mask, view.depth)


def make_depth():
    depth = np.full((CAMERA.height, CAMERA.width), 0.8, np.float32)
    depth[50:70, 60:90] = 0.7
    return depth


def camera_messages(stamp, depth=None):
    depth = make_depth() if depth is None else depth
    return {
        "camera/color/image_raw": color_to_image(np.zeros((*depth.shape, 3), np.uint8), stamp, FRAME),
        "camera/depth/image_raw": depth_to_image(depth, stamp, FRAME),
        "camera/color/camera_info": camera_to_info(CAMERA, stamp, FRAME),
        "camera/pose": transform_to_pose_stamped(SPHERE.pose(SPHERE.positions[3]), stamp, "world"),
    }


ESTIMATOR_INPUTS = tuple(camera_messages(1))[:3]


def send(graph, messages, topics=None):
    for topic in topics or messages:
        graph.publish(topic, messages[topic], latched=topic.startswith(("camera", "hypotheses")))


@pytest.fixture
def estimator(graph):
    return graph.add(PoseEstimatorNode(context=graph.context, overrides={"estimator": "nearest-pixel"}))


def test_estimator_publishes_what_the_estimator_says(graph, estimator):
    hypotheses, poses = (
        graph.mailbox(PointCloud2, "hypotheses", True),
        graph.mailbox(PoseArray, "hypotheses/poses", True),
    )
    masks, diagnostics = (
        graph.mailbox(Image, "hypotheses/segmentation", True),
        graph.mailbox(DiagnosticArray, "/diagnostics"),
    )
    send(graph, camera_messages(SECOND), ESTIMATOR_INPUTS)
    graph.spin_until_filled([hypotheses, poses, masks, diagnostics])
    segmentation = image_to_segmentation(masks[0])
    found = hypotheses_from_cloud(hypotheses[0], segmentation, FRAME)
    assert [stamp_to_ns(message.header.stamp) for message in (hypotheses[0], poses[0], masks[0])] == [SECOND] * 3
    np.testing.assert_array_equal(segmentation == 1, make_depth() < 0.75)
    np.testing.assert_allclose(found.box[0], [60 / 160, 50 / 120, 90 / 160, 70 / 120], atol=1e-6)
    assert found.depth[0] == pytest.approx(0.7)
    assert poses[0].poses[0].position.z == pytest.approx(0.7)
    assert diagnostics[0].status[0].level == DiagnosticStatus.OK


def wrong_encoding(messages):
    messages["camera/depth/image_raw"].encoding = "rgb8"


def wrong_bytes(messages):
    messages["camera/depth/image_raw"].data = messages["camera/depth/image_raw"].data[:-4]


def wrong_size(messages):
    messages["camera/color/camera_info"] = camera_to_info(DEFAULT_CAMERA, SECOND, FRAME)


def wrong_frame(messages):
    messages["camera/color/image_raw"].header.frame_id = "elsewhere"


@pytest.mark.parametrize("spoil", [wrong_encoding, wrong_bytes, wrong_size, wrong_frame])
def test_estimator_refuses_bad_views_and_takes_the_next(graph, estimator, spoil):
    hypotheses, diagnostics = (
        graph.mailbox(PointCloud2, "hypotheses", True),
        graph.mailbox(DiagnosticArray, "/diagnostics"),
    )
    messages = camera_messages(SECOND)
    spoil(messages)
    send(graph, messages, ESTIMATOR_INPUTS)
    graph.spin_until(lambda: any(d.status[0].level == DiagnosticStatus.ERROR for d in diagnostics))
    assert not hypotheses
    send(graph, camera_messages(2 * SECOND), ESTIMATOR_INPUTS)
    graph.spin_until_filled([hypotheses])
    assert stamp_to_ns(hypotheses[0].header.stamp) == 2 * SECOND


def test_estimator_waits_for_camera_info_and_ignores_old_stamps(graph, estimator):
    hypotheses, diagnostics = (
        graph.mailbox(PointCloud2, "hypotheses", True),
        graph.mailbox(DiagnosticArray, "/diagnostics"),
    )
    send(graph, camera_messages(SECOND), ESTIMATOR_INPUTS[:2])
    graph.spin_for(0.2)
    assert not hypotheses
    send(graph, camera_messages(2 * SECOND), ESTIMATOR_INPUTS)
    graph.spin_until_filled([hypotheses])
    loss = "lost (1 so far): view of 1.000 s, no camera/color/camera_info came for it"
    graph.spin_until(lambda: loss in [d.status[0].message for d in diagnostics])
    for stamp, kind in ((2 * SECOND, "duplicate"), (SECOND, "stale")):
        diagnostics.clear()
        send(graph, camera_messages(stamp), ESTIMATOR_INPUTS[:1])
        graph.spin_until(lambda kind=kind: any(kind in d.status[0].message for d in diagnostics))
        assert all(d.status[0].level != DiagnosticStatus.ERROR for d in diagnostics)
    assert len(hypotheses) == 1


def test_a_view_without_depth_has_no_hypothesis(graph, estimator):
    hypotheses = graph.mailbox(PointCloud2, "hypotheses", True)
    send(graph, camera_messages(SECOND, np.full((120, 160), np.nan, np.float32)), ESTIMATOR_INPUTS)
    graph.spin_until_filled([hypotheses])
    assert hypotheses[0].width == 0


@pytest.mark.parametrize(
    ("overrides", "text"),
    [
        ({"estimator": "psychic"}, "estimator"),
        ({"estimator_parameters": "[1]"}, "estimator_parameters"),
        ({"estimator_parameters": "{colour: 1}"}, "no parameter 'colour'"),
        (
            {"estimator": "geometric", "estimator_parameters": "{min_score: high}"},
            "parameter 'min_score' must be a number such as",
        ),
        ({"object": "teapot"}, "unknown object 'teapot'"),
    ],
)
def test_bad_estimator_parameters_are_named(graph, overrides, text):
    with pytest.raises(ValueError, match=text):
        graph.add(PoseEstimatorNode(context=graph.context, overrides={"estimator": "nearest-pixel", **overrides}))


# Fusion


@pytest.fixture(scope="module")
def seen(render):
    """Depth and hypotheses of a mug 0.75 m before the camera."""
    model = load_object("mug")
    T = make_transform(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 0.75])[None]
    depth, _ = render(model, T, CAMERA)
    mask = np.isfinite(depth).astype(np.uint16)
    return depth, Hypotheses.from_masks(T, np.array([0.9]), np.ones(1), mask, depth)


def fusion_messages(seen, stamp):
    depth, hypotheses = seen
    return {
        **camera_messages(stamp, depth),
        "hypotheses": hypotheses_to_cloud(hypotheses, stamp, FRAME),
        "hypotheses/segmentation": segmentation_to_image(hypotheses.segmentation, stamp, FRAME),
    }


FUSION_INPUTS = (
    "camera/depth/image_raw",
    "camera/color/camera_info",
    "camera/pose",
    "hypotheses/segmentation",
    "hypotheses",
)


@pytest.fixture
def fusion(graph, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return graph.add(HypothesisFusionNode(context=graph.context))


def test_an_object_set_on_an_unconfigured_node_is_the_one_that_is_loaded(graph):
    node = graph.add(PoseEstimatorNode(context=graph.context, overrides={"estimator": "geometric"}), start=False)
    for name, loaded in (("coffee_cup", None), ("teapot", "unknown object 'teapot'")):
        request = SetParameters.Request(parameters=[Parameter("object", value=name).to_parameter_msg()])
        (result,) = graph.call(SetParameters, "pose_estimator/set_parameters", request).results
        assert result.successful, result.reason
        if loaded is None:
            node.trigger_configure()
            assert node._estimator.model.name == name
            node.trigger_cleanup()
        else:
            with pytest.raises(ValueError, match=loaded):
                node.start()


def test_fusion_by_the_best_view_publishes_verified_objects(graph, seen, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    graph.add(HypothesisFusionNode(context=graph.context, overrides={"method": "best-view"}))
    objects, poses = graph.mailbox(PointCloud2, "objects", True), graph.mailbox(PoseArray, "objects/poses", True)
    markers = graph.mailbox(MarkerArray, "objects/markers", True)
    send(graph, fusion_messages(seen, SECOND), FUSION_INPUTS)
    graph.spin_until_filled([objects, poses, markers])
    depth, hypotheses = seen
    model = load_object("mug")
    T_world_camera = SPHERE.pose(SPHERE.positions[3])
    core = BestViewFusion(model)
    core.add_view(SECOND, T_world_camera, hypotheses, Verifier(model).score(depth, CAMERA, hypotheses))
    expected = core.objects(SECOND, T_world_camera, CAMERA)
    published = objects_from_cloud(objects[0], "world")
    for name in ("T_world_object", "verification", "score", "box", "depth", "support", "spread"):
        np.testing.assert_allclose(getattr(published, name), getattr(expected, name), atol=1e-4, err_msg=name)
    assert published.verification[0] > 0.8
    assert len(poses[0].poses) == 1
    assert markers[0].markers[1].mesh_resource == (tmp_path / "active6d/meshes/mug.stl").as_uri()
    assert (tmp_path / "active6d/meshes/mug.stl").stat().st_size > 1000


def test_fusion_from_all_views_is_that_of_the_core(graph, seen, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("ACTIVE6D_OBJECT_PATH", str(tmp_path))
    weights = replace(BeliefWeights.indifferent(), probability=Scorer.of_weights(np.full(len(OBJECT_COLUMNS), 0.1)))
    weights.save(tmp_path / belief_file("mug"), "mug")
    overrides = {"bin_width": 0.5, "bin_depth": 0.4, "wall_height": 0.0, "confirmed": 0.99}
    graph.add(HypothesisFusionNode(context=graph.context, overrides=overrides))
    objects, markers = graph.mailbox(PointCloud2, "objects", True), graph.mailbox(MarkerArray, "objects/markers", True)
    send(graph, fusion_messages(seen, SECOND), FUSION_INPUTS)
    graph.spin_until_filled([objects, markers])
    depth, hypotheses = seen
    model = load_object("mug")
    T_world_camera = SPHERE.pose(SPHERE.positions[3])
    core = AllViewsFusion(model, weights=weights, tray=Tray(0.5, 0.4, 0.0))
    verification = Verifier(model).score(depth, CAMERA, hypotheses)
    core.add_view(SECOND, T_world_camera, hypotheses, verification, depth, CAMERA)
    expected = core.objects(SECOND, T_world_camera, CAMERA)
    published = objects_from_cloud(objects[0], "world")
    for name in ("T_world_object", "score", "probability", "entropy"):
        np.testing.assert_allclose(getattr(published, name), getattr(expected, name), atol=1e-3, err_msg=name)
    assert 0.5 < published.probability[0] < 0.99
    assert markers[0].markers[1].color.a == pytest.approx(0.3)


@pytest.mark.parametrize(("height", "is_said"), [(0.05, False), (-0.02, True)])
def test_a_floor_that_is_too_high_is_said_once(graph, render, tmp_path, monkeypatch, height, is_said):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    T_world_camera = SPHERE.pose(SPHERE.positions[3])
    model, places = load_object("mug"), np.array([[-0.08, 0.0, height], [0.08, 0.0, height]])
    T = invert(T_world_camera) @ make_transform(np.tile(np.eye(3), (2, 1, 1)), places)
    depths = np.stack([render(model, each[None], CAMERA)[0] for each in T])
    depth = np.fmin(*depths)
    mask = np.where(np.isfinite(depth), 1 + (depths[1] == depth), 0).astype(np.uint16)
    hypotheses = Hypotheses.from_masks(T, np.array([0.9, 0.9]), np.ones(2), mask, depth)
    graph.add(HypothesisFusionNode(context=graph.context))
    objects, statuses = graph.mailbox(PointCloud2, "objects", True), graph.mailbox(DiagnosticArray, "/diagnostics")
    for number in (1, 2):
        send(graph, fusion_messages((depth, hypotheses), number * SECOND), FUSION_INPUTS)
        graph.spin_until_filled([objects], number)
    graph.spin_until_filled([statuses])
    texts = [status.message for each in statuses for status in each.status]
    assert sum("2 objects reach below the bin's floor" in text for text in texts) == is_said


def test_wrong_camera_poses_are_corrected_and_reported(graph, tmp_path, monkeypatch):
    """Of three views of a stored scene the second says that it is 12 mm beside where it is. Surface that both show is
    not doubled, the corrected poses are offered, and the diagnostics say by how much the pose was corrected."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    scene = find_scene("mug", "mug/val/0", 0)
    simulator = Simulator(scene, DEFAULT_CAMERA.scaled(0.5), noise=ActiveStereo().scaled(0.0))
    true = [SPHERE.pose(SPHERE.positions[view]) for view in (62, 65, 68)]
    said = list(true)
    said[1] = make_transform(np.eye(3), np.array([0.010, -0.006, 0.003])) @ true[1]
    graph.add(HypothesisFusionNode(context=graph.context))
    poses = graph.mailbox(PoseArray, "objects/camera_poses", True)
    statuses = graph.mailbox(DiagnosticArray, "/diagnostics")
    for number, (T_true, T_said) in enumerate(zip(true, said, strict=True)):
        view = simulator.capture(T_true, (number + 1) * SECOND)
        messages = {
            "camera/depth/image_raw": depth_to_image(view.depth, view.stamp, FRAME),
            "camera/color/camera_info": camera_to_info(view.camera, view.stamp, FRAME),
            "camera/pose": transform_to_pose_stamped(T_said, view.stamp, "world"),
            "hypotheses": hypotheses_to_cloud(Hypotheses.empty(*view.depth.shape), view.stamp, FRAME),
            "hypotheses/segmentation": segmentation_to_image(np.zeros(view.depth.shape, np.uint16), view.stamp, FRAME),
        }
        send(graph, messages, FUSION_INPUTS)
        graph.spin_until_filled([poses], number + 1)
    corrected = poses_from_array(poses[-1], "world")
    # The mean of the three errors stays, the differences between them do not.
    mean = make_transform(np.eye(3), np.array([0.010, -0.006, 0.003]) / 3)
    for T, T_true in zip(corrected, true, strict=True):
        np.testing.assert_allclose(T[:3, 3], (mean @ T_true)[:3, 3], atol=0.003)
    told = [value.value for each in statuses for status in each.status for value in status.values]
    assert sum("the camera's pose was corrected by 12." in text for text in told) == 1


def test_weights_that_do_not_fit_are_named(graph, tmp_path, monkeypatch):
    monkeypatch.setenv("ACTIVE6D_OBJECT_PATH", str(tmp_path))
    (tmp_path / belief_file("mug")).write_bytes(b"")
    with pytest.raises(ValueError, match=r"no weights of fusion .*active6d train fusion"):
        graph.add(HypothesisFusionNode(context=graph.context))


def box_on_the_floor(stamp, left=60):
    """A view of a box that nobody has a hypothesis of."""
    depth = np.full((CAMERA.height, CAMERA.width), np.nan, np.float32)
    depth[50:70, left : left + 30] = 0.72
    empty = Hypotheses.empty(CAMERA.height, CAMERA.width)
    return depth, fusion_messages((depth, empty), stamp)


def unexplained_by_nothing(depths, grid=None):
    surface = ObservedSurface(load_object("mug"), grid)
    for stamp, depth in enumerate(depths):
        surface.add_view(stamp, depth, CAMERA, SPHERE.pose(SPHERE.positions[3]))
    return surface.unexplained(np.zeros((0, 4, 4)))


def test_unexplained_surface_adds_up_within_an_episode(graph, fusion):
    clouds = graph.mailbox(PointCloud2, "objects/unexplained", True)
    first, messages = box_on_the_floor(SECOND)
    send(graph, messages, FUSION_INPUTS)
    graph.spin_until_filled([clouds])
    assert stamp_to_ns(clouds[0].header.stamp) == SECOND
    np.testing.assert_array_equal(points_from_cloud(clouds[0], "world"), unexplained_by_nothing([first]))
    second, messages = box_on_the_floor(2 * SECOND, left=40)
    send(graph, messages, FUSION_INPUTS)
    graph.spin_until_filled([clouds], 2)
    both = unexplained_by_nothing([first, second])
    np.testing.assert_array_equal(points_from_cloud(clouds[1], "world"), both)
    start = DiagnosticArray(status=[DiagnosticStatus()])
    start.header.stamp = ns_to_stamp(3 * SECOND)
    graph.publish("episode/start", start, latched=True)
    send(graph, box_on_the_floor(3 * SECOND, left=40)[1], FUSION_INPUTS)
    graph.spin_until_filled([clouds], 3)
    alone = unexplained_by_nothing([second])
    np.testing.assert_array_equal(points_from_cloud(clouds[2], "world"), alone)
    assert 0 < len(alone) < len(both)


def test_the_workspace_is_the_parameters(graph, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    clouds = graph.mailbox(PointCloud2, "objects/unexplained", True)
    overrides = {"workspace_width": [0.0, 0.1], "workspace_floor": 0.03, "workspace_height": 0.3}
    graph.add(HypothesisFusionNode(context=graph.context, overrides=overrides))
    depth, messages = box_on_the_floor(SECOND)
    send(graph, messages, FUSION_INPUTS)
    graph.spin_until_filled([clouds])
    usual = WorkspaceGrid.for_model(load_object("mug"))
    grid = WorkspaceGrid((usual.width[0], 0.1), 0.03, 0.3, usual.cell)
    expected = unexplained_by_nothing([depth], grid)
    np.testing.assert_array_equal(points_from_cloud(clouds[0], "world"), expected)
    assert len(expected) > 0


def test_fusion_without_a_writable_cache_sends_no_markers(graph, seen, tmp_path, monkeypatch):
    (tmp_path / "cache").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    objects, markers = graph.mailbox(PointCloud2, "objects", True), graph.mailbox(MarkerArray, "objects/markers", True)
    logged = graph.log()
    graph.add(HypothesisFusionNode(context=graph.context))
    send(graph, fusion_messages(seen, SECOND), FUSION_INPUTS)
    graph.spin_until_filled([objects, markers])
    assert objects[0].width == 1
    assert [marker.action for marker in markers[0].markers] == [Marker.DELETEALL]
    graph.spin_until(lambda: any("objects/markers stays empty" in entry.msg for entry in logged))


def test_nodes_that_are_activated_last_take_the_views_so_far(graph, tmp_path, monkeypatch, seen):
    """Everything was said before either node was active, as with autostart off."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    objects = graph.mailbox(PointCloud2, "objects", True)
    fusion = graph.add(HypothesisFusionNode(context=graph.context), start=False)
    estimator = graph.add(
        PoseEstimatorNode(context=graph.context, overrides={"estimator": "nearest-pixel"}), start=False
    )
    start = DiagnosticArray(status=[DiagnosticStatus()])
    start.header.stamp = ns_to_stamp(SECOND)
    graph.publish("episode/start", start, latched=True)
    for stamp in (SECOND, 2 * SECOND):
        send(graph, camera_messages(stamp))
    graph.spin_until(lambda: all(len(held) == 2 for _, held in [*estimator._held, *fusion._held[-3:]]))
    estimator.start()
    graph.spin_for(0.2)
    assert not objects
    fusion.start()
    graph.spin_until_filled([objects], 2)
    assert [stamp_to_ns(message.header.stamp) for message in objects] == [SECOND, 2 * SECOND]
    assert objects_from_cloud(objects[1], "world").support[0] == 2


def test_fusion_hands_the_objects_to_the_detections_too(graph, fusion, seen, monkeypatch):
    sent = []
    monkeypatch.setattr(fusion._detections, "publish", lambda *arguments: sent.append(arguments))
    objects = graph.mailbox(PointCloud2, "objects", True)
    send(graph, fusion_messages(seen, SECOND), FUSION_INPUTS)
    graph.spin_until_filled([objects])
    found, model, stamp, frame = sent[0]
    assert (len(found), model.name, stamp, frame) == (1, "mug", SECOND, "world")


def test_the_same_view_again_changes_nothing(graph, fusion, seen):
    objects = graph.mailbox(PointCloud2, "objects", True)
    send(graph, fusion_messages(seen, SECOND), FUSION_INPUTS)
    graph.spin_until_filled([objects])
    send(graph, fusion_messages(seen, SECOND), ("hypotheses/segmentation", "hypotheses"))
    graph.spin_until_filled([objects], 2)
    assert bytes(objects[0].data) == bytes(objects[1].data)
    assert objects[0].header == objects[1].header


def test_a_node_that_is_configured_again_knows_no_view(graph, fusion, seen):
    objects = graph.mailbox(PointCloud2, "objects", True)
    send(graph, fusion_messages(seen, SECOND), FUSION_INPUTS)
    send(graph, fusion_messages(seen, 2 * SECOND), FUSION_INPUTS)
    graph.spin_until_filled([objects], 2)
    fusion.trigger_deactivate()
    fusion.trigger_cleanup()
    fusion.start()
    send(graph, fusion_messages(seen, SECOND), FUSION_INPUTS)
    graph.spin_until_filled([objects], 3)
    assert objects_from_cloud(objects[2], "world").support[0] == 1


def test_a_new_episode_forgets_the_last(graph, fusion, seen):
    objects = graph.mailbox(PointCloud2, "objects", True)
    send(graph, fusion_messages(seen, SECOND), FUSION_INPUTS)
    send(graph, fusion_messages(seen, 2 * SECOND), FUSION_INPUTS)
    graph.spin_until_filled([objects], 2)
    assert objects_from_cloud(objects[1], "world").support[0] == 2
    start = DiagnosticArray(status=[DiagnosticStatus()])
    start.header.stamp = ns_to_stamp(3 * SECOND)
    graph.publish("episode/start", start, latched=True)
    send(graph, fusion_messages(seen, 3 * SECOND), FUSION_INPUTS)
    graph.spin_until_filled([objects], 3)
    assert objects_from_cloud(objects[2], "world").support[0] == 1


def test_hypotheses_that_come_after_their_episode_are_ignored(graph, fusion, seen):
    objects, diagnostics = graph.mailbox(PointCloud2, "objects", True), graph.mailbox(DiagnosticArray, "/diagnostics")
    send(graph, fusion_messages(seen, SECOND), FUSION_INPUTS[:-1])
    start = DiagnosticArray(status=[DiagnosticStatus()])
    start.header.stamp = ns_to_stamp(2 * SECOND)
    graph.publish("episode/start", start, latched=True)
    graph.spin_for(0.2)
    send(graph, fusion_messages(seen, 2 * SECOND), FUSION_INPUTS[:1])
    graph.spin_for(0.2)
    send(graph, fusion_messages(seen, SECOND), FUSION_INPUTS[-1:])
    graph.spin_until(lambda: any("older than the episode" in d.status[0].message for d in diagnostics))
    send(graph, fusion_messages(seen, 2 * SECOND), FUSION_INPUTS)
    graph.spin_until_filled([objects])
    assert [stamp_to_ns(message.header.stamp) for message in objects] == [2 * SECOND]
    assert objects_from_cloud(objects[0], "world").support[0] == 1


def zero_quaternion(messages):
    messages["camera/pose"].pose.orientation.w = 0.0
    for axis in "xyz":
        setattr(messages["camera/pose"].pose.orientation, axis, 0.0)


def unknown_frame(messages):
    messages["camera/pose"].header.frame_id = "map"


def hypotheses_of_nan(messages):
    table = np.frombuffer(bytes(messages["hypotheses"].data), np.uint8).copy()
    table[:4] = np.frombuffer(np.float32(np.nan).tobytes(), np.uint8)
    messages["hypotheses"].data = table.tobytes()


def mask_of_another_size(messages):
    messages["hypotheses/segmentation"] = segmentation_to_image(np.ones((4, 4), np.uint16), SECOND, FRAME)


def mask_encoding(messages):
    messages["hypotheses/segmentation"].encoding = "mono8"


def short_table(messages):
    messages["hypotheses"].data = messages["hypotheses"].data[:-1]


@pytest.mark.parametrize(
    "spoil", [zero_quaternion, unknown_frame, hypotheses_of_nan, mask_of_another_size, mask_encoding, short_table]
)
def test_fusion_refuses_bad_input_and_takes_the_next(graph, fusion, seen, spoil):
    objects, diagnostics = graph.mailbox(PointCloud2, "objects", True), graph.mailbox(DiagnosticArray, "/diagnostics")
    messages = fusion_messages(seen, SECOND)
    spoil(messages)
    send(graph, messages, FUSION_INPUTS)
    graph.spin_until(lambda: any(d.status[0].level == DiagnosticStatus.ERROR for d in diagnostics))
    assert not objects
    send(graph, fusion_messages(seen, 2 * SECOND), FUSION_INPUTS)
    graph.spin_until_filled([objects])
    assert objects_from_cloud(objects[0], "world").support[0] == 1


def test_fusion_ignores_stale_views(graph, fusion, seen):
    objects, diagnostics = graph.mailbox(PointCloud2, "objects", True), graph.mailbox(DiagnosticArray, "/diagnostics")
    send(graph, fusion_messages(seen, SECOND), FUSION_INPUTS[:1])
    send(graph, fusion_messages(seen, 2 * SECOND), FUSION_INPUTS)
    graph.spin_until_filled([objects])
    send(graph, fusion_messages(seen, SECOND), FUSION_INPUTS[:1])
    graph.spin_until(lambda: any("stale" in d.status[0].message for d in diagnostics))
    assert len(objects) == 1


def test_nan_depth_verifies_to_nothing(graph, fusion, seen):
    objects = graph.mailbox(PointCloud2, "objects", True)
    messages = fusion_messages(seen, SECOND)
    messages["camera/depth/image_raw"] = depth_to_image(np.full((120, 160), np.nan, np.float32), SECOND, FRAME)
    send(graph, messages, FUSION_INPUTS)
    graph.spin_until_filled([objects])
    assert objects_from_cloud(objects[0], "world").verification[0] == 0.0


def test_bad_fusion_parameters_are_named(graph):
    with pytest.raises(ValueError, match="'epsilon'"):
        HypothesisFusionNode(context=graph.context, overrides={"epsilon": -1.0})


# Last, for a node that is refused keeps its name in the log.
@pytest.mark.parametrize(
    ("overrides", "text"),
    [
        ({"workspace_width": [0.3]}, r"hypothesis_fusion: parameters 'workspace_\*': .* finite"),
        ({"workspace_width": [0.3, -0.3]}, r"'workspace_\*': .* expected one to a million"),
        ({"workspace_height": 0.001}, r"'workspace_\*'"),
        ({"workspace_floor": float("nan")}, r"'workspace_\*'"),
        ({"explained_within": 0.0}, "parameter 'explained_within' is 0.0"),
    ],
)
def test_bad_workspaces_are_named(graph, overrides, text):
    with pytest.raises(ValueError, match=text):
        graph.add(HypothesisFusionNode(context=graph.context, overrides=overrides))
