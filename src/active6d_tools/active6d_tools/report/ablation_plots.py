"""Figures of ablations: what was measured over what was varied."""

from typing import Any

from active6d_tools.report.line_plots import Panel

_REPORTED = ("reported", "hypotheses per object")
_TRADE_OFFS = ("metres_weight", "stop_below", "as shipped", "random")


def ablation_panels(part: str, rows: list[dict[str, Any]]) -> list[Panel]:
    """Detection rate, ADD and a third measure over what ``part`` varies; around them the interval over scenes.

    Args:
        part: of ``active6d ablate``.
        rows: of the ablation.
    """
    if part == "planning":
        return _trade_offs(rows)
    share = ("gap_closed", "share of the gap on own noise")
    third = {"fusion": _REPORTED, "verification": _REPORTED, "noise-resampling": share}.get(
        part, ("distance_m", "d [m]")
    )
    line, x, x_label = {
        "steps": ("variant", "budget", "T"),
        "seeds": ("policy", "training_seed", "seed of the training"),
        "noise-resampling": ("noise", "policy", "views chosen by"),
    }.get(part, ("", "variant", part))
    panels = []
    for key, label in (("detection_rate", "detection rate"), ("e_add_mm", "ADD [mm]"), third):
        lines: dict[str, tuple[Any, ...]] = {}
        for name in dict.fromkeys(row.get(line, label) for row in rows):
            own = [row for row in rows if row.get(line, label) == name]
            # Where there is one scene, there is no interval over scenes, and the line stands alone.
            known = [ends for row in own if (ends := row[f"{key}_ci95_scenes"]) is not None]
            interval = [list(zip(*known, strict=True))] if len(known) == len(own) else []
            # As text, so that few views have as much room as many.
            lines[name] = ([str(row[x]) for row in own], [row[key] for row in own], *interval)
        panels.append(Panel(x_label, label, lines))
    return panels


def _trade_offs(rows: list[dict[str, Any]]) -> list[Panel]:
    """Detection rate and ADD over travelled distance, and detection rate over moves."""
    panels = []
    for x, x_label, y, y_label, names in (
        ("distance_m", "d [m]", "detection_rate", "detection rate", _TRADE_OFFS),
        ("distance_m", "d [m]", "e_add_mm", "ADD [mm]", _TRADE_OFFS),
        ("moves", "moves taken", "detection_rate", "detection rate", _TRADE_OFFS[1:]),
    ):
        lines = {}
        for name in names:
            own = [row for row in rows if row["parameter"] == name]
            lines[name] = ([row[x] for row in own], [row[y] for row in own])
        panels.append(Panel(x_label, y_label, lines))
    return panels
