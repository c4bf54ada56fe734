"""``active6d benchmark environment|pipeline``."""

from pathlib import Path
from typing import Annotated

import typer

from active6d_tools.cli.options import Banks, JsonFile, ObjectName, Seed, Split
from active6d_tools.cli.output import write_json
from active6d_tools.cli.terminal import console, messages, progress_bar


def environment(
    object_name: ObjectName = "mug",
    split: Split = "test",
    workers: Annotated[int, typer.Option(min=0, help="Number of processes; 0 for one per core.")] = 0,
    environments: Annotated[int, typer.Option(min=1, help="Number of parallel episodes in each process.")] = 512,
    seconds: Annotated[float, typer.Option(min=0.1, help="Duration of the measurement in seconds.")] = 5.0,
    banks: Banks = None,
    seed: Seed = 0,
    json_file: JsonFile = None,
) -> None:
    """Measure the training environment in steps per second; every step runs the deployed fusion.

    Example: [bold]active6d benchmark environment --object mug --json environment.json[/bold]
    """
    from active6d_agent.bank.scene_bank import find_bank
    from active6d_tools.benchmark.environment_speed import measure_environment

    bank = find_bank(object_name, split, banks)
    with messages.status(f"reading the bank, then {seconds:g} s of random moves"):
        result = measure_environment(
            bank, workers=workers or None, environments=environments, seconds=seconds, seed=seed
        )
    console.print(
        f"{result['steps_per_second']:,.0f} steps per second in {result['workers']} processes", highlight=False
    )
    write_json(json_file, {"object": object_name, "split": split, "seed": seed, **result})


def pipeline(
    object_name: ObjectName = "mug",
    policy: Annotated[str, typer.Option(help="Policy that chooses the views: {policies}.")] = "view-attention",
    repeats: Annotated[int, typer.Option(min=1, help="Number of repetitions of every measurement.")] = 50,
    png: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Draw times over the number of hypotheses to this PNG file.")
    ] = None,
    seed: Seed = 0,
    json_file: JsonFile = None,
) -> None:
    """Measure the time of verification, fusion and policy for 10 to 1000 accumulated hypotheses.

    Example: [bold]active6d benchmark pipeline --object mug --json pipeline.json --png pipeline.png[/bold]
    """
    from rich.table import Table

    from active6d_core.object_model import load_object
    from active6d_tools.benchmark.pipeline import measure_pipeline
    from active6d_tools.report.line_plots import Panel, draw_panels

    load_object(object_name)
    with progress_bar() as progress:
        task = progress.add_task("rendering views", total=None)
        result = measure_pipeline(
            object_name,
            policy=policy,
            seed=seed,
            repeats=repeats,
            on_progress=lambda what, done, total: progress.update(task, description=what, completed=done, total=total),
        )
    parts = ("verification", "fusion", "policy")
    table = Table(
        box=None, pad_edge=False, title=f"{object_name}, {result['objects']} objects, {result['views']} views"
    )
    for column in ("hypotheses", "objects", *(f"{part} [ms]" for part in parts)):
        table.add_column(column, justify="right", header_style="dim")
    for row in result["cost"]:
        cells = (f"{row[f'{part}_ms']:.2f}" for part in parts)
        table.add_row(str(row["hypotheses"]), str(row["objects"]), *cells)
    console.print(table)
    untrained = "" if result["trained"] else " (untrained weights)"
    console.print(
        f"fusion {result['fusion_hz']:.0f} Hz   decision {result['policy_ms_p99']:.2f} ms at the 99th percentile"
        f"   all {result['hz_total']:.0f} Hz{untrained}",
        highlight=False,
    )
    if png is not None:
        counts = [row["hypotheses"] for row in result["cost"]]
        lines = {part: (counts, [row[f"{part}_ms"] for row in result["cost"]]) for part in parts}
        draw_panels(png, f"Cost of one view, {object_name}", [Panel("hypotheses", "ms", lines, logarithmic=True)])
    write_json(json_file, {"seed": seed, **result})
