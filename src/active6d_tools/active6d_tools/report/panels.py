"""Panels of the pictures of an episode: a view with outlines, the camera path on the hemisphere."""

import io
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Polygon
from matplotlib.patheffects import withStroke

from active6d_core.view_sphere import ViewSphere
from active6d_tools.report.analysis import EpisodeAnalysis, StepAnalysis
from active6d_tools.report.drawing import ScoreScale, StepOutlines

ACCENT = "#1769e0"
INK = "#1b1f24"
SOFT = "#6b7480"
#: Text from a bag is drawn literally: a "$" in it starts no formula.
STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "axes.edgecolor": "#c9d0d8",
    "text.color": INK,
    "text.parse_math": False,
}
#: The path is seen from this high, as one stands before a table.
_ELEVATION = np.radians(28.0)


def save_png(figure: Figure) -> bytes:
    """The figure as PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", pil_kwargs={"optimize": True})
    return buffer.getvalue()


def draw_view(axes: Axes, step: StepAnalysis, outlines: StepOutlines, colors: list[str]) -> None:
    """The image with the visible outline of each object in its colour; the attended one has a white edge, too."""
    view = step.record.view
    axes.imshow(view.color, interpolation="antialiased")
    drawn = zip(step.rows, outlines.objects, colors, strict=True)
    for row, outline, color in sorted(drawn, key=lambda item: item[0].attended):
        if outline.visible_fraction <= 0.05:
            continue
        edge = withStroke(linewidth=5 if row.attended else 2.6, foreground="white" if row.attended else "#00000090")
        shape = Polygon.make_compound_path(*(Polygon(polygon, closed=True) for polygon in outline.visible))
        axes.add_patch(PathPatch(shape, facecolor=color + "30", edgecolor="none"))
        axes.add_patch(PathPatch(shape, facecolor="none", edgecolor=color, linewidth=1.5, path_effects=[edge]))
    axes.set(xlim=(-0.5, view.camera.width - 0.5), ylim=(view.camera.height - 0.5, -0.5), xticks=[], yticks=[])
    axes.spines[:].set_visible(False)


def name_panel(axes: Axes, name: str, value: str = "") -> None:
    """A name above the left corner and what was measured above the right one."""
    axes.set_title(name, loc="left", size=9, weight="bold", pad=4)
    axes.set_title(value, loc="right", size=9, color=SOFT, pad=4)


def count_found(step: StepAnalysis) -> str:
    """How many objects are found, or without ground truth how many there are."""
    truth = step.truth
    return f"{truth.detected.sum()} of {len(truth.detected)} found" if truth else f"{len(step.rows)} objects"


def draw_score_bar(figure: Figure, scale: ScoreScale, x: float, y: float, width: float) -> None:
    """A ramp of colours with the scores of its ends; it begins at ``x`` around ``y``, figure fractions."""
    bar = figure.add_axes((x, y - 0.008, width, 0.016))
    ramp = LinearSegmentedColormap.from_list("score", scale.ramp())
    bar.imshow(np.linspace(0, 1, 256)[None], aspect="auto", cmap=ramp)
    bar.set_axis_off()
    figure.text(x - 0.005, y, f"verification score  {scale.low:.2f}", size=9, color=SOFT, ha="right", va="center")
    figure.text(x + width + 0.005, y, f"{scale.high:.2f}", size=9, color=SOFT, va="center")


def draw_path(axes: Axes, analysis: EpisodeAnalysis, colors: list[str]) -> None:
    """Hemisphere, views, arcs and the objects of the last view, projected so that the path overlaps least.

    An orthographic projection of our own: matplotlib's 3D axes cut off what does not fit their box.
    """
    sphere, cameras = analysis.sphere, analysis.record.positions
    right, up, toward = projection = clearest_projection(sphere, cameras)
    plane = np.stack([right, up], axis=1)
    turn = np.linspace(0, 2 * np.pi, 181)
    rings = [sphere.position(turn, np.full_like(turn, level)) for level in np.radians((0.0, 30.0, 60.0))]
    meridians = [sphere.position(np.full(91, level), turn[:91]) for level in np.arange(6) * np.pi / 6]
    for line in (*rings, *meridians):
        _draw_line(axes, line, projection, color=SOFT, lw=0.6, alpha=0.4)
    x, y = (sphere.positions @ plane).T
    axes.scatter(x, y, s=3, color=SOFT, alpha=0.45, linewidths=0)
    centers = analysis.steps[-1].objects.T_world_object[:, :3, 3]
    nearest_last = np.argsort(centers @ toward)
    shades = [colors[i] for i in nearest_last]
    x, y = (centers[nearest_last] @ plane).T
    axes.scatter(x, y, s=70, c=shades, edgecolors="white", linewidths=0.6, label="objects")
    arcs = [_arc(start, end, sphere.radius) for start, end in pairwise(cameras)]
    for arc in arcs:
        _draw_line(axes, arc, projection, color=ACCENT, lw=2.2)
    for number, (x, y) in enumerate(cameras @ plane):
        fill, ink = (ACCENT, "white") if number == len(cameras) - 1 else ("white", ACCENT)
        circle = {"boxstyle": "circle,pad=0.28", "facecolor": fill, "edgecolor": ACCENT}
        axes.text(x, y, str(number), size=8, weight="bold", color=ink, ha="center", va="center", bbox=circle)
    if arcs:
        _name_ends(axes, cameras @ plane, np.concatenate(arcs) @ plane)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.09)
    axes.set_axis_off()


def _name_ends(axes: Axes, cameras: np.ndarray, path: np.ndarray) -> None:
    """Label the first and last of (t, 2) cameras in the drawing, on the side farthest from the (n, 2) path."""
    angles = np.arange(16) * np.pi / 8
    around = np.stack([1.5 * np.cos(angles), np.sin(angles)], axis=1)
    size = 0.16 * np.ptp(path, axis=0).max()
    style: dict[str, Any] = {"size": 8, "color": ACCENT, "ha": "center", "va": "center", "textcoords": "offset points"}
    halo = [withStroke(linewidth=2.5, foreground="white")]
    for word, camera in (("start", cameras[0]), ("end", cameras[-1])):
        gaps = np.linalg.norm((camera + size * around)[:, None] - path, axis=-1).min(axis=1)
        axes.annotate(word, camera, 16 * around[np.argmax(gaps)], path_effects=halo, **style)


def clearest_projection(sphere: ViewSphere, cameras: np.ndarray) -> np.ndarray:
    """The direction of projection in which (t, 3) positions overlap least.

    Returns:
        (3, 3) unit vectors of the world as rows: to the right in the drawing, up in it, and toward the eye.
    """
    azimuths = np.radians(np.arange(-50.0, 310.0, 10.0))
    toward = sphere.position(azimuths, np.full_like(azimuths, _ELEVATION)) / sphere.radius
    right = np.stack([-np.sin(azimuths), np.cos(azimuths), np.zeros_like(azimuths)], axis=1)
    projections = np.stack([right, np.cross(toward, right), toward], axis=1)
    drawn = cameras @ np.swapaxes(projections[:, :2], 1, 2)
    gaps = np.linalg.norm(drawn[:, :, None] - drawn[:, None], axis=-1) / sphere.radius
    gaps[:, np.arange(len(cameras)), np.arange(len(cameras))] = np.inf
    # Circles with numbers need a fifth of the radius; beyond that, better to have the path in front.
    clear = np.minimum(gaps, 0.2).min(axis=(1, 2), initial=0.2)
    front = (toward @ cameras.T / sphere.radius).mean(axis=1)
    return projections[np.argmax(clear + 0.05 * front)]


def _draw_line(axes: Axes, points: np.ndarray, projection: np.ndarray, *, alpha: float = 1.0, **style: Any) -> None:
    """(n, 3) points as a line that is paler where it runs on the far side."""
    drawn, near = points @ projection[:2].T, points @ projection[2] >= 0
    for side, shade in ((near, alpha), (~near, 0.45 * alpha)):
        axes.plot(*np.where(side[:, None], drawn, np.nan).T, alpha=shade, solid_capstyle="round", **style)


def _arc(start: np.ndarray, end: np.ndarray, radius: float) -> np.ndarray:
    """(n, 3) points of the great circle; its chord, pushed out onto the sphere, is enough for a drawing."""
    chord = start + np.linspace(0, 1, 100)[:, None] * (end - start)
    length = np.linalg.norm(chord, axis=1, keepdims=True)
    return radius * chord / np.maximum(length, 1e-6)
