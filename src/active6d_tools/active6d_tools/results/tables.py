"""Results of ``active6d evaluate`` and ``active6d ablate`` as Markdown tables for docs/results.md.

A mark in a cell shows whether the interval of its difference excludes zero, for improvements and losses alike.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

#: Results of a command by object.
Reports = Mapping[str, dict[str, Any]]

#: Key, unit, digits, and the sign of a change for the better (0 for neither).
MEASURES = {
    "detection_rate": ("", 3, 1),
    "detection_rate_at_n": (" of the best n", 3, 1),
    "e_add_mm": (" mm", 2, -1),
    "distance_m": (" m", 2, -1),
    "moves": (" moves", 1, 0),
    "reported": (" per object", 2, 0),
    "confirmed_rate": (" confirmed", 3, 1),
    "wrong": (" wrong", 3, -1),
}
PAPER_STEPS = 5
#: Table 1 of the paper, after five moves: metres, ADD in mm, detection rate.
PAPER = {
    "coffee_cup": {
        "random": (4.97, 13.48, 0.76),
        "max-distance": (7.66, 14.02, 0.75),
        "unidirectional": (2.88, 14.32, 0.74),
        "attention": (3.71, 11.12, 0.80),
    },
    "bunny": {
        "random": (3.97, 26.69, 0.19),
        "max-distance": (7.68, 26.83, 0.46),
        "unidirectional": (2.88, 27.12, 0.44),
        "attention": (2.43, 25.35, 0.46),
    },
}


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def number(value: float, digits: int, sign: bool = False) -> str:
    """A number without the zero before the decimal point."""
    text = f"{value:{'+' if sign else ''}.{digits}f}"
    return text.replace("0.", ".", 1) if abs(value) < 1 and digits == 3 else text


def percent(share: float, sign: bool = False) -> str:
    """A share in percent."""
    return f"{100 * share:{'+' if sign else ''}.0f} %"


def interval(ends: Sequence[float] | None, digits: int, sign: bool = False) -> str:
    """An interval in brackets, a dash where there is none."""
    return "-" if ends is None else f"({' to '.join(number(end, digits, sign) for end in ends)})"


def mark(difference: dict[str, Any], better: int) -> str:
    """``✓`` better or ``✗`` worse if the interval over scenes excludes zero, in brackets if only the one over episodes
    does, ``=`` if neither does."""
    if better == 0:
        return ""
    if not (difference["excludes_zero"] or difference["excludes_zero_scenes"]):
        return "="
    sign = "✓" if difference["mean"] * better > 0 else "✗"
    return sign if difference["excludes_zero_scenes"] else f"({sign})"


def policies_table(report: dict[str, Any]) -> str:
    """The paper's Table 1, with intervals over scenes, bounds, and the paper's numbers where it has any."""
    paper = PAPER.get(report["object"], {}) if report["steps"] == PAPER_STEPS else {}
    header = ["policy", "distance, m", "ADD, mm", "detection rate", "confirmed", "wrong", "gap closed"]
    rows = []
    for name, row in report["policies"].items():
        cells = [f"`{name}`", number(row["distance_m"], 2)]
        for key in ("e_add_mm", "detection_rate", "confirmed_rate", "wrong"):
            digits = MEASURES[key][1]
            known = row.get(key) is not None
            cells.append(f"{number(row[key], digits)} {interval(row[f'{key}_ci95_scenes'], digits)}" if known else "")
        cells.append("" if row["gap_closed"] is None else percent(row["gap_closed"]))
        if paper:
            metres, error, rate = paper.get(name, (None, None, None))
            cells.append("" if rate is None else f"{metres:.2f} m, {error:.2f} mm, {rate:.2f}")
        rows.append(cells)
    return table([*header, "in the paper"] if paper else header, rows)


def differences_table(report: dict[str, Any], name: str) -> str:
    """A policy minus every other, paired by start."""
    keys = ("detection_rate", "e_add_mm", "distance_m")
    rows = []
    for other, difference in report["policies"][name]["against"].items():
        cells = [f"`{other}`"]
        for key in keys:
            _, digits, better = MEASURES[key]
            own = difference[key]
            text = f"{number(own['mean'], digits, True)} {interval(own['ci95_scenes'], digits, True)}"
            cells.append(f"{mark(own, better)} {text}")
        rows.append(cells)
    return table([f"`{name}` minus", "detection rate", "ADD, mm", "distance, m"], rows)


def variants_table(reports: Reports, keys: Sequence[str]) -> str:
    """Variants as rows, objects as columns; marks compare a variant with the first."""
    return _pivot(reports, lambda row: row["variant"], lambda row: describe_row(row, keys))


def describe_row(row: dict[str, Any], keys: Sequence[str]) -> str:
    """The measures of one row of an ablation."""
    parts = []
    for key in keys:
        unit, digits, better = MEASURES[key]
        against = row.get("against_first")
        sign = mark(against[key], better) if against else ""
        parts.append(f"{sign} {number(row[key], digits)}{unit}".strip())
    return ", ".join(parts)


def fusion_methods_table(reports: Reports) -> str:
    """Objects, kinds of views and methods of fusion as rows; what is found, and how good the probability is."""
    columns = {
        "found_of_all": ("found", 3),
        "e_add_mm": ("ADD, mm", 2),
        "median_e_add_mm": ("median of found, mm", 2),
        "found": ("found, confirmed", 3),
        "wrong": ("wrong of confirmed", 3),
        "auc": ("AUC", 3),
        "calibration_error": ("calibration error", 3),
    }
    rows = []
    for name, report in reports.items():
        for kind, methods in report["results"].items():
            for method, row in methods.items():
                cells = ("" if row[key] is None else number(row[key], digits) for key, (_, digits) in columns.items())
                rows.append([name, kind, f"`{method}`", *cells])
    return table(["", "views", "method", *(text for text, _ in columns.values())], rows)


def camera_errors_table(reports: Reports) -> str:
    """Objects and errors of the camera as rows; what is found and what is wrong, without and with aligned views."""
    columns = {
        "found_of_all": ("found", 3),
        "found": ("found, confirmed", 3),
        "e_add_mm": ("ADD, mm", 1),
        "wrong": ("wrong of confirmed", 3),
    }
    rows = []
    for name, report in reports.items():
        for error in dict.fromkeys(_camera_error(row) for row in report["rows"]):
            own = {row["variant"]: row for row in report["rows"] if _camera_error(row) == error}
            cells = []
            for key, (_, digits) in columns.items():
                ends = (own[variant][key] for variant in ("not aligned", "aligned"))
                cells.append(" → ".join("-" if value is None else number(value, digits) for value in ends))
            rows.append([name, error, *cells])
    return table(["", "camera's error", *(text for text, _ in columns.values())], rows)


def _camera_error(row: dict[str, Any]) -> str:
    return f"{row['millimetres']:g} mm, {row['degrees']:g} degrees"


def seeds_table(reports: Reports) -> str:
    """Every training: detection rate, error, validation result, minutes, and whether it is shipped."""

    def render(row: dict[str, Any]) -> str:
        found = describe_row(row, ("detection_rate", "e_add_mm"))
        chosen = "**best**" * row["best_on_validation"]
        ships = "ships" * row["shipped"]
        on_validation = f"validation {number(row['validation_detection_rate'], 3)} {chosen}".strip()
        return ", ".join(filter(None, (found, on_validation, f"{row['training_minutes']:.0f} min", ships)))

    return _pivot(reports, lambda row: row["variant"], render)


def steps_tables(reports: Reports) -> str:
    """One table per object: budgets T as rows, detection rate and error of policies as columns."""
    parts = []
    for name, report in reports.items():
        rows = {(row["budget"], row["variant"]): row for row in report["rows"]}
        budgets, policies = (list(dict.fromkeys(names)) for names in zip(*rows, strict=True))
        measures = ("detection_rate", "e_add_mm")
        lines = ([str(T), *(describe_row(rows[T, policy], measures) for policy in policies)] for T in budgets)
        parts += [f"**{name}**", table(["T", *(f"`{policy}`" for policy in policies)], lines)]
    return "\n\n".join(parts)


def noise_resampling_table(reports: Reports) -> str:
    """Policies and noise as rows: detection rate, error, and the share of the gap with its interval over scenes."""

    def render(row: dict[str, Any]) -> str:
        # Without an interval, as in one scene, the share stands alone.
        share, (low, high) = row["gap_closed"], row["gap_closed_ci95_scenes"] or (0.0, 0.0)
        ends = f" ({100 * low:.0f} to {100 * high:.0f})" if high - low > 0.005 else ""
        return f"{describe_row(row, ('detection_rate', 'e_add_mm'))}, {percent(share)}{ends}"

    return _pivot(reports, lambda row: f"`{row['policy']}`, {row['noise']} noise", render)


def _pivot(reports: Reports, key: Callable[[dict[str, Any]], str], render: Callable[[dict[str, Any]], str]) -> str:
    columns = [{key(row): render(row) for row in report["rows"]} for report in reports.values()]
    names = list(dict.fromkeys(name for column in columns for name in column))
    return table(["", *reports], ([name, *(column.get(name, "") for column in columns)] for name in names))


def environment_table(reports: Reports) -> str:
    """Steps of the training environment per second."""
    header = ["", "steps per second", "processes"]
    return table(
        header, ([name, f"{own['steps_per_second']:,.0f}", str(own["workers"])] for name, own in reports.items())
    )


def arm_table(reports: Reports) -> str:
    """What the camera on the arm finds, and the seconds that it takes."""
    header = ["", "policy", "found in the first view", "in the end", "seconds a move", "95 % below", "an episode"]
    header += ["refused goals", "least clearance"]
    rows = []
    for name, own in reports.items():
        for policy, row in own["policies"].items():
            shares = (f"{row['found'][view]:.3f}" for view in (0, -1))
            seconds = (f"{row[f'seconds_{part}']:.1f}" for part in ("per_move", "p95", "per_episode"))
            rest = f"{row['refused']:.1f}", f"{row['least_clearance_mm']:.0f} mm"
            rows.append([name, policy, *shares, *seconds, *rest])
    return table(header, rows)


def pipeline_table(reports: Reports) -> str:
    """Times of the last of six views after the estimator."""
    header = ["", "objects", "verification", "fusion", "policy", "all", "decision, 99th percentile"]
    rows = []
    for name, own in reports.items():
        parts = (f"{own[f'{part}_ms']:.2f} ms" for part in ("verification", "fusion", "policy"))
        rate, slowest = f"{own['hz_total']:,.0f} Hz", f"{own['policy_ms_p99']:.2f} ms"
        rows.append([name, str(own["objects"]), *parts, rate, slowest])
    return table(header, rows)
