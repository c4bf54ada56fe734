"""``active6d benchmark graph``."""

from typing import Annotated

import typer

from active6d_bringup.cli.output import JsonFile, ObjectName, Seed, console, progress_bar, write_json

app = typer.Typer(help="Measure speed and quality.", rich_markup_mode="rich")


@app.callback()
def benchmark() -> None:
    """Measure speed and quality."""


@app.command()
def graph(
    object_name: ObjectName = "mug",
    seed: Seed = 0,
    views: Annotated[int, typer.Option(min=2, help="Views of one episode.")] = 11,
    hypotheses: Annotated[int, typer.Option(min=1, help="Hypotheses a view.")] = 20,
    repeats: Annotated[int, typer.Option(min=1, help="Episodes; a view's time is their median.")] = 5,
    json_file: JsonFile = None,
) -> None:
    """Compare the node graph with calling the core functions, and time verification and fusion.

    Example: [bold]active6d benchmark graph --object mug --json graph.json[/bold]
    """
    from rich.table import Table

    from active6d_bringup.benchmark.graph import measure_graph
    from active6d_core.object_model import load_object

    load_object(object_name)
    with progress_bar() as progress:
        task = progress.add_task("rendering views", total=None)
        result = measure_graph(
            object_name,
            seed=seed,
            views=views,
            hypotheses=hypotheses,
            repeats=repeats,
            on_progress=lambda what, done, total: progress.update(task, description=what, completed=done, total=total),
        )
    table = Table(box=None, pad_edge=False, title=f"{object_name}, {views} views, {hypotheses} hypotheses a view")
    for column in ("", "ms a view", "beyond direct calls"):
        table.add_column(column, justify="left" if not column else "right", header_style="dim")
    table.add_row("core functions called directly", f"{result['direct_ms']:.2f}", "")
    table.add_row("through the graph", f"{result['graph_ms']:.2f}", f"{result['overhead_ms']:.2f} ms")
    table.add_row(
        "through the graph, recorded", f"{result['recorded_ms']:.2f}", f"{result['overhead_recorded_ms']:.2f} ms"
    )
    table.add_row("verification and fusion, last view", f"{result['fusion_ms']:.2f}", f"{result['fusion_hz']:.0f} Hz")
    console.print(table)
    write_json(json_file, {"seed": seed, **result})


@app.command()
def estimator(
    object_name: ObjectName = "mug",
    names: Annotated[
        list[str] | None, typer.Option("--estimator", help="Estimator; repeatable. All that know it by default.")
    ] = None,
    split: Annotated[str, typer.Option(help="Which stored scenes.")] = "test",
    sample: Annotated[int | None, typer.Option(min=1, help="That many views, drawn by --seed; all by default.")] = None,
    moves: Annotated[int, typer.Option(min=0, help="Also fuse this many moves a scene.")] = 5,
    noise: Annotated[float, typer.Option(min=0.0, help="Factor on the sensor's noise.")] = 1.0,
    seed: Seed = 0,
    json_file: JsonFile = None,
) -> None:
    """Count what estimators find in single views, and what fusion finds after several.

    Example: [bold]active6d benchmark estimator --object mug --sample 50 --json mug.json[/bold]
    """
    from rich.table import Table

    from active6d_bringup.benchmark.estimator import VISIBLE, measure_estimators
    from active6d_perception.estimator import list_estimators, weights_path

    # The learned one takes part for objects that it has learned.
    able = [name for name in list_estimators() if name != "dense" or weights_path(object_name).is_file()]
    with progress_bar() as progress:
        task = progress.add_task("loading", total=None)
        result = measure_estimators(
            object_name,
            split,
            names or able,
            sample=sample,
            moves=moves,
            seed=seed,
            noise=noise,
            on_progress=lambda what, done, total: progress.update(task, description=what, completed=done, total=total),
        )
    table = Table(box=None, pad_edge=False, title=f"{object_name}, {split}, {result['views']} views")
    table.add_column("estimator", header_style="dim")
    columns = [f"{kind} ≥{least:.0%}" for kind in ("e_ADD", "ADD-S") for least in VISIBLE]
    for column in (*columns, "precision", "ms", *([f"{1} view", f"{moves + 1} fused"] if moves else [])):
        table.add_column(column, justify="right", header_style="dim")
    for name, row in result["estimators"].items():
        rates = [row[kind][str(least)] for kind in ("add", "adds") for least in VISIBLE]
        fused = [row["fused"][0], row["fused"][-1]] if moves else []
        cells = ["-" if rate is None else f"{rate:.3f}" for rate in (*rates, row["precision"])]
        table.add_row(name, *cells, f"{row['ms_median']:.0f}", *(f"{rate:.3f}" for rate in fused))
    console.print(table)
    write_json(json_file, result)
