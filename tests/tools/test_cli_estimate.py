"""`active6d estimate` on a recorded scene: the CSV file holds poses of the mesh file, and errors name their cause."""

import csv
import json
import shutil
import weakref
from types import SimpleNamespace

import numpy as np
import pytest
from hand_made_scenes import CAMERA
from PIL import Image
from typer.testing import CliRunner

from active6d_core.camera import View
from active6d_core.hypotheses import Hypotheses
from active6d_core.object_model import load_object
from active6d_core.view_sphere import ViewSphere
from active6d_sim.datasets.bop import write_bop_scene
from active6d_sim.rendering.simulator import Simulator
from active6d_sim.scenes.scene_store import load_scene
from active6d_tools.cli import app
from active6d_tools.cli.estimate import _draw_each
from active6d_tools.image_estimation import ImageResult


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Two views of a stored heap of cups, as a BOP scene without camera poses."""
    folder = tmp_path_factory.mktemp("bop") / "000007"
    sphere, heap = ViewSphere(), load_scene("coffee_cup", "test", 1)
    simulator = Simulator(heap, seed=0)
    views = [simulator.capture(sphere.pose(sphere.positions[index]), index) for index in (42, 77)]
    write_bop_scene(folder, views, heap.T_world_object)
    path = folder / "scene_camera.json"
    entries = {
        image: {key: value for key, value in entry.items() if not key.endswith("w2c")}
        for image, entry in json.loads(path.read_text()).items()
    }
    path.write_text(json.dumps(entries))
    return folder


def rows(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def test_results_are_poses_of_the_mesh_file(scene, tmp_path):
    run = CliRunner().invoke(app, ["estimate", str(scene), "--object", "coffee_cup", "--out", str(tmp_path)])
    assert run.exit_code == 0, run.output
    found = rows(tmp_path / "results.csv")
    assert {(row["scene_id"], row["im_id"], row["obj_id"]) for row in found} == {("7", "0", "1"), ("7", "1", "1")}
    # The cup's profile stands on z = 0 of its own frame; BOP's truth, as written here, is in the object frame.
    truth = json.loads((scene / "scene_gt.json").read_text())
    origin = 1e3 * load_object("coffee_cup").origin
    near = 0
    for row in found:
        R = np.reshape([float(value) for value in row["R"].split()], (3, 3))
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-6)
        centre = R @ origin + [float(value) for value in row["t"].split()]
        apart = [np.linalg.norm(centre - entry["cam_t_m2c"]) for entry in truth[row["im_id"]]]
        near += min(apart) < 10.0
    assert near >= 0.8 * len(found) >= 10
    for image in ("000000", "000001"):
        with Image.open(tmp_path / "overlays" / f"{image}.png") as picture:
            assert picture.size == (640, 480)


def test_one_image_gives_the_same_as_its_scene(scene, tmp_path):
    K = json.loads((scene / "scene_camera.json").read_text())["0"]
    (tmp_path / "k.json").write_text(json.dumps({"cam_K": K["cam_K"]}))
    images = ["--rgb", str(scene / "rgb/000000.png"), "--depth", str(scene / "depth/000000.png")]
    options = ["--intrinsics", str(tmp_path / "k.json"), "--depth-scale", "1e-4", "--object", "coffee_cup"]
    single, whole = tmp_path / "single", tmp_path / "whole"
    run = CliRunner().invoke(app, ["estimate", *images, *options, "--out", str(single)])
    assert run.exit_code == 0, run.output
    CliRunner().invoke(app, ["estimate", str(scene), "--object", "coffee_cup", "--out", str(whole)])
    expected = [row["t"] for row in rows(whole / "results.csv") if row["im_id"] == "0"]
    assert [row["t"] for row in rows(single / "results.csv")] == expected


@pytest.mark.parametrize(
    ("arguments", "cause"),
    [
        ([], "give a scene folder"),
        (["nowhere"], "nowhere: no such folder"),
        (["SCENE", "--range", "5", "6"], "no depth pixel is inside"),
        (["SCENE", "--range", "2", "1"], "near < far"),
        (["SCENE", "--rgb", "x.png"], "either a scene folder"),
        (["SCENE", "--region-in-world"], "--region-in-world needs --region"),
        (["SCENE", "--object", "teapot"], "unknown object 'teapot'"),
        (["SCENE", "--estimator", "magic"], "unknown estimator 'magic'"),
    ],
)
def test_errors_name_their_cause(scene, tmp_path, arguments, cause):
    arguments = [str(scene) if argument == "SCENE" else argument for argument in arguments]
    run = CliRunner().invoke(app, ["estimate", "--object", "coffee_cup", *arguments, "--out", str(tmp_path)])
    assert run.exit_code == 2
    assert cause in run.stderr


def test_an_image_that_cannot_be_used_is_left_out_and_told(scene, tmp_path):
    copy = tmp_path / "000007"
    shutil.copytree(scene, copy)
    Image.fromarray(np.zeros((480, 640), np.uint16)).save(copy / "depth" / "000000.png")
    out, told = tmp_path / "out", tmp_path / "told.json"
    options = ["--object", "coffee_cup", "--out", str(out), "--json", str(told)]
    run = CliRunner().invoke(app, ["estimate", str(copy), *options])
    assert run.exit_code == 1
    assert {row["im_id"] for row in rows(out / "results.csv")} == {"1"}
    (reason,) = json.loads(told.read_text())["left_out"]
    assert reason.startswith("image 0 is left out: depth has no valid pixel")
    assert reason in " ".join(run.stderr.split())


def test_images_are_not_kept(tmp_path):
    """A scene can have thousands: of each, its poses and scores stay, not its view and masks."""
    alive, views = [], weakref.WeakSet()

    def found():
        for number in range(6):
            alive.append(len(views))
            view = View(number, np.zeros((12, 16, 3), np.uint8), np.ones((12, 16), np.float32), CAMERA, np.eye(4))
            views.add(view)
            T, nothing = np.eye(4)[None], np.zeros((12, 16), np.uint16)
            one = Hypotheses(T, np.array([0.7]), np.zeros((1, 4)), np.ones(1), np.ones(1, np.uint16), nothing)
            yield ImageResult(3, number, view, one, 0.5)

    overlay = SimpleNamespace(draw=lambda view, shown: Image.fromarray(view.color))
    results = _draw_each(found(), 6, overlay, tmp_path, 0.5)
    told = [(each.image_id, each.score.tolist(), each.seconds) for each in results]
    assert told == [(number, [0.7], 0.5) for number in range(6)]
    assert max(alive) <= 2
    assert len(list(tmp_path.glob("*.png"))) == 6
