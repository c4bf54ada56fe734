"""The camera without ROS: which goals it takes, when it arrives, and that seed and stamp alone decide what it sees."""

import numpy as np
import pytest
from hand_made_scenes import CAMERA, SPHERE, three_mugs
from hypothesis import given
from hypothesis import strategies as st

from active6d_core.se3 import look_at
from active6d_sim.rendering.active_stereo import ActiveStereo
from active6d_sim.rendering.renderer import SceneRenderer
from active6d_sim.rendering.simulator import GoalError, Simulator, admit_goal, arrival

SECOND = 1_000_000_000


def goal_at(position):
    return look_at(position, np.zeros(3))


@st.composite
def positions(draw, radius):
    azimuth, elevation = draw(st.floats(-np.pi, np.pi)), draw(st.floats(-np.pi / 2, np.pi / 2))
    return draw(radius) * SPHERE.position(azimuth, elevation) / SPHERE.radius


@given(positions(st.floats(0.01, 3.0)), st.booleans(), st.floats(0.0, 0.3))
def test_goals_are_taken_above_the_table_and_near_the_hemisphere_only(position, snap, tolerance):
    height, off = position[2], abs(np.linalg.norm(position) - SPHERE.radius)
    goal = goal_at(position)
    if height > 1e-9 and off < tolerance - 1e-9:
        T_world_camera = admit_goal(goal, SPHERE, snap=snap, tolerance=tolerance)
        if snap:
            cosines = SPHERE.positions @ position / np.linalg.norm(position)
            cosine = T_world_camera[:3, 3] @ position / np.linalg.norm(position)
            assert cosine == pytest.approx(cosines.max(), abs=1e-9)
            np.testing.assert_allclose(T_world_camera[:3, 2], -T_world_camera[:3, 3] / SPHERE.radius, atol=1e-12)
        else:
            np.testing.assert_array_equal(T_world_camera, goal)
    elif height < 0 or off > tolerance + 1e-9:
        with pytest.raises(GoalError, match="below the table" if height <= 0 else "off the hemisphere"):
            admit_goal(goal, SPHERE, snap=snap, tolerance=tolerance)


@pytest.mark.parametrize("entry", [np.nan, np.inf, 2.0, -1.0])
def test_goals_must_be_rigid(entry):
    goal = goal_at(SPHERE.positions[5])
    goal[1, 1] = entry
    with pytest.raises(GoalError, match="not a rigid pose"):
        admit_goal(goal, SPHERE, snap=True, tolerance=1.0)


def test_every_view_of_the_grid_is_a_goal_that_stays():
    for position in SPHERE.positions:
        goal = SPHERE.pose(position)
        for snap in (True, False):
            np.testing.assert_array_equal(admit_goal(goal, SPHERE, snap=snap, tolerance=1e-6), goal)


@given(st.integers(SECOND, 10**18), st.floats(0.0, 3000.0))
def test_arrival(stamp, seconds):
    took = arrival(stamp, seconds) - stamp
    assert took >= SECOND // 10
    assert took == pytest.approx(max(seconds, 0.1) * SECOND, abs=1)


@pytest.fixture(scope="module")
def simulator():
    return Simulator(three_mugs(), CAMERA, seed=3)


def test_view_is_a_function_of_seed_and_stamp(simulator):
    T_world_camera = SPHERE.pose(SPHERE.positions[45])
    first, other = simulator.capture(T_world_camera, SECOND), simulator.capture(T_world_camera, 2 * SECOND)
    again = Simulator(three_mugs(), CAMERA, seed=3).capture(T_world_camera, SECOND)
    np.testing.assert_array_equal(first.depth, again.depth)
    np.testing.assert_array_equal(first.color, again.color)
    assert not np.array_equal(first.depth, other.depth, equal_nan=True)
    seed = Simulator(three_mugs(), CAMERA, seed=4).capture(T_world_camera, SECOND)
    assert not np.array_equal(first.depth, seed.depth, equal_nan=True)


def test_view_says_where_and_when(simulator):
    T_world_camera = SPHERE.pose(SPHERE.positions[45])
    view = simulator.capture(T_world_camera, 7)
    assert (view.stamp, view.camera) == (7, CAMERA)
    np.testing.assert_array_equal(view.T_world_camera, T_world_camera)
    assert (view.color.shape, view.color.dtype) == ((48, 64, 3), np.uint8)
    assert (view.depth.shape, view.depth.dtype) == ((48, 64), np.float32)
    T_world_camera[0, 3] = 99.0
    assert view.T_world_camera[0, 3] != 99.0


def test_perfect_sensor_sees_what_is_rendered():
    T_world_camera = SPHERE.pose(SPHERE.positions[45])
    view = Simulator(three_mugs(), CAMERA, ActiveStereo().scaled(0), seed=3).capture(T_world_camera, SECOND)
    rendered = SceneRenderer(three_mugs(), appearance_seed=3).render(T_world_camera, CAMERA)
    np.testing.assert_array_equal(view.depth, rendered.depth)
    np.testing.assert_array_equal(view.color, rendered.color)
