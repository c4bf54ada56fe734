"""Files that several subcommands write: JSON results, pictures, weights, reports."""

import json
import platform
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

from active6d_core.files import atomic_file, write_file
from active6d_tools.cli.terminal import console, messages

if TYPE_CHECKING:
    import numpy as np
    from PIL import Image

    from active6d_tools.report.analysis import EpisodeAnalysis

_VERSIONS = ("numpy", "scipy", "open3d", "pybullet", "torch", "rclpy")


def write_json(path: Path | None, result: dict[str, Any]) -> None:
    """Write a result with the versions of Python and libraries; does nothing without a path.

    Raises:
        OSError: the file cannot be written.
    """
    if path is None:
        return
    document = {**result, "versions": {"python": platform.python_version(), **_installed_versions()}}
    write_file(path, json.dumps(document, indent=2, allow_nan=False) + "\n")
    messages.print(f"wrote {path}", highlight=False)


def write_png(path: Path, picture: "np.ndarray | Image.Image") -> None:
    """Write a picture: (H, W, 3) uint8 RGB, or Pillow's own.

    Raises:
        OSError: the file cannot be written.
    """
    from PIL import Image

    with atomic_file(path) as unfinished:
        image = picture if isinstance(picture, Image.Image) else Image.fromarray(picture)
        image.save(unfinished, "PNG")


def export_weights(best: Path, folder: Path, name: str) -> None:
    """Copy weights and their JSON configuration to ``folder`` as ``name``.

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


def write_reports(
    analysis: "EpisodeAnalysis", html: Path | None = None, png: Path | None = None, figure: Path | None = None
) -> None:
    """Write each output that has a path: the HTML page, the picture of all views, the figure of the episode.

    Raises:
        OSError: a file cannot be written.
    """
    from active6d_tools.report.figure import render_png
    from active6d_tools.report.html_page import render_html
    from active6d_tools.report.qualitative import render_qualitative

    for path, render in ((html, render_html), (png, render_png), (figure, render_qualitative)):
        if path is not None:
            with messages.status(f"drawing {path.name}"):
                write_file(path, render(analysis))
            messages.print(f"wrote {path}", highlight=False, markup=False)


def print_left_out(left_out: dict[str, int], notes: list[str]) -> None:
    """Print how many views of a recording are not used, for which reason, and what is doubtful."""
    for reason, count in sorted(left_out.items(), key=lambda item: -item[1]):
        console.print(f"left out {count}: {reason}", highlight=False, markup=False)
    for note in notes:
        console.print(f"note: {note}", highlight=False, markup=False)
