"""Evaluation and bounds against exhaustive search, step-by-step episodes and closed forms."""

from itertools import combinations, product

import numpy as np
import pytest
import scipy.stats
from synthetic_bank import synthetic_bank

from active6d_agent.bank.best_view_lookup import BestViewLookup
from active6d_agent.environment.gym_environment import Active6DEnv
from active6d_agent.evaluation import oracle
from active6d_agent.evaluation import policy_evaluation as evaluation
from active6d_agent.policies.registry import Decision, create_policy
from active6d_core.metrics import DETECTION_FRACTION, e_add, evaluate_scene


@pytest.fixture(scope="module")
def lookup():
    return BestViewLookup(synthetic_bank("mug"))


@pytest.fixture(scope="module")
def starts(lookup):
    return evaluation.all_starts(lookup, 12, seed=1)


def exact_score(lookup, scene, views):
    objects = lookup.objects(scene, [view for view in views if view >= 0])
    return evaluate_scene(lookup.model, objects.T_world_object, lookup.bank.scenes[scene].T_world_object)


def test_starts_are_every_pair_or_a_sample(lookup):
    assert len(np.unique(evaluation.all_starts(lookup), axis=0)) == 200
    sample = evaluation.all_starts(lookup, 20, seed=3)
    assert len(np.unique(sample, axis=0)) == 20
    np.testing.assert_array_equal(sample, evaluation.all_starts(lookup, 20, seed=3))


@pytest.mark.parametrize("name", ["random", "lowest-score", "entropy", "single-view", "oracle", "all-views"])
def test_results_are_scored_like_any_other_poses(lookup, starts, name):
    results = evaluation.run_named(lookup, name, starts, 3)
    np.testing.assert_array_equal(results.views[:, 0], starts[:, 1])
    for index, (scene, _) in enumerate(starts):
        taken = results.views[index][results.views[index] >= 0]
        assert len(set(taken)) == len(taken) == {"single-view": 1, "all-views": 100}.get(name, 4)
        score = exact_score(lookup, scene, taken)
        assert results.detection_rate[index] == pytest.approx(score.detection_rate)
        assert results.e_add_mm[index] == pytest.approx(score.mean_e_add_mm, abs=1e-3)
        assert results.distance_m[index] == pytest.approx(lookup.sphere.path_length(lookup.sphere.positions[taken]))


@pytest.mark.parametrize("name", ["random", "lowest-score"])
def test_side_by_side_is_one_by_one(lookup, starts, name):
    together = evaluation.run_named(lookup, name, starts, 4, seed=7)
    alone = [evaluation.run_named(lookup, name, start[None], 4, seed=7).views[0] for start in starts]
    np.testing.assert_array_equal(together.views, alone)


def test_an_evaluated_episode_is_the_environments(lookup):
    """The same views, so the same results."""
    views = evaluation.run_named(lookup, "max-distance", np.array([[1, 8]]), 5)
    env = Active6DEnv(lookup)
    env.reset(options={"scene": 1, "view": 8})
    for view in views.views[0, 1:]:
        azimuth, elevation = lookup.sphere.angles(lookup.sphere.positions[view])
        _, _, _, _, info = env.step(np.array([azimuth / np.pi, elevation / (np.pi / 4) - 1.0, 0.0]))
        assert info["view"] == view
    assert info["detection_rate"] == pytest.approx(views.detection_rate[0])
    assert info["distance_m"] == pytest.approx(views.distance_m[0])


class StopsAfterTwo:
    def reset(self, rng):
        self.inner = create_policy("max-distance", None)
        self.inner.reset(rng)

    def decide(self, observation):
        return Decision.stop_here(observation) if observation.steps_left <= 3 else self.inner.decide(observation)


def test_stopping_early_keeps_what_was_seen(lookup, starts):
    results = evaluation.run_policy(lookup, lambda scene: StopsAfterTwo(), starts, 5)
    assert ((results.views >= 0).sum(axis=1) == 3).all()
    scores = [exact_score(lookup, scene, views) for (scene, _), views in zip(starts, results.views, strict=True)]
    np.testing.assert_allclose(results.detection_rate, [score.detection_rate for score in scores])


def test_a_policy_is_given_its_mask_and_its_metres(lookup, starts):
    allowed = np.arange(100) % 3 == 0
    results = evaluation.run_policy(
        lookup, lambda scene: create_policy("random", lookup.model), starts, 6, allowed=allowed, metres=2.0
    )
    later = results.views[:, 1:]
    assert allowed[later[later >= 0]].all()
    assert (results.distance_m <= 2.0 + 1e-9).all()


# Bounds


def test_the_greedy_oracle_takes_the_best_next_view(lookup):
    path = oracle.search_views(lookup, 0, 17, 2)
    for step in (1, 2):
        taken = path[:step]
        others = np.setdiff1d(np.arange(100), taken)
        candidates = np.array([[*taken, view] for view in others])
        worths = oracle.worth(lookup, np.zeros(len(others), int), candidates)
        chosen = oracle.worth(lookup, np.zeros(1, int), path[None, : step + 1])[0]
        assert chosen == pytest.approx(worths.max())


def test_worth_counts_detected_objects_first(lookup):
    scene, views = np.array([0, 1]), np.array([[3, 40, 77], [9, 60, 12]])
    for index in range(2):
        score = exact_score(lookup, scene[index], views[index])
        detected = int(oracle.worth(lookup, scene, views)[index])
        assert detected >= score.detected.sum(), "without one-to-one matching no fewer objects count"


def test_a_wide_beam_is_exhaustive_search(lookup):
    allowed = np.zeros(100, bool)
    allowed[[2, 11, 29, 45, 58, 73, 91]] = True
    path = oracle.search_views(lookup, 1, 45, 3, width=1000, allowed=allowed)
    others = np.setdiff1d(np.flatnonzero(allowed), [45])
    every = np.array([[45, *chosen] for chosen in combinations(others, 3)])
    best = oracle.worth(lookup, np.ones(len(every), int), every).max()
    assert oracle.worth(lookup, np.ones(1, int), path[None])[0] == pytest.approx(best)
    greedy = oracle.search_views(lookup, 1, 45, 3, allowed=allowed)
    assert oracle.worth(lookup, np.ones(1, int), greedy[None])[0] <= best + 1e-12


def test_search_ends_where_no_view_is_left(lookup):
    allowed = np.zeros(100, bool)
    allowed[[4, 5]] = True
    assert sorted(oracle.search_views(lookup, 0, 4, 9, allowed=allowed)) == [4, 5]


# The table


def test_the_bootstrap_of_episodes_is_the_normal_interval_of_many_values():
    values = np.random.default_rng(0).normal(3.0, 2.0, 4000)
    low, high = evaluation.Intervals(np.arange(4000) % 10, seed=1).of(values)["ci95"]
    half = 1.96 * 2.0 / np.sqrt(4000)
    assert low == pytest.approx(values.mean() - half, abs=0.1 * half)
    assert high == pytest.approx(values.mean() + half, abs=0.1 * half)


def test_the_bootstrap_of_scenes_draws_them_whole():
    """All 5^5 ways to draw five scenes, of unequal sizes, one after the other."""
    rng = np.random.default_rng(4)
    scene = np.repeat([3, 0, 7, 1, 2], [4, 9, 6, 2, 5])
    values = rng.normal(size=len(scene)) + rng.normal(size=8)[scene]
    means = []
    for drawn in product(np.unique(scene), repeat=5):
        together = np.concatenate([values[scene == one] for one in drawn])
        means.append(together.mean())
    intervals = evaluation.Intervals(scene, seed=1, resamples=50_000).of(values)
    expected = values.mean() + widening(5) * (np.quantile(means, [0.025, 0.975]) - values.mean())
    np.testing.assert_allclose(intervals["ci95_scenes"], expected, atol=0.03 * np.ptp(means))
    assert np.ptp(intervals["ci95_scenes"]) > np.ptp(intervals["ci95"]), "episodes of a scene are alike"


def widening(scenes):
    return scipy.stats.t.ppf(0.975, scenes - 1) / 1.959964 * np.sqrt(scenes / (scenes - 1))


def test_nineteen_of_twenty_intervals_over_ten_scenes_hold_the_truth():
    rng, scene, held = np.random.default_rng(5), np.repeat(np.arange(10), 3), 0
    for trial in range(600):
        values = np.repeat(rng.normal(2.0, 1.0, 10), 3)
        low, high = evaluation.Intervals(scene, seed=trial, resamples=500).of(values)["ci95_scenes"]
        held += low < 2.0 < high
    assert 0.925 < held / 600 < 0.975


def test_an_interval_stays_within_the_values():
    low, high = evaluation.Intervals(np.arange(6) // 3).of(np.array([0.9, 1.0, 1.0, 0.5, 0.6, 1.0]))["ci95_scenes"]
    assert (low, high) == (0.5, 1.0)


def test_one_scene_has_no_interval_over_scenes():
    """However far apart two policies are in one scene, that says nothing of other scenes."""
    own = {"e_add_mm": np.array([1.0, 2.0, 3.0]), "confirmed": np.full(3, 4.0), "wrong": np.array([0.0, 1.0, 2.0])}
    other = {name: values + 5.0 for name, values in own.items()}
    row = evaluation.describe(own, evaluation.Intervals(np.full(3, 7)), other)
    for name in own:
        assert row[f"{name}_ci95_scenes"] is None
    assert row["e_add_mm_ci95"][0] < row["e_add_mm"] < row["e_add_mm_ci95"][1]
    told = row["against_first"]["e_add_mm"]
    assert (told["mean"], told["ci95_scenes"]) == (-5.0, None)
    assert (told["excludes_zero"], told["excludes_zero_scenes"]) == (True, False)


def test_the_table_pairs_policies_and_says_how_much_of_the_gap_is_closed(lookup, starts):
    names = ["single-view", "random", "max-distance", "oracle"]
    results = dict(evaluation.evaluate(lookup, names, 3, starts))
    table = evaluation.summarise(results, "mug", 3)
    rows = table["policies"]
    assert (table["object"], table["steps"], table["episodes"], table["scenes"]) == ("mug", 3, len(starts), 2)
    assert rows["random"]["gap_closed"] == 0.0
    assert rows["oracle"]["gap_closed"] == 1.0
    low, own, high = (rows[name]["detection_rate"] for name in ("random", "max-distance", "oracle"))
    assert rows["max-distance"]["gap_closed"] == pytest.approx((own - low) / (high - low))
    won = rows["oracle"]["against"]["single-view"]["detection_rate"]
    assert won["mean"] == pytest.approx(rows["oracle"]["detection_rate"] - rows["single-view"]["detection_rate"])
    assert won["ci95"][0] > 0
    assert won["ci95"][0] <= won["mean"] <= won["ci95"][1]
    assert won["excludes_zero"]
    for row in rows.values():
        for name in ("detection_rate", "e_add_mm"):
            for kind in ("ci95", "ci95_scenes"):
                assert row[f"{name}_{kind}"][0] <= row[name] <= row[f"{name}_{kind}"][1]
    alone = evaluation.summarise({"random": results["random"]}, "mug", 3)
    assert alone["policies"]["random"]["gap_closed"] is None


def test_differences_are_resampled_by_scene_start_by_start(lookup, starts):
    """Of two scenes, a quarter of the draws takes one twice: before it is widened, the interval joins their means."""
    results = dict(evaluation.evaluate(lookup, ["random", "max-distance"], 2, starts))
    against = evaluation.summarise(results, "mug", 2)["policies"]["max-distance"]["against"]["random"]
    for name, told in against.items():
        differences = getattr(results["max-distance"], name) - getattr(results["random"], name)
        by_scene = sorted(differences[starts[:, 0] == scene].mean() for scene in (0, 1))
        wide = differences.mean() + widening(2) * (np.array(by_scene) - differences.mean())
        low, high = np.clip(wide, differences.min(), differences.max())
        np.testing.assert_allclose(told["ci95_scenes"], [low, high])
        assert told["excludes_zero_scenes"] == (low > 0 or high < 0)
        assert told["mean"] == pytest.approx(differences.mean())


def test_confirmed_objects_are_counted_by_hand(lookup, starts):
    results = evaluation.run_named(lookup, "random", starts, 3)
    limit = DETECTION_FRACTION * lookup.model.diameter
    for index, (scene, _) in enumerate(starts):
        objects = lookup.objects(scene, results.views[index])
        sure = objects.T_world_object[objects.probability >= lookup.parameters.confirmed]
        true = lookup.bank.scenes[scene].T_world_object
        assert results.confirmed_rate[index] == pytest.approx(evaluate_scene(lookup.model, sure, true).detection_rate)
        right = (e_add(lookup.model, sure[:, None], true) < limit).any(axis=1)
        assert (results.confirmed[index], results.wrong[index]) == (len(right), (~right).sum())
    row = evaluation.describe(results.measures, evaluation.Intervals(results.scene))
    assert 0 < row["wrong"] == pytest.approx(results.wrong.sum() / results.confirmed.sum())
    low, high = row["wrong_ci95"]
    assert low <= row["wrong"] <= high


def test_nothing_confirmed_has_no_share_of_wrong_objects():
    nothing = {"confirmed": np.zeros(2), "wrong": np.zeros(2)}
    row = evaluation.describe(nothing, evaluation.Intervals(np.array([0, 1])))
    assert row["wrong"] is None
    assert row["confirmed"] == 0
