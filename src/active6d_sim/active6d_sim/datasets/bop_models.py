"""What a BOP data set says of its models: their symmetries, as those of an object's description."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from active6d_core.mesh_file import load_mesh
from active6d_core.mesh_limits import SUFFIXES
from active6d_core.object_model import ObjectModel
from active6d_core.structured_text import read_json

INFO_FILE = "models_info.json"
_MODEL_FOLDERS = ("models", "models_eval")
#: Share of the diameter by which bounding boxes of the same model may differ.
_SAME_BOUNDS = 0.03
#: Coordinates of a rotation that counts as one.
_ROTATION_TOLERANCE = 1e-3


@dataclass(frozen=True, eq=False)
class ModelSymmetry:
    """Symmetries of one model.

    Attributes:
        description: of the keys ``axis`` and ``discrete_rotvec_degrees``, as in an object's description.
        moves: (k, 4, 4) symmetry transforms in the file's frame and unit, those of an axis by half a turn.
        axes: number of continuous axes; a description has one.
    """

    description: dict[str, Any]
    moves: np.ndarray
    axes: int

    def shift(self, centre: np.ndarray) -> float:
        """How far the symmetries move (3,) a point of the file's frame, in the file's unit."""
        if not len(self.moves):
            return 0.0
        moved = self.moves[:, :3, :3] @ centre + self.moves[:, :3, 3]
        return float(np.linalg.norm(moved - centre, axis=1).max())


def symmetry_beside(mesh: Path) -> ModelSymmetry | None:
    """Symmetries from ``models_info.json`` beside a model file ``obj_NNNNNN.ply``, None where it names none.

    Raises:
        ValueError: the entry is damaged; the message names the file and the model.
    """
    number, path = re.fullmatch(r"obj_(\d+)", mesh.stem), mesh.parent / INFO_FILE
    if number is None or not path.is_file():
        return None
    key = str(int(number[1]))
    try:
        entry = read_json(path)[key]
        continuous, discrete = entry.get("symmetries_continuous", []), entry.get("symmetries_discrete", [])
        if not continuous and not discrete:
            return None
        moves = [np.array(each, float).reshape(4, 4) for each in discrete]
        turns = [move[:3, :3] for move in moves]
        if any(np.abs(R @ R.T - np.eye(3)).max() > _ROTATION_TOLERANCE or np.linalg.det(R) < 0 for R in turns):
            raise ValueError("a discrete symmetry is not a rotation")
        description: dict[str, Any] = {}
        for each in continuous:
            axis, offset = (np.array(each.get(name, [0, 0, 0]), float) for name in ("axis", "offset"))
            if not np.linalg.norm(axis) > 0:
                raise ValueError("the axis of a continuous symmetry is zero")
            axis = axis / np.linalg.norm(axis)
            description.setdefault("axis", axis.tolist())
            half_turn, move = Rotation.from_rotvec(np.pi * axis).as_matrix(), np.eye(4)
            move[:3, :3], move[:3, 3] = half_turn, offset - half_turn @ offset
            moves.append(move)
        if turns:
            degrees = np.degrees(Rotation.from_matrix(np.array(turns)).as_rotvec())
            description["discrete_rotvec_degrees"] = degrees.round(4).tolist()
        if not np.isfinite(moves).all():
            raise ValueError("a symmetry is not finite")
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: model {key}: {error or type(error).__name__}") from error
    return ModelSymmetry(description, np.array(moves), len(continuous))


def differs_from_data_set(scene: Path, object_id: int, model: ObjectModel) -> str:
    """What is wrong where a scene's data set has another mesh, or another frame, than an object; empty if nothing is.

    Args:
        scene: folder of the scene, within ``DATA_SET/SPLIT``.
        object_id: BOP's number of the model.
        model: the object whose poses are compared with the data set's.
    """
    folders = [parent / name for parent in list(scene.resolve().parents)[:3] for name in _MODEL_FOLDERS]
    # Textures and materials have the same name.
    names = [f"obj_{object_id:06d}{suffix}" for suffix in (".ply", *SUFFIXES)]
    meshes = [folder / name for folder in folders for name in names if (folder / name).is_file()]
    info = next((folder / INFO_FILE for folder in folders if (folder / INFO_FILE).is_file()), None)
    try:
        if info is not None:
            entry = read_json(info)[str(object_id)]
            low = np.array([entry[f"min_{axis}"] for axis in "xyz"], float)
            bounds = np.array([low, low + [entry[f"size_{axis}"] for axis in "xyz"]])
        else:
            bounds = np.asarray(load_mesh(meshes[0]).bounds)
    except (IndexError, KeyError, TypeError, ValueError):  # the scene can be used without
        return ""
    apart = float(np.abs(bounds - 1e3 * (model.mesh.bounds + model.origin)).max())
    if apart <= _SAME_BOUNDS * 1e3 * model.diameter:
        return ""
    mesh = meshes[0] if meshes else "MESH"
    return (
        f"the mesh of {model.name} is not model {object_id} of this data set, or in another frame: their bounds differ "
        f"by {apart:.0f} mm, so poses differ too; use `active6d object add {mesh} --name NAME --scale 0.001`"
    )
