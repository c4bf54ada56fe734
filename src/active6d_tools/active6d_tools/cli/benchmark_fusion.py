"""``active6d benchmark fusion``."""

from typing import Annotated, Any

import typer

from active6d_tools.cli.options import JsonFile, ObjectName, Seed, Split
from active6d_tools.cli.output import write_json
from active6d_tools.cli.terminal import print_table, work_progress

_COLUMNS = {
    "found": "found",
    "e_add_mm": "ADD, mm",
    "median_e_add_mm": "of found",
    "wrong": "wrong",
    "confirmed": "confirmed",
    "found_of_all": "found of all",
    "wrong_of_all": "wrong of all",
    "reported": "reported",
    "auc": "AUC",
    "calibration_error": "calibration",
    "ms": "ms",
}
_DIGITS = {"e_add_mm": 2, "median_e_add_mm": 2, "confirmed": 1, "reported": 1, "ms": 0}


def fusion(
    object_name: ObjectName = "mug",
    split: Split = "val",
    scenes: Annotated[int | None, typer.Option(min=1, help="Number of scenes; by default all of the split.")] = None,
    episodes: Annotated[int, typer.Option(min=1, help="Number of episodes per scene and kind of views.")] = 4,
    kinds: Annotated[
        str, typer.Option(help="Kinds of views, separated by commas: ring and random (six views), all (100).")
    ] = "ring,random",
    confirmed: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Least probability of the objects that count.")
    ] = 0.5,
    vary_shapes: Annotated[
        bool, typer.Option("--vary-shapes", help="Let the objects deviate from their mesh, as real ones do.")
    ] = False,
    estimator: Annotated[str, typer.Option(help="Estimator for each view: auto, {estimators}.")] = "auto",
    seed: Seed = 0,
    json_file: JsonFile = None,
) -> None:
    """Compare the methods of fusion on the same views: found objects, errors, wrong objects, and time per view.

    Example: [bold]active6d benchmark fusion --object mug --scenes 2 --json fusion.json[/bold]
    """
    from active6d_perception.scene.fusion_parameters import FusionParameters
    from active6d_tools.bank_building import scene_names
    from active6d_tools.benchmark.fusion_methods import KINDS, compare_methods

    chosen = [kind.strip() for kind in kinds.split(",")]
    if unknown := set(chosen) - set(KINDS):
        raise ValueError(f"--kinds: '{min(unknown)}' is not among {', '.join(KINDS)}")
    names = scene_names(object_name, split, scenes)
    settings: dict[str, Any] = {
        "kinds": chosen,
        "episodes": episodes,
        "vary_shapes": vary_shapes,
        "estimator": estimator,
        "seed": seed,
    }
    with work_progress() as on_progress:
        results = compare_methods(
            names,
            **settings,
            parameters=FusionParameters(confirmed=confirmed),
            on_progress=on_progress,
        )
    for kind, methods in results.items():
        title = f"{object_name}, {kind} views, {len(names)} scenes of {split}; confirmed: at least {confirmed:g}"
        _print_methods(methods, title)
    report: dict[str, Any] = {
        "object": object_name,
        "split": split,
        "scenes": len(names),
        "confirmed": confirmed,
        **settings,
    }
    write_json(json_file, {**report, "results": results})


def _print_methods(methods: dict[str, dict[str, float | None]], title: str) -> None:
    rows = []
    for method, row in methods.items():
        values = [(row[key], _DIGITS.get(key, 3)) for key in _COLUMNS]
        rows.append((method, *("-" if value is None else f"{value:.{digits}f}" for value, digits in values)))
    print_table(("method", *_COLUMNS.values()), rows, title=title)
