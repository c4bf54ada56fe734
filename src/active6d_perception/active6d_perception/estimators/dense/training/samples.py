"""Training views at the network's resolution, and the files that hold them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from active6d_core.camera import PinholeCamera, View
from active6d_core.files import atomic_file
from active6d_perception.estimators.dense.network_input import OUTPUT_STRIDE, ReducedView, reduce_view

_DEPTH_UNIT = 1e-4  # metres; 16 bits reach 6.5 m


@dataclass(frozen=True, eq=False)
class Sample:
    """One view to learn from.

    Attributes:
        view: what the sensor saw, at the network's input resolution.
        surface_depth: (h, w) float32 true depth in metres at the network's output resolution, NaN where nothing is.
        instance: (h, w) int16 index of the pixel's object, -1 where there is none.
        T_camera_object: (n, 4, 4) true poses.
        visible_fraction: (n,) share of each silhouette in the picture that nothing covers.
    """

    view: ReducedView
    surface_depth: np.ndarray
    instance: np.ndarray
    T_camera_object: np.ndarray
    visible_fraction: np.ndarray


def make_sample(
    view: View,
    surface_depth: np.ndarray,
    instance: np.ndarray,
    T_camera_object: np.ndarray,
    visible_fraction: np.ndarray,
) -> Sample:
    """Reduce a view and check that the truth, which comes at the network's output resolution, fits to it.

    Raises:
        ValueError: the truth has another size.
    """
    reduced = reduce_view(view)
    expected = tuple(size // OUTPUT_STRIDE for size in reduced.depth.shape)
    if surface_depth.shape != expected or instance.shape != expected:
        raise ValueError(
            f"the truth of a training view must be {expected}, got {surface_depth.shape} and {instance.shape}"
        )
    return Sample(reduced, surface_depth, instance, T_camera_object, visible_fraction)


def write_shard(path: Path, samples: Sequence[Sample]) -> None:
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


def read_shard(path: Path) -> list[Sample]:
    """Read what :func:`write_shard` wrote.

    Raises:
        ValueError: the file is missing, damaged or something else; the message names it.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            data = {key: file[key] for key in file.files}
        ends = np.cumsum(data["object_counts"])
        height, width = data["depth"].shape[1:]
        return [
            Sample(
                ReducedView(
                    data["color"][i],
                    _unpack_depth(data["depth"][i]),
                    PinholeCamera(width, height, *data["intrinsics"][i].tolist()),
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
    """float metres to uint16 tenths of millimetres, 0 where invalid."""
    return np.clip(np.rint(np.nan_to_num(depth) / _DEPTH_UNIT), 0, np.iinfo(np.uint16).max).astype(np.uint16)


def _unpack_depth(packed: np.ndarray) -> np.ndarray:
    return np.where(packed > 0, packed * np.float32(_DEPTH_UNIT), np.float32(np.nan))
