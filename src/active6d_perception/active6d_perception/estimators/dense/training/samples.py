"""Files of training views at the network's resolution."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from active6d_core.camera import PinholeCamera, View
from active6d_core.files import atomic_file
from active6d_core.training_view import TrainingView
from active6d_perception.estimators.dense.network_input import OUTPUT_STRIDE, reduce_view

_DEPTH_UNIT = 1e-4  # metres; 16 bits reach 6.5 m


def make_sample(item: TrainingView) -> TrainingView:
    """Reduce a training view to the network's input resolution; its truth must have the output resolution already.

    Raises:
        ValueError: the truth has another size.
    """
    reduced = reduce_view(item.view)
    expected = tuple(size // OUTPUT_STRIDE for size in reduced.depth.shape)
    if item.surface_depth.shape != expected or item.instance.shape != expected:
        raise ValueError(
            f"the truth of a training view must be {expected}, got {item.surface_depth.shape} and {item.instance.shape}"
        )
    return replace(item, view=reduced)


def write_shard(path: Path, samples: Sequence[TrainingView]) -> None:
    """Write samples of one size as a compressed ``.npz``; a half-written file never has the final name."""
    counts = [len(sample.T_camera_object) for sample in samples]
    cameras = [sample.view.camera for sample in samples]
    with atomic_file(path) as unfinished:
        np.savez_compressed(
            unfinished,
            color=np.stack([sample.view.color for sample in samples]),
            depth=np.stack([_pack_depth(sample.view.depth) for sample in samples]),
            intrinsics=np.array([[camera.fx, camera.fy, camera.cx, camera.cy] for camera in cameras]),
            surface_depth=np.stack([_pack_depth(sample.surface_depth) for sample in samples]),
            instance=np.stack([sample.instance for sample in samples]).astype(np.int16),
            object_counts=counts,
            T_camera_object=np.concatenate([sample.T_camera_object for sample in samples]),
            visible_fraction=np.concatenate([sample.visible_fraction for sample in samples]).astype(np.float32),
        )


def read_shard(path: Path) -> list[TrainingView]:
    """Read what :func:`write_shard` wrote. Files hold no camera pose, so the camera's frame is the world.

    Raises:
        ValueError: the file is missing, damaged or something else; the message names it.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            data = {key: file[key] for key in file.files}
        ends = np.cumsum(data["object_counts"])
        height, width = data["depth"].shape[1:]
        return [
            TrainingView(
                View(
                    0,
                    data["color"][i],
                    _unpack_depth(data["depth"][i]),
                    PinholeCamera(width, height, *data["intrinsics"][i].tolist()),
                    np.eye(4),
                ),
                _unpack_depth(data["surface_depth"][i]),
                data["instance"][i],
                data["T_camera_object"][end - count : end],
                data["visible_fraction"][end - count : end],
            )
            for i, (count, end) in enumerate(zip(data["object_counts"], ends, strict=True))
        ]
    except Exception as error:  # numpy and zipfile raise many kinds on damaged archives
        raise ValueError(f"{path}: not a file of training views ({error}); delete it and render it again") from error


def _pack_depth(depth: np.ndarray) -> np.ndarray:
    """float metres to uint16 tenths of millimetres, 0 where invalid or farther than these reach."""
    steps = np.rint(np.nan_to_num(depth) / _DEPTH_UNIT)
    return np.where(steps <= np.iinfo(np.uint16).max, np.maximum(steps, 0), 0).astype(np.uint16)


def _unpack_depth(packed: np.ndarray) -> np.ndarray:
    return np.where(packed > 0, packed * np.float32(_DEPTH_UNIT), np.float32(np.nan))
