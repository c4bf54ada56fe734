"""Plots of score quality: equation 1 against the errors, and the certainty of the rotation of hidden handles."""

from pathlib import Path
from typing import Any

import numpy as np

from active6d_core.files import atomic_file
from active6d_core.metrics import MISSED_E_ADD
from active6d_core.object_model import ObjectModel
from active6d_perception.estimators.single_view_evaluation import EstimatorResult
from active6d_tools.benchmark.estimator_summary import FEATURE_SEEN, SAME_ROTATION, axis_rotation_errors, score_study

_RIGHT, _WRONG = "tab:green", "tab:red"


def draw_verification(path: Path, title: str, result: EstimatorResult) -> None:
    """Scatter of the verification score over ADD and over ADD-S (the paper's supplement A) as PNG.

    Errors above 50 mm, the error of a missed object, are drawn at 50 mm.

    Raises:
        OSError: the file cannot be written.
    """
    from matplotlib.figure import Figure  # slow to import

    study = score_study(result)
    score = result.gather("verification")
    figure = Figure(figsize=(11.0, 4.4), layout="constrained")
    for axes, (kind, label) in zip(figure.subplots(1, 2), (("add", "ADD"), ("adds", "ADD-S")), strict=True):
        error = np.concatenate([view.least(kind) for view in result.views])
        for chosen, color, name in ((error < result.limit, _RIGHT, "right"), (error >= result.limit, _WRONG, "wrong")):
            axes.plot(
                1e3 * np.minimum(error[chosen], MISSED_E_ADD),
                score[chosen],
                ".",
                color=color,
                alpha=_alpha(len(score)),
                markersize=6,
                markeredgewidth=0,
                label=f"{name} ({chosen.sum()})",
            )
        axes.axvline(1e3 * result.limit, color="0.4", linestyle="--", linewidth=1, label="10 % of the diameter")
        axes.set(xlabel=f"{label}, mm", ylabel="verification score", xlim=(0, 1e3 * MISSED_E_ADD + 1))
        axes.set_title(
            f"rank correlation {_number(study['equation_1'][f'spearman_{kind}'])}, "
            f"area under the curve {_number(study['equation_1'][f'auc_{kind}'])}",
            fontsize="medium",
        )
        _finish(axes)
    _save(figure, path, title)


def draw_ambiguity(path: Path, title: str, model: ObjectModel, result: EstimatorResult) -> None:
    """Certainty over the true rotation error as PNG, separately for objects with a visible and a hidden named part.

    Raises:
        OSError: the file cannot be written.
    """
    from matplotlib.figure import Figure

    found = axis_rotation_errors(result)
    part = " or ".join(model.features)
    figure = Figure(figsize=(11.0, 6.0), layout="constrained")
    panels = figure.subplots(2, 2, sharex=True, height_ratios=(3, 1))
    names = (f"{part} seen (over {FEATURE_SEEN:.0%} of its surface)", f"{part} hidden")
    label = "certainty of the axis rotation" if found.certain else "score"
    for (axes, histogram), name, chosen in zip(panels.T, names, (found.seen, ~found.seen), strict=True):
        right = chosen & (found.rotation < SAME_ROTATION)
        for group, color in ((right, _RIGHT), (chosen & ~right, _WRONG)):
            axes.plot(
                found.rotation[group],
                found.certainty[group],
                ".",
                color=color,
                alpha=_alpha(len(found.rotation)),
                markersize=6,
                markeredgewidth=0,
            )
        share = f", {right.sum() / chosen.sum():.0%} right" if chosen.any() else ""
        axes.set(ylabel=label, ylim=(0, 1.02), xlim=(0, 180))
        axes.set_title(f"{name}: {chosen.sum()} hypotheses{share}", fontsize="medium")
        histogram.hist(found.rotation[chosen], bins=np.arange(0, 181, 10), color="0.6")
        histogram.set(xlabel="true rotation error, degrees", ylabel="hypotheses")
        for part_of_panel in (axes, histogram):
            part_of_panel.grid(alpha=0.3)
            part_of_panel.axvline(SAME_ROTATION, color="0.4", linestyle="--", linewidth=1)
    _save(figure, path, title)


def _alpha(count: int) -> float:
    """Opacity of one of ``count`` points."""
    return float(np.clip(300 / max(count, 1), 0.15, 0.8))


def _number(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.2f}"


def _finish(axes: Any) -> None:
    axes.grid(alpha=0.3)
    legend = axes.legend(fontsize="small")
    for handle in legend.legend_handles:
        handle.set_alpha(1.0)


def _save(figure: Any, path: Path, title: str) -> None:
    figure.suptitle(title)
    with atomic_file(path) as unfinished:
        figure.savefig(unfinished, dpi=110)
