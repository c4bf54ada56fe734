"""An episode as one picture: views with outlines coloured by score, the camera path, and the errors over the views."""

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from active6d_tools.report import panels
from active6d_tools.report.analysis import EpisodeAnalysis, StepAnalysis
from active6d_tools.report.drawing import ScoreScale, outline_step, score_scale
from active6d_tools.report.panels import ACCENT, SOFT
from active6d_tools.report.silhouette import SilhouetteDrawer

_MOST_VIEWS = 6


def render_png(analysis: EpisodeAnalysis) -> bytes:
    """PNG of up to six views (first, last, and evenly between), the camera path and the errors over the views."""
    chosen = np.unique(np.linspace(0, len(analysis.steps) - 1, _MOST_VIEWS).round().astype(int))
    drawer, scale = SilhouetteDrawer(analysis.model), score_scale(analysis)
    with matplotlib.rc_context(panels.STYLE):
        figure = Figure(figsize=(13.4, 6.1), dpi=120, facecolor="white")
        grid = figure.add_gridspec(2, 3, left=0.01, right=0.715, top=0.9, bottom=0.015, wspace=0.03, hspace=0.11)
        for place, number in enumerate(chosen):
            step = analysis.steps[number]
            outlines = outline_step(drawer, step, analysis.record.ground_truth)
            axes = figure.add_subplot(grid[place // 3, place % 3])
            colors = [scale.color(row.verification) for row in step.rows]
            panels.draw_view(axes, step, outlines, colors)
            panels.name_panel(axes, f"view {step.number}", panels.count_found(step))
        # The last view's colours.
        panels.draw_path(figure.add_axes((0.725, 0.5, 0.265, 0.42)), analysis, colors)
        _draw_course(figure.add_axes((0.755, 0.095, 0.21, 0.32)), analysis.steps)
        _draw_title(figure, analysis, scale)
        return panels.save_png(figure)


def _draw_title(figure: Figure, analysis: EpisodeAnalysis, scale: ScoreScale) -> None:
    record = analysis.record
    figure.text(0.01, 0.965, record.scene or analysis.model.name, size=14, weight="bold", va="center")
    parts = [record.policy, f"{len(analysis.steps) - 1} moves", f"{analysis.distance_m:.2f} m"]
    figure.text(0.175, 0.965, "   ".join(part for part in parts if part), size=11, color=SOFT, va="center")
    panels.draw_score_bar(figure, scale, 0.585, 0.966, 0.09)


def _draw_course(axes: Axes, steps: list[StepAnalysis]) -> None:
    numbers = [step.number for step in steps]
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(colors=SOFT, length=3)
    axes.set_xticks(numbers if len(numbers) <= 12 else np.unique(np.linspace(0, numbers[-1], 6).round()))
    axes.set_xlabel("moves", color=SOFT)
    scores = [step.truth for step in steps if step.truth is not None]
    if len(scores) < len(steps):
        axes.plot(numbers, [len(step.rows) for step in steps], color=ACCENT, marker="o")
        axes.set_title("objects accumulated", loc="left", size=9, color=ACCENT)
        axes.set_ylim(bottom=0)
        return
    axes.plot(numbers, [100 * score.detection_rate for score in scores], color=ACCENT, marker="o", ms=4)
    axes.set_ylim(0, 100)
    axes.set_title("objects found, %", loc="left", size=9, color=ACCENT)
    errors = axes.twinx()
    errors.plot(numbers, [score.mean_e_add_mm for score in scores], color="#d4572a", marker="s", ms=4)
    errors.set_ylim(0, 50)
    errors.tick_params(colors=SOFT, length=3)
    errors.spines[["top", "left"]].set_visible(False)
    errors.set_title("mean ADD, mm", loc="right", size=9, color="#d4572a")
