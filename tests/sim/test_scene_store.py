"""Stored scenes: finding them, what is said when there are none, and the measure of their density."""

from concurrent.futures import Future

import numpy as np
import pytest
from hand_made_scenes import SPHERE, store_mugs

from active6d_sim.scenes import scene_store
from active6d_sim.scenes.scene import Bin, Scene
from active6d_sim.scenes.scene_store import (
    FIRST_STORED_SEED,
    SPLIT_SEEDS,
    SPLITS,
    density_report,
    find_scene,
    generate,
    load_scene,
)


@pytest.fixture
def mugs(tmp_path, monkeypatch):
    return store_mugs(tmp_path, monkeypatch)


@pytest.mark.parametrize("name", ["mug/test/0", "test/0", "test/00"])
def test_stored_scenes_are_found_by_name(mugs, name):
    scene = find_scene("mug", name, seed=99)
    assert (scene.name, scene.seed, scene.bin) == ("mug/test/0", 5, mugs.bin)
    np.testing.assert_array_equal(scene.T_world_object, mugs.T_world_object)


@pytest.mark.parametrize("name", "mug mug/test bunny/test/0 test/one test/-1 test/0/0 ../test/0 test/1.5".split())
def test_other_names_are_refused(mugs, name):
    with pytest.raises(ValueError, match=r"not of the form mug/test/3"):
        find_scene("mug", name, 0)


@pytest.mark.parametrize(("split", "index"), [("test", 10), ("train", 24), ("val", 6), ("tset", 0)])
def test_what_is_in_no_split_is_refused_with_the_splits(mugs, split, index):
    with pytest.raises(ValueError, match=r"there are mug/ train/0\.\.23, val/0\.\.5, test/0\.\.9"):
        load_scene("mug", split, index)


def test_unknown_objects_are_named_with_the_known_ones(mugs):
    with pytest.raises(ValueError, match=r"unknown object 'teapot'; known: .*bunny.*mug"):
        load_scene("teapot", "test", 0)


def test_missing_scenes_say_how_to_make_them(mugs):
    with pytest.raises(ValueError, match="active6d scenes generate --object mug"):
        load_scene("mug", "test", 2)


def test_damaged_and_misplaced_files_are_named(mugs, tmp_path):
    (tmp_path / "mug" / "test_02.npz").write_bytes(b"PK\x03\x04 and no more")
    with pytest.raises(ValueError, match=r"test_02\.npz: not a stored scene"):
        load_scene("mug", "test", 2)
    (tmp_path / "bunny").mkdir()
    mugs.save(tmp_path / "bunny" / "test_00.npz")
    with pytest.raises(ValueError, match=r"test_00\.npz: is a scene of 'mug', not of 'bunny'"):
        load_scene("bunny", "test", 0)


@pytest.mark.parametrize("seed", [-1, FIRST_STORED_SEED, SPLIT_SEEDS["test"] + 3])
def test_seeds_of_stored_scenes_are_not_dropped_again(mugs, seed):
    with pytest.raises(ValueError, match=f"seed must be within 0 and {FIRST_STORED_SEED - 1}.*got {seed}"):
        find_scene("mug", "", seed)


def test_seeds_of_the_splits_do_not_overlap():
    ranges = [range(SPLIT_SEEDS[split], SPLIT_SEEDS[split] + count) for split, count in SPLITS.items()]
    assert len({seed for seeds in ranges for seed in seeds}) == sum(SPLITS.values()) == 56


def test_generate_makes_what_is_missing(tmp_path, monkeypatch):
    drops = []

    def drop(model, seed, *, name):
        drops.append((model.name, seed))
        return Scene("mug", name, seed, np.eye(4)[None], Bin(0.3, 0.3, 0.05), np.full((100, 1), 1 / 3))

    class SameProcess:
        """A pool that runs a job when it is handed in."""

        def __init__(self, workers, **options):
            assert workers == 2

        def __enter__(self):
            return self

        def __exit__(self, *error):
            pass

        def submit(self, function, *arguments):
            future = Future()
            future.set_result(function(*arguments))
            return future

    monkeypatch.setattr(scene_store, "simulate_heap", drop)
    monkeypatch.setattr(scene_store, "worker_pool", SameProcess)
    made = list(generate("mug", tmp_path, splits=("val",), workers=2))
    assert sorted(path.name for path in made) == [f"val_{index:02d}.npz" for index in range(6)]
    assert sorted(drops) == [("mug", 200_000 + index) for index in range(6)]
    scene = Scene.load(tmp_path / "mug" / "val_03.npz")
    assert (scene.name, scene.seed) == ("mug/val/3", 200_003)
    np.testing.assert_allclose(scene.visible_fraction, 0.333, atol=1e-6)
    (tmp_path / "mug" / "val_03.npz").unlink()
    assert [path.name for path in generate("mug", tmp_path, splits=("val",), workers=2)] == ["val_03.npz"]
    assert sorted(path.name for path in (tmp_path / "mug").iterdir()) == [f"val_{index:02d}.npz" for index in range(6)]


def test_generate_refuses_what_it_does_not_know(tmp_path):
    with pytest.raises(ValueError, match="unknown split 'dev'; there are train, val, test"):
        list(generate("mug", tmp_path, splits=("dev",)))
    with pytest.raises(ValueError, match="unknown object 'teapot'"):
        list(generate("teapot", tmp_path))


def scene_seen(visible):
    n = visible.shape[1]
    T = np.broadcast_to(np.eye(4), (n, 4, 4)).copy()
    return Scene("mug", "mug/test/0", 0, T, Bin(0.3, 0.3, 0.05), visible.astype(float))


def test_density_when_every_view_shows_another_object():
    report = density_report([scene_seen(np.eye(100))], np.random.default_rng(0), moves=5, starts=3)
    six = dict.fromkeys(("random", "revolution", "oracle"), 0.06)
    assert report == pytest.approx({"one_view": 0.01, **six, "all_views": 1.0})


def test_density_when_two_views_show_all():
    visible = np.full((100, 10), 0.49)
    visible[17, :5] = visible[62, 5:] = 0.5
    report = density_report([scene_seen(visible)], np.random.default_rng(0), moves=2, starts=200)
    assert report["oracle"] == report["all_views"] == 1.0
    # Three of a hundred views; each half is seen if its view is among them. Neither view is at 45 degrees.
    assert report["random"] == pytest.approx(0.03, abs=0.025)
    assert report["revolution"] == 0.0
    assert not np.isclose(SPHERE.positions[[17, 62], 2], SPHERE.radius * np.sin(np.pi / 4)).any()


def test_density_of_a_revolution():
    """Objects that only one half of the ring sees are all found by going around once."""
    azimuth = SPHERE.angles(SPHERE.positions)[:, 0]
    visible = np.stack([azimuth > 0, azimuth <= 0], axis=1)
    report = density_report([scene_seen(visible)], np.random.default_rng(0), moves=5)
    assert report["revolution"] == report["oracle"] == 1.0
    assert report["one_view"] == 0.5
