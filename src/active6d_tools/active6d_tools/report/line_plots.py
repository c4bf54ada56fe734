"""Curves as pictures: training, costs, ablations."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from active6d_core.files import atomic_file


@dataclass(frozen=True)
class Panel:
    """One pair of axes.

    Attributes:
        x_label: of the horizontal axis.
        y_label: of the vertical axis.
        lines: label to x and y values, and where there is one, the (2, k) interval around them.
        logarithmic: both axes.
    """

    x_label: str
    y_label: str
    lines: dict[str, tuple[Any, ...]]
    logarithmic: bool = False
    levels: dict[str, float] = field(default_factory=dict)
    """Horizontal lines to compare with, by label."""


def draw_panels(path: Path, title: str, panels: Sequence[Panel]) -> None:
    """Draw panels side by side into a PNG.

    Raises:
        OSError: the file cannot be written.
    """
    from matplotlib.figure import Figure  # slow to import

    figure = Figure(figsize=(5.4 * len(panels), 4.0), layout="constrained")
    for axes, panel in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        for label, (x, y, *interval) in panel.lines.items():
            (line,) = axes.plot(x, y, marker=".", label=label)
            if interval:
                axes.fill_between(x, *interval[0], color=line.get_color(), alpha=0.15, linewidth=0)
        for number, (label, level) in enumerate(panel.levels.items()):
            axes.axhline(level, color="0.4", linestyle=("--", ":", "-.")[number % 3], linewidth=1, label=label)
        if panel.logarithmic:
            axes.set(xscale="log", yscale="log")
        axes.set(xlabel=panel.x_label, ylabel=panel.y_label)
        axes.grid(alpha=0.3)
        if len(panel.lines) + len(panel.levels) > 1:
            axes.legend(fontsize="small")
    figure.suptitle(title)
    with atomic_file(path) as unfinished:
        figure.savefig(unfinished, dpi=110)
