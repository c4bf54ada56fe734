"""A scene: objects at rest in a bin. The world's origin is the centre of the bin's floor, z up, metres."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from active6d_core.array_archive import read_archive
from active6d_core.bounds import FARTHEST
from active6d_core.object_model import ObjectModel
from active6d_core.se3 import is_rigid
from active6d_sim.scenes.surroundings import Surroundings

_MOST_OBJECTS, _MOST_BYTES = 1000, 2**24


@dataclass(frozen=True)
class Bin:
    """An open bin. Its floor is at z = 0, and the table is one wall thickness below.

    Attributes:
        inner_width: along world x, metres.
        inner_depth: along world y, metres.
        wall_height: height of the inner walls above the floor, metres; 0 for a plate without walls.
        wall_thickness: of walls and floor, metres.

    Raises:
        ValueError: a size is not positive or too large.
    """

    inner_width: float
    inner_depth: float
    wall_height: float
    wall_thickness: float = 0.008

    def __post_init__(self) -> None:
        sizes = (self.inner_width, self.inner_depth, self.wall_thickness)
        if not (np.isfinite(sizes).all() and min(sizes) > 0 and 0 <= self.wall_height <= FARTHEST >= max(sizes)):
            raise ValueError(f"bin sizes must be positive and at most {FARTHEST:g} m, got {self}")

    @classmethod
    def for_model(cls, model: ObjectModel) -> "Bin":
        """The square bin for the model's usual number of instances, see ``ObjectModel.bin_width``."""
        return cls(model.bin_width, model.bin_width, model.wall_height)


@dataclass(frozen=True, eq=False)
class Scene:
    """Identical objects at rest in a bin.

    Attributes:
        object_name: name of the object.
        name: ``mug/test/3`` for a stored scene, ``mug/seed/7`` for one that was simulated on demand.
        seed: seed of the simulation.
        T_world_object: (n, 4, 4) true poses of the objects, metres.
        bin: the bin that they lie in.
        visible_fraction: (M, n) share of each object's silhouette seen from each view of the default grid, in [0, 1].
        T_world_hidden: (h, 4, 4) poses of objects that are simulated and rendered, but do not belong to the ground
            truth because no view of the grid shows enough of them.
        surroundings: other things; None for a bin on an empty table.

    Raises:
        ValueError: shapes disagree or a pose is not rigid.
    """

    object_name: str
    name: str
    seed: int
    T_world_object: np.ndarray
    bin: Bin
    visible_fraction: np.ndarray
    T_world_hidden: np.ndarray = field(default_factory=lambda: np.zeros((0, 4, 4)))
    surroundings: Surroundings | None = None

    def __post_init__(self) -> None:
        for poses in (self.T_world_object, self.T_world_hidden):
            if poses.ndim != 3 or not is_rigid(poses):
                raise ValueError(f"scene {self.name}: poses must be rigid (n, 4, 4) transforms")
            if len(poses) > _MOST_OBJECTS or np.abs(poses[:, :3, 3]).max(initial=0.0) > FARTHEST:
                raise ValueError(f"scene {self.name}: more than {_MOST_OBJECTS} objects, or one {FARTHEST:g} m away")
        if self.visible_fraction.ndim != 2 or self.visible_fraction.shape[1] != len(self):
            shape = self.visible_fraction.shape
            raise ValueError(f"scene {self.name}: visible_fraction has shape {shape}, expected (M, {len(self)})")

    def __len__(self) -> int:
        return len(self.T_world_object)

    @property
    def T_world_all(self) -> np.ndarray:
        """(n + h, 4, 4) poses of all objects in the bin, those of the ground truth first."""
        return np.concatenate([self.T_world_object, self.T_world_hidden])

    def save(self, path: Path) -> None:
        """Write the scene as one compressed ``.npz`` without pickled data."""
        around = {} if self.surroundings is None else self.surroundings.arrays()
        np.savez_compressed(
            path,
            object_name=self.object_name,
            name=self.name,
            seed=self.seed,
            T_world_object=self.T_world_object,
            T_world_hidden=self.T_world_hidden,
            bin=[self.bin.inner_width, self.bin.inner_depth, self.bin.wall_height, self.bin.wall_thickness],
            visible_fraction=self.visible_fraction.astype(np.float32),
            **{f"surroundings_{name}": value for name, value in around.items()},
        )

    @classmethod
    def load(cls, path: Path) -> "Scene":
        """Read a file that :meth:`save` wrote.

        Raises:
            ValueError: the file is missing, damaged or not a scene; the message names it.
        """
        try:
            data = read_archive(path, _MOST_BYTES)
            around = {name.removeprefix("surroundings_"): data[name] for name in data if name.startswith("surr")}
            return cls(
                str(data["object_name"]),
                str(data["name"]),
                int(data["seed"]),
                data["T_world_object"],
                Bin(*data["bin"].reshape(4).tolist()),
                data["visible_fraction"],
                data["T_world_hidden"],
                Surroundings.from_arrays(around) if around else None,
            )
        except Exception as error:  # a wrong value fails in whichever library meets it first
            raise ValueError(f"{path}: not a stored scene ({error})") from error
