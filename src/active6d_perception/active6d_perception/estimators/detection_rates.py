"""Detection rates of an estimator over many views, as BOP defines them, with confidence intervals."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from scipy.stats import mannwhitneyu, spearmanr

from active6d_perception.estimators.single_view_evaluation import ViewResult

#: BOP counts objects whose visible fraction is at least this.
LEAST_VISIBLE = 0.1
#: BOP's thresholds of MSSD as shares of the diameter.
MSSD_THRESHOLDS = np.arange(1, 11) * 0.05
#: BOP's thresholds of MSPD in pixels of an image 640 wide.
MSPD_THRESHOLDS = np.arange(1, 11) * 5.0
_RECALL_STEPS = np.linspace(0.0, 1.0, 101)
_RESAMPLES = 2000
#: Number of bins of the score in :func:`reliability`.
CALIBRATION_BINS = 10


def bootstrapped(hits: np.ndarray, counts: np.ndarray, groups: Sequence[Any]) -> dict[str, float | int | None]:
    """The rate ``hits / counts`` with its 95 % bootstrap interval.

    Whole scenes are resampled, because views of one scene show the same objects. With a single scene, views are.

    Args:
        hits: (v,) number of hits in each view.
        counts: (v,) number of trials in each view.
        groups: (v,) scene of each view.

    Returns:
        ``rate``, ``low`` and ``high`` (None without a trial), and ``of``, the number of trials.
    """
    total = int(np.sum(counts))
    if total == 0:
        return {"rate": None, "low": None, "high": None, "of": 0}
    names, index = np.unique(groups, return_inverse=True)
    if len(names) == 1:
        index = np.arange(len(index))
    sums = np.stack([np.bincount(index, weights=values) for values in (hits, counts)])
    draws = np.random.default_rng(0).multinomial(
        sums.shape[1], np.full(sums.shape[1], 1 / sums.shape[1]), size=_RESAMPLES
    )
    drawn = draws @ sums.T
    rates = drawn[drawn[:, 1] > 0]
    low, high = np.percentile(rates[:, 0] / rates[:, 1], (2.5, 97.5))
    return {"rate": float(np.sum(hits) / total), "low": float(low), "high": float(high), "of": total}


def thresholds(error: str, diameter: float, width: int) -> np.ndarray:
    """(10,) BOP's thresholds of ``mssd`` (metres) or ``mspd`` (pixels of an image of that width)."""
    return MSSD_THRESHOLDS * diameter if error == "mssd" else MSPD_THRESHOLDS * width / 640.0


def recalls(views: Sequence[ViewResult], error: str, diameter: float) -> tuple[np.ndarray, np.ndarray]:
    """Objects found at BOP's thresholds (task "6D localization").

    In each view, the number of hypotheses that count is the number of objects; the best scored ones are taken.

    Args:
        views: results in v views.
        error: ``mssd`` or ``mspd``.
        diameter: the object's, metres.

    Returns:
        (v, 10) objects found per view and threshold, (v,) objects at least a tenth visible.
    """
    found, counts = np.zeros((len(views), 10)), np.zeros(len(views), int)
    for number, view in enumerate(views):
        valid = view.visible_fraction >= LEAST_VISIBLE
        counts[number] = valid.sum()
        best = np.argsort(-view.score, kind="stable")[: valid.sum()]
        for step, limit in enumerate(thresholds(error, diameter, view.width)):
            matched = view.match(error, limit, np.where(valid, 0, -1))
            found[number, step] = (matched[best] >= 0).sum()
    return found, counts


def average_precision(views: Sequence[ViewResult], error: str, limits: Iterable[float]) -> float | None:
    """Mean over ``limits`` of the area under the curve of precision over recall, over the hypotheses of all views.

    As in BOP's task "6D detection" and in COCO: 101 recall steps and monotone precision. Objects less than a tenth
    visible are ignored, and so are hypotheses that match them. None without an object to be found.
    """
    if not _objects(views):
        return None
    areas = []
    for limit in limits:
        recall, precision = _precision_over_recall(views, error, limit)
        first = np.searchsorted(recall, _RECALL_STEPS - 1e-12)
        areas.append(np.append(precision, 0.0)[first].mean())
    return float(np.mean(areas))


def recall_at_precision(views: Sequence[ViewResult], error: str, limit: float, least: float) -> float | None:
    """The highest recall at a precision of at least ``least``, over all thresholds of the score.

    Counted as in :func:`average_precision`. 0 if no threshold is that precise, None without an object to be found.
    """
    if not _objects(views):
        return None
    recall, precision = _precision_over_recall(views, error, limit)
    return float(recall[precision >= least].max(initial=0.0))


def _objects(views: Sequence[ViewResult]) -> int:
    """Number of objects that have to be found."""
    return sum(int((view.visible_fraction >= LEAST_VISIBLE).sum()) for view in views)


def _precision_over_recall(views: Sequence[ViewResult], error: str, limit: float) -> tuple[np.ndarray, np.ndarray]:
    """Recall and monotone precision after each of the hypotheses of all views, best first."""
    order = np.argsort(-np.concatenate([view.score for view in views]), kind="stable")
    parts: list[tuple[np.ndarray, np.ndarray]] = []
    for view in views:
        hidden = view.visible_fraction < LEAST_VISIBLE
        matched = view.match(error, limit, hidden.astype(int))
        parts.append((~np.append(hidden, False)[matched], matched >= 0))  # -1, no match, indexes the last entry
    counted, right = (np.concatenate(part)[order] for part in zip(*parts, strict=True))
    hits = np.cumsum(right[counted])
    precision = np.maximum.accumulate((hits / np.arange(1, len(hits) + 1))[::-1])[::-1]
    return hits / _objects(views), precision


def area_under_curve(score: np.ndarray, right: np.ndarray) -> float | None:
    """Probability that a right hypothesis scores higher than a wrong one, ties counting half; None without both."""
    if right.all() or not right.any():
        return None
    return float(mannwhitneyu(score[right], score[~right]).statistic / (right.sum() * (~right).sum()))


def calibration_error(score: np.ndarray, right: np.ndarray) -> float | None:
    """Expected calibration error of probabilities: the mean difference between score and share of right poses.

    Guo et al., "On Calibration of Modern Neural Networks" (2017), with :data:`CALIBRATION_BINS` bins of equal width.

    Args:
        score: (h,) in [0, 1].
        right: (h,) bool.

    Returns:
        The error in [0, 1], None without hypotheses.
    """
    bins = reliability(score, right)
    total = sum(row["hypotheses"] for row in bins)
    if not total:
        return None
    return sum(row["hypotheses"] * abs(row["score"] - row["right"]) for row in bins) / total


def reliability(score: np.ndarray, right: np.ndarray) -> list[dict[str, float]]:
    """Mean score and share of right poses by bins of the score; empty bins are left out.

    Args:
        score: (h,) in [0, 1].
        right: (h,) bool.
    """
    number = np.minimum((score * CALIBRATION_BINS).astype(int), CALIBRATION_BINS - 1)
    rows = []
    for bin in np.unique(number):
        chosen = number == bin
        rows.append(
            {
                "hypotheses": int(chosen.sum()),
                "score": float(score[chosen].mean()),
                "right": float(right[chosen].mean()),
            }
        )
    return rows


def rank_correlation(score: np.ndarray, error: np.ndarray) -> float | None:
    """Spearman's rank correlation of score and error; None if one of them is constant."""
    if len(score) < 3 or np.ptp(score) == 0 or len(np.unique(error)) == 1:
        return None
    return float(spearmanr(score, error).statistic)
