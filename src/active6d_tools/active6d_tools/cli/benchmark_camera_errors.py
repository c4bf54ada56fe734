"""``active6d benchmark camera-errors``."""

from pathlib import Path
from typing import Annotated, Any

import typer

from active6d_tools.cli.options import JsonFile, ObjectName, Seed, Split
from active6d_tools.cli.output import write_json
from active6d_tools.cli.terminal import messages, print_table, work_progress

_COLUMNS = {"found": 3, "e_add_mm": 2, "wrong": 3, "found_of_all": 3, "reported": 1}


def camera_errors(
    object_name: ObjectName = "mug",
    split: Split = "val",
    errors: Annotated[
        str, typer.Option(help="Root mean squares of shift and rotation, MM/DEGREES, separated by commas.")
    ] = "0/0,2/0.2,5/0.5,10/1,20/1.5",
    scenes: Annotated[int | None, typer.Option(min=1, help="Number of scenes; by default all of the split.")] = None,
    episodes: Annotated[
        int, typer.Option(min=1, help="Episodes of six ring views, and as many of six random views, per scene.")
    ] = 2,
    confirmed: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Least probability of the objects that count.")
    ] = 0.5,
    estimator: Annotated[str, typer.Option(help="Estimator for each view: auto, {estimators}.")] = "auto",
    png: Annotated[Path | None, typer.Option(metavar="FILE", help="Draw the curves to this PNG file.")] = None,
    seed: Seed = 0,
    json_file: JsonFile = None,
) -> None:
    """Measure what wrong camera poses cost the fusion of all views, with and without aligning the views.

    Example: [bold]active6d benchmark camera-errors --object mug --scenes 2 --errors 0/0,5/0.5 --png errors.png[/bold]
    """
    from active6d_perception.scene.fusion_parameters import FusionParameters
    from active6d_tools.bank_building import scene_names
    from active6d_tools.benchmark.camera_errors import error_panels, measure_errors, parse_errors
    from active6d_tools.report.line_plots import draw_panels

    parsed = parse_errors(errors)
    names = scene_names(object_name, split, scenes)
    settings: dict[str, Any] = {"episodes": episodes, "estimator": estimator, "seed": seed}
    with work_progress() as on_progress:
        rows = measure_errors(
            names, parsed, **settings, parameters=FusionParameters(confirmed=confirmed), on_progress=on_progress
        )
    title = f"{object_name}, {len(names)} scenes of {split}; confirmed: at least {confirmed:g}"
    cells = [
        (
            f"{row['millimetres']:g} mm, {row['degrees']:g} degrees",
            row["variant"],
            *("-" if row[key] is None else f"{row[key]:.{digits}f}" for key, digits in _COLUMNS.items()),
        )
        for row in rows
    ]
    head = ("camera's error", "views", "found", "ADD, mm", "wrong", "found of all", "reported")
    print_table(head, cells, title=title)
    report = {"object": object_name, "split": split, "scenes": len(names), "confirmed": confirmed, **settings}
    write_json(json_file, {**report, "rows": rows})
    if png:
        draw_panels(png, title, error_panels(rows))
        messages.print(f"wrote {png}", highlight=False)
