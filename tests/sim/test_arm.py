"""The simulated arm, against the URDF as pybullet reads it and against distances computed without pybullet."""

from itertools import pairwise

import numpy as np
import open3d as o3d
import pybullet_data
import pytest
import trimesh
from hand_made_scenes import SPHERE

from active6d_core.object_model import load_object
from active6d_core.se3 import look_at, rotation_angle, transform_points
from active6d_sim.physics.bullet import connect
from active6d_sim.rendering.simulator import GoalError
from active6d_sim.robot.arm import ArmSettings, CameraArm, hand_eye_error
from active6d_sim.robot.motion import find_way, sample_way, seconds_of

VIEWS = 20, 26, 45, 52, 60, 71
MILLIMETRE = 1e-3


@pytest.fixture(scope="module")
def tour(mug_heap):
    """The arm, and its motions from view to view."""
    arm = CameraArm(mug_heap)
    arm.place(SPHERE.pose(SPHERE.positions[VIEWS[0]]))
    motions = []
    for view in VIEWS[1:]:
        motions.append(arm.plan(SPHERE.pose(SPHERE.positions[view])))
        arm.follow(motions[-1])
    return arm, motions


@pytest.fixture(scope="module")
def link_poses():
    """Joint angles to (8, 4, 4) poses of the arm's meshes, the base first, by pybullet."""
    client = connect()
    base = ArmSettings().T_world_base
    path = f"{pybullet_data.getDataPath()}/kuka_iiwa/model.urdf"
    robot = client.loadURDF(path, base[:3, 3].tolist(), [1, 0, 0, 0], useFixedBase=True)

    def poses(joints):
        for index, angle in enumerate(joints):
            client.resetJointState(robot, index, angle)
        frames = [client.getLinkState(robot, i, computeForwardKinematics=True)[4:6] for i in range(7)]
        T = np.tile(np.eye(4), (8, 1, 1))
        T[0] = base
        for index, (position, turn) in enumerate(frames, start=1):
            T[index, :3, :3] = np.reshape(client.getMatrixFromQuaternion(turn), (3, 3))
            T[index, :3, 3] = position
        return T

    yield poses
    client.disconnect()


def test_the_camera_arrives_where_it_was_asked_to(tour, link_poses):
    arm, motions = tour
    for view, motion in zip(VIEWS[1:], motions, strict=True):
        T = link_poses(motion.way[-1])[-1] @ arm.settings.T_flange_camera
        goal = SPHERE.pose(SPHERE.positions[view])
        assert np.linalg.norm(T[:3, 3] - goal[:3, 3]) < MILLIMETRE
        assert np.degrees(rotation_angle(T[:3, :3], goal[:3, :3])) < 0.1
        np.testing.assert_allclose(T, motion.T_world_camera, atol=1e-5)


def test_motions_are_continuous_and_stay_within_the_joint_limits(tour):
    _, motions = tour
    limits = np.radians([170, 120, 170, 120, 170, 120, 175])
    for earlier, later in pairwise(motions):
        np.testing.assert_array_equal(earlier.way[-1], later.way[0])
    for motion in motions:
        assert (np.abs(motion.way) <= limits + 1e-9).all()


def test_nothing_is_touched_on_the_way(tour, link_poses, mug_heap):
    """By the points of the links' meshes and of the camera, and their distances to boxes and triangles."""
    arm, motions = tour
    folder = f"{pybullet_data.getDataPath()}/kuka_iiwa/meshes"
    meshes = [trimesh.load(f"{folder}/link_{index}.stl") for index in range(8)]
    points = [np.array(mesh.convex_hull.vertices)[::3] for mesh in meshes]
    points[-1] = np.concatenate([points[-1], transform_points(arm.settings.T_flange_camera, camera_points())])
    heap = o3d.t.geometry.RaycastingScene()
    mug = load_object("mug").mesh
    for T in mug_heap.T_world_all:
        placed = mug.copy().apply_transform(T)
        heap.add_triangles(placed.vertices.astype(np.float32), placed.faces.astype(np.uint32))
    width, height = mug_heap.bin.inner_width / 2, mug_heap.bin.wall_height
    nearest = np.inf
    for motion in motions:
        for joints in sample_way(motion.way, 0.05):
            world = np.concatenate(
                [transform_points(T, each) for T, each in zip(link_poses(joints), points, strict=True)]
            )
            over_bin = np.abs(world[:, :2]).max(axis=1) < width + 0.03
            assert world[:, 2].min() > 0.005
            assert world[over_bin, 2].min(initial=1.0) > height
            nearest = min(nearest, heap.compute_distance(world.astype(np.float32)).numpy().min())
    assert nearest > arm.settings.clearance
    assert min(arm.clearance(motion) for motion in motions) >= arm.settings.clearance - 1e-4


def camera_points():
    """The corners of a camera of 90 x 25 x 25 mm whose optical centre is in the middle of its front."""
    x, y, z = np.meshgrid([-0.045, 0.045], [-0.0125, 0.0125], [-0.025, 0.0])
    return np.column_stack([x.ravel(), y.ravel(), z.ravel()])


def test_seconds_are_those_of_the_slowest_joint(tour):
    """By numerical integration of its speed: full acceleration, cruise, full deceleration."""
    arm, motions = tour
    speeds = 0.5 * np.radians([85, 85, 100, 75, 130, 135, 135])
    for motion in motions:
        expected = arm.settings.pause
        for turn in np.abs(np.diff(motion.way, axis=0)):
            seconds = []
            for angle, speed in zip(turn, speeds, strict=True):
                clock = np.arange(0, 60, 1e-4)
                rising = np.minimum(speed / 0.5 * clock, speed)
                # Symmetric about the middle, where half of the angle is done.
                half = np.searchsorted(np.cumsum(rising) * 1e-4, angle / 2)
                seconds.append(2 * clock[half])
            expected += max(seconds)
        assert motion.seconds == pytest.approx(expected, abs=0.01)


def test_a_short_motion_never_reaches_full_speed():
    way = np.array([[0.0, 0.0], [0.02, 0.0]])
    assert seconds_of(way, np.ones(2), np.full(2, 2.0)) == pytest.approx(2 * np.sqrt(0.02 / 2.0))
    assert seconds_of(way[:1], np.ones(2), np.ones(2)) == 0.0


def test_views_out_of_reach_are_refused_with_the_reason(tour):
    arm, _ = tour
    before = arm.joints
    with pytest.raises(GoalError, match="out of reach"):
        arm.plan(SPHERE.pose(SPHERE.positions[3]))
    assert not arm.reaches(SPHERE.pose(SPHERE.positions[3]))
    with pytest.raises(GoalError, match="the camera would touch the heap"):
        arm.plan(look_at(np.array([0.01, 0.02, 0.07]), np.zeros(3)))
    assert arm.joints is before


def test_a_way_around_an_obstacle_is_found_and_does_not_cross_it():
    """Two joints, and a wall between start and end with a gap at the top."""
    limits = np.array([[-2.0, 2.0], [-2.0, 2.0]])

    def is_free(joints):
        return abs(joints[0]) > 0.2 or joints[1] > 1.5

    start, end = np.array([-1.0, -1.0]), np.array([1.0, -1.0])
    way = find_way(start, end, limits, is_free, np.random.default_rng(0))
    assert way is not None
    assert len(way) > 2
    np.testing.assert_array_equal(way[[0, -1]], [start, end])
    assert all(is_free(joints) for joints in sample_way(way, 0.03))
    closed = find_way(start, end, limits, lambda joints: abs(joints[0]) > 0.2, np.random.default_rng(0))
    assert closed is None


def test_the_hand_eye_error_has_the_size_asked_for():
    for seed in range(3):
        T = hand_eye_error(1.5, 0.3, seed)
        assert np.linalg.norm(T[:3, 3]) == pytest.approx(1.5e-3)
        assert np.degrees(rotation_angle(T[:3, :3], np.eye(3))) == pytest.approx(0.3)
    np.testing.assert_allclose(hand_eye_error(0.0, 0.0, 1), np.eye(4), atol=1e-12)
