"""An episode as one self-contained HTML file with pictures, drawings and data."""

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from active6d_tools.report.analysis import EpisodeAnalysis, StepAnalysis
from active6d_tools.report.drawing import (
    ScoreScale,
    StepOutlines,
    data_uri,
    depth_to_color,
    outline_step,
    score_scale,
)
from active6d_tools.report.silhouette import Outline, SilhouetteDrawer

_CHART_WIDTH, _CHART_HEIGHT = 300.0, 130.0


@dataclass(frozen=True)
class Chart:
    """A line chart over the views of the episode, in the coordinates of its SVG.

    Attributes:
        title: what is drawn, with its unit.
        points: (x, y, text) per view.
        ticks: (y, text) of the horizontal lines.
    """

    title: str
    points: list[tuple[float, float, str]]
    ticks: list[tuple[float, str]]
    width: float = _CHART_WIDTH
    height: float = _CHART_HEIGHT


def render_html(analysis: EpisodeAnalysis) -> str:
    """The whole report as HTML text. Text from the bag is escaped."""
    environment = Environment(
        loader=PackageLoader("active6d_tools", "report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["path"] = svg_path
    drawer, scale = SilhouetteDrawer(analysis.model), score_scale(analysis)
    truth = analysis.record.ground_truth
    return environment.get_template("report.html.j2").render(
        analysis=analysis,
        record=analysis.record,
        last=analysis.steps[-1],
        facts=_facts(analysis),
        charts=_charts(analysis.steps),
        slowest_ms=max((time.longest_ms for time in analysis.node_times), default=1.0),
        steps=[_StepPictures.of(step, outline_step(drawer, step, truth)) for step in analysis.steps],
        scale=scale,
        hypothesis_scale=_hypothesis_scale(analysis.steps),
        scene=_path_scene(analysis, scale),
    )


def svg_path(polygons: list[np.ndarray]) -> str:
    """Closed polygons, each (n, 2) pixels, as the ``d`` of one SVG path, to a tenth of a pixel."""
    return "".join("M" + "L".join(f"{u:.1f} {v:.1f}" for u, v in polygon) + "Z" for polygon in polygons)


@dataclass(frozen=True, eq=False)
class _StepPictures:
    step: StepAnalysis
    outlines: StepOutlines
    color: str
    depth: str
    depth_range: tuple[float, float]

    @classmethod
    def of(cls, step: StepAnalysis, outlines: StepOutlines) -> "_StepPictures":
        depth, depth_range = depth_to_color(step.record.view.depth)
        return cls(step, outlines, data_uri(step.record.view.color), data_uri(depth[::2, ::2]), depth_range)

    @property
    def objects(self) -> list[tuple[Any, ...]]:
        return list(zip(self.step.rows, self.outlines.objects, strict=True))

    @property
    def hypotheses(self) -> list[tuple[float, Outline]]:
        known = self.step.record.hypotheses
        return [] if known is None else list(zip(known.score.tolist(), self.outlines.hypotheses, strict=True))


def _facts(analysis: EpisodeAnalysis) -> list[tuple[str, str]]:
    """Information in the bag that is nowhere else on the page, and the path of the bag."""
    shown = {"object", "scene", "policy", "moves", "metres"}
    facts = [(key.replace("_", " "), value) for key, value in analysis.record.info.items() if key not in shown]
    started = analysis.steps[0].record.stamp
    if started > 1e18:  # a real camera's clock; simulated time begins at one second
        facts.append(("started", datetime.fromtimestamp(started / 1e9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")))
    return [*facts, ("bag", str(analysis.record.folder))]


def _charts(steps: list[StepAnalysis]) -> list[Chart]:
    scores = [step.truth for step in steps if step.truth is not None]
    if len(scores) == len(steps):
        rates = [100 * score.detection_rate for score in scores]
        errors = [score.mean_e_add_mm for score in scores]
        return [
            _chart("Objects found, %", rates, 100.0, "{:.0f}"),
            _chart("Mean ADD, mm (missed: 50)", errors, 50.0, "{:.1f}"),
        ]
    means = [float(np.mean(step.objects.verification)) if len(step.rows) else 0.0 for step in steps]
    counts = [float(len(step.rows)) for step in steps]
    return [
        _chart("Objects accumulated", counts, max(5.0, 5 * np.ceil(max(counts) / 5)), "{:.0f}"),
        _chart("Mean verification score", means, 1.0, "{:.2f}"),
    ]


def _chart(title: str, values: list[float], top: float, form: str) -> Chart:
    x = np.linspace(16, _CHART_WIDTH - 8, len(values)) if len(values) > 1 else np.array([_CHART_WIDTH / 2])
    y = _CHART_HEIGHT * (1 - np.clip(np.array(values) / top, 0, 1))
    points = [(float(a), float(b), form.format(value)) for a, b, value in zip(x, y, values, strict=True)]
    ticks = [(_CHART_HEIGHT * (1 - share), f"{share * top:g}") for share in (0.0, 0.5, 1.0)]
    return Chart(title, points, ticks)


def _hypothesis_scale(steps: list[StepAnalysis]) -> ScoreScale:
    known = [step.record.hypotheses.score for step in steps if step.record.hypotheses is not None]
    return ScoreScale.around(np.concatenate([np.zeros(0), *known]))


def _path_scene(analysis: EpisodeAnalysis, scale: ScoreScale) -> dict[str, Any]:
    """Data of the 3D drawing of the path, in metres, as plain numbers for JSON."""
    last = analysis.steps[-1]
    return {
        "radius": analysis.sphere.radius,
        "grid": analysis.sphere.positions.round(4).tolist(),
        "cameras": analysis.record.positions.round(4).tolist(),
        "objects": [
            {"position": T[:3, 3].round(4).tolist(), "color": scale.color(row.verification)}
            for T, row in zip(last.objects.T_world_object, last.rows, strict=True)
        ],
        "size": analysis.model.diameter,
    }
