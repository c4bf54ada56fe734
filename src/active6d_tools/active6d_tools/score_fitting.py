"""Fitting of an estimator's score: what it says of poses in validation views, and whether they are right."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from active6d_core.camera import View
from active6d_core.metrics import DETECTION_FRACTION, add_s, e_add, match
from active6d_core.object_model import ObjectModel
from active6d_core.se3 import invert
from active6d_core.view_sphere import ViewSphere
from active6d_perception.estimators.dense.canonical_frame import AxisRotation
from active6d_perception.estimators.dense.dense_estimator import DenseEstimator, DenseParameters, log_odds
from active6d_perception.estimators.dense.trained_network import (
    CERTAINTY_FEATURES,
    SCORE_FEATURES,
    SCORE_LOWERED_BY,
    load_network,
    save_score,
)
from active6d_perception.estimators.detection_rates import calibration_error
from active6d_perception.estimators.score_model import ScoreModel
from active6d_sim.scenes.scene_store import SPLITS, load_scene
from active6d_tools.benchmark.grid_views import GridViews
from active6d_tools.training_data import VALIDATION_SPLITS

#: From a model, estimated and true poses to errors in metres, see :mod:`active6d_core.metrics`.
ErrorMeasure = Callable[[ObjectModel, np.ndarray, np.ndarray], np.ndarray]
#: From a view to (k, 4, 4) ``T_camera_object`` and their (k, f) features.
Judge = Callable[[View], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True, eq=False)
class JudgedPoses:
    """k poses of validation views.

    Attributes:
        features: (k, f) as the estimator computes them.
        right: (k,) bool, whether each is the best match of a true object, within 10 % of the diameter. An object with a
            part that can be hidden counts by ADD-S, as no view may show how it is turned.
        exact: (k,) bool, the same by ADD for every object.
        split: (k,) index into :data:`.VALIDATION_SPLITS`.
        group: (k,) number of the scene.
    """

    features: np.ndarray
    right: np.ndarray
    exact: np.ndarray
    split: np.ndarray
    group: np.ndarray

    @property
    def weight(self) -> np.ndarray:
        """(k,) weights with which every split counts alike."""
        return np.asarray(1.0 / np.bincount(self.split, minlength=len(VALIDATION_SPLITS))[self.split])


def fit_dense_score(
    model: ObjectModel,
    weights: Path,
    views: int,
    rng: np.random.Generator,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, float]:
    """Fit the score of a trained network and write it beside the weights.

    Args:
        model: the object.
        weights: ``.safetensors`` file of the network.
        views: number of views of each validation scene.
        rng: random generator of the views.
        on_progress: as :func:`judge_validation_views`.

    Returns:
        Calibration error and precision at score .5 by split, on the views that it was fitted on.
    """
    uncalibrated = replace(load_network(weights, model), certainty=None)
    estimator = DenseEstimator(model, uncalibrated, DenseParameters(min_score=0.0))

    def judge(view: View) -> tuple[np.ndarray, np.ndarray]:
        poses, _ = estimator.locate(view)
        return poses.T_camera_object, np.column_stack([poses.features, log_odds(poses.certainty)])

    poses = judge_validation_views(model, judge, views, rng, on_progress)
    poses, rotation = replace(poses, features=poses.features[:, :-1]), poses.features[:, -1:]
    score = ScoreModel.fit(SCORE_FEATURES, poses.features, poses.right, poses.weight, against=SCORE_LOWERED_BY)
    certainty = None
    if uncalibrated.canonical_frame.axis_rotation is AxisRotation.SHOWN_BY_FEATURE:
        body, weight = poses.right, poses.weight
        certainty = ScoreModel.fit(CERTAINTY_FEATURES, rotation[body], poses.exact[body], weight[body])
    save_score(weights, score, certainty)
    return summarise_score(score, poses)


def summarise_score(score: ScoreModel, poses: JudgedPoses) -> dict[str, float]:
    """By split: the calibration error, and of the poses with score .5 or more the share that is right."""
    probability = score.probability(poses.features)
    summary: dict[str, float] = {}
    for number, split in enumerate(VALIDATION_SPLITS):
        chosen = poses.split == number
        sure = chosen & (probability >= 0.5)
        summary[f"{split}_calibration_error"] = calibration_error(probability[chosen], poses.right[chosen]) or 0.0
        summary[f"{split}_precision_at_half"] = float(poses.right[sure].mean()) if sure.any() else 0.0
        summary[f"{split}_right_found"] = float(sure[poses.right & chosen].mean())
    return summary


def judge_validation_views(
    model: ObjectModel,
    judge: Judge,
    views: int,
    rng: np.random.Generator,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> JudgedPoses:
    """Run an estimator on random views of the nominal and the wild validation scenes.

    Args:
        model: the object.
        judge: the estimator's poses and features.
        views: number of views of each scene.
        rng: random generator of the views.
        on_progress: called with the number of scenes done and of all scenes.
    """
    parts: list[tuple[np.ndarray, ...]] = []
    total = sum(SPLITS[split] for split in VALIDATION_SPLITS)
    done = 0
    for number, split in enumerate(VALIDATION_SPLITS):
        scenes = [load_scene(model.name, split, index) for index in range(SPLITS[split])]
        grid = GridViews(model, scenes, seed=0)
        for index in range(len(scenes)):
            for view in rng.choice(len(ViewSphere()), views, replace=False):
                labelled = grid.capture(index, int(view), 1.0)
                T, features = judge(labelled.view)
                true = invert(labelled.view.T_world_camera) @ labelled.T_world_object
                right, exact = (is_right(model, T, true, measure) for measure in (error_measure(model), e_add))
                parts.append((features, right, exact, np.full(len(T), number), np.full(len(T), done)))
            done += 1
            on_progress(done, total)
    return JudgedPoses(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def error_measure(model: ObjectModel) -> ErrorMeasure:
    """ADD-S for an object with a part that can be hidden, as no view may show how it is turned; ADD for others."""
    return add_s if model.features else e_add


def is_right(
    model: ObjectModel, T_camera_object: np.ndarray, T_camera_true: np.ndarray, measure: ErrorMeasure
) -> np.ndarray:
    """(k,) whether each of (k, 4, 4) poses is the match of one of (n, 4, 4) true ones, within 10 % of the diameter."""
    limit = DETECTION_FRACTION * model.diameter
    errors = np.full((len(T_camera_object), len(T_camera_true)), np.inf)
    apart = np.linalg.norm(T_camera_object[:, None, :3, 3] - T_camera_true[None, :, :3, 3], axis=-1)
    for pose, other in zip(*np.nonzero(apart < 0.5 * model.diameter), strict=True):
        errors[pose, other] = measure(model, T_camera_object[pose], T_camera_true[other])
    matched = match(errors, limit)
    return np.isin(np.arange(len(T_camera_object)), matched[matched >= 0])
