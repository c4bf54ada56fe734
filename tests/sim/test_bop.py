"""Scenes in BOP's format: what is written is read again, and broken recordings are named by file and key."""

import json

import numpy as np
import pytest
from hand_made_scenes import CAMERA
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image
from scipy.spatial.transform import Rotation

from active6d_core.camera import PinholeCamera, View
from active6d_core.se3 import invert, look_at, make_transform
from active6d_sim.datasets.bop import BopScene, write_bop_scene

EYES = [(0.5, 0.1, 0.6), (-0.4, 0.5, 0.5), (0.02, -0.7, 0.4)]
ROTATIONS = Rotation.from_euler("xyz", [[10, 20, 30], [200, -40, 5], [0, 0, 90], [-70, 80, 160]], degrees=True)
T_WORLD_OBJECT = make_transform(ROTATIONS.as_matrix(), np.linspace(-0.2, 0.2, 12).reshape(4, 3))
VISIBLE = np.linspace(0, 1, 12).reshape(3, 4)


def make_views():
    rng = np.random.default_rng(0)
    for number, eye in enumerate(EYES):
        depth = rng.uniform(0.3, 1.5, (CAMERA.height, CAMERA.width)).astype(np.float32)
        depth[rng.random(depth.shape) < 0.2] = np.nan
        color = rng.integers(0, 256, (*depth.shape, 3)).astype(np.uint8)
        yield View(number, color, depth, CAMERA, look_at(eye, (0, 0, 0)))


@pytest.fixture
def folder(tmp_path):
    write_bop_scene(tmp_path / "scene", make_views(), T_WORLD_OBJECT, 7, visible_fraction=VISIBLE)
    return tmp_path / "scene"


def test_round_trip(folder):
    scene = BopScene.load(folder)
    assert (len(scene), scene.image_ids) == (3, (0, 1, 2))
    for index, view in enumerate(make_views()):
        read = scene.view(index, 123)
        assert (read.stamp, read.camera) == (123, CAMERA)
        np.testing.assert_array_equal(read.color, view.color)
        np.testing.assert_array_equal(np.isnan(read.depth), np.isnan(view.depth))
        assert np.nanmax(np.abs(read.depth - view.depth)) <= 0.5e-4 + 1e-7  # half a step of 0.1 mm, and float32
        np.testing.assert_allclose(read.T_world_camera, view.T_world_camera, atol=1e-12)
        np.testing.assert_allclose(scene.T_world_object(index), T_WORLD_OBJECT, atol=1e-12)
        truth, in_camera = scene.truth[index], invert(view.T_world_camera) @ T_WORLD_OBJECT
        np.testing.assert_allclose(truth.T_camera_object, in_camera, atol=1e-12)
        np.testing.assert_array_equal(truth.object_id, [7] * 4)
        np.testing.assert_allclose(truth.visible_fraction, VISIBLE[index])
    assert len(scene.T_world_object(0, 7)) == 4
    assert scene.T_world_object(0, 8).shape == (0, 4, 4)


def test_files_are_as_bop_says(folder):
    """By hand from the JSON: millimetres, row-major, world to camera, model to camera."""
    view = next(make_views())
    entry = json.loads((folder / "scene_camera.json").read_text())["0"]
    assert entry["cam_K"] == [55.0, 0.0, 30.7, 0.0, 57.0, 24.2, 0.0, 0.0, 1.0]
    point = np.array([0.1, -0.2, 0.3])
    in_camera = np.reshape(entry["cam_R_w2c"], (3, 3)) @ (1e3 * point) + entry["cam_t_w2c"]
    np.testing.assert_allclose(in_camera, 1e3 * (invert(view.T_world_camera) @ [*point, 1])[:3])
    truth = json.loads((folder / "scene_gt.json").read_text())["0"][2]
    in_camera = np.reshape(truth["cam_R_m2c"], (3, 3)) @ (1e3 * point) + truth["cam_t_m2c"]
    np.testing.assert_allclose(in_camera, 1e3 * (invert(view.T_world_camera) @ T_WORLD_OBJECT[2] @ [*point, 1])[:3])
    assert truth["obj_id"] == 7
    with Image.open(folder / "depth" / "000000.png") as picture:
        assert picture.mode == "I;16"
        millimetres = np.array(picture) * entry["depth_scale"]
    assert np.nanmax(np.abs(millimetres - 1e3 * view.depth)) <= 0.05 + 1e-4


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=25, deadline=None)
@given(
    depth=arrays(np.float32, (6, 8), elements=st.one_of(st.floats(0, 30, width=32), st.just(np.nan), st.just(np.inf))),
    scale=st.sampled_from([0.05, 0.1, 1.0]),
)
def test_depth_is_off_by_half_a_step_at_most(depth, scale, tmp_path_factory):
    folder = tmp_path_factory.mktemp("bop")
    view = View(0, np.zeros((6, 8, 3), np.uint8), depth, PinholeCamera(8, 6, 5, 5, 4, 3), look_at((1, 0, 1), (0, 0, 0)))
    write_bop_scene(folder, [view], np.zeros((0, 4, 4)), depth_scale=scale)
    read = BopScene.load(folder).view(0, 0).depth
    step, kept = scale * 1e-3, np.isfinite(read)
    assert (np.abs(read - depth)[kept] <= step / 2 + 1e-6 * depth[kept]).all()
    # Nothing else gets lost than what is nearer than half a step or beyond 16 bits.
    lost = np.isfinite(depth) & ~kept
    assert ((depth[lost] <= step / 2) | (depth[lost] >= 65535 * step)).all()


def test_ground_truth_is_optional(folder):
    for name in ("scene_gt_info.json", "scene_gt.json"):
        (folder / name).unlink()
        scene = BopScene.load(folder)
        if name == "scene_gt_info.json":
            assert np.isnan(scene.truth[0].visible_fraction).all()
    assert scene.truth is None
    with pytest.raises(ValueError, match=r"scene_gt\.json: no such file"):
        scene.T_world_object(0)


def test_published_variants_are_read(folder):
    """JPEG and grey colour, image numbers with gaps, rotations rounded to six digits."""
    rename = {"0": "12", "1": "3", "2": "2"}
    for name in ("scene_camera.json", "scene_gt.json", "scene_gt_info.json"):
        content = json.loads((folder / name).read_text())
        if name == "scene_camera.json":
            for entry in content.values():
                entry["cam_R_w2c"] = [round(value, 6) for value in entry["cam_R_w2c"]]
        (folder / name).write_text(json.dumps({rename[key]: value for key, value in content.items()}))
    for old, new in rename.items():
        (folder / "depth" / f"00000{old}.png").rename(folder / "depth" / f"x{int(new):06d}.png")
        (folder / "rgb" / f"00000{old}.png").unlink()
        Image.new("L", (64, 48), int(new)).save(folder / "rgb" / f"{int(new):06d}.jpg")
    for path in (folder / "depth").glob("x*"):
        path.rename(path.with_name(path.name[1:]))
    scene = BopScene.load(folder)
    assert scene.image_ids == (2, 3, 12)
    first, _, last = make_views()
    np.testing.assert_allclose(scene.T_world_camera[[0, 2]], [last.T_world_camera, first.T_world_camera], atol=2e-6)
    np.testing.assert_allclose(scene.view(2, 0).depth, first.depth, atol=1e-4)
    np.testing.assert_array_equal(scene.view(2, 0).color, np.full((48, 64, 3), 12))


def test_nearest_by_direction(folder):
    scene = BopScene.load(folder)
    for index, eye in enumerate(EYES):
        assert scene.nearest(3.0 * np.array(eye) + 0.05) == index


def spoil(folder, name, change):
    path = folder / name
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


@pytest.mark.parametrize("key", ["cam_K", "depth_scale", "cam_R_w2c", "cam_t_w2c"])
@pytest.mark.parametrize("value", [None, "text", [1, 2], [[1], [2, 3]], [float("nan")] * 9])
def test_bad_camera_keys_are_named(folder, key, value):
    spoil(folder, "scene_camera.json", lambda content: content["1"].update({key: value}))
    with pytest.raises(ValueError, match=rf"scene_camera\.json: image 1: {key} must be"):
        BopScene.load(folder)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("scene_camera.json", lambda c: c["2"].pop("cam_R_w2c"), r"scene_camera\.json: image 2: no key cam_R_w2c"),
        ("scene_camera.json", lambda c: c["0"].update(cam_K=[0.0] * 9), "image 0: cam_K: K must be"),
        ("scene_camera.json", lambda c: c["0"].update(cam_K=[55, 0, 0, 0, 55, 0, 30, 24, 1]), "is it transposed"),
        ("scene_camera.json", lambda c: c["0"].update(cam_K=[1, 0, 0, 0, 1, 0, 0, 0, 1]), "impossible for 64x48"),
        ("scene_camera.json", lambda c: c["0"].update(cam_K=[55, 0, 900, 0, 55, 24, 0, 0, 1]), "outside the 64x48"),
        ("scene_camera.json", lambda c: c["0"].update(depth_scale=0), "depth_scale must be positive"),
        ("scene_camera.json", lambda c: c["0"].update(cam_R_w2c=[1, 0, 0, 0, 1, 0, 0, 0, -1]), "cam_R_w2c is not a"),
        ("scene_camera.json", lambda c: c["0"].update(cam_t_w2c=[0, 0, 0]), "cam_t_w2c puts the camera at"),
        ("scene_camera.json", lambda c: c.update({"9": c["0"]}), r"000009\.png: no such file, but scene_camera\.json"),
        ("scene_camera.json", lambda c: c.update(x=1), r"scene_camera\.json: must map image numbers"),
        ("scene_camera.json", lambda c: c.clear(), r"scene_camera\.json: no image"),
        ("scene_camera.json", lambda c: c.update({"0": 5}), "image 0: no key"),
        ("scene_gt.json", lambda c: c["1"][2].pop("obj_id"), r"scene_gt\.json: image 1: no key obj_id"),
        ("scene_gt.json", lambda c: c["1"][2].update(cam_R_m2c=[2.0] * 9), "cam_R_m2c is not a rotation"),
        ("scene_gt.json", lambda c: c.update({"1": {}}), r"scene_gt\.json: image 1: no list of objects"),
        ("scene_gt_info.json", lambda c: c["1"].pop(), r"info\.json: image 1: 3 objects, scene_gt\.json has 4"),
        ("scene_gt_info.json", lambda c: c["1"].__setitem__(0, 0.5), "image 1: no key visib_fract"),
        ("scene_gt_info.json", lambda c: c["1"][0].update(visib_fract="x"), "image 1: visib_fract must be 1 numbers"),
        ("scene_gt_info.json", lambda c: c.update({"1": 3}), r"info\.json: image 1: no list of objects"),
    ],
)
def test_broken_entries_are_named(folder, name, change, message):
    spoil(folder, name, change)
    with pytest.raises(ValueError, match=message):
        BopScene.load(folder)


def test_what_is_not_labelled_is_no_error(folder):
    """Images without labels, and objects without a visible fraction, occur in published data sets."""
    spoil(folder, "scene_gt.json", lambda c: c.pop("1"))
    spoil(folder, "scene_gt_info.json", lambda c: (c["0"][2].pop("visib_fract"), c.pop("2")))
    first, second, third = BopScene.load(folder).truth
    np.testing.assert_allclose(first.visible_fraction, [*VISIBLE[0, :2], np.nan, VISIBLE[0, 3]])
    assert second.object_id.shape == (0,)
    assert second.T_camera_object.shape == (0, 4, 4)
    assert np.isnan(third.visible_fraction).all()
    assert len(third.object_id) == 4


def test_a_part_of_a_larger_image_is_read(folder):
    spoil(folder, "scene_camera.json", lambda c: c["0"].update(cam_K=[55, 0, 90, 0, 55, 24, 0, 0, 1]))
    assert BopScene.load(folder).cameras[0].cx == 90


def test_a_world_at_the_first_camera_is_read_where_no_poses_are_needed(folder):
    spoil(folder, "scene_camera.json", lambda c: c["0"].update(cam_t_w2c=[0, 0, 0]))
    with pytest.raises(ValueError, match="puts the camera at"):
        BopScene.load(folder)
    assert BopScene.load(folder, needs_poses=False).has_pose.all()


def test_whether_an_image_has_a_pose_is_recorded(folder):
    """An identity can be a pose: a world may be the first camera's frame."""
    identity = {"cam_R_w2c": np.eye(3).ravel().tolist(), "cam_t_w2c": [0, 0, 0]}

    def change(content):
        content["0"].update(identity)
        for key in identity:
            content["1"].pop(key)

    spoil(folder, "scene_camera.json", change)
    scene = BopScene.load(folder, needs_poses=False)
    np.testing.assert_array_equal(scene.has_pose, [True, False, True])
    np.testing.assert_array_equal(scene.T_world_camera[:2], [np.eye(4)] * 2)
    np.testing.assert_array_equal(scene.take([1, 2]).has_pose, [False, True])


@pytest.mark.parametrize("text", ["", "{", "[1]", "\udcff", "[" * 100_000])
def test_what_is_no_json_is_named(folder, text):
    (folder / "scene_camera.json").write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(ValueError, match=r"scene_camera\.json"):
        BopScene.load(folder)


def test_missing_folders_are_named(folder, tmp_path):
    with pytest.raises(ValueError, match="nowhere: no such folder"):
        BopScene.load(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match=r"empty/scene_camera\.json: no such file; a BOP scene folder needs it$"):
        BopScene.load(tmp_path / "empty")
    with pytest.raises(ValueError, match=rf"it has \d+ scenes: give one of them, such as {folder.parent}/"):
        BopScene.load(folder.parent)


def test_broken_images_are_named(folder):
    depth, color = folder / "depth" / "000001.png", folder / "rgb" / "000001.png"
    scene = BopScene.load(folder)
    whole = depth.read_bytes()
    depth.write_bytes(whole[:200])
    with pytest.raises(ValueError, match=r"depth/000001\.png: not a readable image"):
        scene.view(1, 0)
    scene.view(0, 0)
    Image.new("RGB", (64, 48)).save(depth)
    with pytest.raises(ValueError, match=r"depth/000001\.png: is a colour image, depth needs 16-bit"):
        scene.view(1, 0)
    depth.write_bytes(b"no image")
    with pytest.raises(ValueError, match=r"depth/000001\.png: not an image"):
        BopScene.load(folder)
    depth.write_bytes(whole)
    Image.new("RGB", (32, 48)).save(color)
    with pytest.raises(ValueError, match=r"rgb/000001\.png: is .32, 48. pixels"):
        BopScene.load(folder)
    with pytest.raises(ValueError, match=r"rgb/000001\.png: is .32, 48. pixels, was .64, 48."):
        scene.view(1, 0)


def test_writing_refuses(folder, tmp_path):
    with pytest.raises(ValueError, match=r"scene_camera\.json exists already"):
        write_bop_scene(folder, make_views(), T_WORLD_OBJECT)
    for arguments in ({"object_id": 0}, {"depth_scale": 0.0}):
        with pytest.raises(ValueError, match="BOP counts objects from 1 and scales are positive"):
            write_bop_scene(tmp_path / "new", make_views(), T_WORLD_OBJECT, **arguments)
    with pytest.raises(ValueError, match=r"visible_fraction has shape \(4, 3\), expected \(3, 4\)"):
        write_bop_scene(tmp_path / "new", make_views(), T_WORLD_OBJECT, visible_fraction=VISIBLE.T)
