"""The library call: the arrays that users have, and poses in the frames that they expect."""

import numpy as np
import pytest
import trimesh

from active6d_core.camera import DEFAULT_CAMERA
from active6d_core.object_model import load_object
from active6d_perception import Active6D


@pytest.fixture(scope="module")
def images():
    """Colour, depth in metres and intrinsics of a stored test scene of bunnies."""
    from active6d_core.view_sphere import ViewSphere
    from active6d_sim.rendering.simulator import Simulator
    from active6d_sim.scenes.scene_store import load_scene

    sphere = ViewSphere()
    view = Simulator(load_scene("bunny", "test", 0), seed=0).capture(sphere.pose(sphere.positions[40]), 0)
    return view.color, view.depth, DEFAULT_CAMERA.matrix


@pytest.fixture(scope="module")
def estimate():
    return Active6D("bunny")


def test_hypotheses_come_best_first(estimate, images):
    found = estimate(*images)
    assert len(found) >= 3
    assert (np.diff(found.score) <= 0).all()


def test_millimetres_and_zeros_give_the_same_objects(estimate, images):
    rgb, depth, K = images
    expected = estimate(rgb, depth, K)
    found = estimate(rgb, np.nan_to_num(np.rint(1000 * depth)).astype(np.uint16), K)
    best = expected.T_camera_object[:3, :3, 3]
    apart = np.linalg.norm(best[:, None] - found.T_camera_object[:, :3, 3], axis=-1).min(axis=1)
    assert (apart < 0.003).all()


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        (lambda rgb, depth, K: (rgb, 1000 * depth, K), "millimetres"),
        (lambda rgb, depth, K: (rgb, depth[::2, ::2], K), "register"),
        (lambda rgb, depth, K: (rgb, np.zeros_like(depth), K), "no valid pixel"),
        (lambda rgb, depth, K: (rgb / 255, depth, K), "uint8"),
        (lambda rgb, depth, K: (rgb, depth, np.eye(3)), "identity"),
        (lambda rgb, depth, K: (rgb, depth + 18.0, K), "would span"),
    ],
)
def test_what_cannot_be_meant_is_refused(estimate, images, change, cause):
    with pytest.raises(ValueError, match=cause):
        estimate(*change(*images))


def test_the_distance_that_counts_is_within_the_range(estimate, images):
    rgb, depth, K = images
    behind = np.full((480, 1280), 18.0, np.float32)
    wide = np.where(np.arange(1280) < 640, np.pad(depth, ((0, 0), (0, 640))), behind)
    picture = np.pad(rgb, ((0, 0), (0, 640), (0, 0)))
    wide[: len(wide) // 4] = 18.0  # most of the image
    with pytest.raises(ValueError, match="would span"):
        estimate(picture, wide, K)
    assert len(estimate(picture, wide, K, depth_range=(0.3, 1.5)))


def test_range_leaves_only_what_is_inside(estimate, images):
    rgb, depth, K = images
    far = float(np.nanquantile(depth, 0.4))
    found = estimate(rgb, depth, K, depth_range=(0.1, far))
    assert len(found)
    assert (found.T_camera_object[:, 2, 3] < far + estimate.model.diameter).all()


def test_poses_of_the_mesh_file_place_the_file_where_the_object_is(tmp_path, monkeypatch):
    """A part modelled far from the file's origin, in millimetres: the file's vertices land on the object."""
    part = trimesh.creation.box((30.0, 50.0, 90.0))
    part.apply_translation((400.0, -120.0, 15.0))
    part.export(tmp_path / "offset_brick.stl")
    (tmp_path / "offset_brick.yaml").write_text(
        "name: offset_brick\nmesh: offset_brick.stl\nscale: 0.001\ninstances: [2, 5]\ncolor: [0.5, 0.5, 0.5]\n"
    )
    monkeypatch.setenv("ACTIVE6D_OBJECT_PATH", str(tmp_path))
    model = load_object("offset_brick")
    c, s = np.cos(0.3), np.sin(0.3)
    T_camera_object = np.array([[[c, -s, 0, 0.1], [s, c, 0, -0.05], [0, 0, 1, 0.8], [0, 0, 0, 1]]])
    T = model.T_camera_mesh(T_camera_object)[0]
    from_file = 1e-3 * np.asarray(trimesh.load_mesh(tmp_path / "offset_brick.stl").vertices) @ T[:3, :3].T + T[:3, 3]
    np.testing.assert_allclose(from_file.mean(axis=0), [0.1, -0.05, 0.8], atol=1e-9)
    corners = np.asarray(model.mesh.vertices) @ T_camera_object[0, :3, :3].T + T_camera_object[0, :3, 3]
    for corner in from_file:
        assert np.linalg.norm(corners - corner, axis=1).min() < 1e-9


def test_the_kind_of_camera_sets_the_range_and_removes_flying_pixels(estimate, images):
    rgb, depth, K = images
    with pytest.raises(ValueError, match="unknown kind of depth camera 'sonar'"):
        estimate(rgb, depth, K, sensor="sonar")
    far = np.where(np.isfinite(depth), depth + 6.0, depth)
    with pytest.raises(ValueError, match="no depth pixel is inside"):
        estimate(rgb, far, K, sensor="structured_light")
    assert len(estimate(rgb, depth, K, sensor="time_of_flight")) > 0
