"""Fitting fusion to scenes: which views are drawn, and what is learned from an episode."""

from dataclasses import replace

import numpy as np
import pytest
from hand_made_scenes import make_scene, three_mugs

from active6d_agent.bank.all_views_lookup import AllViewsLookup
from active6d_agent.bank.scene_bank import find_bank, load_bank
from active6d_core.metrics import DETECTION_FRACTION, e_add
from active6d_core.object_model import load_object
from active6d_core.view_sphere import ViewSphere
from active6d_perception.scene.all_views_fusion import AllViewsFusion
from active6d_perception.scene.belief_weights import BeliefWeights, belief_path, load_belief
from active6d_perception.scene.object_probability import OBJECT_COLUMNS
from active6d_tools import fusion_training
from active6d_tools.fusion_training import count_scenes, describe_scene, fit_fusion, label_scene, refit_probability
from active6d_tools.processed_scene import ViewPool

SPHERE = ViewSphere()


def test_pool_has_a_ring_and_draws_only_its_views():
    pool = ViewPool(SPHERE, 30, np.random.default_rng(0))
    assert len(set(pool.views)) == 30
    assert set(pool.ring) <= set(pool.views)
    rng = np.random.default_rng(0)
    ring = SPHERE.positions[pool.draw(5, ring=True, rng=rng)]
    angles = SPHERE.angles(ring)
    np.testing.assert_allclose(np.degrees(angles[:, 1]), 45, atol=1e-6)
    apart = np.diff(np.sort(angles[:, 0] % (2 * np.pi)))
    assert np.degrees(apart).min() > 50
    drawn = pool.draw(20, ring=False, rng=rng)
    assert len(set(drawn)) == 20
    assert set(drawn) <= set(pool.views)
    assert drawn != pool.draw(20, ring=False, rng=rng)
    with pytest.raises(ValueError, match="at least the 6 views"):
        ViewPool(SPHERE, 5, rng)


def test_scenes_are_those_of_the_splits():
    assert count_scenes(["mug"], None) == 24 + 6 + 6
    assert count_scenes(["mug", "bunny"], 2) == 2 * 3 * 2


@pytest.fixture
def scene_folder(tmp_path, monkeypatch):
    """Hand-made scenes of the first of each split."""
    monkeypatch.setenv("ACTIVE6D_SCENE_PATH", str(tmp_path))
    mugs = three_mugs()
    (tmp_path / "mug").mkdir()
    for split, seed in (("train", 1), ("val", 2), ("wild_val", 3)):
        scene = make_scene(mugs.T_world_object, mugs.bin, f"mug/{split}/0", seed)
        scene.save(tmp_path / "mug" / f"{split}_00.npz")
    return mugs


@pytest.mark.slow
def test_weights_are_fitted_to_scenes(scene_folder, monkeypatch):
    monkeypatch.setattr(fusion_training, "_VIEWS", (2, 3))
    labelled = label_scene("mug/train/0", episodes=2, estimator="auto", seed=0)
    again = label_scene("mug/train/0", episodes=2, estimator="auto", seed=0)
    assert [len(each.place) for each in labelled] == [len(each.place) for each in again]
    assert all(set(each.place[each.right.any(axis=1)]) == set(each.place) for each in labelled)
    rows = describe_scene("mug/val/0", weights=BeliefWeights.indifferent(), episodes=1, estimator="auto", seed=0)
    assert rows.shape[1] == len(OBJECT_COLUMNS) + 1
    assert set(rows[:, -1]) <= {0.0, 1.0}
    names = []
    # In this process: the scenes of the test are hand-made.
    monkeypatch.setattr(fusion_training, "_in_processes", lambda work, names, workers: ((n, work(n)) for n in names))
    weights, measured = fit_fusion(["mug"], episodes=2, scenes=1, on_scene=names.append)
    assert names == ["mug/train/0", "mug/val/0", "mug/wild_val/0"]
    assert measured["places"] >= 3
    assert weights.provenance["objects"] == ["mug"]
    assert (weights.provenance["belief_scenes"], weights.provenance["probability_scenes"]) == (1, 2)
    episodes = fusion_training._episodes("mug/val/0", weights, 1, "auto", 7)
    fusion, last, T_true = next(episodes)
    assert isinstance(fusion, AllViewsFusion)
    objects = fusion.objects(last.stamp, last.T_world_camera, last.camera)
    model = load_object("mug")
    errors = e_add(model, objects.T_world_object[:, None], T_true).min(axis=0)
    assert (errors < DETECTION_FRACTION * model.diameter).sum() >= 2


@pytest.fixture(scope="module")
def bunny_bank():
    bank = load_bank(find_bank("bunny", "test"))
    return replace(bank, scenes=bank.scenes[:2])


def test_only_the_probability_is_fitted_to_banks(bunny_bank, monkeypatch):
    """The descriptions of the same views, scored by hand, are as probable as any near weights make them."""
    monkeypatch.setattr(fusion_training, "_VIEWS", (3, 1))
    weights = load_belief(belief_path("bunny"))
    fitted, measured = refit_probability(weights, [bunny_bank], episodes=4, seed=5)
    assert fitted.rotation is weights.rotation
    assert fitted.body is weights.body
    belief = replace(weights, probability=BeliefWeights.indifferent().probability)
    lookup, model, rows, right = AllViewsLookup(bunny_bank, weights=belief), load_object("bunny"), [], []
    for index, scene in enumerate(bunny_bank.scenes):
        rng = np.random.default_rng([5, index])
        for count in (3, 1, 3, 1):
            views = rng.choice(100, count, replace=False)
            objects = lookup.objects(index, views)
            errors = e_add(model, objects.T_world_object[:, None], scene.T_world_object)
            right.append((errors < DETECTION_FRACTION * model.diameter).any(axis=1))
            rows.append(lookup.describe_fused(index, views)[0])
    right = np.concatenate(right)
    assert (measured["probability_scenes"], measured["fused_objects"]) == (2, len(right))
    assert measured["right"] == pytest.approx(right.mean())

    def loss(linear):
        odds = np.concatenate(rows) @ linear
        return (np.logaddexp(0, odds) - right * odds).mean() + 1e-3 * (linear**2).sum()

    best = loss(fitted.probability.linear)
    assert best < loss(weights.probability.linear)
    for step in np.random.default_rng(0).normal(0, 0.1, (20, len(OBJECT_COLUMNS))):
        assert best < loss(fitted.probability.linear + step)


def test_a_second_fit_is_the_first(bunny_bank):
    first, _ = refit_probability(load_belief(belief_path("bunny")), [bunny_bank], episodes=2)
    second, _ = refit_probability(first, [bunny_bank], episodes=2)
    np.testing.assert_array_equal(second.probability.linear, first.probability.linear)


def test_scenes_of_the_belief_do_not_fit_the_probability(bunny_bank):
    weights = load_belief(belief_path("bunny"))
    learned = [replace(scene, name=f"bunny/train/{index}") for index, scene in enumerate(bunny_bank.scenes)]
    with pytest.raises(ValueError, match="only scenes of the split train, to which the belief was fitted"):
        refit_probability(weights, [replace(bunny_bank, scenes=learned)])
