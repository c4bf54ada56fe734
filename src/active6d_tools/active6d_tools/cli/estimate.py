"""``active6d estimate``."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from active6d_core.files import write_file
from active6d_tools.cli.options import Imports, JsonFile, ObjectName
from active6d_tools.cli.output import write_json, write_png
from active6d_tools.cli.terminal import console, messages, progress_bar

if TYPE_CHECKING:
    from active6d_perception.active6d import Active6D
    from active6d_tools.bop_results import BopEstimates
    from active6d_tools.image_estimation import ImageResult, NumberedImage, Overlay

_SENSOR = (
    "Kind of depth camera: active_stereo, structured_light or time_of_flight. It sets --range where that is not given, "
    "and removes flying pixels of time-of-flight cameras."
)
_BOX = "Use only depth inside a box: X_MIN Y_MIN Z_MIN X_MAX Y_MAX Z_MAX in metres, in the camera's optical frame."


def estimate(
    folder: Annotated[Path | None, typer.Argument(metavar="[FOLDER]", help="A scene folder in BOP format.")] = None,
    object_name: ObjectName = "mug",
    rgb: Annotated[Path | None, typer.Option(metavar="FILE", help="One colour image instead of a folder.")] = None,
    depth: Annotated[Path | None, typer.Option(metavar="FILE", help="Its depth: 16-bit image or .npy array.")] = None,
    intrinsics: Annotated[Path | None, typer.Option(metavar="FILE", help="Its K or cam_K: JSON file.")] = None,
    depth_scale: Annotated[
        float | None,
        typer.Option(min=0.0, help="Metres per unit of --depth; by default 0.001 for integers, 1 for floats."),
    ] = None,
    estimator: Annotated[str, typer.Option(help="Estimator that finds the poses: auto, {estimators}.")] = "auto",
    sensor: Annotated[str | None, typer.Option(help=_SENSOR)] = None,
    depth_range: Annotated[
        tuple[float, float] | None,
        typer.Option("--range", metavar="NEAR FAR", help="Use only depth in this range, in metres."),
    ] = None,
    region: Annotated[tuple[float, float, float, float, float, float] | None, typer.Option(help=_BOX)] = None,
    region_in_world: Annotated[
        bool, typer.Option("--region-in-world", help="The box is in the world frame; the scene needs camera poses.")
    ] = False,
    object_id: Annotated[int, typer.Option(min=1, help="BOP object id for the CSV file.")] = 1,
    min_score: Annotated[float, typer.Option(min=0.0, max=1.0, help="Least score of what is drawn.")] = 0.5,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the results.")] = Path("estimates"),
    imports: Imports = None,
    json_file: JsonFile = None,
) -> None:
    """Estimate the poses of an object in recorded images.

    Writes DIR/results.csv, a BOP results file with poses of the mesh file's frame in millimetres, and an overlay PNG of
    every image. Exits with code 1 if an image cannot be used.

    Example: [bold]active6d estimate path/to/bop/scene --object coffee_cup --range 0.3 1.2 --out estimates[/bold]
    """
    import numpy as np

    from active6d_perception.active6d import Active6D
    from active6d_tools.bop_results import bop_csv
    from active6d_tools.image_estimation import Overlay, describe, estimate_images

    if region_in_world and (region is None or folder is None):
        raise ValueError("--region-in-world needs --region and a scene folder with camera poses")
    scene_id, numbering, images = _read(folder, rgb, depth, intrinsics, depth_scale, region_in_world)
    box = (np.array(region[:3]), np.array(region[3:])) if region is not None else None
    with messages.status(f"loading the estimator of {object_name}"):
        finder = Active6D(object_name, estimator)
    left_out: list[str] = []
    estimator = _announce(finder, estimator, folder, object_id)
    crop: dict[str, Any] = {"depth_range": depth_range, "region": box, "region_in_world": region_in_world}
    found = estimate_images(finder, scene_id, images, **crop, sensor=sensor, on_left_out=left_out.append)
    results = _draw_each(found, len(images), Overlay(finder.model), out / "overlays", min_score)
    _print(results, min_score)
    write_file(out / "results.csv", bop_csv(results, finder.model, object_id))
    messages.print(f"wrote {out / 'results.csv'} and {out / 'overlays'}", highlight=False, markup=False)
    for text in filter(None, [numbering, *left_out]):
        messages.print(text, highlight=False, markup=False)
    report = {"object": object_name, "estimator": estimator, "images": describe(results, finder.model)}
    write_json(json_file, {**report, "left_out": left_out})
    if left_out:
        raise typer.Exit(1)


def _announce(finder: "Active6D", estimator: str, folder: Path | None, object_id: int) -> str:
    """Say what is looked for, and whether the data set has another mesh; the estimator's name where it was chosen."""
    from active6d_core.registry import AUTOMATIC
    from active6d_perception.estimators.registry import choose_estimator
    from active6d_sim.datasets.bop_models import differs_from_data_set

    name = choose_estimator(finder.model.name) if estimator == AUTOMATIC else estimator
    messages.print(f"looking for {finder.model.name} with the estimator {name}", highlight=False, markup=False)
    if folder is not None and (text := differs_from_data_set(folder, object_id, finder.model)):
        messages.print(text, highlight=False, markup=False)
    return name


def _draw_each(
    found: Iterator["ImageResult"], total: int, overlay: "Overlay", folder: Path, min_score: float
) -> list["BopEstimates"]:
    """The results; each is drawn as soon as it is there, and its images and masks are not kept."""
    results = []
    with progress_bar() as bar:
        for result in bar.track(found, total=total, description="estimating"):
            results.append(result.bop)
            shown = result.hypotheses.take(result.hypotheses.score >= min_score)
            write_png(folder / f"{result.image_id:06d}.png", overlay.draw(result.view, shown))
    return results


def _print(results: list["BopEstimates"], min_score: float) -> None:
    for result in results:
        sure = int((result.score >= min_score).sum())
        text = f"image {result.image_id:6}  hypotheses {len(result.score):3}  score >= {min_score:g}: {sure:3}"
        console.print(f"{text}  {result.seconds:.2f} s", highlight=False)
    if results and not any((result.score >= min_score).any() for result in results):
        why = "is --object what the images show, and are its scale and that of the depth right?"
        messages.print(f"nothing with a score of {min_score:g} or more; {why}", highlight=False, markup=False)


def _read(
    folder: Path | None,
    rgb: Path | None,
    depth: Path | None,
    intrinsics: Path | None,
    depth_scale: float | None,
    needs_poses: bool,
) -> tuple[int, str, list["NumberedImage"]]:
    """BOP scene id, what to say of it, and images with their BOP image ids."""
    from active6d_tools.image_estimation import read_image, read_scene

    single = (rgb, depth, intrinsics)
    if folder is not None:
        if any(path is not None for path in single):
            raise ValueError("give either a scene folder, or --rgb, --depth and --intrinsics")
        return read_scene(folder, needs_poses)
    if rgb is None or depth is None or intrinsics is None:
        raise ValueError("give a scene folder in BOP format, or all of --rgb, --depth and --intrinsics")
    view = read_image(rgb, depth, intrinsics, depth_scale)
    return 0, "", [(0, lambda: view)]
