"""``active6d benchmark estimator``."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from active6d_tools.cli.options import JsonFile, ObjectName, Seed, SensorName, Split
from active6d_tools.cli.output import write_json
from active6d_tools.cli.terminal import console, messages, print_table, work_progress

if TYPE_CHECKING:
    from active6d_core.object_model import ObjectModel
    from active6d_tools.benchmark.estimator_views import Measurement

_WEIGHTS = "Weights of the dense estimator instead of the shipped ones; repeatable, to compare them."
_RECORDS = "File for the results of all views; a run continues from it."


def estimator(
    object_name: ObjectName = "mug",
    names: Annotated[
        list[str] | None,
        typer.Option("--estimator", help="Name of an estimator; repeatable. By default all that support the object."),
    ] = None,
    peers: Annotated[bool, typer.Option("--peers", help="Also measure PPF and FPFH with RANSAC (slow).")] = False,
    split: Split = "test",
    wild: Annotated[
        bool, typer.Option("--wild", help="Take the wild scenes of the split: other things, containers and sensors.")
    ] = False,
    sensor: SensorName = "auto",
    sample: Annotated[int | None, typer.Option(min=1, help="Number of views, sampled with --seed.")] = None,
    noise: Annotated[
        list[float] | None,
        typer.Option(min=0.0, help="Factor on the noise of the simulated sensor; repeatable. By default 1."),
    ] = None,
    moves: Annotated[int, typer.Option(min=0, help="Also fuse the views of this many moves in each scene.")] = 0,
    weights: Annotated[list[Path] | None, typer.Option(metavar="FILE", help=_WEIGHTS)] = None,
    records: Annotated[Path | None, typer.Option(metavar="FILE", help=_RECORDS)] = None,
    plots: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder for PNG plots of the scores.")] = None,
    seed: Seed = 0,
    json_file: JsonFile = None,
) -> None:
    """Measure detection rate, precision, score quality and time of estimators on single views.

    Wild scenes are in the splits wild_val and wild_test; --wild --split test means the latter.

    Example: [bold]active6d benchmark estimator --object mug --sample 50 --plots plots --json mug.json[/bold]
    """
    from active6d_core.object_model import load_object
    from active6d_perception.estimators.registry import list_estimators, weights_path
    from active6d_tools.benchmark.estimator_views import enlist, measure_estimators

    model = load_object(object_name)
    if wild and not split.startswith("wild_"):
        split = f"wild_{split}"
    # The dense estimator needs weights of the object.
    able = [name for name in list_estimators() if name != "dense" or weights or weights_path(object_name).is_file()]
    with work_progress() as on_progress:
        contenders = enlist(model, names or able, weights=weights or [], peers=peers)
        measured = measure_estimators(
            object_name,
            split,
            contenders,
            sample=sample,
            moves=moves,
            seed=seed,
            noises=tuple(dict.fromkeys(noise or [1.0])),
            sensor=sensor,
            records=records,
            on_progress=on_progress,
        )
    _print(measured, f"{object_name}, {split}", " or ".join(model.features))
    write_json(json_file, measured.document)
    if plots is not None:
        _draw(plots, model, f"{object_name}, {split}", measured)


def _print(measured: "Measurement", title: str, part: str) -> None:
    for factor, rows in measured.document["noise"].items():
        _print_rates(f"{title}, {measured.document['views']} views, noise x{factor}", rows, part)
        _print_details(rows, part)
    console.print(f"peak memory of this process: {measured.document['peak_memory_mib']:.0f} MiB", highlight=False)


def _draw(folder: Path, model: "ObjectModel", title: str, measured: "Measurement") -> None:
    from active6d_tools.benchmark.estimator_plots import draw_ambiguity, draw_verification

    for (factor, name), result in measured.results.items():
        ending = f"{model.name}_{name}_noise{factor:g}.png"
        own = f"{title}, {name}, noise x{factor:g}, {len(result.views)} views"
        draw_verification(folder / f"verification_{ending}", own, result)
        if model.features:
            draw_ambiguity(folder / f"ambiguity_{ending}", own, model, result)
        messages.print(f"wrote {folder}/*_{ending}", highlight=False)


def _print_rates(title: str, rows: dict[str, dict[str, Any]], part: str) -> None:
    """Detection rates by visible fraction and precision, with 95 % intervals; ``part`` breaks the symmetry."""
    table = []
    for name, row in rows.items():
        for label, rates in ((name, row), (f"  {part} seen", row.get("feature_seen"))):
            if rates:
                cells = [_interval(rates[kind][least]) for kind in ("add", "adds") for least in ("0.5", "0.1")]
                table.append([label, *cells, _interval(row["precision"]) if rates is row else ""])
    columns = ("detection at 10 %", "ADD ≥half", "≥tenth", "ADD-S ≥half", "≥tenth", "precision")
    print_table(columns, table, title=title)
    console.print()


#: Label, what is shown of a value, and the nested keys of the value.
Detail = tuple[str, Callable[[Any], str], tuple[str, ...]]


def _print_details(rows: dict[str, dict[str, Any]], part: str) -> None:
    """BOP's recalls and precisions, quality of the scores, times; one column per estimator, "-" where it has none."""
    table = []
    for label, show, keys in (*_quality(rows, part), *_times(rows)):
        found: list[Any] = list(rows.values())
        for key in keys:
            found = [value.get(key) if value else None for value in found]
        table.append([label, *("-" if value is None else show(value) for value in found)])
    print_table(("", *rows), table)
    console.print()


def _quality(rows: dict[str, dict[str, Any]], part: str) -> Iterator[Detail]:
    yield "precision at score ≥ 0.5", _interval, ("precision_at_half",)
    yield "calibration error", _number, ("calibration_error",)
    for kind in ("mssd", "mspd"):
        yield f"average recall, {kind.upper()}", _interval, (kind, "average_recall")
    for least in next(iter(rows.values()))["recall_at_precision"]:
        yield f"found at precision {least}", _number, ("recall_at_precision", least)
    for kind, label in (("pose", "10 % of the diameter"), ("mssd", "MSSD"), ("mspd", "MSPD")):
        yield f"average precision, {label}", _number, ("average_precision", kind)
    for kind, label in (("equation_1", "verification"), ("own_score", "own score")):
        yield f"{label}, area under the curve", _number, ("verification", kind, "auc_adds")
        yield f"{label}, rank correlation, ADD", _number, ("verification", kind, "spearman_add")
    if all("ambiguity" in row for row in rows.values()):
        for where in ("seen", "hidden"):
            yield f"axis rotation right, {part} {where}", _number, ("ambiguity", where, "right_turn")
        yield "certainty of the axis rotation, area under the curve", _number, ("ambiguity", "auc")


def _times(rows: dict[str, dict[str, Any]]) -> Iterator[Detail]:
    crowded = all("crowded" in row["time"] for row in rows.values())
    for which, label in (("all", "all views"), *([("crowded", "14 objects or more")] if crowded else [])):
        for key, clock in (("total", "ms"), ("cpu", "CPU ms")):
            yield f"{clock}, {label}: median (95 %)", _time, ("time", which, key)
    which = "crowded" if crowded else "all"
    for stage in dict.fromkeys(stage for row in rows.values() for stage in row["time"][which]["stages"]):
        yield f"  {stage}", _time, ("time", which, "stages", stage)
    if any("fused" in row for row in rows.values()):
        yield "all objects, ADD: one view, fused", lambda rates: f"{rates[0]:.2f}, {rates[-1]:.2f}", ("fused",)


def _number(value: float) -> str:
    return f"{value:.2f}"


def _interval(rate: dict[str, Any]) -> str:
    if rate["rate"] is None:
        return "-"
    return f"{rate['rate']:.3f}\n[dim]{rate['low']:.2f}-{rate['high']:.2f}[/dim]"  # narrow enough for 80 columns


def _time(times: dict[str, float]) -> str:
    return f"{times['median_ms']:.0f} ({times['p95_ms']:.0f})"
