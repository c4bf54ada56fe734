"""`active6d evaluate --bop`: recorded views, scored the same by an independent calculation from the results file."""

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from hand_made_scenes import SPHERE
from PIL import Image
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from active6d_core.camera import PinholeCamera, View, backproject, project
from active6d_core.hypotheses import Hypotheses
from active6d_core.object_model import load_object
from active6d_core.se3 import invert, look_at, make_transform, rotation_angle
from active6d_perception.estimators.registry import register_estimator
from active6d_perception.scene import camera_alignment
from active6d_sim.datasets.bop import BopScene, ImageTruth, write_bop_scene
from active6d_sim.datasets.bop_export import write_model
from active6d_sim.datasets.bop_models import differs_from_data_set
from active6d_sim.rendering.active_stereo import ActiveStereo
from active6d_sim.rendering.simulator import Simulator
from active6d_sim.scenes.scene_store import load_scene
from active6d_tools.bop_results import BopEstimates, number_scenes, once_per_image
from active6d_tools.cli import app
from active6d_tools.direct_episode import Perception
from active6d_tools.recorded_evaluation import RecordedEvaluation, _choose, _place, _reasons
from active6d_tools.recorded_scene import RecordedScene, TrueObjects, find_bin, looks_down, turn_boxes
from active6d_tools.view_registration import _Placing, register_views

CAMERA = PinholeCamera.from_field_of_view(160, 120, 60.0)
VIEWS = (21, 26, 33, 41, 45, 48, 52, 57, 63, 70, 78, 90)
#: The recording's world is not the bin's.
SHIFT = np.array([0.4, -0.3, 0.2])
MODEL = load_object("mug")


@register_estimator("recorded-truth")
class RecordedTruth:
    """Finds what the image in the first pixel's number shows at least half of, some of it wrong."""

    poses: dict[int, np.ndarray] = {}  # noqa: RUF012
    calls = 0

    def __init__(self, model):
        pass

    def estimate(self, view):
        RecordedTruth.calls += 1
        T = self.poses[int(view.color[0, 0, 0])]
        rng = np.random.default_rng(int(view.color[0, 0, 0]))
        T = T @ make_transform(
            Rotation.from_rotvec(rng.normal(0, 0.12, (len(T), 3))).as_matrix(), rng.normal(0, 0.004, (len(T), 3))
        )
        middle = project(T[:, :3, 3], CAMERA)
        box = np.concatenate([middle - 9, middle + 9], axis=1) / np.tile([CAMERA.width, CAMERA.height], 2)
        labels = np.zeros((CAMERA.height, CAMERA.width), np.uint16)
        for label, (u, v) in enumerate(middle.astype(int), start=1):
            labels[max(v - 9, 0) : v + 9, max(u - 9, 0) : u + 9] = label
        score = rng.uniform(0.6, 1.0, len(T))
        numbers = np.arange(1, len(T) + 1, dtype=np.uint16)
        return Hypotheses(T, score, np.clip(box, 0, 1), T[:, 2, 3], numbers, labels)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """A heap in a world that is shifted, taken by cameras that are turned about their optical axes."""
    folder = tmp_path_factory.mktemp("bop")
    heap = load_scene("mug", "test", 1)
    simulator, rng = Simulator(heap, CAMERA, ActiveStereo().scaled(0.0)), np.random.default_rng(0)
    views = []
    for number, index in enumerate(VIEWS):
        turn = Rotation.from_rotvec([0, 0, rng.uniform(-np.pi, np.pi)]).as_matrix()
        T = SPHERE.pose(SPHERE.positions[index]) @ make_transform(turn, np.zeros(3))
        view = simulator.capture(T, number + 1)
        view.color[0, 0] = number
        seen = heap.visible_fraction[index] > 0.5
        RecordedTruth.poses[number] = invert(T) @ heap.T_world_object[seen]
        view.T_world_camera[:3, 3] += SHIFT
        views.append(view)
    shifted = make_transform(np.eye(3), SHIFT) @ heap.T_world_object
    visible = heap.visible_fraction[list(VIEWS)]
    write_bop_scene(folder / "test" / "000003", views, MODEL.T_camera_mesh(shifted), visible_fraction=visible)
    write_model(folder / "models", MODEL)
    return folder


def run(*arguments):
    return CliRunner().invoke(
        app, ["evaluate", "--object", "mug", "--estimator", "recorded-truth", *map(str, arguments)]
    )


def independent_scores(folder, results):
    """Detection rate and mean ADD in millimetres from BOP's files, by numpy and trimesh alone."""
    with results.open() as file:
        rows = list(csv.DictReader(file))
    scene = folder / "test" / "000003"
    cameras, truths = (json.loads((scene / f"scene_{name}.json").read_text()) for name in ("camera", "gt"))
    surface = np.array(trimesh.load_mesh(folder / "models" / "obj_000001.ply").sample(4000, seed=1))
    image = cameras[rows[0]["im_id"]]
    R_w, t_w = np.reshape(image["cam_R_w2c"], (3, 3)), np.array(image["cam_t_w2c"])

    def posed(R, t):
        return surface @ np.reshape(np.array(R, float), (3, 3)).T + np.array(t, float)

    found = [(posed(row["R"].split(), row["t"].split()) - t_w) @ R_w for row in rows]
    own = cameras["0"]
    R_0, t_0 = np.reshape(own["cam_R_w2c"], (3, 3)), np.array(own["cam_t_w2c"])
    true = [(posed(entry["cam_R_m2c"], entry["cam_t_m2c"]) - t_0) @ R_0 for entry in truths["0"]]
    infos = json.loads((scene / "scene_gt_info.json").read_text())
    shown = np.max([[entry["visib_fract"] for entry in infos[image]] for image in infos], axis=0)
    true = [points for points, most in zip(true, shown, strict=True) if most >= 0.1]
    errors = np.array([[np.linalg.norm(a - b, axis=1).mean() for b in true] for a in found])
    errors = np.minimum(errors, 50.0)
    rows_, columns = linear_sum_assignment(errors)
    error = np.full(len(true), 50.0)
    error[columns] = errors[rows_, columns]
    return (error < 0.1 * 1e3 * MODEL.diameter).mean(), error.mean()


def test_the_results_file_scores_the_same_by_an_independent_calculation(dataset, tmp_path):
    told = tmp_path / "told.json"
    options = "--policies", "random", "--steps", 3, "--starts", 1, "--csv", tmp_path, "--json", told
    result = run("--bop", dataset, *options)
    assert result.exit_code == 0, result.output
    summary = json.loads(told.read_text())
    rate, error = independent_scores(dataset, tmp_path / f"random_{dataset.name}-test.csv")
    assert 0.3 < summary["policies"]["random"]["detection_rate"] < 1.0
    assert summary["policies"]["random"]["detection_rate"] == pytest.approx(rate, abs=1e-9)
    assert summary["policies"]["random"]["e_add_mm"] == pytest.approx(error, rel=0.03)
    (views,) = summary["views"]["random"]
    assert len(set(views)) == 4
    assert summary["starts"] == [[0, views[0]]]
    assert summary["scene_folders"] == ["000003"]
    assert summary["policies"]["random"]["detection_rate_ci95_scenes"] is None, "there is one scene"


def test_scenes_without_camera_poses_are_placed_by_their_objects(dataset, tmp_path):
    entries = json.loads((dataset / "test" / "000003" / "scene_camera.json").read_text())
    copy = tmp_path / "000003"
    shutil.copytree(dataset / "test" / "000003", copy)
    show_something_else(copy / "rgb" / "000005.png")
    bare = {key: {k: v for k, v in entry.items() if not k.endswith("w2c")} for key, entry in entries.items()}
    (copy / "scene_camera.json").write_text(json.dumps(bare))
    RecordedTruth.calls = 0
    result = run("--bop", copy, "--policies", "random", "--steps", 3, "--starts", 1, "--json", tmp_path / "told.json")
    assert result.exit_code == 0, result.output
    assert RecordedTruth.calls == 12, "images are estimated once"
    words = " ".join(result.output.split())
    assert "11 images are placed by the objects in them" in words
    assert "1 of 12 images cannot be placed and are left out: image 5: at most" in words
    assert json.loads((tmp_path / "told.json").read_text())["policies"]["random"]["detection_rate"] > 0.7
    bare["4"] |= {key: entries["4"][key] for key in ("cam_R_w2c", "cam_t_w2c")}
    (copy / "scene_camera.json").write_text(json.dumps(bare))
    result = run("--bop", copy, "--policies", "random")
    assert result.exit_code == 2
    assert "11 of 12 images have no camera pose" in result.output


def test_the_results_file_has_the_poses_in_the_images_though_cameras_are_off(dataset, tmp_path):
    """Cameras are said to be some 12 mm from where they were; objects are right in their images all the same."""
    copy, rng = tmp_path / "000003", np.random.default_rng(4)
    shutil.copytree(dataset / "test" / "000003", copy)
    entries = json.loads((copy / "scene_camera.json").read_text())
    for entry in entries.values():
        entry["cam_t_w2c"] = (np.array(entry["cam_t_w2c"]) + rng.normal(0, 7.0, 3)).tolist()
    (copy / "scene_camera.json").write_text(json.dumps(entries))
    result = run("--bop", copy, "--policies", "random", "--steps", 5, "--starts", 1, "--csv", tmp_path)
    assert result.exit_code == 0, result.output
    (file,) = tmp_path.glob("*.csv")
    with file.open() as opened:
        rows = list(csv.DictReader(opened))
    truths = json.loads((copy / "scene_gt.json").read_text())
    surface = np.array(MODEL.mesh.vertices) * 1e3

    def posed(R, t):
        return surface @ np.reshape(np.array(R, float), (3, 3)).T + np.array(t, float)

    true = [posed(entry["cam_R_m2c"], entry["cam_t_m2c"]) for entry in truths[rows[0]["im_id"]]]
    errors = [
        min(np.linalg.norm(posed(row["R"].split(), row["t"].split()) - one, axis=1).mean() for one in true)
        for row in rows
        if float(row["score"]) > 0.5
    ]
    assert len(errors) > 5
    assert np.median(errors) < 2.5


def test_images_that_fit_no_other_are_named(dataset, monkeypatch):
    options = "--bop", dataset, "--policies", "random", "--steps", 3, "--starts", 1
    assert "could not be aligned" not in run(*options).output
    alone = camera_alignment.Alignment(np.eye(4), aligned=False)
    monkeypatch.setattr(camera_alignment, "_align", lambda *arguments: alone)
    words = " ".join(run(*options).output.split())
    assert "random: 3 views, of 3 images (such as 000003/" in words
    assert "could not be aligned by their depth with those before them; there, the given camera poses" in words


def show_something_else(path):
    """In this image, the estimator finds objects that no other image shows."""
    rng, number = np.random.default_rng(0), 99
    pixels = np.array(Image.open(path))
    pixels[0, 0] = number
    Image.fromarray(pixels).save(path)
    t = np.array([0.0, 0.0, 0.8]) + rng.uniform(-0.15, 0.15, (9, 3))
    RecordedTruth.poses[number] = make_transform(Rotation.random(9, rng=rng).as_matrix(), t)


def seen_by(cameras, poses, rng, *, off, wrong=0):
    """What each camera sees of objects, in its frame: 70 % of them, with errors; the first ``wrong`` at random."""
    found = []
    for camera in cameras:
        T = invert(camera) @ poses[rng.permutation(len(poses))[: int(0.7 * len(poses))]]
        T[:, :3, 3] += rng.normal(0, off, (len(T), 3))
        T[:wrong, :3, :3] = Rotation.random(wrong, rng=rng).as_matrix() if wrong else T[:0, :3, :3]
        found.append(T)
    return found


@pytest.mark.parametrize(("off", "wrong"), [(0.001, 0), (0.004, 3)])
def test_placed_cameras_are_where_they_were(dataset, off, wrong):
    T = BopScene.load(dataset / "test" / "000003").T_world_camera[:5]
    heap = make_transform(np.eye(3), SHIFT) @ load_scene("mug", "test", 1).T_world_object
    found = seen_by(T, heap, np.random.default_rng(3), off=off, wrong=wrong)
    placed, left_out = register_views(found, MODEL)
    assert not left_out
    error = invert(invert(T[0]) @ T) @ np.array([placed[index] for index in range(5)])
    assert np.degrees(rotation_angle(error[:, :3, :3], np.eye(3))).max() < 1.0 + 750 * off
    assert np.linalg.norm(error[:, :3, 3], axis=1).max() < 0.01 + 12 * off


def test_images_that_share_too_little_are_not_placed(dataset):
    T, rng = BopScene.load(dataset / "test" / "000003").T_world_camera[:2], np.random.default_rng(3)
    first, second = seen_by(T, load_scene("mug", "test", 1).T_world_object, rng, off=0.001)
    elsewhere = make_transform(Rotation.random(9, rng=rng).as_matrix(), rng.uniform(-0.2, 0.2, (9, 3)))
    placed, left_out = register_views([elsewhere, second[:3], first, second, second[:0]], MODEL)
    assert list(placed) == [2, 3]
    assert "objects agree with the other images, 5 must" in left_out[0]
    assert left_out[1] == "it shows 3 objects, and 5 must be shared"
    assert left_out[4] == "it shows 0 objects, and 5 must be shared"
    np.testing.assert_allclose(placed[2], np.eye(4), atol=1e-9)


def test_of_two_places_that_fit_the_rotations_choose(dataset):
    """Four objects stand at the corners of a square and one in its middle: the centres fit in four ways."""
    corners = np.array([[0, 0, 0], [1, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0]]) * 0.15
    poses = make_transform(Rotation.random(5, rng=np.random.default_rng(0)).as_matrix(), corners)
    T = np.array([SPHERE.pose(SPHERE.positions[index]) for index in (40, 52)])
    placed, _ = register_views([invert(camera) @ poses for camera in T], MODEL)
    np.testing.assert_allclose([placed[0], placed[1]], invert(T[0]) @ T, atol=1e-6)
    first, second = (invert(camera) @ poses for camera in T)
    second[:, :3, :3] = Rotation.random(5, rng=np.random.default_rng(1)).as_matrix()
    assert register_views([first, second], MODEL)[1] == {1: "two placements fit, with 5 and 5 objects"}


def test_boxes_are_turned_as_a_turned_camera_would_see_them():
    rng = np.random.default_rng(1)
    camera = PinholeCamera(64, 48, 55.0, 57.0, 30.7, 24.2)
    low = rng.uniform(0.3, 0.5, (20, 2))
    boxes = np.concatenate([low, low + rng.uniform(0.01, 0.15, (20, 2))], axis=1)
    turn = Rotation.from_rotvec([0, 0, 0.7]).as_matrix()
    turned = turn_boxes(boxes, turn[:2, :2], camera)
    size = np.array([64, 48])
    for box, found in zip(boxes, turned, strict=True):
        x, y = np.meshgrid(box[[0, 2]] * 64, box[[1, 3]] * 48)
        rays = np.stack([(x - 31.2) / 55.0, (y - 24.7) / 57.0, np.ones((2, 2))], axis=-1) @ turn.T
        pixels = (project(rays, camera) + 0.5).reshape(-1, 2) / size
        np.testing.assert_allclose(found, [*pixels.min(axis=0), *pixels.max(axis=0)], atol=1e-9)


def test_the_bin_is_where_the_cameras_look(dataset):
    scene = BopScene.load(dataset / "test" / "000003")
    told = []
    T = find_bin(scene, MODEL, told.append)
    assert "the cameras look at" in told[0]
    expected = np.array([SPHERE.positions[index] for index in VIEWS])
    np.testing.assert_allclose(T[:, :2, 3], expected[:, :2], atol=1e-6)
    # Little of the floor is seen under the heap.
    assert np.abs(T[:, 2, 3] - expected[:, 2]).max() < 0.003
    recorded = RecordedScene(scene, MODEL, None, Perception(MODEL, "recorded-truth"), T)
    assert recorded.sphere.radius == pytest.approx(0.8, abs=0.02)
    truth = recorded.truth(pytest.fail)
    assert len(truth.T_bin_object) == len(load_scene("mug", "test", 1))
    most = np.max([image.visible_fraction for image in scene.truth], axis=0)
    np.testing.assert_array_equal(truth.visible, most >= 0.1)


CUP = load_object("coffee_cup")


def labelled(images, *, shown=1.0):
    """The true objects of a scene whose images list these poses in the first camera's frame, and the warnings."""
    truth = [
        ImageTruth(np.ones(len(T), int), CUP.T_camera_mesh(T), np.full(len(T), fraction))
        for T, fraction in zip(images, np.broadcast_to(shown, len(images)), strict=True)
    ]
    scene, told = RecordedScene.__new__(RecordedScene), []
    scene.recording = SimpleNamespace(truth=truth, folder=Path("labelled"))
    scene.model, scene.T_bin_camera, scene._object_id = CUP, np.tile(np.eye(4), (len(images), 1, 1)), 1
    return scene.truth(told.append), told


def stacked(*heights, tilt=0.0):
    R = Rotation.from_euler("x", tilt, degrees=True).as_matrix()
    return make_transform(np.tile(R, (len(heights), 1, 1)), np.array([[0.0, 0.0, each] for each in heights]))


@pytest.mark.parametrize("apart", [0.010, 0.020, 0.030])
def test_nested_cups_stay_as_many_as_they_are(apart):
    """Labels are off by a third of their distance, and images list them in another order."""
    cups = apart * np.arange(3)
    images = [stacked(*cups), stacked(*(cups + apart / 3)[::-1]), stacked(*(cups - apart / 3)[[1, 2, 0]])]
    truth, told = labelled(images)
    np.testing.assert_allclose(truth.T_bin_object, images[0], atol=1e-9)
    assert not told


def test_one_object_in_several_poses_counts_once():
    """A label that is upside down is no second cup; a cup beside it is."""
    upside_down = stacked(0.004, tilt=180.0)
    truth, told = labelled([stacked(0.0), np.concatenate([upside_down, stacked(0.3)]), upside_down], shown=[0, 0, 1])
    np.testing.assert_allclose(truth.T_bin_object, stacked(0.0, 0.3), atol=1e-9)
    np.testing.assert_array_equal(truth.visible, [True, False])
    (text,) = told
    assert "2 labels are where an earlier image has an object in another pose" in text


def test_more_objects_than_an_image_lists_are_told():
    truth, told = labelled([stacked(0.0), stacked(0.3)])
    assert len(truth.T_bin_object) == 2
    assert told == [
        "labelled: 2 objects in all, but no image lists more than 1: labels are partial, or camera poses disagree"
    ]


def test_an_object_without_a_visible_label_is_no_wrong_one_to_find():
    """By hand: two cups are confirmed; one is barely visible and need not be found, the other is nowhere."""
    truth = TrueObjects(stacked(0.0, 0.3), np.array([True, False]))
    evaluation = RecordedEvaluation.__new__(RecordedEvaluation)
    evaluation._model, evaluation._steps, evaluation._truths = CUP, 1, [truth]
    evaluation._fusion = SimpleNamespace(parameters=SimpleNamespace(confirmed=0.5))
    path = SimpleNamespace(path_length=lambda positions: 0.0)
    evaluation.scenes = [SimpleNamespace(sphere=path, recording=SimpleNamespace(image_ids=(5, 8)))]
    objects = SimpleNamespace(T_world_object=stacked(0.0, 0.3, 0.6), probability=np.array([0.9, 0.8, 0.7]))
    view = SimpleNamespace(view=SimpleNamespace(T_world_camera=np.eye(4)))
    episode = SimpleNamespace(objects=[objects], views=[view])
    found, error, _, taken, rate, confirmed, wrong = evaluation._score(0, episode, SimpleNamespace(taken=[1]))
    assert (found, rate, confirmed, wrong) == (1.0, 1.0, 3, 1)
    assert error == pytest.approx(0.0, abs=0.06)
    assert taken == [8, -1], "BOP's image numbers"
    evaluation.starts = np.array([[0, 1]])
    assert evaluation.start_images == [(0, 8)]


class LookedAt:
    """Views of a surface z(x, y) from above, 0.7 m from the world's (0.4, -0.3, 0.2)."""

    folder = Path("recorded")
    middle = np.array([0.4, -0.3, 0.2])

    def __init__(self, surface, *, degrees, off=0.0):
        around = [Rotation.from_euler("yz", [30.0, turn], degrees=True).as_matrix() for turn in degrees]
        self.T_world_camera = np.array(
            [
                look_at(self.middle + R @ [0, 0, 0.7], self.middle + [off * (-1) ** n, 0, 0])
                for n, R in enumerate(around)
            ]
        )
        self._surface = surface

    def __len__(self):
        return len(self.T_world_camera)

    def view(self, index, stamp):
        camera, T = CAMERA, self.T_world_camera[index]
        far = backproject(np.ones((camera.height, camera.width), np.float32), camera).astype(float) @ T[:3, :3].T
        depth = np.full(far.shape[:2], 0.7)
        for _ in range(20):  # slide along the ray
            points = T[:3, 3] + depth[..., None] * far
            depth += (self._surface(points[..., 0], points[..., 1]) - points[..., 2]) / far[..., 2]
        return View(stamp, np.zeros((*depth.shape, 3), np.uint8), depth.astype(np.float32), camera, T)


@pytest.mark.parametrize(
    ("degrees", "off"), [((0, 90, 200), 0.0), ((0, 4), 0.02), ((10,), 0.0)], ids=["around", "nearly parallel", "one"]
)
def test_what_cameras_look_at_does_not_need_axes_that_cross(degrees, off):
    """Two cameras 5 degrees apart with 2 cm of error look at each other's side: their axes cross far from the scene."""
    scene = LookedAt(lambda x, y: np.full(x.shape, 0.2), degrees=degrees, off=off)
    T_bin_world = find_bin(scene, MODEL)[0] @ invert(scene.T_world_camera[0])
    np.testing.assert_allclose(T_bin_world[:3, 3], -LookedAt.middle, atol=0.01 if off else 1e-4)


def test_where_a_pile_hides_the_floor_no_object_is_below_it():
    warnings = []
    pile = LookedAt(lambda x, y: 0.2 + 0.05 * np.sin(25 * x) * np.sin(25 * y), degrees=(0, 90, 200))
    floor = -(find_bin(pile, MODEL, warnings.append)[0] @ invert(pile.T_world_camera[0]))[2, 3]
    assert 0.2 - 0.055 - 1.1 * MODEL.diameter < floor < 0.2 - 0.055
    assert "no floor is seen" in warnings[0]


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("--policies", "oracle"), "is a bound of scene banks"),
        (("--object-id", 7), "no ground truth of object 7"),
    ],
)
def test_what_cannot_be_scored_is_refused(dataset, arguments, reason):
    result = run("--bop", dataset, *arguments)
    assert result.exit_code == 2
    assert reason in " ".join(result.output.split())


def test_a_folder_without_scenes_is_refused(tmp_path):
    result = run("--bop", tmp_path)
    assert result.exit_code == 2
    assert "must be a data set in BOP's format" in " ".join(result.output.split())


def copied(dataset, folder, change):
    """The scene with files that ``change(copy)`` replaces."""
    copy = folder / "000003"
    copy.mkdir()
    for path in (dataset / "test" / "000003").iterdir():
        (copy / path.name).symlink_to(path)
    for name, content in change(copy).items():
        (copy / name).unlink()
        if content is not None:
            (copy / name).write_text(json.dumps(content))
    return copy


def another_object(copy):
    truth = json.loads((copy / "scene_gt.json").read_text())
    truth["0"][0]["obj_id"] = 2
    return {"scene_gt.json": truth}


def no_truth(copy):
    return {"scene_gt.json": None, "scene_gt_info.json": None}


def few_labels(copy):
    """Of a recording without camera poses, no image lists five objects."""
    truth, cameras = (json.loads((copy / f"scene_{name}.json").read_text()) for name in ("gt", "camera"))
    bare = {image: {k: v for k, v in entry.items() if not k.endswith("w2c")} for image, entry in cameras.items()}
    few = {image: entries[:4] for image, entries in truth.items()}
    return {"scene_gt.json": few, "scene_gt_info.json": None, "scene_camera.json": bare}


def other_cameras(copy):
    cameras = json.loads((copy / "scene_camera.json").read_text())
    (copy / "scene_camera_cam1.json").write_text(json.dumps(cameras))
    return {"scene_camera.json": None}


def wrong_scale(copy):
    cameras = json.loads((copy / "scene_camera.json").read_text())
    return {"scene_camera.json": {image: {**entry, "depth_scale": 10.0} for image, entry in cameras.items()}}


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (another_object, "has objects 1, 2; choose with --object-id"),
        (no_truth, "policies need ground truth to be scored"),
        (wrong_scale, "would span"),
        (few_labels, "no image's ground truth lists more than 4 of object 1"),
        (other_cameras, "it has scene_camera_cam1.json: copy one camera's files to the usual names"),
    ],
)
def test_a_scene_that_cannot_be_scored_is_refused_before_it_is_estimated(dataset, tmp_path, change, reason):
    RecordedTruth.calls = 0
    result = run("--bop", copied(dataset, tmp_path, change), "--policies", "random")
    assert result.exit_code == 2
    assert reason in " ".join(result.output.split())
    assert RecordedTruth.calls == 0


def test_scenes_of_several_splits_are_not_mixed(dataset, tmp_path):
    for split in ("test", "train_pbr"):
        (tmp_path / split).mkdir()
        (tmp_path / split / "000003").symlink_to(dataset / "test" / "000003")
    result = run("--bop", tmp_path, "--policies", "random")
    assert result.exit_code == 2
    assert "has scenes in test, train_pbr; name one of these folders" in " ".join(result.output.split())


def test_a_results_file_has_each_image_once():
    def estimates(scene, image, seconds):
        return BopEstimates(scene, image, np.eye(4)[None], np.ones(1), seconds)

    kept, others = once_per_image([estimates(1, 5, 0.1), estimates(1, 6, 0.2), estimates(1, 5, 0.3)])
    assert [(each.image_id, each.seconds) for each in kept] == [(5, 0.1), (6, 0.2)]
    assert others == 1


def test_a_data_set_with_another_mesh_or_frame_is_noticed(dataset, tmp_path):
    scene = dataset / "test" / "000003"
    assert differs_from_data_set(scene, 1, MODEL) == ""
    assert "not model 1 of this data set" in differs_from_data_set(scene, 1, load_object("coffee_cup"))
    moved = replace(MODEL, origin=MODEL.origin + [0.02, 0.0, 0.0])
    assert "their bounds differ by 20 mm" in differs_from_data_set(scene, 1, moved)
    assert differs_from_data_set(tmp_path / "test" / "000001", 1, MODEL) == ""


def test_a_data_set_without_a_description_of_its_models_is_compared_by_the_mesh(dataset, tmp_path):
    shutil.copytree(dataset / "models", tmp_path / "models")
    (tmp_path / "models" / "models_info.json").unlink()
    (tmp_path / "models" / "obj_000001.jpg").write_bytes(b"a texture")
    scene = tmp_path / "test" / "000003"
    assert differs_from_data_set(scene, 1, MODEL) == ""
    moved = replace(MODEL, origin=MODEL.origin + [0.02, 0.0, 0.0])
    text = differs_from_data_set(scene, 1, moved)
    assert "their bounds differ by 20 mm" in text
    assert f"object add {tmp_path / 'models' / 'obj_000001.ply'} --name NAME --scale 0.001" in text
    assert differs_from_data_set(scene, 2, moved) == ""


def recordings(*object_ids):
    """Recordings whose images list these objects; (1, 0.05) is object 1 of which a twentieth is visible."""
    made = []
    for number, images in enumerate(object_ids):
        truth = [
            ImageTruth(
                np.array([each[0] for each in image], int),
                np.tile(np.eye(4), (len(image), 1, 1)),
                np.array([each[1] for each in image], float),
            )
            for image in images
        ]
        made.append(SimpleNamespace(truth=truth, folder=Path("split") / f"scene{number}"))
    return made


def test_scenes_of_different_objects_are_not_scored_as_one():
    first, second, nothing = recordings([[(1, 1.0)]], [[(2, 1.0)], [(3, np.nan)]], [[(2, 0.05)], []])
    told = []
    with pytest.raises(ValueError, match=r"^split: has objects 1, 2, 3; choose with --object-id"):
        _choose([first, second, nothing], None, told.append)
    assert _choose([first, second, nothing], 3, told.append) == (3, [second])
    assert told == ["2 of 3 scenes have no object 3 that is visible by a tenth and are left out: scene0, scene2"]
    with pytest.raises(ValueError, match=r"no ground truth of object 7, only of \[1, 2, 3\]"):
        _choose([first, second, nothing], 7, told.append)
    with pytest.raises(ValueError, match="object 2, or none that is visible by a tenth"):
        _choose([nothing], None, told.append)
    assert _choose([first, first], None, pytest.fail) == (1, [first, first])


def test_images_without_a_sure_object_are_refused_with_the_cause(dataset):
    scene = BopScene.load(dataset / "test" / "000003")
    bare = replace(scene, has_pose=np.full(len(scene), False))
    unsure = SimpleNamespace(T_camera_object=np.tile(np.eye(4), (2, 1, 1)), score=np.array([0.4, 0.1]))
    with pytest.raises(ValueError, match=r"000003: no object with a score of 0\.5 or more in any image; is --object"):
        _place(bare, MODEL, lambda view: SimpleNamespace(hypotheses=unsure), pytest.fail)


def test_a_world_in_the_first_cameras_frame_is_turned_upright(dataset, tmp_path):
    """Its poses are poses, the identity too, and the table's normal takes the place of its z axis."""
    scene = BopScene.load(dataset / "test" / "000003")
    cameras = json.loads((scene.folder / "scene_camera.json").read_text())
    first = invert(scene.T_world_camera[0])
    for image, T in zip(cameras.values(), scene.T_world_camera, strict=True):
        T_camera_world = invert(first @ T)
        image["cam_R_w2c"] = T_camera_world[:3, :3].ravel().tolist()
        image["cam_t_w2c"] = (1e3 * T_camera_world[:3, 3]).tolist()
    copy = copied(dataset, tmp_path, lambda copy: {"scene_camera.json": cameras})
    recording = BopScene.load(copy, needs_poses=False)
    np.testing.assert_allclose(recording.T_world_camera[0], np.eye(4), atol=1e-9)
    assert not looks_down(recording.T_world_camera)
    told = []
    placed, seen = _place(recording, MODEL, lambda view: pytest.fail("poses are known"), told.append)
    assert seen is None
    assert "000003: the world's z axis is not up; up is taken to be the normal of the largest plane" in told[0]
    relative = invert(placed.T_world_camera[0]) @ placed.T_world_camera
    np.testing.assert_allclose(relative, first @ scene.T_world_camera, atol=1e-6)
    # The true directions and heights of the cameras over the floor, whose plane is measured.
    up = placed.T_world_camera[:, 2, :3] - scene.T_world_camera[:, 2, :3]
    assert np.abs(up).max() < 0.05
    heights = find_bin(placed, MODEL)[:, 2, 3] - [SPHERE.positions[index][2] for index in VIEWS]
    assert np.abs(heights).max() < 0.03


def test_up_needs_depth_in_the_first_image(dataset, tmp_path):
    """Where a camera looks up in a world, a plane has to tell what is up."""
    scene = BopScene.load(dataset / "test" / "000003")
    turned = make_transform(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    upside_down = replace(scene, T_world_camera=turned @ scene.T_world_camera)
    depth = tmp_path / "000003"
    shutil.copytree(scene.folder, depth)
    Image.fromarray(np.zeros((CAMERA.height, CAMERA.width), np.uint16)).save(depth / "depth" / "000000.png")
    with pytest.raises(ValueError, match="000003: image 0 has no depth for the plane that tells what is up"):
        _place(replace(upside_down, folder=depth), MODEL, pytest.fail, lambda text: None)


def test_an_image_is_tried_again_only_among_more_objects(dataset, monkeypatch):
    T, rng = BopScene.load(dataset / "test" / "000003").T_world_camera[:4], np.random.default_rng(3)
    seen = seen_by(T, load_scene("mug", "test", 1).T_world_object, rng, off=0.001)
    strangers = [make_transform(Rotation.random(6, rng=rng).as_matrix(), rng.uniform(-0.2, 0.2, (6, 3))) for _ in "abc"]
    tries = []

    def place(self, a, b, rng):
        index = next(index for index, each in enumerate(every) if each is b)
        tries.append((index, len(a)))
        return (invert(T[0]) @ T[index - 3], "") if index >= 3 else (None, "no")

    every = [*strangers, *seen]
    monkeypatch.setattr(_Placing, "place", place)
    placed, left_out = register_views(every, MODEL)
    assert (sorted(placed), sorted(left_out)) == ([3, 4, 5, 6], [0, 1, 2])
    assert len(set(tries)) == len(tries), "the same image among the same objects"
    assert [index for index, _ in tries[:6]] == [0, 1, 2, 4, 5, 6]


def test_reasons_are_told_of_the_first_images():
    assert _reasons({4: "a", 7: "b"}) == "image 4: a; image 7: b"
    assert _reasons(dict.fromkeys(range(20), "no")) == "image 0: no; image 1: no; image 2: no; and 17 more"


def test_scenes_without_numbers_are_numbered_by_their_order():
    assert number_scenes([Path("x/000004"), Path("x/000012")]) == ([4, 12], "")
    numbers, text = number_scenes([Path("x/000004"), Path("x/left"), Path("x/right")])
    assert numbers == [0, 1, 2]
    assert text.endswith("0 is 000004, 1 is left, 2 is right")
