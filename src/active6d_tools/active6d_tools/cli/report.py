"""``active6d report``."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from active6d_tools.cli.options import BagDepthScale, BagFolder, BagObject, BagRectified, BagTopics, JsonFile
from active6d_tools.cli.output import print_left_out, write_json, write_reports
from active6d_tools.cli.terminal import console, messages, print_table

if TYPE_CHECKING:
    from active6d_tools.report.analysis import EpisodeAnalysis


def report(
    folder: BagFolder,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FILE", help="HTML file; by default DIR/report.html.")
    ] = None,
    png: Annotated[Path | None, typer.Option(metavar="FILE", help="Draw all views and the scores as one PNG.")] = None,
    figure: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Draw a figure of the episode as PNG: before, after, attention, path."),
    ] = None,
    object_name: BagObject = None,
    topics: BagTopics = "",
    depth_scale: BagDepthScale = 0.0,
    rectified: BagRectified = None,
    episode: Annotated[int, typer.Option(min=0, help="Number of the episode in a bag with several, from 0.")] = 0,
    json_file: JsonFile = None,
) -> None:
    """Write a self-contained HTML report of a recorded episode and print a summary.

    Example: [bold]active6d report bags/mug -o mug.html --figure mug.png[/bold]
    """
    from active6d_bringup.bags.camera_topics import CameraOptions
    from active6d_bringup.bags.index import read_bag
    from active6d_bringup.bags.reader import read_episodes
    from active6d_tools.report.analysis import analyse

    with messages.status("reading the bag"):
        index = read_bag(folder, CameraOptions.parse(topics, depth_scale, rectified))
        records = read_episodes(index)
        if episode >= len(records):
            raise ValueError(f"--episode {episode}: {folder} has {len(records)}, counted from 0")
        analysis = analyse(records[episode], object_name)
    for line in records[0].damage:
        typer.echo(f"{folder}: {line}", err=True)
    beside = folder / "report.html" if folder.is_dir() else folder.with_suffix(".html")
    write_reports(analysis, output or beside, png, figure)
    print_summary(analysis)
    print_left_out(index.left_out, index.notes)
    write_json(json_file, analysis.summary())


def print_summary(analysis: "EpisodeAnalysis") -> None:
    """Print one line per view, then the totals."""
    record, last = analysis.record, analysis.steps[-1]
    title = "  ".join(part for part in (record.scene or analysis.model.name, record.policy) if part)
    columns = [
        "view",
        "camera",
        "moved",
        "hypotheses",
        "objects",
        "confirmed",
        "for",
        *["found", "ADD"] * bool(last.truth),
    ]
    rows = []
    for step in analysis.steps:
        truth = step.truth
        attended = f"#{step.attended.index}" if step.attended else "-"
        scored = [f"{truth.detected.sum()}/{len(truth.detected)}", f"{truth.mean_e_add_mm:.1f} mm"] if truth else []
        camera = f"{step.azimuth:.0f}° {step.elevation:2.0f}°"
        confirmed = f"{len(step.confirmed)}, {step.wrong} wrong" if step.wrong else len(step.confirmed)
        counts = (step.hypothesis_count, len(step.rows), confirmed) if not analysis.without_results else "---"
        rows.append([str(step.number), camera, f"{step.moved_m:.2f} m", *map(str, counts), attended, *scored])
    print_table(columns, rows, title=f"[bold]{escape(title)}[/bold]")
    found = f"{len(last.rows)} objects"
    if last.truth:
        found = f"found {last.truth.detected.sum()} of {len(last.truth.detected)} objects, "
        found += f"mean ADD {last.truth.mean_e_add_mm:.1f} mm"
    if analysis.without_results:
        found = "no hypotheses and no objects in the recording"
    console.print(f"{found}, {analysis.distance_m:.2f} m in {len(analysis.steps) - 1} moves", highlight=False)
    if analysis.without_results:
        first = "nothing was estimated yet; run first:"
        console.print(f"{first} {analysis.replay_command}", highlight=False, markup=False, soft_wrap=True)
    times = ", ".join(f"{time.node} {time.median_ms:.1f} ms" for time in analysis.node_times)
    if times:
        console.print(f"median per view: {times}", style="dim", highlight=False, markup=False)
