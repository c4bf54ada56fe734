"""Rigid transforms against scipy's rotations and homogeneous algebra written out."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from active6d_core import se3

seeds = st.integers(0, 2**32 - 1)


def random_transforms(rng, *leading):
    count = int(np.prod(leading, initial=1))
    rotations = Rotation.random(count, rng=rng).as_matrix()
    return se3.make_transform(rotations, rng.uniform(-2, 2, (count, 3))).reshape(*leading, 4, 4)


@given(seeds)
def test_invert_is_the_matrix_inverse(seed):
    T = random_transforms(np.random.default_rng(seed), 2, 3)
    np.testing.assert_allclose(se3.invert(T), np.linalg.inv(T), atol=1e-12)


@given(seeds)
def test_transform_points_is_homogeneous_multiplication(seed):
    rng = np.random.default_rng(seed)
    T, points = random_transforms(rng, 4), rng.uniform(-1, 1, (4, 7, 3))
    homogeneous = np.concatenate([points, np.ones((4, 7, 1))], axis=-1)
    expected = np.einsum("bij,bnj->bni", T, homogeneous)[..., :3]
    np.testing.assert_allclose(se3.transform_points(T, points), expected, atol=1e-12)
    np.testing.assert_allclose(se3.transform_points(T, points[0])[2], (homogeneous[0] @ T[2].T)[:, :3], atol=1e-12)


@given(seeds)
def test_quaternion_round_trip(seed):
    rng = np.random.default_rng(seed)
    T = random_transforms(rng, 3, 2)
    quaternion = se3.quaternion_from_transform(T)
    assert quaternion.shape == (3, 2, 4)
    assert (quaternion[..., 3] >= 0).all()
    scaled = quaternion * rng.uniform(0.1, 5.0, (3, 2, 1)) * rng.choice([-1.0, 1.0], (3, 2, 1))
    np.testing.assert_allclose(se3.transform_from_quaternion(scaled, T[..., :3, 3]), T, atol=1e-12)


def test_quaternions_are_scalar_last():
    T = se3.transform_from_quaternion([0.0, 0.0, np.sin(0.3), np.cos(0.3)], [1.0, 2.0, 3.0])
    c, s = np.cos(0.6), np.sin(0.6)
    np.testing.assert_allclose(T, [[c, -s, 0, 1], [s, c, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], atol=1e-15)


def test_no_transform_is_an_empty_table():
    none = np.zeros((0, 4, 4))
    assert se3.quaternion_from_transform(none).shape == (0, 4)
    assert se3.transform_from_quaternion(np.zeros((0, 4)), np.zeros((0, 3))).shape == (0, 4, 4)
    assert se3.invert(none).shape == (0, 4, 4)
    assert se3.is_rigid(none)


def test_a_zero_quaternion_is_refused():
    with pytest.raises(ValueError, match="zero norm"):
        se3.transform_from_quaternion(np.zeros(4), np.zeros(3))


@given(angle=st.floats(0.0, np.pi), seed=seeds)
def test_rotation_angle_recovers_the_angle(angle, seed):
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    base = Rotation.random(rng=rng)
    turned = base * Rotation.from_rotvec(angle * axis / np.linalg.norm(axis))
    # Near pi the chord is flat, so 1e-16 in the matrix is 1e-8 in the angle.
    assert se3.rotation_angle(base.as_matrix(), turned.as_matrix()) == pytest.approx(angle, abs=1e-7)


def test_rotation_angle_is_accurate_near_zero():
    R = Rotation.from_rotvec([1e-9, 0, 0]).as_matrix()
    assert se3.rotation_angle(np.eye(3), R) == pytest.approx(1e-9, rel=1e-6)


@pytest.mark.parametrize(
    ("change", "rigid"),
    [
        (lambda T: T, True),
        (lambda T: T * np.array([[1.001], [1], [1], [1]]), False),
        (lambda T: T @ np.diag([-1.0, 1, 1, 1]), False),
        (lambda T: np.where(T[0, 3] == T, np.nan, T), False),
        (lambda T: T + np.array([[0], [0], [0], [1e-3]]), False),
        (lambda T: T[:3, :3], False),
    ],
)
def test_is_rigid(change, rigid):
    assert se3.is_rigid(change(random_transforms(np.random.default_rng(0), 1)[0])) is rigid


@given(seeds)
def test_look_at_puts_the_target_on_the_optical_axis_and_up_in_the_picture(seed):
    rng = np.random.default_rng(seed)
    eye, target = rng.uniform(-1, 1, 3), rng.uniform(-1, 1, 3)
    T_world_camera = se3.look_at(eye, target)
    assert se3.is_rigid(T_world_camera)
    seen = se3.transform_points(se3.invert(T_world_camera), np.stack([target, target + [0, 0, 0.01]]))
    np.testing.assert_allclose(seen[0], [0, 0, np.linalg.norm(target - eye)], atol=1e-9)
    assert seen[1, 1] <= 1e-9, "the world's up must not point down in the picture (y is down)"
    assert abs(T_world_camera[2, 0]) < 1e-12, "the horizon is level"


def test_look_straight_down_has_north_at_the_top():
    T_camera_world = se3.invert(se3.look_at([0, 0, 1.0], [0, 0, 0]))
    np.testing.assert_allclose(se3.transform_points(T_camera_world, np.array([[0, 1.0, 0]]))[0], [0, -1, 1], atol=1e-12)


def test_look_at_needs_a_direction():
    with pytest.raises(ValueError, match="differs from its target"):
        se3.look_at([1, 2, 3], [1, 2, 3])
