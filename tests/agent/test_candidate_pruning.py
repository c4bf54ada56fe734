"""Pruned banks: what no choice of views makes probable is gone, and what is found stays."""

from dataclasses import replace

import numpy as np
import pytest

from active6d_agent.bank.all_views_lookup import AllViewsLookup
from active6d_agent.bank.candidate_pruning import prune_candidates
from active6d_agent.bank.scene_bank import SHIPPED_BANKS, bank_path, load_bank
from active6d_core.se3 import make_transform


@pytest.fixture(scope="module")
def bank():
    whole = load_bank(bank_path(SHIPPED_BANKS, "mug", "test"))
    return replace(whole, scenes=whole.scenes[:1])


def with_hopeless_candidates(bank, count):
    """The bank with more candidates, a metre beside the pile, for which no view has a hypothesis."""
    (scene,) = bank.scenes
    tables = scene.evidence
    more = tables.take(np.arange(count))
    aside = make_transform(np.eye(3), np.array([1.0, 0.0, 0.0]))
    joined = replace(
        tables,
        T_world_body=np.concatenate([tables.T_world_body, aside @ more.T_world_body]),
        place=np.concatenate([tables.place, tables.place.max() + 1 + np.arange(count)]),
        T_world_object=np.concatenate([tables.T_world_object, aside @ more.T_world_object]),
        **{
            name: np.concatenate([getattr(tables, name), getattr(more, name)], 1)
            for name in ("body", "twin", "telling")
        },
    )
    return replace(bank, scenes=[replace(scene, evidence=joined)])


def test_hopeless_candidates_go_and_what_is_found_stays(bank):
    larger = with_hopeless_candidates(bank, 5)
    pruned = prune_candidates(larger, np.random.default_rng(0))
    kept = pruned.scenes[0].evidence
    assert len(bank.scenes[0].T_world_object) <= len(kept.place) <= len(bank.scenes[0].evidence.place)
    assert (kept.T_world_body[:, 0, 3] < 0.5).all()
    assert sorted(set(kept.place)) == list(range(kept.place.max() + 1))
    found = []
    for each in (larger, pruned):
        lookup, rng = AllViewsLookup(each), np.random.default_rng(1)
        views = np.stack([rng.choice(100, 6, replace=False) for _ in range(100)])
        scene = np.zeros(100, int)
        found.append(
            np.mean([score.detected for score in lookup.evaluate(lookup.fuse(scene, views, views[:, -1]), scene)])
        )
    assert found[1] == pytest.approx(found[0], abs=0.005)


def test_an_object_without_ambiguous_rotation_keeps_all_candidates():
    bunnies = load_bank(bank_path(SHIPPED_BANKS, "bunny", "test"))
    assert prune_candidates(bunnies, np.random.default_rng(0)) is bunnies


def test_a_bank_without_evidence_is_refused(bank):
    (scene,) = bank.scenes
    with pytest.raises(ValueError, match="no evidence of all views"):
        prune_candidates(replace(bank, scenes=[replace(scene, evidence=None)]), np.random.default_rng(0))
