"""Results of one estimator: detection rates by visible fraction, BOP's measures, times, and quality of the scores."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from active6d_core.object_model import ObjectModel
from active6d_perception.estimators.detection_rates import (
    LEAST_VISIBLE,
    area_under_curve,
    average_precision,
    bootstrapped,
    calibration_error,
    rank_correlation,
    recall_at_precision,
    recalls,
    reliability,
    thresholds,
)
from active6d_perception.estimators.single_view_evaluation import EstimatorResult

#: Visible fractions from which on objects are counted.
VISIBLE = (0.5, 0.1)
#: Edges of the visible fractions by which detection is listed.
VISIBLE_BINS = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
#: A named part (the mug's handle) is visible when more of its surface than this share is seen.
FEATURE_SEEN = 0.15
#: Times are also given for the views with at least so many objects that are a tenth visible.
CROWDED = 14
#: Recall is given at the score thresholds with these precisions.
PRECISIONS = (0.95, 0.98)
#: Hypotheses with at least this score count as reported.
SURE = 0.5
#: A rotation about the axis is right within this many degrees.
SAME_ROTATION = 30.0


def summarise(model: ObjectModel, result: EstimatorResult, scenes: Sequence[Any]) -> dict[str, Any]:
    """All results of one estimator, for JSON.

    Args:
        model: the object.
        result: of v views.
        scenes: (v,) which scene each view is of; intervals are by scenes.

    Returns:
        The results by name. For an object with a part that can be hidden (the mug's handle), ``precision`` and
        ``average_precision.pose`` use ADD-S, because a view may not show the rotation about the axis. The calibration
        error is by ADD, as the score is the probability that the whole pose is right.
    """
    by = "adds" if model.features else "add"
    row: dict[str, Any] = _detection(result, scenes)
    if model.features:
        row["feature_seen"] = _detection(result, scenes, FEATURE_SEEN)
    for kind in ("add", "adds"):
        hits = np.array([(view.match(kind, result.limit) >= 0).sum() for view in result.views])
        row[f"precision_{kind}"] = bootstrapped(hits, np.array([len(view.score) for view in result.views]), scenes)
    row["precision"] = row[f"precision_{by}"]
    sure = [view.score >= SURE for view in result.views]
    hits = np.array(
        [(view.match(by, result.limit)[chosen] >= 0).sum() for view, chosen in zip(result.views, sure, strict=True)]
    )
    row["precision_at_half"] = bootstrapped(hits, np.array([chosen.sum() for chosen in sure]), scenes)
    row["reliability"] = reliability(result.gather("score"), result.right())
    row["calibration_error"] = calibration_error(result.gather("score"), result.right())
    row["average_precision"] = {"pose": average_precision(result.views, by, [result.limit])}
    row["recall_at_precision"] = {
        str(least): recall_at_precision(result.views, by, result.limit, least) for least in PRECISIONS
    }
    for error in ("mssd", "mspd"):
        found, counts = recalls(result.views, error, result.diameter)
        limits = thresholds(error, result.diameter, result.views[0].width)
        row[error] = {
            "recalls": [bootstrapped(hits, counts, scenes)["rate"] for hits in found.T],
            "average_recall": bootstrapped(found.mean(axis=1), counts, scenes),
        }
        row["average_precision"][error] = average_precision(result.views, error, limits)
    row["hypotheses_per_view"] = float(np.mean([len(view.score) for view in result.views]))
    row["time"] = _times(result)
    row["verification"] = score_study(result)
    if model.features:
        row["ambiguity"] = ambiguity_study(result)
    return row


def headline(row: dict[str, Any]) -> dict[str, Any]:
    """The rates that most readers of the JSON want, from a row of :func:`summarise`."""
    return {
        **{kind: {least: row[kind][least]["rate"] for least in map(str, VISIBLE)} for kind in ("add", "adds")},
        "precision": row["precision"]["rate"],
        "precision_at_half": row["precision_at_half"]["rate"],
        "calibration_error": row["calibration_error"],
        "ms_median": row["time"]["all"]["total"]["median_ms"],
    }


def _detection(result: EstimatorResult, scenes: Sequence[Any], feature_seen: float | None = None) -> dict[str, Any]:
    """Detection rates by ADD and ADD-S; only of objects with a visible named part if ``feature_seen`` is given."""
    per_view = np.repeat(np.arange(len(result.views)), [len(view.visible_fraction) for view in result.views])
    visible = result.gather("visible_fraction")
    counted = np.ones(len(visible), bool) if feature_seen is None else result.gather("feature_seen") > feature_seen
    bins = np.clip(np.searchsorted(VISIBLE_BINS, visible, side="right") - 1, 0, len(VISIBLE_BINS) - 2)
    rates: dict[str, Any] = {}
    for kind in ("add", "adds"):
        found = result.found(kind)

        def rate(chosen: np.ndarray, found: np.ndarray = found) -> dict[str, Any]:
            chosen = chosen & counted
            hits, counts = (np.bincount(per_view[i], minlength=len(result.views)) for i in (chosen & found, chosen))
            return bootstrapped(hits, counts, scenes)

        rates[kind] = {str(least): rate(visible >= least) for least in VISIBLE}
        rates[kind]["bins"] = [
            {"from": low, "to": high, **rate(bins == number)}
            for number, (low, high) in enumerate(pairwise(VISIBLE_BINS))
        ]
    return rates


def _times(result: EstimatorResult) -> dict[str, Any]:
    """Milliseconds of wall clock of the estimator and of its stages, for all views and for the crowded ones.

    ``cpu`` is the CPU time of all threads. It is the one to compare on a shared machine.
    """
    crowded = [view for view in result.views if (view.visible_fraction >= LEAST_VISIBLE).sum() >= CROWDED]
    times: dict[str, Any] = {}
    for name, views in (("all", result.views), ("crowded", crowded)):
        if not views:
            continue
        stages = dict.fromkeys(stage for view in views for stage in view.stage_ms)
        times[name] = {
            "views": len(views),
            "total": _spread([1e3 * view.seconds for view in views]),
            "cpu": _spread([1e3 * view.cpu_seconds for view in views]),
            "stages": {stage: _spread([view.stage_ms.get(stage, 0.0) for view in views]) for stage in stages},
        }
    return times


def _spread(milliseconds: Sequence[float]) -> dict[str, float]:
    median, slow = np.percentile(milliseconds, (50, 95))
    return {"median_ms": float(median), "p95_ms": float(slow)}


def score_study(result: EstimatorResult) -> dict[str, Any]:
    """How well equation 1 and the estimator's own score separate right from wrong poses (supplement A)."""
    errors = {kind: np.concatenate([view.least(kind) for view in result.views]) for kind in ("add", "adds")}
    right = {kind: error < result.limit for kind, error in errors.items()}
    study: dict[str, Any] = {"hypotheses": len(right["adds"])}
    for kind in ("add", "adds"):
        study[f"wrong_{kind}"] = int((~right[kind]).sum())
    for name, score in (("equation_1", result.gather("verification")), ("own_score", result.gather("score"))):
        study[name] = {f"auc_{kind}": area_under_curve(score, right[kind]) for kind in errors} | {
            f"spearman_{kind}": rank_correlation(score, error) for kind, error in errors.items()
        }
    return study


@dataclass(frozen=True, eq=False)
class AxisRotationErrors:
    """Hypotheses that are right by ADD-S, so that only their rotation about the axis may be wrong.

    Attributes:
        rotation: (h,) degrees between the orientation and the true one.
        certainty: (h,) of the estimator, or its score if it reports no certainty.
        seen: (h,) bool, the named part is visible.
        certain: whether the estimator reports a certainty.
    """

    rotation: np.ndarray
    certainty: np.ndarray
    seen: np.ndarray
    certain: bool


def axis_rotation_errors(result: EstimatorResult) -> AxisRotationErrors:
    """Collect the errors of all views."""
    rotation, certainty, score, seen = [], [], [], []
    for view in result.views:
        for pair in np.flatnonzero(view.adds < result.limit):
            hypothesis = view.hypothesis[pair]
            if view.adds[pair] == view.adds[view.hypothesis == hypothesis].min():
                rotation.append(view.rotation[pair])
                certainty.append(view.certainty[hypothesis])
                score.append(view.score[hypothesis])
                seen.append(view.feature_seen[view.object[pair]] > FEATURE_SEEN)
    certain = bool(np.isfinite(certainty).all()) and len(certainty) > 0
    return AxisRotationErrors(
        np.array(rotation), np.array(certainty if certain else score), np.array(seen, bool), certain
    )


def ambiguity_study(result: EstimatorResult) -> dict[str, Any]:
    """Whether the certainty is low where the rotation about the axis is wrong."""
    found = axis_rotation_errors(result)
    right = found.rotation < SAME_ROTATION
    study: dict[str, Any] = {
        "told_by": "certainty" if found.certain else "score",
        "auc": area_under_curve(found.certainty, right) if len(right) else None,
        "spearman": rank_correlation(found.certainty, found.rotation),
    }
    for name, chosen in (("seen", found.seen), ("hidden", ~found.seen)):
        study[name] = {
            "hypotheses": int(chosen.sum()),
            "right_turn": float(right[chosen].mean()) if chosen.any() else None,
            "certainty": [float(value) for value in np.percentile(found.certainty[chosen], (25, 50, 75))]
            if chosen.any()
            else None,
        }
    return study
