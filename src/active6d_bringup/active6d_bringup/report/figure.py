"""An episode as one picture: its views with outlines coloured by score, its path, and how the score rose."""

import io
from itertools import pairwise

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Polygon
from matplotlib.patheffects import withStroke

from active6d_bringup.report.analysis import EpisodeAnalysis, StepAnalysis
from active6d_bringup.report.drawing import ScoreScale, StepOutlines, outline_step, score_scale
from active6d_bringup.report.silhouette import SilhouetteDrawer

_MOST_VIEWS = 6
_ACCENT = "#1769e0"
_SOFT = "#6b7480"
_FONT = {"font.family": "DejaVu Sans", "font.size": 9, "axes.edgecolor": "#c9d0d8", "text.color": "#1b1f24"}


def render_png(analysis: EpisodeAnalysis) -> bytes:
    """PNG of up to six views (first, last, and evenly between), the camera's path and the course of the errors."""
    chosen = np.unique(np.linspace(0, len(analysis.steps) - 1, _MOST_VIEWS).round().astype(int))
    drawer, scale = SilhouetteDrawer(analysis.model), score_scale(analysis)
    with matplotlib.rc_context(_FONT):
        figure = Figure(figsize=(13.4, 6.1), dpi=120, facecolor="white")
        grid = figure.add_gridspec(2, 3, left=0.01, right=0.715, top=0.9, bottom=0.015, wspace=0.03, hspace=0.11)
        for place, number in enumerate(chosen):
            step = analysis.steps[number]
            outlines = outline_step(drawer, step, analysis.record.ground_truth)
            _draw_view(figure.add_subplot(grid[place // 3, place % 3]), step, outlines, scale)
        _draw_path(figure.add_axes((0.725, 0.5, 0.265, 0.42)), analysis, scale)
        _draw_course(figure.add_axes((0.755, 0.095, 0.21, 0.32)), analysis.steps)
        _draw_title(figure, analysis, scale)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", pil_kwargs={"optimize": True})
    return buffer.getvalue()


def _draw_title(figure: Figure, analysis: EpisodeAnalysis, scale: ScoreScale) -> None:
    record = analysis.record
    figure.text(0.01, 0.965, record.scene or analysis.model.name, size=14, weight="bold", va="center")
    parts = [record.policy, f"{len(analysis.steps) - 1} moves", f"{analysis.distance_m:.2f} m"]
    figure.text(0.175, 0.965, "   ".join(part for part in parts if part), size=11, color=_SOFT, va="center")
    bar = figure.add_axes((0.585, 0.958, 0.09, 0.016))
    ramp = LinearSegmentedColormap.from_list("score", scale.ramp())
    bar.imshow(np.linspace(0, 1, 256)[None], aspect="auto", cmap=ramp)
    bar.set_axis_off()
    figure.text(0.58, 0.966, f"verification score  {scale.low:.2f}", size=9, color=_SOFT, ha="right", va="center")
    figure.text(0.68, 0.966, f"{scale.high:.2f}", size=9, color=_SOFT, va="center")


def _draw_view(axes: Axes, step: StepAnalysis, outlines: StepOutlines, scale: ScoreScale) -> None:
    view = step.record.view
    axes.imshow(view.color, interpolation="antialiased")
    for row, outline in sorted(zip(step.rows, outlines.objects, strict=True), key=lambda pair: pair[0].attended):
        if outline.visible_fraction <= 0.05:
            continue
        edge = withStroke(linewidth=5 if row.attended else 2.6, foreground="white" if row.attended else "#00000090")
        shape = Polygon.make_compound_path(*(Polygon(polygon, closed=True) for polygon in outline.visible))
        color = scale.color(row.verification)
        axes.add_patch(PathPatch(shape, facecolor=color + "30", edgecolor="none"))
        axes.add_patch(PathPatch(shape, facecolor="none", edgecolor=color, linewidth=1.5, path_effects=[edge]))
    axes.set(xlim=(-0.5, view.camera.width - 0.5), ylim=(view.camera.height - 0.5, -0.5), xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
    truth = step.truth
    found = f"{truth.detected.sum()} of {len(truth.detected)} found" if truth else f"{len(step.rows)} objects"
    axes.set_title(f"view {step.number}", loc="left", size=9, weight="bold", pad=4)
    axes.set_title(found, loc="right", size=9, color=_SOFT, pad=4)


def _draw_path(axes: Axes, analysis: EpisodeAnalysis, scale: ScoreScale) -> None:
    """The hemisphere in an orthographic projection: matplotlib's own 3D axes cut off what does not fit their box."""
    sphere, cameras = analysis.sphere, analysis.record.positions
    azimuth, elevation = np.radians(-50.0), np.radians(28.0)
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    toward = sphere.position(azimuth, elevation) / sphere.radius
    projection = np.stack([right, np.cross(toward, right)], axis=1)
    turn = np.linspace(0, 2 * np.pi, 181)
    rings = [sphere.position(turn, np.full_like(turn, level)) for level in np.radians((0.0, 30.0, 60.0))]
    meridians = [sphere.position(np.full(91, level), turn[:91]) for level in np.arange(6) * np.pi / 6]
    for line in (*rings, *meridians):
        axes.plot(*(line @ projection).T, color=_SOFT, lw=0.6, alpha=0.3)
    axes.scatter(*(sphere.positions @ projection).T, s=3, color=_SOFT, alpha=0.45, linewidths=0)
    last = analysis.steps[-1]
    centers = last.objects.T_world_object[:, :3, 3]
    nearest_last = np.argsort(centers @ toward)
    colors = [scale.color(last.rows[i].verification) for i in nearest_last]
    axes.scatter(*(centers[nearest_last] @ projection).T, s=80, c=colors, linewidths=0, alpha=0.9)
    for start, end in pairwise(cameras):
        axes.plot(*(_arc(start, end, sphere.radius) @ projection).T, color=_ACCENT, lw=2.2, solid_capstyle="round")
    for number, position in enumerate(cameras @ projection):
        fill, ink = (_ACCENT, "white") if number == len(cameras) - 1 else ("white", _ACCENT)
        circle = {"boxstyle": "circle,pad=0.28", "facecolor": fill, "edgecolor": _ACCENT}
        axes.text(*position, str(number), size=8, weight="bold", color=ink, ha="center", va="center", bbox=circle)
    axes.set_aspect("equal")
    axes.margins(0.06)
    axes.set_axis_off()


def _arc(start: np.ndarray, end: np.ndarray, radius: float) -> np.ndarray:
    """(n, 3) points of the great circle; its chord, pushed out onto the sphere, is enough for a drawing."""
    chord = start + np.linspace(0, 1, 40)[:, None] * (end - start)
    length = np.linalg.norm(chord, axis=1, keepdims=True)
    return radius * chord / np.maximum(length, 1e-6)


def _draw_course(axes: Axes, steps: list[StepAnalysis]) -> None:
    numbers = [step.number for step in steps]
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(colors=_SOFT, length=3)
    axes.set_xticks(numbers if len(numbers) <= 12 else np.unique(np.linspace(0, numbers[-1], 6).round()))
    axes.set_xlabel("moves", color=_SOFT)
    if any(step.truth is None for step in steps):
        axes.plot(numbers, [len(step.rows) for step in steps], color=_ACCENT, marker="o")
        axes.set_title("objects accumulated", loc="left", size=9, color=_ACCENT)
        axes.set_ylim(bottom=0)
        return
    axes.plot(numbers, [100 * step.truth.detection_rate for step in steps], color=_ACCENT, marker="o", ms=4)
    axes.set_ylim(0, 100)
    axes.set_title("objects found, %", loc="left", size=9, color=_ACCENT)
    errors = axes.twinx()
    errors.plot(numbers, [step.truth.mean_e_add_mm for step in steps], color="#d4572a", marker="s", ms=4)
    errors.set_ylim(0, 50)
    errors.tick_params(colors=_SOFT, length=3)
    errors.spines[["top", "left"]].set_visible(False)
    errors.set_title("mean e_ADD, mm", loc="right", size=9, color="#d4572a")
