"""An episode as the paper's qualitative figure: before and after, attention against scores, the path (supplement B)."""

from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.text import Annotation

from active6d_core.se3 import invert
from active6d_tools.report import panels
from active6d_tools.report.analysis import EpisodeAnalysis, StepAnalysis
from active6d_tools.report.drawing import outline_step, score_scale
from active6d_tools.report.panels import ACCENT, INK, SOFT
from active6d_tools.report.silhouette import SilhouetteDrawer

_FOUND, _WRONG = "#25d397", "#f53fae"
_MOST_MOVES = 5
#: Room for bars: the title of one move needs the first, and bars of fewer in all would be wider than they are high.
_LEAST_OF_MOVE, _LEAST_OF_ALL = 7, 45


def render_qualitative(analysis: EpisodeAnalysis) -> bytes:
    """PNG of :func:`qualitative_figure`, 1200 pixels wide."""
    with matplotlib.rc_context(panels.STYLE):
        return panels.save_png(qualitative_figure(analysis))


def qualitative_figure(analysis: EpisodeAnalysis) -> Figure:
    """First and last view with their objects, score and attention of each object at each move, the path.

    Objects are coloured by detection if the bag has ground truth, else by their verification score.
    Of more than five moves, five are drawn: first, last, and evenly between. The axes are labelled ``before``,
    ``after``, ``path``, and ``score N`` and ``attention N`` for move N.
    """
    figure = Figure(figsize=(10.0, 5.3), dpi=120, facecolor="white")
    first, last, moves = analysis.steps[0], analysis.steps[-1], _shown_moves(analysis)
    drawer, bottom, height = SilhouetteDrawer(analysis.model), 0.4, 0.488
    for name, step, left, known in (("before", first, 0.01, moves[:1]), ("after", last, 0.365, moves)):
        axes = figure.add_axes((left, bottom, 0.345, height), label=name)
        outlines = outline_step(drawer, step, analysis.record.ground_truth)
        panels.draw_view(axes, step, outlines, _colors(analysis, step))
        panels.name_panel(axes, f"{name}: view {step.number}", panels.count_found(step))
        _mark_attended(axes, drawer, step, known)
    path = figure.add_axes((0.725, bottom, 0.265, height), label="path")
    panels.draw_path(path, analysis, _colors(analysis, last))
    panels.name_panel(path, "camera path", f"{analysis.distance_m:.2f} m")
    _draw_moves(figure, analysis, moves)
    _draw_header(figure, analysis)
    return figure


def _shown_moves(analysis: EpisodeAnalysis) -> list[StepAnalysis]:
    """The views at which the moves were decided."""
    decided = analysis.steps[:-1]
    if len(decided) <= _MOST_MOVES:
        return decided
    return [decided[i] for i in np.linspace(0, len(decided) - 1, _MOST_MOVES).round().astype(int)]


def _colors(analysis: EpisodeAnalysis, step: StepAnalysis) -> list[str]:
    if step.truth is not None:
        return [_FOUND if row.detected else _WRONG for row in step.rows]
    scale = score_scale(analysis)
    return [scale.color(row.verification) for row in step.rows]


def _mark_attended(axes: Axes, drawer: SilhouetteDrawer, step: StepAnalysis, moves: list[StepAnalysis]) -> None:
    """The numbers of moves, each at the object that the policy attended to for that move."""
    view = step.record.view
    T_camera_world = invert(step.record.T_world_camera)
    places: list[tuple[np.ndarray, list[str]]] = []
    for move in moves:
        if move.attended is None:
            continue
        T_world_object = move.objects.T_world_object[move.attended.index]
        center = drawer.outline(T_camera_world @ T_world_object, view.camera, view.depth).center
        if center is None:
            continue
        # The same object, or another whose number would cover this one's.
        near = [numbers for place, numbers in places if np.linalg.norm(place - center) < 0.06 * view.camera.width]
        if near:
            near[0].append(str(move.number + 1))
        else:
            places.append((center, [str(move.number + 1)]))
    box = {"boxstyle": "round,pad=0.25", "facecolor": "white", "edgecolor": INK, "linewidth": 0.8}
    leader = {"arrowstyle": "-", "color": "white", "linewidth": 1.5, "shrinkA": 0, "shrinkB": 0}
    style: dict[str, Any] = {
        "size": 8,
        "weight": "bold",
        "ha": "center",
        "va": "center",
        "bbox": box,
        "arrowprops": leader,
    }
    for center, numbers in places:
        axes.annotate(", ".join(numbers), tuple(center), (-16, 14), textcoords="offset points", **style)


def _draw_moves(figure: Figure, analysis: EpisodeAnalysis, moves: list[StepAnalysis]) -> None:
    """Two rows of bars, one column per move; all bars have the same width, and attention has one scale."""
    if not moves:
        figure.text(0.5, 0.2, "no move was made", ha="center", va="center", color=SOFT)
        return
    caption = "one bar per object, lowest score first; shaded: attended to"
    figure.text(0.99, 0.022, caption, size=8, color=SOFT, ha="right", va="center")
    slots = [max(len(move.rows), _LEAST_OF_MOVE) for move in moves]
    columns = slots if sum(slots) >= _LEAST_OF_ALL else [*slots, _LEAST_OF_ALL - sum(slots)]
    place = {"left": 0.06, "right": 0.99, "top": 0.32, "bottom": 0.055, "hspace": 0.0, "wspace": 0.06}
    grid = figure.add_gridspec(2, len(columns), width_ratios=columns, **place)
    top = max((row.attention for move in moves for row in move.rows if row.attention is not None), default=0.0)
    for column, move in enumerate(moves):
        number = move.number + 1
        score = figure.add_subplot(grid[0, column], label=f"score {number}")
        attention = figure.add_subplot(grid[1, column], label=f"attention {number}", sharex=score)
        _draw_bars(score, attention, move, _colors(analysis, move))
        panels.name_panel(score, f"move {number}")
        score.set(xlim=(-0.7, slots[column] - 0.3), xticks=[], ylim=(0, 1), yticks=[0, 1])
        attention.set(ylim=(1.08 * top or 1, 0), yticks=[top], yticklabels=[f"{top:.2f}" if top else ""])
        for axes, name in ((score, "score"), (attention, "attention")):
            axes.spines[:].set_visible(False)
            axes.tick_params(colors=SOFT, length=0, labelsize=8, labelleft=column == 0)
            axes.set_ylabel(name if column == 0 else "", color=SOFT)


def _draw_bars(score: Axes, attention: Axes, move: StepAnalysis, colors: list[str]) -> None:
    rows = sorted(move.rows, key=lambda row: row.verification)
    places = range(len(rows))
    score.bar(places, [row.verification for row in rows], color=[colors[row.index] for row in rows])
    attention.axhline(0, color=INK, linewidth=0.8)
    if not rows:
        score.text(0.0, 0.5, "no object yet", transform=score.transAxes, size=8, color=SOFT, va="center")
    elif rows[0].attention is None:
        attention.text(0.0, 0.5, "not recorded", transform=attention.transAxes, size=8, color=SOFT, va="center")
    else:
        attention.bar(places, [row.attention or 0.0 for row in rows], color=ACCENT)
    for place in (place for place, row in enumerate(rows) if row.attended):
        for axes in (score, attention):
            axes.axvspan(place - 0.5, place + 0.5, color=INK, alpha=0.12, linewidth=0, zorder=0)


def _draw_header(figure: Figure, analysis: EpisodeAnalysis) -> None:
    height, moves = 0.965, len(analysis.steps) - 1
    name = analysis.record.scene or analysis.model.name
    title = figure.text(0.01, height, name, size=13, weight="bold", va="center")
    parts = [analysis.record.policy, "1 move" if moves == 1 else f"{moves} moves"]
    subtitle = "   ".join(part for part in parts if part)
    beside: dict[str, Any] = {"xycoords": title, "textcoords": "offset points"}
    figure.add_artist(Annotation(subtitle, (1, 0.5), (12, 0), size=10, color=SOFT, va="center", **beside))
    keys: list[Any] = [
        Line2D([], [], ls="none", marker="s", mfc="white", mec=INK, label="attended to, and for which move")
    ]
    if analysis.record.ground_truth is None:
        panels.draw_score_bar(figure, score_scale(analysis), 0.62, height, 0.09)
    else:
        found = f"found: ADD below {analysis.threshold_mm:.1f} mm"
        keys = [Patch(color=_FOUND, label=found), Patch(color=_WRONG, label="wrong pose"), *keys]
    place: dict[str, Any] = {"loc": "center right", "bbox_to_anchor": (1.0, height), "ncols": len(keys)}
    figure.legend(handles=keys, frameon=False, fontsize=9, handlelength=1, columnspacing=1.2, **place)
