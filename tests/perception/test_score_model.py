"""The fitted probability against the one that the data was drawn with."""

import json

import numpy as np
import pytest

from active6d_perception.estimators.detection_rates import calibration_error, reliability
from active6d_perception.estimators.score_model import ScoreModel

NAMES = ("fit", "violated")


def drawn(count=20_000, seed=0):
    """Features of very different scales, and outcomes with the probability sigmoid(3 fit - 200 violated - 1)."""
    rng = np.random.default_rng(seed)
    features = np.column_stack([rng.normal(0.5, 1.0, count), rng.uniform(0, 0.02, count)])
    probability = 1 / (1 + np.exp(-(features @ [3.0, -200.0] - 1.0)))
    return features, probability, rng.random(count) < probability


def test_weights_are_found_again():
    features, probability, right = drawn()
    model = ScoreModel.fit(NAMES, features, right, np.ones(len(right)), penalty=1e-6)
    assert model.weights == pytest.approx([3.0, -200.0], rel=0.05)
    assert model.intercept == pytest.approx(-1.0, abs=0.1)
    assert np.abs(model.probability(features) - probability).max() < 0.03


def test_weighted_poses_count_as_often_as_their_weight_says():
    features, _, right = drawn(400)
    twice = np.concatenate([features, features[:100]]), np.concatenate([right, right[:100]])
    weight = np.ones(400)
    weight[:100] = 2.0
    ours, theirs = ScoreModel.fit(NAMES, features, right, weight), ScoreModel.fit(NAMES, *twice, np.ones(500))
    grid = np.column_stack([np.linspace(-2, 3, 20), np.linspace(0, 0.02, 20)])
    assert np.abs(ours.probability(grid) - theirs.probability(grid)).max() < 0.02


def test_a_model_comes_back_from_json():
    model = ScoreModel(NAMES, np.array([1.5, -2.25]), 0.5)
    again = ScoreModel.from_dict(json.loads(json.dumps(model.as_dict())), NAMES)
    features = drawn(50)[0]
    assert np.allclose(model.probability(features), again.probability(features))


@pytest.mark.parametrize(
    "data",
    [
        {},
        {"weights": {"fit": 1.0}, "intercept": 0.0},
        {"weights": {"fit": 1.0, "violated": "much"}, "intercept": 0.0},
        {"weights": {"fit": 1.0, "violated": float("nan")}, "intercept": 0.0},
        {"weights": [1.0, 2.0], "intercept": 0.0},
    ],
)
def test_what_is_no_model_is_refused(data):
    with pytest.raises(ValueError, match="not a score model"):
        ScoreModel.from_dict(data, NAMES)


def test_what_speaks_against_a_pose_never_speaks_for_it():
    features, _, right = drawn()
    model = ScoreModel.fit(NAMES, features * [1, -1], right, np.ones(len(right)), against=("violated",))
    assert model.weights[1] == 0


def test_one_kind_of_outcome_is_not_enough():
    features, _, right = drawn(20)
    with pytest.raises(ValueError, match="right and wrong"):
        ScoreModel.fit(NAMES, features, np.ones_like(right), np.ones(20))


def test_calibration_error_by_hand():
    """Two bins: .25 with half right (off by .25), and .85 with all right (off by .15)."""
    score = np.array([0.25, 0.25, 0.85, 0.85, 0.85, 0.85])
    right = np.array([True, False, True, True, True, True])
    assert calibration_error(score, right) == pytest.approx((2 * 0.25 + 4 * 0.15) / 6)
    assert [row["hypotheses"] for row in reliability(score, right)] == [2, 4]
    assert calibration_error(np.zeros(0), np.zeros(0, bool)) is None
    assert calibration_error(np.array([1.0]), np.array([True])) == 0


def test_true_probabilities_are_calibrated():
    _, probability, right = drawn()
    assert calibration_error(probability, right) < 0.01
    assert calibration_error(np.sqrt(probability), right) > 0.05
