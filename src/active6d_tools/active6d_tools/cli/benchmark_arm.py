"""``active6d benchmark arm``."""

from pathlib import Path
from typing import Annotated, Any

import typer

from active6d_tools.cli.options import JsonFile, ObjectName, Seed
from active6d_tools.cli.output import write_json
from active6d_tools.cli.terminal import print_table, work_progress


def arm(
    object_name: ObjectName = "mug",
    policies: Annotated[str, typer.Option(help="Names separated by commas: {policies}.")] = (
        "random,unidirectional,view-attention"
    ),
    episodes: Annotated[int, typer.Option(min=1, help="Number of episodes of each policy.")] = 20,
    steps: Annotated[int, typer.Option(min=1, help="Budget of moves T; T moves give T + 1 views.")] = 5,
    estimator: Annotated[str, typer.Option(help="Estimator for each view: auto, {estimators}.")] = "auto",
    hand_eye: Annotated[
        tuple[float, float], typer.Option(help="Error of the calibration: millimetres and degrees.")
    ] = (1.0, 0.2),
    png: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Draw found objects over seconds to this PNG file.")
    ] = None,
    seed: Seed = 0,
    json_file: JsonFile = None,
) -> None:
    """Run episodes with the camera on the simulated arm: found objects, seconds per move, refused goals, clearance.

    Example: [bold]active6d benchmark arm --object mug --episodes 20 --json arm.json --png arm.png[/bold]
    """
    from active6d_agent.policies.registry import create_policy
    from active6d_core.object_model import load_object
    from active6d_tools.benchmark.arm_episodes import measure_arm
    from active6d_tools.report.line_plots import Panel, draw_panels

    model = load_object(object_name)
    names = [name.strip() for name in policies.split(",")]
    for name in names:
        create_policy(name, model)  # refuses a wrong name or missing weights before the first episode
    settings: dict[str, Any] = {"episodes": episodes, "steps": steps, "estimator": estimator, "hand_eye": hand_eye}
    with work_progress() as on_progress:
        result = measure_arm(object_name, names, **settings, seed=seed, on_progress=on_progress)
    rows = [
        (
            name,
            f"{row['found'][0]:.3f}",
            f"{row['found'][-1]:.3f}",
            _cell(row["seconds_per_move"], 1),
            _cell(row["seconds_p95"], 1),
            f"{row['seconds_per_episode']:.1f}",
            f"{row['metres']:.2f}",
            f"{row['refused']:.1f}",
            _cell(row["least_clearance_mm"], 0),
        )
        for name, row in result["policies"].items()
    ]
    title = f"{object_name}, {episodes} episodes of {steps} moves"
    columns = ("policy", "found at once", "found", "s/move", "95 %", "s", "m", "refused", "clearance, mm")
    print_table(columns, rows, title=title)
    if png is not None:
        lines = {name: (result["times"], row["found_at"]) for name, row in result["policies"].items()}
        draw_panels(png, title, [Panel("seconds of motion", "found", lines)])
    write_json(json_file, result)


def _cell(value: float | None, digits: int) -> str:
    """A number of the moves; a dash where none was made."""
    return "-" if value is None else f"{value:.{digits}f}"
