"""Object models: mesh, number of instances, symmetries and named parts, from one YAML file per object.

Descriptions are found by name in the folders of ``ACTIVE6D_OBJECT_PATH`` (separated as in ``PATH``), then among those
shipped with this package, so adding an object is adding a file. ``objects/README.md`` explains every key.
"""

import os
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from active6d_core.mesh_file import check_diameter, close_mesh, load_mesh
from active6d_core.nearest_name import did_you_mean
from active6d_core.rotation_group import LARGEST_GROUP, rotation_group
from active6d_core.structured_text import read_yaml

SHIPPED_OBJECTS = Path(__file__).parent / "objects"
_REQUIRED = {"name", "instances", "color"}
_OPTIONAL = {"mesh", "profile", "scale", "symmetry", "features", "source"}
#: If set, a description may name a mesh outside of its own folder.
ALLOW_OUTSIDE_VARIABLE = "ACTIVE6D_ALLOW_OUTSIDE"
_MOST_INSTANCES, _MOST_PROFILE_ROWS, _MOST_FEATURES = 200, 1000, 100
# Cells along the longest side, for the search of the two vertices that are farthest apart.
_DIAMETER_CELLS = 16
# Least side of a bin, diameters of the object.
_LEAST_BIN = 1.2


@dataclass(frozen=True, eq=False)
class Symmetry:
    """Rotations about the object's origin that do not change its appearance.

    Attributes:
        axis: (3,) unit axis of a continuous symmetry, None without such an axis.
        discrete: (s, 3, 3) rotations of a finite symmetry group, including the identity.
    """

    axis: np.ndarray | None
    discrete: np.ndarray

    def rotations(self, step_degrees: float = 1.0) -> np.ndarray:
        """(s, 3, 3) rotations of the whole group; a continuous axis is sampled every ``step_degrees``, as in BOP."""
        if self.axis is None:
            return self.discrete
        angles = np.radians(np.arange(0.0, 360.0, step_degrees))
        about_axis = Rotation.from_rotvec(angles[:, None] * self.axis).as_matrix()
        return (about_axis[:, None] @ self.discrete[None]).reshape(-1, 3, 3)


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """A rigid object. The mesh's frame is the object's frame; its origin is the volume's centroid, units are metres.

    Attributes:
        name: of the description file, without ``.yaml``.
        mesh: triangle mesh in the object frame.
        diameter: largest distance between two vertices, metres.
        symmetry: of shape and colour together.
        instances: smallest and largest number of instances in a scene.
        color: (3,) RGB in [0, 1].
        features: named parts of the surface, such as the mug's ``handle``, whose visibility decides whether the pose is
            ambiguous: name to (2, 3) axis-aligned box (min, max) in the object frame, metres.
        origin: (3,) the object frame's origin in the frame of the mesh file, metres.
    """

    name: str
    mesh: trimesh.Trimesh
    diameter: float
    symmetry: Symmetry
    instances: tuple[int, int]
    color: np.ndarray
    features: dict[str, np.ndarray]
    origin: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def T_camera_mesh(self, T_camera_object: np.ndarray) -> np.ndarray:
        """(k, 4, 4) object poses as poses of the frame of the mesh file, scaled to metres.

        Other tools that load the same mesh, such as those of BOP, expect poses in that frame.
        """
        T_object_mesh = np.eye(4)
        T_object_mesh[:3, 3] = -self.origin
        return np.asarray(T_camera_object) @ T_object_mesh

    def T_camera_object(self, T_camera_mesh: np.ndarray) -> np.ndarray:
        """(k, 4, 4) poses of the frame of the mesh file, scaled to metres, as object poses.

        Data sets such as BOP's give poses in that frame.
        """
        T_mesh_object = np.eye(4)
        T_mesh_object[:3, 3] = self.origin
        return np.asarray(T_camera_mesh) @ T_mesh_object

    @cached_property
    def surface(self) -> tuple[np.ndarray, np.ndarray]:
        """(8192, 3) random surface points with a fixed seed, metres, and their (8192, 3) outward unit normals."""
        points, faces = trimesh.sample.sample_surface(self.mesh, 8192, seed=0)
        return np.asarray(points), np.asarray(self.mesh.face_normals[faces])

    @cached_property
    def error_points(self) -> np.ndarray:
        """(n, 3) points for pose errors, metres: the vertices, or 2000 surface points if there are fewer vertices."""
        vertices = np.asarray(self.mesh.vertices)
        return vertices if len(vertices) >= 2000 else self.surface[0][:2000]

    @property
    def bin_width(self) -> float:
        """Side of the square bin in which the usual number of instances lies one and a half to two layers deep, metres.

        It is 0.625 diameters times the root of that number. Then objects hide each other, but the heap is neither too
        high nor larger than the default camera's image (measured in ``docs/scenes.md``).
        """
        width = max(0.625 * float(np.sqrt(np.mean(self.instances))), _LEAST_BIN) * self.diameter
        return round(width, 2 if width >= 0.1 else 4)

    @property
    def wall_height(self) -> float:
        """Height of that bin's inner walls, metres."""
        return round(0.6 * self.diameter, 3)

    def feature_mask(self, feature: str, points: np.ndarray) -> np.ndarray:
        """(n,) bool, which of (n, 3) ``points`` in the object frame, metres, belong to the named part."""
        low, high = self.features[feature]
        return ((points >= low) & (points <= high)).all(axis=-1)


def list_objects() -> list[str]:
    """Names of all objects that :func:`load_object` finds."""
    return sorted({path.stem for folder in search_folders() for path in folder.glob("*.yaml") if path.is_file()})


@lru_cache(maxsize=16)
def load_object(name: str) -> ObjectModel:
    """Load an object by name.

    Raises:
        ValueError: no such object, or its description is wrong; the message names the file and the key.
    """
    for folder in search_folders():
        path = folder / f"{name}.yaml"
        # A name can come from a bag or a scene: it must not lead to another folder.
        if path.name == f"{name}.yaml" and path.is_file():
            return read_description(path)
    known, here = list_objects(), Path("objects").resolve()
    # Objects are added to this folder, which is searched only where the user says so.
    added = Path(name).name == name and (here / f"{name}.yaml").is_file()
    hint = f"to use {here}: export ACTIVE6D_OBJECT_PATH={here}" if added else "ACTIVE6D_OBJECT_PATH adds folders"
    raise ValueError(f"unknown object '{name}'{did_you_mean(name, known)}; known: {', '.join(known)} ({hint})")


@np.errstate(all="ignore")
def read_description(path: Path) -> ObjectModel:
    """Read one description file and the mesh that it names.

    Raises:
        ValueError: the description or the mesh is wrong; the message names the file and the key.
    """
    try:
        description = read_yaml(path)
        _check_keys(description, path)
        mesh, origin = _load_mesh(description, path)
        diameter = _diameter(mesh)
        check_diameter(diameter, float(description.get("scale", 1.0)))
        return ObjectModel(
            name=path.stem,
            mesh=mesh,
            diameter=diameter,
            symmetry=_read_symmetry(description.get("symmetry") or {}),
            instances=_read_instances(description["instances"]),
            color=_read_color(description["color"]),
            features=_read_features(description.get("features") or {}),
            origin=origin,
        )
    # A wrong value fails in whichever library meets it first.
    except Exception as error:
        raise ValueError(f"{path}: {error or type(error).__name__}") from error


def _check_keys(description: Any, path: Path) -> None:
    if not isinstance(description, dict):
        raise ValueError("not a mapping of keys")
    missing, unknown = _REQUIRED - description.keys(), {*map(str, description)} - _REQUIRED - _OPTIONAL
    if missing or unknown:
        hints = "".join(did_you_mean(key, _REQUIRED | _OPTIONAL) for key in sorted(unknown)[:1])
        raise ValueError(f"missing keys {sorted(missing)}, unknown keys {sorted(unknown)}{hints}")
    if description["name"] != path.stem:
        raise ValueError(f"name '{description['name']}' differs from the file's")


def _read_instances(value: Any) -> tuple[int, int]:
    low, high = (int(count) for count in value)
    if not 1 <= low <= high <= _MOST_INSTANCES:
        raise ValueError(f"instances needs [fewest, most] from 1 to {_MOST_INSTANCES}")
    return low, high


def _read_color(value: Any) -> np.ndarray:
    color = np.array(value, float)
    if color.shape != (3,) or not ((color >= 0) & (color <= 1)).all():
        raise ValueError("color needs [r, g, b] from 0 to 1")
    return color


def _read_features(value: Any) -> dict[str, np.ndarray]:
    boxes = {str(key): np.array(box, float).reshape(2, 3) for key, box in value.items()}
    if len(boxes) > _MOST_FEATURES or not all(np.isfinite(box).all() for box in boxes.values()):
        raise ValueError(f"features must be at most {_MOST_FEATURES} boxes of finite numbers")
    return boxes


def search_folders() -> list[Path]:
    """Folders with descriptions in the order of search: ``ACTIVE6D_OBJECT_PATH``, then the shipped ones."""
    extra = os.environ.get("ACTIVE6D_OBJECT_PATH", "")
    return [Path(folder) for folder in extra.split(os.pathsep) if folder] + [SHIPPED_OBJECTS]


def find_beside(file_name: str, shipped: Path) -> Path:
    """Path of a file of an object: beside the descriptions if it exists there, else in the folder ``shipped``."""
    beside = (folder / file_name for folder in search_folders())
    return next((path for path in beside if path.is_file()), shipped / file_name)


def _load_mesh(description: dict[str, Any], path: Path) -> tuple[trimesh.Trimesh, np.ndarray]:
    """The mesh of ``mesh`` (a file) or ``profile`` ((r, z) rows revolved about z), scaled, origin at its centroid.

    Also returns (3,) that centroid in the file's frame, metres.
    """
    if ("mesh" in description) == ("profile" in description):
        raise ValueError("needs either mesh (a file) or profile (rows of radius and height)")
    if "profile" in description:
        profile = np.array(description["profile"], float)
        if profile.ndim != 2 or profile.shape[1] != 2 or not 2 <= len(profile) <= _MOST_PROFILE_ROWS:
            raise ValueError(f"profile needs 2 to {_MOST_PROFILE_ROWS} rows of radius and height")
        if not np.isfinite(profile).all() or (profile[:, 0] < 0).any():
            raise ValueError("profile needs finite numbers and radii that are not negative")
        mesh = trimesh.creation.revolve(profile, sections=96)
    else:
        mesh = load_mesh(_mesh_path(description["mesh"], path))
    scale = float(description.get("scale", 1.0))
    if not 0 < scale < np.inf:
        raise ValueError(f"scale must be positive, got {scale}")
    mesh.apply_scale(scale)  # type: ignore[no-untyped-call]
    close_mesh(mesh)
    # With the origin at the centre of mass, physics needs no inertial offset, and ADD depends less on rotation errors.
    origin = np.array(mesh.center_mass)
    mesh.apply_translation(-origin)
    return mesh, origin


def _mesh_path(name: Any, path: Path) -> Path:
    """Path of the mesh that the description at ``path`` names."""
    mesh, folder = path.parent / str(name), path.parent.resolve()
    if not os.environ.get(ALLOW_OUTSIDE_VARIABLE) and not mesh.resolve().is_relative_to(folder):
        raise ValueError(
            f"mesh {name} is outside of the description's folder; move it there, or allow it with "
            f"'active6d --allow-outside COMMAND' or {ALLOW_OUTSIDE_VARIABLE}=1"
        )
    return mesh


def _diameter(mesh: trimesh.Trimesh) -> float:
    """Largest distance between two vertices, exactly, with memory that grows linearly.

    Vertices of the convex hull are grouped in cells. Pairs of cells are compared in the order of the largest distance
    that they allow, until no pair can hold a larger distance than the largest so far.
    """
    points = np.asarray(mesh.convex_hull.vertices)
    low = points.min(axis=0)
    edge = max(float(np.ptp(points, axis=0).max()), np.finfo(float).tiny) / _DIAMETER_CELLS
    x, y, z = ((points - low) / edge).astype(int).T
    number = (x * (_DIAMETER_CELLS + 1) + y) * (_DIAMETER_CELLS + 1) + z
    order = np.argsort(number, kind="stable")
    starts = np.unique(number[order], return_index=True)[1]
    cells = np.split(points[order], starts[1:])
    lows = np.minimum.reduceat(points[order], starts)
    highs = np.maximum.reduceat(points[order], starts)
    first, second = np.triu_indices(len(cells))
    farthest = np.linalg.norm(np.maximum(highs[first] - lows[second], highs[second] - lows[first]), axis=1)
    largest = 0.0
    for pair in np.argsort(-farthest):
        if farthest[pair] <= largest:
            break
        largest = max(largest, float(cdist(cells[first[pair]], cells[second[pair]]).max()))
    return largest


def _read_symmetry(description: dict[str, Any]) -> Symmetry:
    unknown = description.keys() - {"axis", "discrete_rotvec_degrees"}
    if unknown:
        raise ValueError(f"symmetry has unknown keys {sorted(unknown)}")
    axis = description.get("axis")
    if axis is not None:
        axis = np.array(axis, float)
        if axis.shape != (3,) or not 0 < np.linalg.norm(axis) < np.inf:
            raise ValueError("symmetry.axis needs three numbers, not all zero")
        axis = axis / np.linalg.norm(axis)
    rotation_vectors = np.array(description.get("discrete_rotvec_degrees") or np.zeros((0, 3)), float).reshape(-1, 3)
    if len(rotation_vectors) > LARGEST_GROUP or not np.isfinite(rotation_vectors).all():
        raise ValueError(f"symmetry.discrete_rotvec_degrees needs at most {LARGEST_GROUP} rows of finite numbers")
    try:
        group = rotation_group(Rotation.from_rotvec(np.radians(rotation_vectors)).as_matrix())
    except ValueError as error:
        raise ValueError(f"symmetry.discrete_rotvec_degrees: {error}; check the angles") from error
    return Symmetry(axis, group)
