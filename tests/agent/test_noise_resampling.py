"""What the views of one bank are worth with the other bank's noise."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.stats
from synthetic_bank import synthetic_bank

from active6d_agent.bank.best_view_lookup import BestViewLookup
from active6d_agent.environment.rollout import measure
from active6d_agent.evaluation.noise_resampling import ablate_noise_resampling, join_banks, search_unforeseen
from active6d_agent.evaluation.oracle import search_views, worth
from active6d_agent.evaluation.policy_evaluation import Intervals, all_starts, run_named

STEPS = 3


@pytest.fixture(scope="module")
def lookups():
    return tuple(BestViewLookup(synthetic_bank("mug", scenes=2, objects=6, noise=noise)) for noise in (0, 1))


@pytest.fixture(scope="module")
def starts(lookups):
    return all_starts(lookups[0], 10, seed=2)


@pytest.fixture(scope="module")
def rows(lookups, starts):
    made = ablate_noise_resampling(lookups, ["lowest-score"], starts, STEPS, seed=4)
    return {(row["policy"], row["noise"]): row for row in made}


def test_views_are_scored_on_both_banks_and_both_ways_round(lookups, starts, rows):
    assert list(rows) == [(name, noise) for name in ("random", "lowest-score") for noise in ("own", "other")] + [
        ("oracle", noise) for noise in ("own", "unforeseen", "other")
    ]
    for name in ("random", "lowest-score", "oracle"):
        played = [run_named(lookup, name, starts, STEPS, seed=4) for lookup in lookups]
        crossed = [
            measure(lookup, starts[:, 0], each.views) for lookup, each in zip(lookups, played[::-1], strict=True)
        ]
        for noise, pair in (("own", played), ("other", crossed)):
            for key in ("detection_rate", "e_add_mm", "distance_m"):
                expected = np.mean([getattr(each, key).mean() for each in pair])
                assert rows[name, noise][key] == pytest.approx(expected)


def test_who_does_not_look_has_no_luck_and_the_oracle_has(rows):
    assert rows["random", "other"]["detection_rate"] == pytest.approx(rows["random", "own"]["detection_rate"])
    assert rows["random", "own"]["gap_closed"] == rows["random", "own"]["gap_closed_ci95"][0] == 0.0
    assert rows["oracle", "own"]["gap_closed"] == 1.0
    own, unforeseen, other = (rows["oracle", noise] for noise in ("own", "unforeseen", "other"))
    assert other["e_add_mm"] > unforeseen["e_add_mm"] > own["e_add_mm"]
    low, high = (rows[name, "own"]["detection_rate"] for name in ("random", "oracle"))
    assert other["gap_closed"] == pytest.approx((other["detection_rate"] - low) / (high - low))
    difference = other["against_first"]["detection_rate"]["mean"]
    assert difference == pytest.approx(other["detection_rate"] - own["detection_rate"])


def test_without_other_noise_nothing_is_luck(lookups, starts):
    rows = [row for row in ablate_noise_resampling((lookups[0],) * 2, [], starts, 2) if row["policy"] == "oracle"]
    assert [row["noise"] for row in rows] == ["own", "unforeseen", "other"]
    assert {row["gap_closed"] for row in rows} == {1.0}
    foreseen = [search_views(lookups[0], *start, 2) for start in starts.tolist()]
    same = join_banks(lookups[0].bank, lookups[0].bank)
    np.testing.assert_array_equal(search_unforeseen(same, starts, 2), foreseen)


def test_the_joined_bank_is_either_bank(lookups):
    joined, rng = join_banks(*(lookup.bank for lookup in lookups)), np.random.default_rng(0)
    scene, views = rng.integers(2, size=20), rng.permuted(np.tile(np.arange(100), (20, 1)), axis=1)[:, :4]
    for number, lookup in enumerate(lookups):
        expected = worth(lookup, scene, views)
        np.testing.assert_allclose(worth(joined, scene, views + 100 * number), expected)
    # The last image foretold by the other bank: fused by hand from both banks' hypotheses.
    mixed = np.column_stack([views[:, :3], views[:, 3] + 100])
    first, second = (lookup.bank.scenes[scene[0]] for lookup in lookups)
    taken, foretold = np.isin(first.view, views[0, :3]), second.view == views[0, 3]
    fields = {
        field: np.concatenate([getattr(first, field)[taken], getattr(second, field)[foretold]])
        for field in ("view", "table", "errors")
    }
    order = np.argsort(fields["view"], kind="stable")
    by_hand = replace(first, **{field: values[order] for field, values in fields.items()})
    alone = BestViewLookup(replace(lookups[0].bank, scenes=[by_hand]))
    assert worth(joined, scene[:1], mixed[:1]) == pytest.approx(worth(alone, np.array([0]), views[:1]))


def test_intervals_of_a_ratio_are_those_of_resampled_ratios():
    rng = np.random.default_rng(3)
    scene, whole = np.repeat(np.arange(5), 4), rng.uniform(0.1, 0.5, 20)
    part = 0.5 * whole + rng.normal(0, 0.02, 20)
    intervals = Intervals(scene, seed=1)
    low, high = intervals.of_ratio(part, whole)["ci95_scenes"]
    drawn = [np.concatenate([np.flatnonzero(scene == s) for s in rng.integers(5, size=5)]) for _ in range(4000)]
    expected = np.quantile([part[d].mean() / whole[d].mean() for d in drawn], [0.025, 0.975])
    centre, ratios = part.mean() / whole.mean(), part / whole
    widening = scipy.stats.t.ppf(0.975, 4) / 1.959964 * np.sqrt(5 / 4)
    expected = np.clip(centre + widening * (expected - centre), ratios.min(), ratios.max())
    np.testing.assert_allclose([low, high], expected, atol=0.02)
    # Where nothing is to be shared out in some scenes, the resamples of these alone say nothing.
    assert intervals.of_ratio(part * (scene == 0), whole * (scene == 0))["ci95"][1] < 2.0


@pytest.mark.parametrize(
    "change", [{"provenance": {"estimator": "geometric"}}, {"scenes": slice(0, 1)}], ids=["estimator", "scenes"]
)
def test_banks_of_something_else_are_refused(lookups, starts, change):
    bank = lookups[1].bank
    change = {key: bank.scenes[value] if key == "scenes" else value for key, value in change.items()}
    with pytest.raises(ValueError, match="differ in more than their seed"):
        next(ablate_noise_resampling((lookups[0], BestViewLookup(replace(bank, **change))), [], starts, 1))


def test_no_gap_is_refused(lookups, starts):
    with pytest.raises(ValueError, match="finds no more than Random"):
        next(ablate_noise_resampling(lookups, [], starts, 0))
