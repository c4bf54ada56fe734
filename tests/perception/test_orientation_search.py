"""The search for orientations, on ray-cast views of a bunny whose network knows its centre and half of its axis."""

import numpy as np
import open3d as o3d
import pytest
from scipy.spatial.transform import Rotation

from active6d_core.camera import PinholeCamera, backproject, normals_from_points, pixel_rays
from active6d_core.object_model import load_object
from active6d_core.se3 import is_rigid, make_transform, transform_points
from active6d_perception.estimators.dense.canonical_frame import canonical_frame_of
from active6d_perception.estimators.dense.decoding import Instances
from active6d_perception.estimators.dense.measured_surface import MeasuredSurface
from active6d_perception.estimators.dense.network import DIRECTION_BINS
from active6d_perception.estimators.dense.orientation_search import OrientationSearch
from active6d_perception.estimators.measured_image import measure_image

CAMERA = PinholeCamera.from_field_of_view(320, 240, 60.0)


@pytest.fixture(scope="module")
def bunny():
    return load_object("bunny")


@pytest.fixture(scope="module")
def search(bunny):
    return OrientationSearch(bunny, canonical_frame_of(bunny))


def surface_of(model, T_camera_object, owner=0, instances=1):
    """A bunny alone; ``owner`` is said to have all its pixels."""
    scene = o3d.t.geometry.RaycastingScene()
    vertices = transform_points(T_camera_object, np.asarray(model.mesh.vertices))
    scene.add_triangles(vertices.astype(np.float32), np.uint32(model.mesh.faces))
    rays = np.concatenate([np.zeros((240, 320, 3), np.float32), pixel_rays(CAMERA)], axis=-1)
    depth = scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()
    depth[np.isinf(depth)] = np.nan
    points = backproject(depth, CAMERA)
    owners = np.where(np.isfinite(depth), owner, -1)
    detail = measure_image(depth, CAMERA)
    return MeasuredSurface(depth, points, normals_from_points(points), owners, CAMERA, detail, instances)


def told(T_camera_axis):
    """What a network says that has an opinion on centre and axis only."""
    nothing, even = np.zeros(0, int), np.full((len(T_camera_axis), DIRECTION_BINS), 1 / DIRECTION_BINS)
    return Instances(nothing, nothing, T_camera_axis, even)


@pytest.mark.parametrize("seed", range(6))
def test_an_orientation_near_the_truth_is_among_few(bunny, search, seed):
    rng = np.random.default_rng(seed)
    R = Rotation.random(random_state=seed).as_matrix()
    T = make_transform(R, np.array([rng.uniform(-0.2, 0.2), rng.uniform(-0.15, 0.15), 0.8]))
    # The axis is told 40 degrees off, the turn about it not at all, the centre 5 mm off.
    tilt = Rotation.from_rotvec(np.radians(40) * R[:, 0]) * Rotation.from_rotvec(rng.uniform(0, 6) * R[:, 2])
    wrong = make_transform(tilt.as_matrix() @ R, T[:3, 3] + 0.005 * Rotation.random(random_state=seed).as_matrix()[0])
    found = search.candidates(told(wrong[None]), surface_of(bunny, T), 12)[0]
    apart = np.degrees(Rotation.from_matrix(np.swapaxes(found[:, :3, :3], 1, 2) @ R).magnitude())
    assert apart.min() < 20
    assert np.argmin(apart) < 6
    between = Rotation.from_matrix(np.swapaxes(found[:, None, :3, :3], 2, 3) @ found[:, :3, :3]).magnitude()
    assert np.degrees(between[~np.eye(12, dtype=bool)]).min() > 24
    np.testing.assert_allclose(found[:, :3, 3], np.tile(wrong[:3, 3], (12, 1)))


def test_an_instance_without_measured_surface_gets_what_the_network_says(bunny, search):
    T = np.stack([make_transform(np.eye(3), np.array([x, 0.0, 0.8])) for x in (-0.1, 0.1)])
    found = search.candidates(told(T), surface_of(bunny, T[0], instances=2), 3)
    assert found.shape == (2, 3, 4, 4)
    assert all(is_rigid(pose, 1e-5) for pose in found.reshape(-1, 4, 4))
    # Nothing else is known than the axis, which the best therefore has.
    assert found[1, 0, :3, 2] @ T[1, :3, 2] > np.cos(np.radians(15))
    nothing = search.candidates(told(T[:0]), surface_of(bunny, T[0], owner=-1, instances=0), 3)
    assert nothing.shape == (0, 3, 4, 4)
