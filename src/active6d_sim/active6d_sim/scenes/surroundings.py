"""What surrounds the objects of a scene: other things in and around the pile, parts of a container, a room."""

from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pybullet_data
import trimesh

from active6d_core.object_model import load_object
from active6d_core.se3 import is_rigid

#: Prefixes of kinds that are meshes: an object of this project by name, and a file of ``pybullet_data`` by path.
OBJECT_KIND, FILE_KIND = "object:", "file:"


@dataclass(frozen=True, eq=False)
class Surroundings:
    """k things that are not the object, and the table that they stand on.

    A thing is a mesh whose bounding box, centred at its origin, is stretched to ``size``.

    Attributes:
        kind: (k,) ``box``, ``cylinder`` (along z), ``cone``, ``sphere``, ``object:NAME`` or ``file:PATH``.
        size: (k, 3) metres along the thing's own axes.
        T_world_thing: (k, 4, 4) poses, metres.
        color: (k, 3) linear RGB in [0, 1].
        table_size: sides of the table along world x and y, metres.
        tray: whether the scene's bin is there; else the objects lie on the table.

    Raises:
        ValueError: shapes disagree, a size is not positive, or a pose is not rigid.
    """

    kind: tuple[str, ...] = ()
    size: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    T_world_thing: np.ndarray = field(default_factory=lambda: np.zeros((0, 4, 4)))
    color: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    table_size: tuple[float, float] = (1.6, 1.0)
    tray: bool = True

    def __post_init__(self) -> None:
        count = len(self.kind)
        if self.size.shape != (count, 3) or self.color.shape != (count, 3) or not (self.size > 0).all():
            raise ValueError(f"surroundings: {count} things need positive (k, 3) sizes and (k, 3) colours")
        if self.T_world_thing.shape != (count, 4, 4) or not is_rigid(self.T_world_thing):
            raise ValueError("surroundings: poses must be rigid (k, 4, 4) transforms")
        if not min(self.table_size) > 0:
            raise ValueError(f"surroundings: the table's sides must be positive, got {self.table_size}")

    def __len__(self) -> int:
        return len(self.kind)

    def __add__(self, other: "Surroundings") -> "Surroundings":
        """Both lists of things, on the table of the first."""
        return Surroundings(
            self.kind + other.kind,
            np.concatenate([self.size, other.size]),
            np.concatenate([self.T_world_thing, other.T_world_thing]),
            np.concatenate([self.color, other.color]),
            self.table_size,
            self.tray,
        )

    def mesh(self, index: int) -> trimesh.Trimesh:
        """The mesh of thing ``index`` in its own frame, metres."""
        mesh = _unit_mesh(self.kind[index]).copy()
        mesh.apply_transform(np.diag([*self.size[index], 1.0]))
        return mesh

    def arrays(self) -> dict[str, Any]:
        """What :meth:`from_arrays` reads, for an ``.npz`` file."""
        return {
            "kind": np.array(self.kind, dtype=str),
            "size": self.size,
            "T_world_thing": self.T_world_thing,
            "color": self.color,
            "table_size": self.table_size,
            "tray": self.tray,
        }

    @classmethod
    def from_arrays(cls, data: dict[str, Any]) -> "Surroundings":
        """Surroundings from what :meth:`arrays` gave.

        Raises:
            ValueError: as the constructor.
        """
        table = data["table_size"]
        return cls(
            tuple(str(kind) for kind in data["kind"]),
            np.asarray(data["size"], float),
            np.asarray(data["T_world_thing"], float),
            np.asarray(data["color"], float),
            (float(table[0]), float(table[1])),
            bool(data["tray"]),
        )


def extents_of(kind: str) -> np.ndarray:
    """(3,) original sides of the bounding box of a kind that is a mesh, in its own units; flat ones are thickened."""
    extents = np.asarray(_source_mesh(kind).extents, float)
    return np.maximum(extents, 0.01 * extents.max())


@lru_cache(maxsize=256)
def _unit_mesh(kind: str) -> trimesh.Trimesh:
    """The mesh of a kind with its bounding box stretched to a unit cube about the origin.

    Raises:
        ValueError: no such kind.
    """
    mesh = _source_mesh(kind).copy()
    mesh.apply_translation(-mesh.bounds.mean(axis=0))
    mesh.apply_transform(np.diag([*(1 / np.maximum(mesh.extents, 1e-9)), 1.0]))
    return mesh


@lru_cache(maxsize=256)
def _source_mesh(kind: str) -> trimesh.Trimesh:
    if kind == "box":
        return trimesh.creation.box()
    if kind == "cylinder":
        return trimesh.creation.cylinder(0.5, 1.0, sections=24)
    if kind == "cone":
        return trimesh.creation.cone(0.5, 1.0, sections=24)
    if kind == "sphere":
        return trimesh.creation.icosphere(subdivisions=2, radius=0.5)
    if kind.startswith(OBJECT_KIND):
        return load_object(kind.removeprefix(OBJECT_KIND)).mesh
    path = Path(pybullet_data.getDataPath()) / kind.removeprefix(FILE_KIND)
    if not kind.startswith(FILE_KIND) or ".." in path.parts or not path.is_file():
        raise ValueError(f"unknown kind of thing '{kind}'")
    return trimesh.load_mesh(path, process=False)
