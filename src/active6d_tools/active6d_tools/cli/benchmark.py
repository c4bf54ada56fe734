"""``active6d benchmark graph``."""

from typing import Annotated

import typer

from active6d_tools.cli.options import JsonFile, ObjectName, Seed
from active6d_tools.cli.output import write_json
from active6d_tools.cli.terminal import console, progress_bar

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
    from rich.table import Table

    from active6d_core.object_model import load_object
    from active6d_tools.benchmark.graph_overhead import measure_graph

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
    table = Table(box=None, pad_edge=False, title=f"{object_name}, {views} views, {hypotheses} hypotheses per view")
    for column in ("", "ms per view", "overhead"):
        table.add_column(column, justify="left" if not column else "right", header_style="dim")
    table.add_row("core functions called directly", f"{result['direct_ms']:.2f}", "")
    table.add_row("through the graph", f"{result['graph_ms']:.2f}", f"{result['overhead_ms']:.2f} ms")
    table.add_row(
        "through the graph, recorded", f"{result['recorded_ms']:.2f}", f"{result['overhead_recorded_ms']:.2f} ms"
    )
    table.add_row("verification and fusion, last view", f"{result['fusion_ms']:.2f}", f"{result['fusion_hz']:.0f} Hz")
    console.print(table)
    write_json(json_file, {"seed": seed, **result})
