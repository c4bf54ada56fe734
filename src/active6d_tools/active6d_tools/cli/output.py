"""What the subcommands share: the terminal, progress with time left, options, JSON with the versions that made it."""

import json
import platform
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from active6d_core.files import write_file

console = Console()
#: Progress and notes, so that standard output holds results only.
messages = Console(stderr=True)

JsonFile = Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write what was measured to this file.")]
Seed = Annotated[int, typer.Option(help="Seed of everything random.", min=0)]
ObjectName = Annotated[str, typer.Option("--object", help="Object to work on, see `active6d object list`.")]
BagFolder = Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a recorded bag.")]
BagObject = Annotated[str | None, typer.Option("--object", help="The object, where the bag does not name it.")]
Processes = Annotated[bool, typer.Option("--processes", help="Run every node in a process of its own.")]
ParamsFile = Annotated[Path | None, typer.Option(metavar="FILE", help="ROS parameters of all nodes.")]
Overrides = Annotated[
    list[str] | None, typer.Option("--set", metavar="NODE.NAME=VALUE", help="A parameter of a node; repeatable.")
]

_VERSIONS = ("numpy", "scipy", "open3d", "pybullet", "torch", "rclpy")


def progress_bar() -> Progress:
    """A progress bar on standard error with a description, counts, elapsed time and time left."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(compact=True),
        console=messages,
    )


def write_json(path: Path | None, result: dict[str, Any]) -> None:
    """Write a result with the versions of what made it; nothing happens without a path.

    Raises:
        OSError: the file cannot be written.
    """
    if path is None:
        return
    document = {**result, "versions": {"python": platform.python_version(), **_installed_versions()}}
    write_file(path, json.dumps(document, indent=2, allow_nan=False) + "\n")
    messages.print(f"wrote {path}", highlight=False)


def export_weights(best: Path, folder: Path, name: str) -> None:
    """Copy weights and the JSON beside them to ``folder`` as ``name``.

    Raises:
        OSError: a file cannot be read or written.
    """
    for suffix in (".safetensors", ".json"):
        write_file(folder / f"{name}{suffix}", best.with_suffix(suffix).read_bytes())
    messages.print(f"wrote {folder / name}.safetensors and .json", highlight=False)


def _installed_versions() -> dict[str, str]:
    versions = {}
    for name in _VERSIONS:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return versions
