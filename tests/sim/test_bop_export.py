"""Exported scenes, read by an independent reader of BOP's files: same images, intrinsics, poses, symmetries."""

import json

import numpy as np
import pytest
import trimesh
from hand_made_scenes import SPHERE, three_mugs
from PIL import Image
from scipy.spatial import cKDTree

from active6d_core.camera import PinholeCamera
from active6d_core.object_model import load_object
from active6d_sim.datasets.bop import BopScene
from active6d_sim.datasets.bop_export import export_scenes, write_model
from active6d_sim.rendering.active_stereo import ActiveStereo
from active6d_sim.rendering.simulator import Simulator

VIEWS = [40, 63]
CAMERA = PinholeCamera.from_field_of_view(240, 180, 40.0)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bop")
    model = load_object("mug")
    assert export_scenes(folder, model, "test", [three_mugs()], VIEWS, "active_stereo", camera=CAMERA) == 1
    return folder, model


def test_what_is_read_back_is_what_was_rendered(exported):
    folder, model = exported
    scene = BopScene.load(folder / "test" / "000000")
    simulator = Simulator(three_mugs(), CAMERA, ActiveStereo(), 0)
    for index, view in enumerate(VIEWS):
        rendered = simulator.capture(SPHERE.pose(SPHERE.positions[view]), view + 1)
        found = scene.view(index, 0)
        np.testing.assert_array_equal(found.color, rendered.color)
        np.testing.assert_allclose(found.depth, rendered.depth, atol=0.5e-4 + 1e-7)
        np.testing.assert_allclose(found.T_world_camera, rendered.T_world_camera, atol=1e-9)
        assert found.camera == CAMERA
        back = model.T_camera_object(scene.T_world_object(index))
        np.testing.assert_allclose(back, three_mugs().T_world_object, atol=1e-9)


def test_the_model_at_its_poses_is_what_was_measured(exported):
    """By BOP's own definitions alone: millimetres, the model file's frame, row-major matrices."""
    folder, _ = exported
    mesh = trimesh.load_mesh(folder / "models" / "obj_000001.ply")
    surface = np.asarray(trimesh.sample.sample_surface(mesh, 20000, seed=0)[0])
    scene = folder / "test" / "000000"
    camera = json.loads((scene / "scene_camera.json").read_text())["0"]
    truth = json.loads((scene / "scene_gt.json").read_text())["0"]
    depth = np.asarray(Image.open(scene / "depth" / "000000.png")) * camera["depth_scale"]
    fx, _, cx, _, fy, cy = camera["cam_K"][:6]
    v, u = np.nonzero(depth)
    points = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones(len(u))], axis=1) * depth[v, u][:, None]
    posed = [surface @ np.reshape(entry["cam_R_m2c"], (3, 3)).T + entry["cam_t_m2c"] for entry in truth]
    R, t = np.reshape(camera["cam_R_w2c"], (3, 3)), np.array(camera["cam_t_w2c"])
    middles = np.array([(each.mean(axis=0) - t) @ R for each in posed])
    world = (points - t) @ R
    # Around an object and above the floor there is nothing else.
    near = np.linalg.norm(world[:, None, :2] - middles[None, :, :2], axis=-1).min(axis=1) < 40
    distance, _ = cKDTree(np.concatenate(posed)).query(points[near & (world[:, 2] > 15)][::5])
    assert len(distance) > 50
    assert np.median(distance) < 3


@pytest.mark.parametrize("name", ["mug", "coffee_cup"])
def test_symmetries_map_the_model_file_onto_itself(tmp_path, name):
    model = load_object(name)
    write_model(tmp_path, model, 7)
    info = json.loads((tmp_path / "models_info.json").read_text())["7"]
    vertices = np.asarray(trimesh.load_mesh(tmp_path / "obj_000007.ply").vertices)
    assert info["diameter"] == pytest.approx(1e3 * model.diameter)
    np.testing.assert_allclose([info[f"min_{axis}"] for axis in "xyz"], vertices.min(axis=0), atol=1e-3)
    assert ("symmetries_continuous" in info) == (model.symmetry.axis is not None)
    if "symmetries_continuous" in info:
        axis, offset = (np.array(info["symmetries_continuous"][0][key]) for key in ("axis", "offset"))
        radius = np.linalg.norm(np.cross(vertices - offset, axis), axis=1)
        height = (vertices - offset) @ axis
        # every ring of a body of revolution: one radius at one height
        for level in np.unique(height.round(3))[::5]:
            ring = radius[np.abs(height - level) < 1e-3]
            assert len(np.unique(ring.round(2))) <= 3
