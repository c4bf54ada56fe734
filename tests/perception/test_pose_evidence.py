"""What a depth image says of a pose, and registration to it, on noise-free images of a cup before a wall."""

import numpy as np
import open3d as o3d
import pytest

from active6d_core.camera import PinholeCamera, pixel_rays
from active6d_core.object_model import load_object
from active6d_core.se3 import make_transform
from active6d_perception.estimators.image_registration import register
from active6d_perception.estimators.measured_image import measure_image
from active6d_perception.estimators.pose_evidence import (
    CONFIRMED,
    CONTINUED,
    FITTING,
    OCCLUDED,
    UNKNOWN,
    VIOLATED,
    weigh_poses,
)
from active6d_perception.estimators.pose_selection import judge_of
from active6d_perception.model.model_views import ray_caster

CAMERA = PinholeCamera.from_field_of_view(320, 240, 60.0)
MODEL = load_object("coffee_cup")
# Lying across the view, at 0.5 m.
T = make_transform(np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), np.array([0.02, 0.01, 0.5]))


def image(wall):
    """The cup at ``T`` before a wall at that depth in metres."""
    rays = pixel_rays(CAMERA)
    rays = (rays / rays[..., 2:]).reshape(-1, 3)
    start = np.broadcast_to(-T[:3, :3].T @ T[:3, 3], rays.shape)
    hit = ray_caster(MODEL.mesh).cast_rays(o3d.core.Tensor(np.hstack([start, rays @ T[:3, :3]]).astype(np.float32)))
    depth = np.minimum(hit["t_hit"].numpy(), wall).reshape(CAMERA.height, CAMERA.width)
    return measure_image(depth.astype(np.float32), CAMERA)


def moved(x=0.0, y=0.0, z=0.0):
    return make_transform(T[:3, :3], T[:3, 3] + [x, y, z])[None]


def test_evidence_of_a_right_pose_and_of_wrong_ones():
    judge, seen = judge_of(MODEL), image(1.0)
    right = weigh_poses(moved(), judge, seen)[0]
    assert right[FITTING] > 0.7
    assert right[VIOLATED] < 0.05
    assert right[CONFIRMED] > 0.9
    assert right[CONTINUED] < 0.05
    assert weigh_poses(moved(z=-0.1), judge, seen)[0, VIOLATED] > 0.8
    assert weigh_poses(moved(z=0.1), judge, seen)[0, OCCLUDED] > 0.8
    assert weigh_poses(moved(x=5.0), judge, seen)[0, UNKNOWN] == 1.0
    # A wall that touches the cup's outline: the surface inside fits as well, but continues beyond.
    wall = weigh_poses(moved(), judge, image(0.495))[0]
    assert wall[FITTING] > 0.7
    assert wall[CONTINUED] > 0.5


@pytest.mark.parametrize("shift", [{"z": -0.015}, {"y": 0.012}])
def test_registration_moves_a_pose_to_its_surface(shift):
    samples = judge_of(MODEL, samples=128).samples
    found = register(moved(**shift), samples, image(1.0), np.array([0.02, 0.01]), 8)[0]
    assert np.linalg.norm(found[:3, 3] - T[:3, 3]) < 0.004


def test_registration_leaves_a_pose_that_nothing_is_near():
    samples, far = judge_of(MODEL, samples=128).samples, moved(z=-0.2)
    np.testing.assert_array_equal(register(far, samples, image(1.0), np.array([0.02]), 4), far)
