"""Banks: what is written is read, an interrupted build goes on, and damaged files are refused in one line."""

import contextlib
import functools
import json

import numpy as np
import pytest
from synthetic_bank import observe_synthetic, synthetic_bank, synthetic_scene

from active6d_agent.bank import scene_bank
from active6d_agent.bank.observation import observe_scene, view_entropy
from active6d_agent.bank.scene_bank import BankScene, build_bank, load_bank
from active6d_core.camera import PinholeCamera, View
from active6d_core.hypotheses import Hypotheses
from active6d_core.metrics import e_add
from active6d_core.object_model import load_object
from active6d_core.se3 import invert
from active6d_core.view_sphere import ViewSphere
from active6d_perception.scene.observed_surface import WorkspaceGrid

SPHERE = ViewSphere()
GRID = WorkspaceGrid.for_model(load_object("mug"))


def assert_equal(a: BankScene, b: BankScene):
    assert a.name == b.name
    for name in ("T_world_object", "view", "table", "errors", "entropy", "surface"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_a_bank_survives_the_disk(tmp_path):
    bank = synthetic_bank("coffee_cup", scenes=3, objects=4)
    bank.save(tmp_path / "bank.npz")
    again = load_bank(tmp_path / "bank.npz")
    assert (again.object_name, again.sphere, again.provenance) == ("coffee_cup", SPHERE, {"estimator": "synthetic"})
    for a, b in zip(bank.scenes, again.scenes, strict=True):
        assert_equal(a, b)


def test_building_goes_on_where_it_stopped(tmp_path):
    names, log, path = [f"mug/synthetic/{seed}" for seed in (4, 1, 2)], tmp_path / "log", tmp_path / "bank.npz"
    observe = functools.partial(observe_synthetic, log=str(log))
    progress = build_bank(path, "mug", names, observe, provenance={"noise": (1, 2)})
    first = next(progress)
    progress.close()
    looked_at = log.read_text().split()
    assert first in looked_at
    assert not path.exists()
    assert sorted(build_bank(path, "mug", names, observe, provenance={"noise": (1, 2)})) == sorted(names)
    looked_at = log.read_text().split()
    assert looked_at.count(first) == 1, "a scene whose result is there is not looked at again"
    assert set(looked_at) == set(names)
    bank = load_bank(path)
    assert [scene.name for scene in bank.scenes] == names
    assert bank.provenance == {"noise": [1, 2]}
    assert_equal(bank.scenes[1], synthetic_scene("mug", 1, 3, SPHERE))
    assert list(tmp_path.glob("*.parts")) == []


def test_scenes_made_otherwise_are_made_again(tmp_path):
    name, path = "mug/synthetic/1", tmp_path / "bank.npz"
    for noise in (1, 2):
        log = tmp_path / f"log{noise}"
        broken = ["mug/broken/x"] if noise == 1 else []
        observe = functools.partial(observe_synthetic, log=str(log))
        with contextlib.suppress(ValueError):
            list(build_bank(path, "mug", [name, *broken], observe, provenance={"noise": noise}))
        assert name in log.read_text()
    assert load_bank(path).provenance == {"noise": 2}


@pytest.fixture
def stored(tmp_path):
    """A bank of three scenes in a file, to be extended."""
    bank = synthetic_bank("mug", scenes=3, objects=3)
    bank.save(tmp_path / "bank.npz")
    return bank


def test_a_bank_keeps_the_scenes_that_are_not_asked_for_again(stored, tmp_path):
    path, log, dropped = tmp_path / "bank.npz", tmp_path / "log", []
    observe = functools.partial(observe_synthetic, log=str(log))
    names = ["mug/synthetic/4", "mug/synthetic/1"]
    list(build_bank(path, "mug", names, observe, provenance=stored.provenance, on_drop=dropped.extend))
    scenes = load_bank(path).scenes
    assert [scene.name for scene in scenes] == [*names, "mug/synthetic/0", "mug/synthetic/2"]
    assert_equal(scenes[3], stored.scenes[2])
    assert log.read_text().split() == names[:1]
    assert dropped == []


def test_scenes_that_cannot_stay_are_named_before_the_work(stored, tmp_path):
    path, log, dropped = tmp_path / "bank.npz", tmp_path / "log", []

    def on_drop(names):
        assert not log.exists()
        dropped.append(names)

    observe = functools.partial(observe_synthetic, log=str(log))
    list(build_bank(path, "mug", ["mug/synthetic/1"], observe, provenance={"noise": 2}, on_drop=on_drop))
    assert dropped == [["mug/synthetic/0", "mug/synthetic/2"]]
    assert [scene.name for scene in load_bank(path).scenes] == ["mug/synthetic/1"]


def test_an_interrupted_scene_goes_on_with_its_next_view(tmp_path):
    """The camera fails at the fourth view. A view whose file is damaged is observed again."""
    log = tmp_path / "log"
    observe = functools.partial(observe_by_eye, log=log)
    with pytest.raises(OSError, match="no image"):
        observe(tmp_path / "views", broken=3)
    damaged = tmp_path / "views" / "1.npz"
    damaged.write_bytes(damaged.read_bytes()[:-20])
    scene = observe(tmp_path / "views")
    assert log.read_text().split() == ["1", "2", "3", "4", "2", "4", "5", "6"]
    whole = observe(None)
    assert_equal(scene, whole)
    for table in ("T_world_body", "place", "T_world_object", "body", "twin", "telling"):
        np.testing.assert_array_equal(getattr(scene.evidence, table), getattr(whole.evidence, table))


def test_views_of_an_unfinished_scene_are_of_one_provenance_and_go_when_it_is_done(tmp_path):
    folders = []

    def observe(name, views):
        folders.append(views)
        views.mkdir(parents=True, exist_ok=True)
        if len(folders) < 3:
            raise OSError("interrupted")
        return synthetic_scene("mug", 1, 3, SPHERE)

    for noise in (1, 2, 2):
        bank = scene_bank.SceneBank("mug", SPHERE, GRID, [], {"noise": noise})
        with contextlib.suppress(OSError):
            scene_bank._observe_to_file(observe, "mug/x/1", tmp_path / "bank.parts" / "x.npz", bank)
    assert folders[0] != folders[1] == folders[2]
    assert folders[0].is_dir()
    assert not folders[1].exists()


FEW = ViewSphere(elevations_degrees=(45.0,), azimuths=6)


def observe_by_eye(views, *, log, broken=-1):
    """One mug seen by a perfect estimator; the camera breaks at the view of index ``broken``."""
    truth, camera = synthetic_scene("mug", 1, 2, FEW).T_world_object, PinholeCamera.from_field_of_view(64, 48, 60.0)

    def capture(T_world_camera, stamp):
        number = stamp // 1_000_000_000
        with log.open("a") as file:
            file.write(f"{number}\n")
        if number == broken + 1:
            raise OSError("no image")
        depth = np.full((48, 64), 0.7, np.float32)
        return View(stamp, np.zeros((48, 64, 3), np.uint8), depth, camera, T_world_camera)

    model = load_object("mug")
    arguments = truth, capture, PerfectEstimator(truth), ConstantVerifier(), model, FEW, GRID
    return observe_scene("mug/synthetic/1", *arguments, views=views)


class PerfectEstimator:
    """Reports every object of the scene, shifted by 2 mm along the optical axis."""

    def __init__(self, T_world_object):
        self.T_world_object = T_world_object

    def estimate(self, view):
        T = invert(view.T_world_camera) @ self.T_world_object
        T[:, 2, 3] += 0.002
        label = np.arange(1, len(T) + 1).astype(np.uint16)
        segmentation = np.zeros(view.depth.shape, np.uint16)
        segmentation[0, : len(T)] = label
        return Hypotheses.from_masks(T, np.full(len(T), 0.9), label, segmentation, view.depth)


class ConstantVerifier:
    def score(self, depth, camera, hypotheses):
        return np.full(len(hypotheses), 0.5)


def test_observing_a_scene_pairs_hypotheses_with_the_truth():
    model = load_object("mug")
    truth = synthetic_scene("mug", 0, 3, SPHERE).T_world_object
    stamps, camera = [], PinholeCamera.from_field_of_view(6, 4, 60.0)

    def capture(T_world_camera, stamp):
        stamps.append(stamp)
        return View(stamp, np.zeros((4, 6, 3), np.uint8), np.full((4, 6), 0.7), camera, T_world_camera)

    scene = observe_scene("mug/x/0", truth, capture, PerfectEstimator(truth), ConstantVerifier(), model, SPHERE, GRID)
    assert stamps == [(i + 1) * 1_000_000_000 for i in range(100)]
    np.testing.assert_array_equal(scene.view, np.repeat(np.arange(100), 3))
    own = scene.errors[np.arange(300), np.tile(np.arange(3), 100)]
    np.testing.assert_allclose(own, 0.002, atol=1e-6)
    T = (
        SPHERE.pose(SPHERE.positions[0])
        @ PerfectEstimator(truth).estimate(capture(SPHERE.pose(SPHERE.positions[0]), 0)).T_camera_object
    )
    expected = e_add(model, T[0], truth)
    np.testing.assert_allclose(scene.errors[0], np.where(expected < 0.05, expected, np.inf), atol=1e-6)
    view = capture(SPHERE.pose(SPHERE.positions[7]), 0)
    seen = GRID.observe(view.depth, camera, view.T_world_camera)
    np.testing.assert_array_equal(np.unpackbits(scene.surface[7], count=len(GRID)).view(bool), seen)
    areas = np.array([21, 1, 1, 1]) / 24
    np.testing.assert_allclose(scene.entropy, -(areas * np.log(areas)).sum())


def test_entropy_of_even_and_of_empty_masks():
    assert view_entropy(np.repeat(np.arange(4), 5).reshape(4, 5)) == pytest.approx(np.log(4))
    assert view_entropy(np.zeros((3, 3), np.uint16)) == 0.0


def damage_header(data):
    data["header"] = np.array(json.dumps({**json.loads(str(data["header"])), "format": 99}))


def old_format(data):
    header = {**json.loads(str(data["header"])), "format": 1}
    del header["surface"], data["surface"]
    data["header"] = np.array(json.dumps(header))


def cut_surface(data):
    data["surface"] = data["surface"][:, :-100]


def cut_table(data):
    data["table"] = data["table"][:-5]


def poison_table(data):
    data["table"][3, 3] = np.nan


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (damage_header, "format 99"),
        (old_format, r"format 1, this version reads 3\); make it again with 'active6d bank'"),
        (cut_table, "table"),
        (poison_table, "finite"),
        (cut_surface, "surface has shape"),
    ],
)
def test_a_damaged_bank_is_refused_with_its_name(tmp_path, damage, message):
    path = tmp_path / "bank.npz"
    synthetic_bank("mug", scenes=1, objects=2).save(path)
    data = dict(np.load(path))
    damage(data)
    np.savez(path, **data)
    with pytest.raises(ValueError, match=message) as error:
        load_bank(path)
    assert str(path) in str(error.value)


@pytest.mark.parametrize("content", [None, b"", b"not a bank at all"])
def test_what_is_no_bank_is_refused_with_its_name(tmp_path, content):
    path = tmp_path / "bank.npz"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ValueError, match=r"bank\.npz: not a scene bank"):
        load_bank(path)


@pytest.mark.parametrize(
    "changes",
    [
        {"hypothesis_count": lambda values: values + 10**9},
        {"object_count": lambda values: values - 1},
        {"pair_count": lambda values: -values},
        {"object_count": lambda values: values.astype(float)},
    ],
)
def test_rows_that_do_not_add_up_are_refused_before_tables_are_made(tmp_path, changes, monkeypatch):
    synthetic_bank("coffee_cup", scenes=3, objects=4).save(tmp_path / "good.npz")
    with np.load(tmp_path / "good.npz") as stored:
        data = dict(stored)
    np.savez(tmp_path / "bank.npz", **{name: changes.get(name, np.asarray)(value) for name, value in data.items()})
    monkeypatch.setattr(scene_bank, "_read_scene", lambda *_: pytest.fail("tables were made"))
    with pytest.raises(ValueError, match=r"not a scene bank \(\w+_count"):
        load_bank(tmp_path / "bank.npz")
