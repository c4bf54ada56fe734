"""Projection, back-projection and normals against closed forms."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from active6d_core.camera import (
    DEFAULT_CAMERA,
    PinholeCamera,
    backproject,
    normals_from_points,
    pixel_rays,
    project,
)

CAMERA = PinholeCamera(64, 48, 50.0, 55.0, 30.0, 25.0)


@given(seed=st.integers(0, 2**32 - 1))
def test_project_undoes_backproject(seed):
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.2, 3.0, (48, 64))
    u, v = np.meshgrid(np.arange(64), np.arange(48))
    points = backproject(depth, CAMERA)
    assert points.dtype == np.float32
    np.testing.assert_allclose(project(points, CAMERA), np.stack([u, v], -1), atol=1e-4)
    np.testing.assert_allclose(points[..., 2], depth, rtol=1e-6)


def test_projection_is_the_intrinsic_matrix():
    point = np.array([0.1, -0.2, 0.7])
    u, v, w = CAMERA.matrix @ point
    np.testing.assert_allclose(project(point, CAMERA), [u / w, v / w])


def test_invalid_depth_stays_invalid():
    assert np.isnan(backproject(np.full((48, 64), np.nan), CAMERA)).all()


def test_field_of_view_spans_the_outer_edges_of_the_border_pixels():
    left = (-0.5 - DEFAULT_CAMERA.cx) / DEFAULT_CAMERA.fx
    right = (639.5 - DEFAULT_CAMERA.cx) / DEFAULT_CAMERA.fx
    assert np.degrees(np.arctan(right) - np.arctan(left)) == pytest.approx(60.0)


@given(factor=st.sampled_from([0.25, 0.5, 2.0]), seed=st.integers(0, 2**32 - 1))
def test_a_resized_image_sees_the_same_rays(factor, seed):
    """A ray meets both images at the same fraction of their width, pixel centres being half a pixel in."""
    point = np.append(np.random.default_rng(seed).uniform(-0.5, 0.5, 2), 1.0)
    small = CAMERA.scaled(factor)
    assert (small.width, small.height) == (64 * factor, 48 * factor)
    np.testing.assert_allclose((project(point, small) + 0.5), (project(point, CAMERA) + 0.5) * factor)


@pytest.mark.parametrize("change", [{"width": 0}, {"height": -1}, {"fx": 0.0}, {"fy": float("nan")}, {"cx": np.inf}])
def test_a_bad_camera_is_refused(change):
    with pytest.raises(ValueError, match="camera"):
        PinholeCamera(**{"width": 4, "height": 4, "fx": 1.0, "fy": 1.0, "cx": 2.0, "cy": 2.0, **change})


def test_rays_are_shared_and_cannot_be_written():
    with pytest.raises(ValueError, match="read-only"):
        pixel_rays(CAMERA)[0, 0, 0] = 1.0


@given(seed=st.integers(0, 2**32 - 1), reach=st.integers(1, 4))
def test_normals_of_a_plane(seed, reach):
    """Every ray meets the plane n . x = -d at depth -d / (n . ray); all normals are n, turned to the camera."""
    normal = np.append(np.random.default_rng(seed).uniform(-0.5, 0.5, 2), -1.0)
    normal /= np.linalg.norm(normal)
    depth = -0.8 / (pixel_rays(CAMERA).astype(float) @ normal)
    normals = normals_from_points(backproject(depth, CAMERA), reach)
    inner = normals[reach:-reach, reach:-reach]
    np.testing.assert_allclose(inner, np.broadcast_to(normal, inner.shape), atol=1e-3)
    assert np.isnan(normals[:reach]).all()
    assert np.isnan(normals[:, -reach:]).all()


def test_normals_of_a_sphere_point_outwards():
    rays = pixel_rays(DEFAULT_CAMERA.scaled(0.25)).astype(float)
    centre, radius = np.array([0.0, 0.0, 0.8]), 0.2
    a, b, c = (rays**2).sum(-1), rays @ centre, centre @ centre - radius**2
    root = b**2 - a * c
    depth = np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, np.nan)
    points = backproject(depth, DEFAULT_CAMERA.scaled(0.25))
    normals = normals_from_points(points, 1)
    expected = (points - centre) / radius
    facing = -(expected * points).sum(-1) / np.linalg.norm(points, axis=-1) > 0.5
    valid = np.isfinite(normals).all(-1) & facing
    assert valid.sum() > 1000
    assert (np.einsum("ij,ij->i", normals[valid], expected[valid]) > 0.999).all()


def test_normals_next_to_a_hole_are_invalid():
    depth = np.ones((48, 64))
    depth[20, 30] = np.nan
    normals = normals_from_points(backproject(depth, CAMERA), 2)
    assert np.isnan(normals[[20, 20, 18, 22], [28, 32, 30, 30]]).all()
    assert np.isfinite(normals[10, 10]).all()
