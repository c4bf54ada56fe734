"""Ablations vary what they say they vary, and nothing else."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic_bank import synthetic_bank

from active6d_agent.bank.best_view_lookup import BestViewLookup
from active6d_agent.environment.episodes import RewardParameters
from active6d_agent.evaluation import ablations as ablation
from active6d_agent.evaluation.policy_evaluation import all_starts, run_named
from active6d_agent.policies.attention.ppo import PpoParameters
from active6d_agent.policies.view_attention.network import ViewAttention, save_network
from active6d_core.metrics import evaluate_scene
from active6d_perception.scene.fusion_parameters import RANKINGS


def by_variant(rows):
    return {row["variant"]: row for row in rows}


@pytest.fixture(scope="module")
def lookup():
    return BestViewLookup(synthetic_bank("mug", scenes=2, objects=6))


@pytest.fixture(scope="module")
def starts(lookup):
    return all_starts(lookup, 8, seed=1)


def test_budgets_go_from_the_single_view_to_all_views(lookup, starts):
    made = ablation.ablate_steps(lookup, ["random"], starts, (0, 3, 99))
    rows = {(row["variant"], row["budget"]): row for row in made}
    for budget, name in ((0, "single-view"), (99, "all-views")):
        expected = run_named(lookup, name, starts, budget)
        assert rows["random", budget]["detection_rate"] == pytest.approx(expected.detection_rate.mean())
    assert rows["random", 3]["distance_m"] == pytest.approx(run_named(lookup, "random", starts, 3).distance_m.mean())


def test_without_clustering_every_hypothesis_is_reported(lookup, starts):
    rows = by_variant(ablation.ablate_fusion(lookup.bank, "random", starts, 2))
    views = run_named(lookup, "random", starts, 2).views
    reported, rates = [], []
    for (scene, _), taken in zip(starts, views, strict=True):
        own = lookup.bank.scenes[scene]
        reported.append(np.isin(own.view, taken).sum() / len(own.T_world_object))
        objects = lookup.objects(scene, taken.tolist())
        rates.append(evaluate_scene(lookup.model, objects.T_world_object, own.T_world_object).detection_rate)
    assert rows["no clustering"]["reported"] == pytest.approx(np.mean(reported))
    assert rows["clustering and exclusion"]["detection_rate"] == pytest.approx(np.mean(rates))
    assert rows["clustering and exclusion"]["reported"] <= rows["clustering alone"]["reported"]
    at_n = [row["detection_rate_at_n"] for row in rows.values()]
    assert at_n[0] >= at_n[2], "repetitions crowd out other objects"


def test_what_hypotheses_are_ranked_by_matters_where_the_scores_differ(lookup, starts):
    rows = by_variant(ablation.ablate_fusion(lookup.bank, "random", starts, 2, scores=True))
    # The made-up estimator's score is its verification score, so nothing may change.
    assert {**rows["verification"], "variant": "score"} == rows["score"]
    reversed_ = [replace(s, table=s.table.copy()) for s in lookup.bank.scenes]
    for scene in reversed_:
        scene.table[:, 8] = 1.0 - scene.table[:, 7]
    worse = by_variant(ablation.ablate_fusion(replace(lookup.bank, scenes=reversed_), "random", starts, 2, scores=True))
    assert list(worse) == list(RANKINGS)
    alone = (table["verification"] | {"against_first": None} for table in (worse, rows))
    assert next(alone) == next(alone)
    assert worse["score"]["e_add_mm"] > rows["verification"]["e_add_mm"]


def test_variants_are_trained_once(lookup, starts, tmp_path):
    banks = dict.fromkeys(("train", "val", "test"), lookup)
    parameters = PpoParameters(steps=2, total=40, environments=4, rollout=4, batch=16, evaluate_every=20)
    variants = {
        "far": (parameters, RewardParameters(alpha=0.0)),
        "rule": (replace(parameters, attend="lowest-score"), RewardParameters()),
    }
    seen = []
    rows = by_variant(
        ablation.ablate_training(banks, variants, tmp_path, starts, on_progress=lambda *told: seen.append(told[0]))
    )
    assert set(seen) == {"far", "rule"}
    assert '"rule": "lowest-score"' in (tmp_path / "lowest-score_alpha0.3" / "best.json").read_text()
    assert "against_first" not in rows["far"]
    difference = rows["rule"]["detection_rate"] - rows["far"]["detection_rate"]
    assert rows["rule"]["against_first"]["detection_rate"]["mean"] == pytest.approx(difference)
    seen.clear()
    assert by_variant(ablation.ablate_training(banks, variants, tmp_path, starts)) == rows
    renamed = {"elsewhere": variants["rule"], "printed": (parameters, RewardParameters(as_printed=True))}
    again = by_variant(
        ablation.ablate_training(banks, renamed, tmp_path, starts, on_progress=lambda *told: seen.append(told))
    )
    assert again["elsewhere"]["e_add_mm"] == rows["rule"]["e_add_mm"]
    assert {name for name, _ in seen} == {"printed"}


def test_planning_varies_one_parameter_of_the_default_policy(lookup, starts, tmp_path, monkeypatch):
    weights = tmp_path / "untrained.safetensors"
    save_network(ViewAttention(), weights, "mug")
    monkeypatch.setattr(ablation, "PLANNING", {"metres_weight": (0.0, 100.0), "stop_below": (1e6,)})
    made = list(ablation.ablate_planning(lookup, starts, 3, parameters={"weights": str(weights)}))
    assert [(row["parameter"], row["value"]) for row in made] == [
        ("as shipped", None),
        ("metres_weight", 0.0),
        ("metres_weight", 100.0),
        ("stop_below", 1e6),
        ("random", None),
    ]
    _, free, costly, stopped, random = made
    grid = lookup.sphere
    nearest = np.sort(grid.arc(grid.positions[:, None], grid.positions[None]), axis=1)[:, 1].mean()
    assert costly["distance_m"] < min(free["distance_m"], 6 * nearest)
    assert (stopped["moves"], stopped["distance_m"]) == (0.0, 0.0)
    assert costly["moves"] == random["moves"] == 3.0
    expected = run_named(lookup, "single-view", starts, 3).detection_rate.mean()
    assert stopped["detection_rate"] == pytest.approx(expected)
    assert stopped["against_first"]["distance_m"]["excludes_zero"]
