"""Matching, recalls, precisions and curves against loops written down from BOP's definitions."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from active6d_core.camera import DEFAULT_CAMERA, View
from active6d_core.hypotheses import Hypotheses
from active6d_core.metrics import add_s, e_add, mspd, mssd
from active6d_core.object_model import load_object
from active6d_core.se3 import make_transform
from active6d_perception.estimators.detection_rates import (
    area_under_curve,
    average_precision,
    bootstrapped,
    rank_correlation,
    recall_at_precision,
    recalls,
    thresholds,
)
from active6d_perception.estimators.single_view_evaluation import (
    EstimatorResult,
    LabelledView,
    ViewResult,
    evaluate_view,
)
from active6d_perception.scene.verification import Verifier

DIAMETER = 0.1
LIMITS = {"mssd": [0.005 * i for i in range(1, 11)], "mspd": [5.0 * i for i in range(1, 11)]}


def random_view(rng):
    """A view with up to 6 objects and 7 hypotheses, and the full (k, n) tables of its errors."""
    n, k = rng.integers(1, 7), rng.integers(0, 8)
    tables = {"mssd": rng.uniform(0, 0.08, (k, n)), "mspd": rng.uniform(0, 80, (k, n))}
    hypothesis, true = np.nonzero(rng.random((k, n)) < 0.8)
    for table in tables.values():
        far = np.ones((k, n), bool)
        far[hypothesis, true] = False
        table[far] = np.inf
    errors = {name: table[hypothesis, true] for name, table in tables.items()}
    view = ViewResult(
        visible_fraction=rng.choice([0.02, 0.3, 0.9], n),
        feature_seen=np.full(n, np.nan),
        score=rng.permutation(100)[:k] / 100,
        certainty=np.full(k, np.nan),
        verification=rng.random(k),
        hypothesis=hypothesis,
        object=true,
        add=errors["mssd"],
        adds=errors["mssd"],
        rotation=errors["mspd"],
        width=640,
        seconds=0.1,
        cpu_seconds=0.1,
        **errors,
    )
    return view, tables


def bop_matches(table, score, limit, allowed):
    """As in BOP's toolkit: hypotheses by falling score, each takes the best object that is free and allowed."""
    taken, matches = set(), {}
    for j in sorted(range(len(score)), key=lambda j: -score[j]):
        best, best_error = None, limit
        for i in range(table.shape[1]):
            if i in allowed and i not in taken and table[j, i] < best_error:
                best, best_error = i, table[j, i]
        if best is not None:
            taken.add(best)
            matches[j] = best
    return matches


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from(["mssd", "mspd"]))
def test_recalls_are_those_of_bop(seed, error):
    rng = np.random.default_rng(seed)
    made = [random_view(rng) for _ in range(3)]
    found, counts = recalls([view for view, _ in made], error, DIAMETER)
    for number, (view, tables) in enumerate(made):
        valid = {i for i, fraction in enumerate(view.visible_fraction) if fraction >= 0.1}
        top = sorted(range(len(view.score)), key=lambda j: -view.score[j])[: len(valid)]
        assert counts[number] == len(valid)
        for step, limit in enumerate(LIMITS[error]):
            expected = bop_matches(tables[error][top], view.score[top], limit, valid)
            assert found[number, step] == len(expected)


def test_thresholds_grow_with_diameter_and_image():
    np.testing.assert_allclose(thresholds("mssd", 0.2, 640), 0.01 * np.arange(1, 11))
    np.testing.assert_allclose(thresholds("mspd", 0.2, 1280), 10.0 * np.arange(1, 11))


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6))
def test_average_precision_is_the_area_under_the_envelope(seed):
    rng = np.random.default_rng(seed)
    made = [random_view(rng) for _ in range(4)]
    limit = 0.04
    ranked, total = [], 0
    for view, tables in made:
        visible = {i for i, fraction in enumerate(view.visible_fraction) if fraction >= 0.1}
        total += len(visible)
        taken = set()
        for j in sorted(range(len(view.score)), key=lambda j: -view.score[j]):
            free = [i for i in range(len(view.visible_fraction)) if i not in taken and tables["mssd"][j, i] < limit]
            wanted = [i for i in free if i in visible] or free
            if not wanted:
                ranked.append((view.score[j], False))
                continue
            best = min(wanted, key=lambda i: tables["mssd"][j, i])
            taken.add(best)
            if best in visible:
                ranked.append((view.score[j], True))
    result = average_precision([view for view, _ in made], "mssd", [limit])
    if not total:
        assert result is None
        return
    ranked.sort(key=lambda pair: -pair[0])  # stable, as scores of two views may be equal
    hits, points = 0, []
    for count, (_, right) in enumerate(ranked, start=1):
        hits += right
        points.append((hits / total, hits / count))
    expected = np.mean(
        [max((p for r, p in points if r >= step - 1e-12), default=0.0) for step in np.linspace(0, 1, 101)]
    )
    assert result == pytest.approx(expected)
    for least in (0.3, 0.6, 1.0):
        precise = max((r for r, p in points if p >= least), default=0.0)
        assert recall_at_precision([view for view, _ in made], "mssd", limit, least) == pytest.approx(precise)


@given(st.lists(st.tuples(st.integers(0, 5), st.booleans()), min_size=1, max_size=30))
def test_area_under_the_curve_counts_pairs(values):
    score, right = np.array([value for value, _ in values], float), np.array([flag for _, flag in values])
    result = area_under_curve(score, right)
    pairs = [(a > b) + 0.5 * (a == b) for a in score[right] for b in score[~right]]
    assert result == (pytest.approx(np.mean(pairs)) if pairs else None)


def test_rank_correlation_knows_only_order():
    error = np.array([1.0, 2.0, 3.0, np.inf])
    assert rank_correlation(np.array([0.9, 0.8, 0.1, 0.05]), error) == pytest.approx(-1.0)
    # 1 - 6 sum d^2 / (n (n^2 - 1)) with d = 1, 1, 0, 0 from the rising order
    assert rank_correlation(np.array([0.2, 0.1, 0.3, 0.4]), error) == pytest.approx(1 - 6 * 2 / (4 * 15))
    assert rank_correlation(np.ones(4), error) is None


def test_intervals_come_from_scenes_not_views():
    alike = bootstrapped(np.full(40, 5), np.full(40, 10), np.repeat([0, 1, 2, 3], 10))
    assert alike == {"rate": 0.5, "low": 0.5, "high": 0.5, "of": 400}
    # Two of four scenes are all found: the rate is the mean of 4 fair coins, whose 2.5 % quantile is 0 or 1/4.
    split = bootstrapped(np.repeat([10, 10, 0, 0], 10), np.full(40, 10), np.repeat([0, 1, 2, 3], 10))
    assert split["rate"] == 0.5
    assert split["low"] == 0.0
    assert split["high"] == 1.0
    assert bootstrapped(np.zeros(2), np.zeros(2), [0, 1])["rate"] is None
    one_scene = bootstrapped(np.array([0, 10]), np.array([10, 10]), [7, 7])
    assert one_scene["low"] < 0.5 < one_scene["high"]


def test_a_view_is_compared_with_the_truth_pair_by_pair():
    model = load_object("mug")
    true = make_transform(np.eye(3), np.array([(0.0, 0.0, 0.8), (0.15, 0.0, 0.8)]))
    guess = true.copy()
    guess[:, 0, 3] += (0.004, 0.5)
    segmentation = np.zeros((480, 640), np.uint16)
    segmentation[100:120, 100:120], segmentation[200:220, 200:220] = 1, 2
    view = View(1, np.zeros((480, 640, 3), np.uint8), np.full((480, 640), 0.8, np.float32), DEFAULT_CAMERA, np.eye(4))

    class Guess:
        def estimate(self, view):
            self.stage_ms = {"thinking": 1.0}
            return Hypotheses.from_masks(guess, np.array([0.9, 0.8]), np.array([1, 2]), segmentation, view.depth)

    result = evaluate_view(Guess(), Verifier(model), model, LabelledView(view, true, np.array([0.9, 0.9])))
    pair = np.flatnonzero((result.hypothesis == 0) & (result.object == 0))[0]
    assert result.add[pair] == pytest.approx(e_add(model, guess[0], true[0]))
    assert result.adds[pair] == pytest.approx(add_s(model, guess[0], true[0]))
    assert result.mssd[pair] == pytest.approx(mssd(model, guess[0], true[0])) == pytest.approx(0.004)
    assert result.mspd[pair] == pytest.approx(mspd(model, guess[0], true[0], DEFAULT_CAMERA))
    assert result.rotation[pair] == 0.0
    assert result.stage_ms == {"thinking": 1.0}
    assert list(result.least("add") < 0.01) == [True, False]
    whole = EstimatorResult(model.diameter, (result,))
    assert list(whole.right("add")) == [True, False]
    assert list(whole.found("adds")) == [True, False]
    assert whole.detection_rate(0.5) == 0.5
    assert np.isnan(whole.detection_rate(0.95))
