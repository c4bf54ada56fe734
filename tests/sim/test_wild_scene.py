"""Wild scenes: the same from the same seed, kept by files, physically plausible."""

import re

import numpy as np
import pytest

from active6d_core.object_model import load_object
from active6d_sim.rendering.appearance import Appearance
from active6d_sim.rendering.surface_print import SurfacePrint
from active6d_sim.scenes.scene import Scene
from active6d_sim.scenes.scene_store import SPLITS, load_scene
from active6d_sim.scenes.surroundings import Surroundings
from active6d_sim.scenes.wild_scene import wild_pile


@pytest.mark.slow
def test_the_same_seed_gives_the_same_scene(monkeypatch):
    monkeypatch.setattr("active6d_sim.scenes.wild_scene._count", lambda model, rng: 2)
    first, again = (wild_pile(load_object("coffee_cup"), 7) for _ in range(2))
    assert np.array_equal(first[0], again[0])
    assert first[1] == again[1]
    for name, value in first[2].arrays().items():
        assert np.array_equal(value, again[2].arrays()[name])


@pytest.mark.parametrize("name", ["bunny", "coffee_cup", "mug"])
def test_stored_wild_scenes_have_objects_and_other_things(name):
    scenes = [load_scene(name, "wild_test", index) for index in range(SPLITS["wild_test"])]
    assert min(len(scene) for scene in scenes) >= 1
    assert len({scene.seed for scene in scenes}) == len(scenes)
    for scene in scenes:
        assert len(scene.surroundings) > 0
        assert (scene.T_world_object[:, 2, 3] > 0).all()
    # Things differ from scene to scene, and so do containers.
    assert {scene.surroundings.tray for scene in scenes} == {True, False}
    kinds = {kind.partition(":")[0] for scene in scenes for kind in scene.surroundings.kind}
    assert {"box", "cylinder", "file", "object"} <= kinds


def test_surroundings_come_back_from_a_file(tmp_path):
    scene = load_scene("mug", "wild_val", 0)
    scene.save(tmp_path / "scene.npz")
    again = Scene.load(tmp_path / "scene.npz")
    for name, value in scene.surroundings.arrays().items():
        assert np.array_equal(value, again.surroundings.arrays()[name])


@pytest.mark.parametrize("kind", ["pyramid", "file:../secret.obj", "file:no/such.obj", "object:nothing"])
def test_unknown_kinds_of_things_are_refused(kind):
    things = Surroundings((kind,), np.ones((1, 3)), np.eye(4)[None], np.zeros((1, 3)))
    with pytest.raises(ValueError, match=re.escape(kind.removeprefix("object:"))):
        things.mesh(0)


@pytest.mark.parametrize("kind", ["box", "cylinder", "sphere", "object:mug", "file:duck.obj"])
def test_a_thing_fills_its_box(kind):
    things = Surroundings((kind,), np.array([[0.1, 0.2, 0.3]]), np.eye(4)[None], np.zeros((1, 3)))
    bounds = things.mesh(0).bounds
    assert np.allclose(bounds, [[-0.05, -0.1, -0.15], [0.05, 0.1, 0.15]], atol=1e-6)


def test_a_print_is_fixed_to_the_surface():
    """Half of a two-tone part has its second colour, whatever the base colour is."""
    two_tone = SurfacePrint(
        ("half",),
        np.array([[0.0, 0.0, 1.0]]),
        np.array([0.2]),
        np.array([0.5]),
        np.zeros((1, 2)),
        np.array([[1.0, 0.0, 0.0]]),
        np.zeros((1, 3)),
    )
    points = np.random.default_rng(0).uniform(-1, 1, (500, 3)).astype(np.float32)
    painted = two_tone.paint(points, np.full((500, 3), 0.5, np.float32))
    assert np.allclose(painted[points[:, 2] > 0.2], [1.0, 0.005, 0.005])
    assert np.allclose(painted[points[:, 2] <= 0.2], 0.5)


def test_all_objects_have_one_print_and_a_plain_appearance_has_none():
    prints = Appearance(seed=3, printed=0.5).prints(4, 10)
    assert prints[0] is prints[3]
    assert Appearance(seed=3).prints(4, 10) == {}
