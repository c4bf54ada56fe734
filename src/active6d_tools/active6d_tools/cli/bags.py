"""``active6d bag``: what is in a recording, whether it can be replayed, and what can be saved of a damaged one."""

from pathlib import Path
from typing import Annotated, Any

import typer

from active6d_tools.cli.options import BagDepthScale, BagFolder, BagRectified, BagTopics, JsonFile
from active6d_tools.cli.output import print_left_out, write_json
from active6d_tools.cli.terminal import console, messages

app = typer.Typer(no_args_is_help=True, help="Look into recordings of this project and of others.")


@app.command()
def info(folder: BagFolder, json_file: JsonFile = None) -> None:
    """Print the topics of a bag: type, number of messages and rate.

    Example: [bold]active6d bag info recording.mcap[/bold]
    """
    from rich.table import Table

    from active6d_bringup.bags.summary import summarise

    with messages.status("reading the bag"):
        summary = summarise(folder)
    table = Table(box=None, pad_edge=False)
    for column in ("topic", "type", "messages", "Hz", "frame", "first message"):
        number = column in ("messages", "Hz")
        table.add_column(column, header_style="dim", justify="right" if number else "left", overflow="fold")
    for row in summary.topics:
        rate = "-" if row.rate_hz is None else f"{row.rate_hz:.1f}"
        table.add_row(row.name, row.type, str(row.count), rate, row.frame, row.content)
    console.print(table)
    console.print(f"{summary.messages} messages, {summary.seconds:.1f} s, {', '.join(summary.files)}", highlight=False)
    write_json(json_file, summary.to_json())


@app.command()
def check(
    folder: BagFolder,
    topics: BagTopics = "",
    depth_scale: BagDepthScale = 0.0,
    rectified: BagRectified = None,
    json_file: JsonFile = None,
) -> None:
    """Read every view of a bag as replay would, and say what is left out and why. Exit with code 1 if anything is.

    Example: [bold]active6d bag check recording --topics depth=/camera/depth/image_rect[/bold]
    """
    from active6d_bringup.bags.camera_topics import CameraOptions
    from active6d_bringup.bags.index import read_bag
    from active6d_bringup.bags.reader import read_episodes

    with messages.status("reading the bag"):
        index = read_bag(folder, CameraOptions.parse(topics, depth_scale, rectified))
        episodes = read_episodes(index)
    views = sum(len(episode.steps) for episode in episodes)
    origin = f"the camera is {index.source}" if index.source else "recorded by active6d"
    console.print(f"{views} usable views in {len(episodes)} episodes; {origin}", highlight=False, markup=False)
    print_left_out(index.left_out, [*index.notes, *index.damage])
    result: dict[str, Any] = {"views": views, "episodes": len(episodes), "camera": index.source}
    write_json(json_file, {**result, "left_out": index.left_out, "notes": index.notes, "damage": list(index.damage)})
    if index.left_out or index.damage:
        raise typer.Exit(1)


@app.command()
def repair(
    folder: BagFolder,
    into: Annotated[Path, typer.Argument(metavar="DIR", help="Folder to create for the repaired bag.")],
    json_file: JsonFile = None,
) -> None:
    """Save what can be read of a bag whose recording was killed or whose file is damaged. The bag stays as it is.

    Example: [bold]active6d bag repair bags/killed bags/saved[/bold]
    """
    from active6d_bringup.bags.repair import repair as save

    with messages.status("reading the bag"):
        saved = save(folder, into)
    console.print(f"{saved.messages} messages saved in {into}", highlight=False, markup=False)
    for line in saved.damage:
        console.print(line, highlight=False, markup=False)
    write_json(json_file, {"messages": saved.messages, "damage": list(saved.damage)})
