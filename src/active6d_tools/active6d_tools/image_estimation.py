"""An estimator on images from files: what is read, and the results as overlays."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from active6d_core.array_archive import read_array
from active6d_core.camera import View
from active6d_core.hypotheses import Hypotheses
from active6d_core.images import read_color, read_depth
from active6d_core.object_model import ObjectModel
from active6d_core.rgbd import make_view
from active6d_core.structured_text import read_json
from active6d_perception.active6d import Active6D
from active6d_sim.datasets.bop import BopScene
from active6d_tools.bop_results import BopEstimates, number_scenes
from active6d_tools.report.drawing import ScoreScale
from active6d_tools.report.silhouette import SilhouetteDrawer


@dataclass(frozen=True, eq=False)
class ImageResult:
    """What an estimator found in one image.

    Attributes:
        scene_id: BOP's number of the scene.
        image_id: BOP's number of the image.
        view: the whole view, before any crop.
        hypotheses: in the optical frame, best score first.
        seconds: of the estimator.
    """

    scene_id: int
    image_id: int
    view: View
    hypotheses: Hypotheses
    seconds: float

    @property
    def bop(self) -> BopEstimates:
        """For a results file."""
        found = self.hypotheses
        return BopEstimates(self.scene_id, self.image_id, found.T_camera_object, found.score, self.seconds)


#: A numbered image, which is read when it is needed: scenes of data sets have thousands.
NumberedImage = tuple[int, Callable[[], View]]


def read_scene(folder: Path, needs_poses: bool = False) -> tuple[int, str, list[NumberedImage]]:
    """A BOP scene folder, with or without camera poses: its number, what to say of that, and its numbered views.

    Raises:
        ValueError: the folder is no BOP scene; the message names the file.
    """
    scene = BopScene.load(folder, needs_poses)
    (number,), numbering = number_scenes([folder])
    images: list[NumberedImage] = [
        (image, partial(scene.view, index, 0)) for index, image in enumerate(scene.image_ids)
    ]
    return number, numbering, images


def read_image(rgb: Path, depth: Path, intrinsics: Path, depth_scale: float | None) -> View:
    """One view from a colour file, a depth file and intrinsics.

    Args:
        rgb: picture of any usual kind, or a ``.npy`` array of 8 bits a channel.
        depth: 16-bit or floating-point picture, or a ``.npy`` array.
        intrinsics: JSON file with ``K`` or ``cam_K``: 9 numbers in pixels, row by row.
        depth_scale: metres per unit of the depth file, None for 0.001 with integers and 1 with floating point.

    Raises:
        ValueError: a file is missing or damaged, or its content cannot be meant; the message names it.
    """
    color, distances = _read_array(rgb, read_color), _read_array(depth, read_depth)
    K = _read_matrix(intrinsics)
    try:
        return make_view(color, distances, K, depth_scale=depth_scale)
    except ValueError as error:
        raise ValueError(f"{rgb}, {depth}: {error}") from error


def estimate_images(
    estimator: Active6D,
    scene_id: int,
    images: Sequence[NumberedImage],
    *,
    depth_range: tuple[float, float] | None = None,
    region: tuple[np.ndarray, np.ndarray] | None = None,
    region_in_world: bool = False,
    sensor: str | None = None,
    on_left_out: Callable[[str], None] = lambda text: None,
) -> Iterator[ImageResult]:
    """Run the estimator on numbered views; yields each result. For the other arguments see :class:`.Active6D`.

    Args:
        estimator: of the object.
        scene_id: BOP's number of the scene.
        images: to estimate.
        depth_range: metres.
        region: corners of a box, metres.
        region_in_world: the box is in the world frame.
        sensor: kind of depth camera.
        on_left_out: called with the number of an image that cannot be used, and why.

    Raises:
        ValueError: no image can be used; the message has the first one's number.
    """
    first_problem, used = "", False
    for image_id, read in images:
        try:
            view = read()
            started = time.perf_counter()
            found = estimator(
                view.color,
                view.depth,
                view.camera,
                depth_range=depth_range,
                region=region,
                sensor=sensor,
                T_world_camera=view.T_world_camera if region_in_world else None,
            )
        except ValueError as error:
            first_problem = first_problem or f"image {image_id}: {error}"
            on_left_out(f"image {image_id} is left out: {error}")
            continue
        used = True
        yield ImageResult(scene_id, image_id, view, found, time.perf_counter() - started)
    if not used:
        raise ValueError(first_problem)


def describe(results: Sequence[BopEstimates], model: ObjectModel) -> list[dict[str, Any]]:
    """Results as JSON rows, one per image."""
    return [
        {
            "image": result.image_id,
            "seconds": result.seconds,
            "hypotheses": [
                {"score": float(score), "T_camera_mesh": T.tolist()}
                for T, score in zip(model.T_camera_mesh(result.T_camera_object), result.score, strict=True)
            ],
        }
        for result in results
    ]


class Overlay:
    """Draws hypotheses onto a view: outlines coloured by score, and the object's axes."""

    def __init__(self, model: ObjectModel) -> None:
        self._drawer = SilhouetteDrawer(model)
        self._scale = ScoreScale(0.0, 1.0)

    def draw(self, view: View, hypotheses: Hypotheses) -> Image.Image:
        """A picture of the view's size with every hypothesis, the best on top."""
        picture = Image.fromarray(view.color).convert("RGB")
        pen = ImageDraw.Draw(picture)
        order = np.argsort(hypotheses.score, kind="stable")
        for T, score in zip(hypotheses.T_camera_object[order], hypotheses.score[order], strict=True):
            outline = self._drawer.outline(T, view.camera, view.depth)
            color = self._scale.color(float(score))
            for polygon in outline.visible:
                pen.line([*map(tuple, polygon), tuple(polygon[0])], fill=color, width=2)
            if outline.axes is not None:
                for tip, axis_color in zip(outline.axes[1:], ("#ff3b30", "#34c759", "#0a84ff"), strict=True):
                    pen.line([tuple(outline.axes[0]), tuple(tip)], fill=axis_color, width=2)
            if outline.center is not None:
                pen.text(tuple(outline.center), f"{score:.2f}", fill="white", stroke_width=1, stroke_fill="black")
        return picture


def _read_array(path: Path, read_image_file: Callable[[Path], np.ndarray]) -> np.ndarray:
    """A ``.npy`` array as it is, an image as ``read_image_file`` gives it."""
    if path.suffix != ".npy":
        return read_image_file(path)
    try:
        return read_array(path)
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: not a readable array ({error})") from error


def _read_matrix(path: Path) -> np.ndarray:
    try:
        content = read_json(path)
        return np.reshape(np.array(content["K" if "K" in content else "cam_K"], float), (3, 3))
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise ValueError(f"{path}: needs 'K' or 'cam_K' with 9 numbers ({error})") from error
