"""``active6d benchmark environment|graph|pipeline``."""

import os
from pathlib import Path
from typing import Annotated, Any

import typer

from active6d_tools.cli.options import Banks, JsonFile, ObjectName, Seed, Split
from active6d_tools.cli.output import write_json
from active6d_tools.cli.terminal import console, messages, print_table, work_progress

app = typer.Typer(help="Measure speed and quality.", rich_markup_mode="rich")


@app.callback()
def benchmark() -> None:
    """Measure speed and quality."""


@app.command()
def graph(
    object_name: ObjectName = "mug",
    seed: Seed = 0,
    views: Annotated[int, typer.Option(min=2, help="Number of views in an episode.")] = 11,
    hypotheses: Annotated[int, typer.Option(min=1, help="Number of hypotheses per view.")] = 20,
    repeats: Annotated[int, typer.Option(min=1, help="Number of episodes; times are medians over them.")] = 5,
    json_file: JsonFile = None,
) -> None:
    """Measure the overhead of the node graph over direct calls of the same functions.

    Example: [bold]active6d benchmark graph --object mug --json graph.json[/bold]
    """
    from active6d_core.object_model import load_object
    from active6d_tools.benchmark.graph_overhead import measure_graph

    load_object(object_name)
    settings = {"seed": seed, "views": views, "hypotheses": hypotheses, "repeats": repeats}
    with work_progress() as on_progress:
        result = measure_graph(object_name, **settings, on_progress=on_progress)
    rows = [
        ("core functions called directly", f"{result['direct_ms']:.2f}", ""),
        ("through the graph", f"{result['graph_ms']:.2f}", f"{result['overhead_ms']:.2f} ms"),
        ("through the graph, recorded", f"{result['recorded_ms']:.2f}", f"{result['overhead_recorded_ms']:.2f} ms"),
        ("verification and fusion, last view", f"{result['fusion_ms']:.2f}", f"{result['fusion_hz']:.0f} Hz"),
    ]
    title = f"{object_name}, {views} views, {hypotheses} hypotheses per view"
    print_table(("", "ms per view", "overhead"), rows, title=title)
    write_json(json_file, {"seed": seed, **result})


@app.command()
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
    from active6d_agent.environment.throughput import measure_steps_per_second

    bank = find_bank(object_name, split, banks)
    settings: dict[str, Any] = {
        "workers": workers or os.cpu_count() or 1,
        "environments": environments,
        "seconds": seconds,
    }
    with messages.status(f"reading the bank, then {seconds:g} s of random moves"):
        rate = measure_steps_per_second(bank, **settings, seed=seed)
    console.print(f"{rate:,.0f} steps per second in {settings['workers']} processes", highlight=False)
    result = {"object": object_name, "split": split, "seed": seed, "steps_per_second": rate, **settings}
    write_json(json_file, result)


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
    from active6d_core.object_model import load_object
    from active6d_tools.benchmark.pipeline import measure_pipeline
    from active6d_tools.report.line_plots import Panel, draw_panels

    load_object(object_name)
    with work_progress() as on_progress:
        result = measure_pipeline(object_name, policy=policy, seed=seed, repeats=repeats, on_progress=on_progress)
    parts = ("verification", "fusion", "policy")
    rows = [
        (str(row["hypotheses"]), str(row["objects"]), *(f"{row[f'{part}_ms']:.2f}" for part in parts))
        for row in result["cost"]
    ]
    title = f"{object_name}, {result['objects']} objects, {result['views']} views"
    print_table(("hypotheses", "objects", *(f"{part}, ms" for part in parts)), rows, title=title)
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
