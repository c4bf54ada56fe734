"""Results files of the BOP challenge: one CSV row for each estimated pose."""

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from active6d_core.object_model import ObjectModel

#: Columns of a results file of the BOP challenge.
BOP_COLUMNS = ("scene_id", "im_id", "obj_id", "score", "R", "t", "time")


@dataclass(frozen=True, eq=False)
class BopEstimates:
    """Poses estimated in one image.

    Attributes:
        scene_id: BOP's number of the scene.
        image_id: BOP's number of the image.
        T_camera_object: (k, 4, 4) in the optical frame, metres.
        score: (k,) in [0, 1].
        seconds: of the estimation.
    """

    scene_id: int
    image_id: int
    T_camera_object: np.ndarray
    score: np.ndarray
    seconds: float


def number_scenes(folders: Sequence[Path]) -> tuple[list[int], str]:
    """BOP's numbers of scenes by the names of their folders, and what to say of them.

    Where names are no numbers, or not different ones, all folders are numbered by their order, from 0, and the text
    says so; else it is empty.
    """
    names = [folder.resolve().name for folder in folders]
    numbers = [int(name) if name.isdecimal() else -1 for name in names]
    if min(numbers) >= 0 and len(set(numbers)) == len(numbers):
        return numbers, ""
    ordered = ", ".join(f"{number} is {name}" for number, name in enumerate(names))
    return list(range(len(names))), f"scene folders without a number are numbered by their order: {ordered}"


def once_per_image(estimates: Iterable[BopEstimates]) -> tuple[list[BopEstimates], int]:
    """The first estimates of each image, and how many others there were: BOP scores an image once."""
    first: dict[tuple[int, int], BopEstimates] = {}
    others = 0
    for each in estimates:
        others += (each.scene_id, each.image_id) in first
        first.setdefault((each.scene_id, each.image_id), each)
    return list(first.values()), others


def bop_csv(estimates: Iterable[BopEstimates], model: ObjectModel, object_id: int) -> str:
    """Results as BOP's CSV: poses of the mesh file's frame in the camera, millimetres."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(BOP_COLUMNS)
    for image in estimates:
        for T, score in zip(model.T_camera_mesh(image.T_camera_object), image.score, strict=True):
            rotation = " ".join(f"{value:.9g}" for value in T[:3, :3].ravel())
            translation = " ".join(f"{value:.6f}" for value in 1e3 * T[:3, 3])
            numbers = [image.scene_id, image.image_id, object_id, f"{score:.6f}"]
            writer.writerow([*numbers, rotation, translation, f"{image.seconds:.4f}"])
    return file.getvalue()
