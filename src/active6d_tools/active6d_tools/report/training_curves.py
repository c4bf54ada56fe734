"""The curve of a policy's training as a picture."""

from pathlib import Path
from typing import Any

from active6d_tools.report.line_plots import Panel, draw_panels


def draw_training(path: Path, title: str, rows: list[dict[str, Any]]) -> None:
    """Draw validation results and the loss or return over minutes of training.

    Raises:
        OSError: the file cannot be written.
    """
    minutes = [row["seconds"] / 60 for row in rows]
    third = ("mean_return", "mean return") if "mean_return" in rows[0] else ("loss", "loss")
    shown = (("detection_rate", "detection rate"), ("e_add_mm", "ADD [mm]"), ("distance_m", "d [m]"), third)
    panels = [Panel("minutes", label, {label: (minutes, [row[key] for row in rows])}) for key, label in shown]
    draw_panels(path, f"{title}: validation scenes", panels)
