"""Reading and writing of recorded scenes in BOP's folder format.

The format is described in ``docs/bop_datasets_format.md`` of https://github.com/thodan/bop_toolkit.

A folder holds ``scene_camera.json`` (intrinsics and the camera's pose in the world), ``rgb/NNNNNN.png``,
``depth/NNNNNN.png`` (16 bit, 0 without a return) and, optionally, ``scene_gt.json`` (object poses in the camera) and
``scene_gt_info.json`` (visible fractions). Poses of objects are those of the model file's frame. Lengths are
millimetres on disk and metres here.
"""

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from active6d_core.camera import PinholeCamera, View
from active6d_core.files import make_folder, naming, write_file
from active6d_core.images import read_color, read_depth
from active6d_core.se3 import invert, make_transform, quaternion_from_transform, transform_from_quaternion
from active6d_core.structured_text import read_json

CAMERA_FILE, TRUTH_FILE, VISIBILITY_FILE = "scene_camera.json", "scene_gt.json", "scene_gt_info.json"
#: Published datasets round rotations to about six digits; matrices farther from orthonormal are refused.
_ROTATION_TOLERANCE = 1e-3
#: Of images, in order of search.
_ENDINGS = ("png", "jpg", "jpeg", "tif", "tiff")
_DEEPEST = np.iinfo(np.uint16).max


@dataclass(frozen=True, eq=False)
class ImageTruth:
    """Ground truth of the n objects in one image.

    Attributes:
        object_id: (n,) int, BOP's number of each object's model.
        T_camera_object: (n, 4, 4) poses in the optical frame, metres.
        visible_fraction: (n,) share in [0, 1] of each silhouette that is visible, NaN if not recorded.
    """

    object_id: np.ndarray
    T_camera_object: np.ndarray
    visible_fraction: np.ndarray


@dataclass(frozen=True, eq=False)
class BopScene:
    """m recorded views of one scene; images are read on demand.

    Attributes:
        folder: folder of the scene.
        image_ids: (m) BOP's image numbers, ascending.
        cameras: (m) intrinsics.
        T_world_camera: (m, 4, 4) poses of the optical frame in the recording's world, metres; the identity where the
            recording has none.
        has_pose: (m,) bool, whether the recording has a pose of each image's camera. A world can be the first
            camera's frame, so that an identity can be a pose.
        depth_scale: (m) millimetres per step of the depth image.
        truth: (m) ground truth, None where the recording has none; empty for images that it does not list.
    """

    folder: Path
    image_ids: tuple[int, ...]
    cameras: tuple[PinholeCamera, ...]
    T_world_camera: np.ndarray
    has_pose: np.ndarray
    depth_scale: tuple[float, ...]
    truth: tuple[ImageTruth, ...] | None

    @classmethod
    def load(cls, folder: str | Path, needs_poses: bool = True) -> "BopScene":
        """Read and check everything except the pixels.

        Args:
            folder: of the scene.
            needs_poses: refuse a recording without camera poses.

        Raises:
            ValueError: a file is missing or damaged, or a key is missing or has a wrong value; the message names both.
        """
        folder = Path(folder)
        path = folder / CAMERA_FILE
        entries = _read_by_image(path)
        if not entries:
            raise ValueError(f"{path}: no image")
        cameras, poses, has_pose, scales = [], [], [], []
        for image, entry in entries.items():
            T_world_camera = _read_camera_pose(entry, path, image, needs_poses)
            has_pose.append(T_world_camera is not None)
            poses.append(np.eye(4) if T_world_camera is None else T_world_camera)
            scale = float(_numbers(entry, "depth_scale", 1, path, image)[0])
            if not scale > 0:
                raise ValueError(f"{path}: image {image}: depth_scale must be positive, got {scale}")
            scales.append(scale)
            k = _numbers(entry, "cam_K", 9, path, image)
            size = _size(_image_path(folder, "depth", image))
            try:
                cameras.append(PinholeCamera.from_matrix(k.reshape(3, 3), *size, cropped=True))
            except ValueError as error:
                raise ValueError(f"{path}: image {image}: cam_K: {error}") from error
            color = _image_path(folder, "rgb", image)
            if _size(color) != size:
                raise ValueError(f"{color}: is {_size(color)} pixels, its depth image {size}")
        truth = _read_truth(folder, tuple(entries)) if (folder / TRUTH_FILE).is_file() else None
        known = np.array(has_pose)
        return cls(folder, tuple(entries), tuple(cameras), np.array(poses), known, tuple(scales), truth)

    def __len__(self) -> int:
        return len(self.image_ids)

    def take(self, index: Sequence[int]) -> "BopScene":
        """The recording of some of its views, in that order."""
        return BopScene(
            self.folder,
            tuple(self.image_ids[i] for i in index),
            tuple(self.cameras[i] for i in index),
            self.T_world_camera[list(index)],
            self.has_pose[list(index)],
            tuple(self.depth_scale[i] for i in index),
            None if self.truth is None else tuple(self.truth[i] for i in index),
        )

    def view(self, index: int, stamp: int) -> View:
        """Read the ``index``-th view and give it the stamp ``stamp`` (nanoseconds).

        Raises:
            ValueError: an image is damaged or has another kind of pixels; the message names the file.
        """
        camera, image = self.cameras[index], self.image_ids[index]
        color_path, depth_path = (_image_path(self.folder, kind, image) for kind in ("rgb", "depth"))
        color = _require_size(read_color(color_path), color_path, camera)
        steps = _require_size(read_depth(depth_path), depth_path, camera)
        depth = np.where(steps > 0, steps * (self.depth_scale[index] * 1e-3), np.nan).astype(np.float32)
        return View(stamp, color, depth, camera, self.T_world_camera[index])

    def nearest(self, position: np.ndarray) -> int:
        """Index of the view whose direction from the world's origin is nearest to that of (3,) ``position``, metres."""
        positions = self.T_world_camera[:, :3, 3]
        return int(np.argmax(positions @ position / np.linalg.norm(positions, axis=1)))

    def T_world_object(self, index: int, object_id: int | None = None) -> np.ndarray:
        """(n, 4, 4) true poses in the world, metres, from the ``index``-th view, of one object model or of all.

        Raises:
            ValueError: the recording has no ground truth.
        """
        if self.truth is None:
            raise ValueError(f"{self.folder / TRUTH_FILE}: no such file")
        truth = self.truth[index]
        chosen = np.full(len(truth.object_id), True) if object_id is None else truth.object_id == object_id
        return self.T_world_camera[index] @ truth.T_camera_object[chosen]


def write_bop_scene(
    folder: str | Path,
    views: Iterable[View],
    T_world_object: np.ndarray,
    object_id: int = 1,
    *,
    visible_fraction: np.ndarray | None = None,
    depth_scale: float = 0.1,
) -> None:
    """Write views of a scene as a BOP folder; images are numbered from 0.

    Args:
        folder: folder to write, created if it does not exist.
        views: m views of the camera.
        T_world_object: (n, 4, 4) true poses of the model file's frame in the world, metres, the same in all views.
        object_id: BOP's number of the objects' model, from 1.
        visible_fraction: (m, n) for ``scene_gt_info.json``; without it the file is not written.
        depth_scale: millimetres per step of the depth image; depth beyond 65535 steps is written as missing.

    Raises:
        ValueError: ``folder`` already holds a scene, or an argument is out of range.
    """
    folder = Path(folder)
    if (folder / CAMERA_FILE).exists():
        raise ValueError(f"{folder / CAMERA_FILE} exists already; choose another folder")
    if object_id < 1 or not 0 < depth_scale < np.inf:
        raise ValueError(f"BOP counts objects from 1 and scales are positive, got {object_id} and {depth_scale}")
    for kind in ("rgb", "depth"):
        make_folder(folder / kind)
    cameras, truth = {}, {}
    for image, view in enumerate(views):
        _write_image(folder / "rgb" / f"{image:06d}.png", view.color)
        steps = np.rint(np.nan_to_num(view.depth.astype(float), nan=0.0, posinf=0.0) * (1e3 / depth_scale))
        steps = np.where(steps <= _DEEPEST, steps, 0).astype(np.uint16)
        _write_image(folder / "depth" / f"{image:06d}.png", steps)
        T_camera_world = invert(view.T_world_camera)
        cameras[image] = {
            "cam_K": view.camera.matrix.ravel().tolist(),
            "depth_scale": depth_scale,
            **_pose_entry(T_camera_world, "cam_R_w2c", "cam_t_w2c"),
        }
        poses = T_camera_world @ T_world_object
        truth[image] = [{**_pose_entry(T, "cam_R_m2c", "cam_t_m2c"), "obj_id": object_id} for T in poses]
    if visible_fraction is not None:
        expected = (len(cameras), len(T_world_object))
        if np.shape(visible_fraction) != expected:
            raise ValueError(f"visible_fraction has shape {np.shape(visible_fraction)}, expected {expected}")
        rows = np.asarray(visible_fraction, float).tolist()
        _write_by_image(folder / VISIBILITY_FILE, {i: [{"visib_fract": v} for v in row] for i, row in enumerate(rows)})
    _write_by_image(folder / TRUTH_FILE, truth)
    _write_by_image(folder / CAMERA_FILE, cameras)


def _pose_entry(T: np.ndarray, rotation: str, translation: str) -> dict[str, list[float]]:
    return {rotation: T[:3, :3].ravel().tolist(), translation: (1e3 * T[:3, 3]).tolist()}


def _write_image(path: Path, pixels: np.ndarray) -> None:
    with naming(path):
        Image.fromarray(pixels).save(path)


def _write_by_image(path: Path, entries: dict[int, Any]) -> None:
    """Write one line per image, as BOP's tools do."""
    lines = ",\n".join(f'  "{image}": {json.dumps(entry)}' for image, entry in entries.items())
    write_file(path, f"{{\n{lines}\n}}\n")


def _read_by_image(path: Path) -> dict[int, Any]:
    """A file's entries by image number, ascending."""
    try:
        content = read_json(path)
    except FileNotFoundError as error:
        folder = path.parent
        if not folder.is_dir():
            raise ValueError(f"{folder}: no such folder") from error
        hint = describe_cameras(folder) or _describe_scenes(folder)
        raise ValueError(f"{path}: no such file; a BOP scene folder needs it{hint}") from error
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: not a JSON file ({error})") from error
    if not isinstance(content, dict) or not all(key.isascii() and key.isdecimal() for key in content):
        raise ValueError(f"{path}: must map image numbers to entries")
    return {int(key): content[key] for key in sorted(content, key=int)}


def describe_cameras(folder: Path) -> str:
    """What to do where a scene folder has the files of several cameras, ``scene_camera_NAME.json``; else empty."""
    cameras = sorted(each.name for each in folder.glob(f"{Path(CAMERA_FILE).stem}_*.json"))
    return f"; it has {', '.join(cameras)}: copy one camera's files to the usual names" if cameras else ""


def _describe_scenes(folder: Path) -> str:
    """Which folder to give in place of a data set or a split of it; else empty."""
    scenes = sorted(path.parent for pattern in ("*", "*/*") for path in folder.glob(f"{pattern}/{CAMERA_FILE}"))
    return f"; it has {len(scenes)} scenes: give one of them, such as {scenes[0]}" if scenes else ""


def _read_truth(folder: Path, image_ids: tuple[int, ...]) -> tuple[ImageTruth, ...]:
    path, visibility_path = folder / TRUTH_FILE, folder / VISIBILITY_FILE
    by_image = _read_by_image(path)
    visibility = _read_by_image(visibility_path) if visibility_path.is_file() else None
    truth = []
    for image in image_ids:
        entries = _entries(by_image, path, image)
        poses = [_read_pose(entry, "cam_R_m2c", "cam_t_m2c", path, image) for entry in entries]
        kinds = [_numbers(entry, "obj_id", 1, path, image)[0] for entry in entries]
        visible = np.full(len(entries), np.nan)
        if visibility is not None and image in visibility and image in by_image:
            known = _entries(visibility, visibility_path, image)
            if len(known) != len(entries):
                raise ValueError(
                    f"{visibility_path}: image {image}: {len(known)} objects, {TRUTH_FILE} has {len(entries)}"
                )
            visible[:] = [_visible_fraction(entry, visibility_path, image) for entry in known]
        truth.append(ImageTruth(np.array(kinds, int), np.array(poses).reshape(-1, 4, 4), visible))
    return tuple(truth)


def _entries(by_image: dict[int, Any], path: Path, image: int) -> list[Any]:
    """The objects of an image; none where the file does not list it: it has no labels."""
    entries = by_image.get(image, [])
    if not isinstance(entries, list):
        raise ValueError(f"{path}: image {image}: no list of objects")
    return entries


def _visible_fraction(entry: Any, path: Path, image: int) -> float:
    """Of one object, NaN where its entry has none."""
    if isinstance(entry, dict) and "visib_fract" not in entry:
        return float("nan")
    return float(_numbers(entry, "visib_fract", 1, path, image)[0])


def _numbers(entry: Any, key: str, count: int, path: Path, image: int) -> np.ndarray:
    """(count,) finite numbers under ``key``."""
    if not isinstance(entry, dict) or key not in entry:
        raise ValueError(f"{path}: image {image}: no key {key}")
    try:
        values = np.array(entry[key], float).ravel()
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: image {image}: {key} must be {count} numbers ({error})") from error
    if len(values) != count or not np.isfinite(values).all():
        raise ValueError(f"{path}: image {image}: {key} must be {count} finite numbers, got {entry[key]}")
    return values


def _read_pose(entry: Any, rotation: str, translation: str, path: Path, image: int) -> np.ndarray:
    """(4, 4) in metres; the rotation is made exactly orthonormal."""
    R = _numbers(entry, rotation, 9, path, image).reshape(3, 3)
    if np.abs(R @ R.T - np.eye(3)).max() > _ROTATION_TOLERANCE or np.linalg.det(R) < 0:
        raise ValueError(f"{path}: image {image}: {rotation} is not a rotation")
    metres = 1e-3 * _numbers(entry, translation, 3, path, image)
    return transform_from_quaternion(quaternion_from_transform(make_transform(R, metres)), metres)


def _read_camera_pose(entry: Any, path: Path, image: int, needed: bool) -> np.ndarray | None:
    """(4, 4) ``T_world_camera`` in metres; None where the entry has none and none is needed."""
    if not needed and isinstance(entry, dict) and not entry.keys() & {"cam_R_w2c", "cam_t_w2c"}:
        return None
    T_world_camera = invert(_read_pose(entry, "cam_R_w2c", "cam_t_w2c", path, image))
    if needed and not np.linalg.norm(T_world_camera[:3, 3]) > 1e-6:
        raise ValueError(f"{path}: image {image}: cam_t_w2c puts the camera at the world's origin")
    return T_world_camera


def _image_path(folder: Path, kind: str, image: int) -> Path:
    """Path of an image: published datasets name and store them in several ways; the first usual name if there is none.

    Grey cameras have a folder ``gray`` in place of ``rgb``.
    """
    folders = ("rgb", "gray") if kind == "rgb" else (kind,)
    candidates = [folder / each / f"{image:06d}.{ending}" for each in folders for ending in _ENDINGS]
    return next((path for path in candidates if path.is_file()), candidates[0])


def _size(path: Path) -> tuple[int, int]:
    """Width and height in pixels, from the file's header."""
    try:
        with Image.open(path) as picture:
            return picture.size
    except FileNotFoundError as error:
        raise ValueError(f"{path}: no such file, but {CAMERA_FILE} lists it") from error
    except (OSError, Image.DecompressionBombError) as error:
        raise ValueError(f"{path}: not an image ({error})") from error


def _require_size(pixels: np.ndarray, path: Path, camera: PinholeCamera) -> np.ndarray:
    """The same pixels, if they are of the camera's size."""
    if pixels.shape[:2] != (camera.height, camera.width):
        raise ValueError(f"{path}: is {pixels.shape[:2][::-1]} pixels, was {(camera.width, camera.height)}")
    return pixels
