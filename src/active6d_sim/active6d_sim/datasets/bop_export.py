"""Stored scenes as a BOP data set: images, poses, the model and its symmetries, all in the mesh file's frame."""

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from active6d_core.camera import DEFAULT_CAMERA, PinholeCamera
from active6d_core.files import make_folder, write_file
from active6d_core.object_model import ObjectModel
from active6d_core.view_sphere import ViewSphere
from active6d_sim.datasets.bop import CAMERA_FILE, write_bop_scene
from active6d_sim.rendering.random_sensor import sensor_of
from active6d_sim.rendering.simulator import Simulator
from active6d_sim.scenes.scene import Scene

_MILLIMETRES = 1e3


def export_scenes(
    folder: Path,
    model: ObjectModel,
    split: str,
    scenes: Iterable[Scene],
    views: list[int],
    sensor: str,
    *,
    camera: PinholeCamera = DEFAULT_CAMERA,
    seed: int = 0,
    object_id: int = 1,
    on_scene: Callable[[str], None] = lambda name: None,
) -> int:
    """Write scenes as ``folder/<split>/<number>`` and the model as ``folder/models``.

    Args:
        folder: of the data set, created if it does not exist.
        model: of all objects in the scenes.
        split: name of the folder of the scenes.
        scenes: in the order of their numbers.
        views: numbers of the views of the default grid, the images of each scene.
        sensor: name of the sensor model, or auto.
        camera: intrinsics of the images.
        seed: of the sensor's noise and of the appearance.
        object_id: BOP's number of the model, from 1.
        on_scene: called with the name of each scene that is written.

    Returns:
        number of scenes.

    Raises:
        ValueError: the folder has the scene already, or a view is not on the grid.
    """
    sphere = ViewSphere()
    if not views or not all(0 <= view < len(sphere) for view in views):
        raise ValueError(f"views must be numbers of the grid, 0 to {len(sphere) - 1}, got {views}")
    write_model(folder / "models", model, object_id)
    count = 0
    for count, scene in enumerate(scenes, start=1):
        target = folder / split / f"{count - 1:06d}"
        if (target / CAMERA_FILE).exists():
            raise ValueError(f"{target / CAMERA_FILE} exists already; choose another folder")
        simulator = Simulator(scene, camera, sensor_of(sensor, model, scene), seed)
        images = [simulator.capture(sphere.pose(sphere.positions[view]), view + 1) for view in views]
        write_bop_scene(
            target,
            images,
            model.T_camera_mesh(scene.T_world_object),
            object_id,
            visible_fraction=scene.visible_fraction[views],
        )
        on_scene(scene.name)
    return count


def write_model(folder: Path, model: ObjectModel, object_id: int = 1) -> None:
    """Write ``obj_NNNNNN.ply`` and ``models_info.json`` in millimetres, in the frame of the mesh file."""
    make_folder(folder)
    mesh = model.mesh.copy()
    mesh.apply_translation(model.origin)
    mesh.apply_scale(_MILLIMETRES)  # type: ignore[no-untyped-call]
    mesh.export(folder / f"obj_{object_id:06d}.ply")
    low, high = mesh.bounds
    info: dict[str, Any] = {"diameter": _MILLIMETRES * model.diameter}
    for axis, name in enumerate("xyz"):
        info |= {f"min_{name}": float(low[axis]), f"size_{name}": float(high[axis] - low[axis])}
    offset = _MILLIMETRES * model.origin
    if model.symmetry.axis is not None:
        info["symmetries_continuous"] = [{"axis": model.symmetry.axis.tolist(), "offset": offset.tolist()}]
    if len(model.symmetry.discrete) > 1:
        info["symmetries_discrete"] = [
            _about(rotation, offset).ravel().tolist() for rotation in model.symmetry.discrete[1:]
        ]
    path = folder / "models_info.json"
    known = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    write_file(path, json.dumps({**known, str(object_id): info}, indent=2) + "\n")


def _about(rotation: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """(4, 4) rotation (3, 3) about a centre (3,)."""
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = centre - rotation @ centre
    return T
