"""Corrected poses of cameras, against the poses that rendered views were taken from."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from active6d_core.camera import PinholeCamera
from active6d_core.hypotheses import Hypotheses
from active6d_core.object_model import load_object
from active6d_core.se3 import invert, make_transform, rotation_angle, transform_points
from active6d_core.view_sphere import ViewSphere
from active6d_perception.model.ambiguity import ambiguity_of
from active6d_perception.scene.all_views_fusion import AllViewsFusion
from active6d_perception.scene.camera_alignment import CameraAlignment
from active6d_perception.scene.measured_view import MeasuredView, measure_view, move_view
from active6d_sim.rendering.pose_error import PoseError
from active6d_sim.rendering.random_sensor import sensor_of
from active6d_sim.rendering.simulator import NANOSECONDS, Simulator
from active6d_sim.scenes.scene_store import find_scene

SPHERE = ViewSphere()
# On two rings, a fifth of a turn apart and more.
VIEWS = (41, 45, 50, 62, 70, 78)
# Places in the heap, world, metres.
PLACES = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (0.02, 0.1)])


@pytest.fixture(scope="module")
def scene():
    return find_scene("mug", "mug/val/0", 0)


@pytest.fixture(scope="module")
def measured(scene):
    """What fusion keeps of the views, with the sensor's noise and with the true poses of the camera."""
    mug = load_object("mug")
    simulator = Simulator(scene, noise=sensor_of("auto", mug, scene), seed=3)
    views = []
    for index in VIEWS:
        view = simulator.capture(SPHERE.pose(SPHERE.positions[index]), (index + 1) * NANOSECONDS)
        none = Hypotheses.empty(*view.depth.shape)
        views.append(measure_view(view.depth, view.camera, view.T_world_camera, none, ambiguity_of(mug)))
    return views


def apart(T, true, places=PLACES):
    """Mean distance by which one pose of a camera places what it sees elsewhere than another, metres."""
    return np.linalg.norm(transform_points(T @ invert(true), places) - places, axis=1).mean()


def wrong_poses(measured, error, seed):
    rng = np.random.default_rng(seed)
    return [move_view(view, invert(view.T_camera_world) @ error.draw(rng)) for view in measured]


def test_right_poses_are_left_as_they_are(measured):
    """To the last bit, whatever the order."""
    for order in (range(6), (3, 5, 0, 1, 4, 2)):
        cameras = CameraAlignment()
        for index in order:
            moved = cameras.add_view(index, measured[index])
            np.testing.assert_array_equal(moved.T_camera_world, measured[index].T_camera_world)
            assert cameras.alignment(index).aligned
            assert cameras.alignment(index).shift == 0
        np.testing.assert_array_equal(cameras.T_world_anchor, np.eye(4))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("millimetres", "degrees"), [(5.0, 0.5), (10.0, 1.0)])
def test_views_are_aligned_with_the_first_one(measured, millimetres, degrees, seed):
    """Most to a millimetre and all to a few, from some ten; the first view's own error stays."""
    wrong = wrong_poses(measured, PoseError(millimetres, degrees), seed)
    cameras = CameraAlignment()
    aligned = [cameras.add_view(index, view) for index, view in enumerate(wrong)]
    off_first = invert(wrong[0].T_camera_world) @ measured[0].T_camera_world
    before, after = (
        [apart(invert(one.T_camera_world), off_first @ invert(true.T_camera_world)) for one, true in pairs]
        for pairs in (zip(wrong[1:], measured[1:], strict=True), zip(aligned[1:], measured[1:], strict=True))
    )
    assert np.median(before) > 0.004
    assert np.median(after) < 0.0015
    assert max(after) < 0.004
    np.testing.assert_array_equal(aligned[0].T_camera_world, wrong[0].T_camera_world)


def test_the_errors_of_the_views_cancel_in_the_world(measured):
    """The corrected poses are nearer to the truth than the given ones, and off by the mean of the errors."""
    wrong = wrong_poses(measured, PoseError(6.0, 0.4), 11)
    cameras = CameraAlignment()
    for index, view in enumerate(wrong):
        cameras.add_view(index, view)
    corrected = cameras.T_world_cameras()
    true = [invert(view.T_camera_world) for view in measured]
    before = np.mean([apart(invert(view.T_camera_world), T) for view, T in zip(wrong, true, strict=True)])
    after = np.mean([apart(view, T) for view, T in zip(corrected, true, strict=True)])
    assert after < 0.6 * before
    # By the mean of where the wrong poses have a point of the heap.
    places = [
        transform_points(invert(view.T_camera_world) @ invert(T), PLACES) for view, T in zip(wrong, true, strict=True)
    ]
    for pose, T in zip(corrected, true, strict=True):
        np.testing.assert_allclose(transform_points(pose @ invert(T), PLACES), np.mean(places, axis=0), atol=0.003)


def plane(pose: np.ndarray, count: int = 120) -> MeasuredView:
    """A table at z = 0 and nothing else."""
    camera = PinholeCamera(count, count, float(count), float(count), (count - 1) / 2, (count - 1) / 2)
    v, u = np.mgrid[0:count, 0:count]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u, float)], axis=-1)
    depth = (-pose[2, 3] / (rays @ pose[2, :3])).astype(np.float32)
    return measure_view(depth, camera, pose, Hypotheses.empty(count, count), ambiguity_of(load_object("mug")))


def test_nothing_is_moved_along_what_does_not_hold_it():
    """A bare table tells height and tilt. Shifts along it and turns about its normal stay as they were given."""
    cameras = CameraAlignment()
    first, second = (SPHERE.pose(SPHERE.positions[index]) for index in (85, 90))
    cameras.add_view(0, plane(first))
    turn = Rotation.from_euler("xyz", [0.4, -0.3, 0.6], degrees=True).as_matrix()
    off = make_transform(turn, np.array([0.006, -0.004, 0.005]))
    aligned = cameras.add_view(1, move_view(plane(second), off @ second))
    left = invert(aligned.T_camera_world) @ invert(second)
    normal = left[:3, :3] @ [0.0, 0.0, 1.0]
    assert np.degrees(np.arccos(normal[2])) < 0.02
    assert abs(transform_points(left, np.zeros((1, 3)))[0, 2]) < 2e-4
    assert np.degrees(rotation_angle(np.eye(3), left[:3, :3])) == pytest.approx(0.6, abs=0.05)
    np.testing.assert_allclose(left[:2, 3], off[:2, 3], atol=5e-4)


def test_a_view_that_shows_nothing_keeps_its_pose_and_holds_no_other(measured):
    blank = measured[1]._replace(depth=np.full_like(measured[1].depth, np.nan))
    cameras = CameraAlignment()
    np.testing.assert_array_equal(cameras.add_view(0, blank).T_camera_world, blank.T_camera_world)
    assert not cameras.alignment(0).aligned
    cameras.add_view(1, measured[0])
    T = invert(measured[1].T_camera_world)
    wrong = move_view(measured[1], T @ make_transform(np.eye(3), np.array([0.006, -0.004, 0.003])))
    cameras.add_view(2, wrong)
    assert cameras.alignment(1).aligned
    assert cameras.alignment(2).shift > 0.002
    assert len(cameras.T_world_cameras()) == 3


def test_a_first_view_of_something_else_does_not_keep_the_others_from_being_aligned(measured):
    """As of a robot whose first picture is of the table beside the bin."""
    wrong = wrong_poses(measured, PoseError(10.0, 1.0), 1)
    elsewhere = move_view(measured[3], make_transform(np.eye(3), [3.0, 0.0, 0.0]) @ invert(measured[3].T_camera_world))
    cameras = CameraAlignment()
    cameras.add_view(-1, elsewhere)
    aligned = [cameras.add_view(index, view) for index, view in enumerate(wrong)]
    alone = CameraAlignment()
    expected = [alone.add_view(index, view) for index, view in enumerate(wrong)]
    for one, other in zip(aligned, expected, strict=True):
        np.testing.assert_array_equal(one.T_camera_world, other.T_camera_world)
    assert cameras.alignment(-1).aligned
    assert not cameras.alignment(0).aligned, "nothing shows whether its pose is right"
    assert all(cameras.alignment(index).aligned for index in range(1, len(wrong)))
    # The first view's correction, which is none, stands in for that of the view that the others were aligned with.
    middle = PLACES.mean(axis=0)[None]
    moved = [transform_points(each.T_world_anchor, middle)[0] for each in (cameras, alone)]
    assert np.linalg.norm(moved[0] - moved[1]) < 0.002


def test_an_error_beyond_reach_is_reported_and_not_corrected(measured):
    cameras = CameraAlignment()
    cameras.add_view(0, measured[0])
    lost = move_view(
        measured[1], make_transform(np.eye(3), np.array([0.0, 0.0, 0.5])) @ invert(measured[1].T_camera_world)
    )
    np.testing.assert_array_equal(cameras.add_view(1, lost).T_camera_world, lost.T_camera_world)
    assert not cameras.alignment(1).aligned


@pytest.mark.parametrize("metres", [0.15, 0.25, 0.4])
def test_a_pose_that_nothing_confirms_is_reported_whichever_way_it_is_off(measured, metres):
    """Some pixels always find a pair; they are not enough to take a pose, given or corrected, for right."""
    rng = np.random.default_rng(1)
    for _ in range(6):
        cameras, direction = CameraAlignment(), rng.normal(size=3)
        for index, view in enumerate(measured[:5]):
            cameras.add_view(index, view)
        off = make_transform(np.eye(3), metres * direction / np.linalg.norm(direction))
        moved = cameras.add_view(5, move_view(measured[5], off @ invert(measured[5].T_camera_world)))
        assert not cameras.alignment(5).aligned
        np.testing.assert_allclose(invert(moved.T_camera_world), off @ invert(measured[5].T_camera_world), atol=1e-12)


def test_forgotten_views_hold_nothing(measured):
    wrong = wrong_poses(measured, PoseError(6.0, 0.5), 5)
    cameras, fresh = CameraAlignment(), CameraAlignment()
    for index, view in enumerate(wrong[:3]):
        cameras.add_view(index, view)
    cameras.forget_before(7)
    for index, view in enumerate(wrong[3:]):
        first, second = cameras.add_view(index, view), fresh.add_view(index, view)
        np.testing.assert_array_equal(first.T_camera_world, second.T_camera_world)


def test_fusion_reports_objects_where_the_corrected_cameras_see_them(scene, measured):
    """All views have guesses from their true poses; with errors of the poses, fusion of corrected views is nearer."""
    mug, T_true = load_object("mug"), scene.T_world_object
    wrong = wrong_poses(measured, PoseError(5.0, 0.5), 2)
    camera = PinholeCamera.from_field_of_view(640, 480, 60.0)
    errors = {}
    for align in (True, False):
        fusion = AllViewsFusion(mug, align=align)
        for stamp, (view, true) in enumerate(zip(wrong, measured, strict=True)):
            T_camera_object = true.T_camera_world @ T_true
            row = np.linspace(0.6, 0.9, len(T_true))
            boxes = np.tile([0.4, 0.4, 0.6, 0.6], (len(T_true), 1))
            labels = np.arange(1, len(T_true) + 1, dtype=np.uint16)
            guesses = Hypotheses(
                T_camera_object, row, boxes, T_camera_object[:, 2, 3], labels, np.zeros((1, 1), np.uint16)
            )
            fusion.add_measured(stamp, invert(view.T_camera_world), guesses, row, view)
        objects = fusion.objects(5, invert(wrong[5].T_camera_world), camera)
        nearest = np.linalg.norm(objects.T_world_object[:, None, :3, 3] - T_true[:, :3, 3], axis=-1).min(axis=0)
        errors[align] = np.median(nearest)
    assert errors[True] < 0.7 * errors[False]
