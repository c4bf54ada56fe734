"""Scene banks: results of the deployed estimator and verification in every view of every scene.

The agent trains and is evaluated on look-ups in a bank, which is thousands of times faster than rendering. A bank is
one compressed ``.npz`` per object and split, without pickled data. It holds:

- hypotheses as tables, in the camera's frame and in float32 as in the graph's messages;
- the true poses, and the ADD of every hypothesis against every object within 50 mm;
- each view's entropy;
- the surface that each view's depth image shows, one bit for each cell of a grid over the bin;
- what each view says of the candidates of the scene, for the fusion of all views (:mod:`.evidence_tables`).
"""

import hashlib
import json
import shutil
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import as_completed
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from active6d_core.array_archive import read_archive
from active6d_core.files import atomic_file, cache_folder, make_folder
from active6d_core.interrupts import worker_pool
from active6d_core.object_model import ObjectModel, load_object
from active6d_core.se3 import transform_from_quaternion
from active6d_core.structured_text import parse_json
from active6d_core.view_sphere import ViewSphere
from active6d_perception.scene.evidence_tables import EvidenceTables
from active6d_perception.scene.observed_surface import WorkspaceGrid

FORMAT = 3
#: Banks of this format have no evidence; their look-up fuses by the best view.
_WITHOUT_EVIDENCE = 2
SHIPPED_BANKS = Path(__file__).parent / "shipped"
_MOST_PAIRS = 50_000_000
_VIEWS_SUFFIX = ".views"
_HYPOTHESIS_COLUMNS = ("x", "y", "z", "qx", "qy", "qz", "qw", "verification", "score", "x0", "y0", "x1", "y1", "depth")


@dataclass(frozen=True, eq=False)
class BankScene:
    """One scene: H hypotheses over the M views of the grid, and the truth.

    Attributes:
        name: of the scene, such as ``mug/test/3``.
        T_world_object: (n, 4, 4) true poses.
        view: (H,) int, the view that each hypothesis is from, not falling.
        table: (H, 14) float32: position (3) and quaternion (4) in the optical frame, verification score, the
            estimator's score, box (4), depth.
        errors: (H, n) float32 ADD in metres, ``inf`` from 50 mm on.
        entropy: (M,) entropy of each view's masks, nats.
        surface: (M, ceil(cells / 8)) uint8, packed bits: the cells of the bank's grid that each view shows surface in.
        evidence: of all views on the scene's candidates; None if only the best view of each object is to be fused.

    Raises:
        ValueError: shapes disagree, or a number is not finite.
    """

    name: str
    T_world_object: np.ndarray
    view: np.ndarray
    table: np.ndarray
    errors: np.ndarray
    entropy: np.ndarray
    surface: np.ndarray
    evidence: EvidenceTables | None = None

    def __post_init__(self) -> None:
        H, n = len(self.view), len(self.T_world_object)
        shapes = {"T_world_object": (n, 4, 4), "table": (H, len(_HYPOTHESIS_COLUMNS)), "errors": (H, n)}
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"{self.name}: {name} has shape {getattr(self, name).shape}, expected {shape}")
        if np.any(np.diff(self.view) < 0) or np.any(self.view < 0) or np.any(self.view >= len(self.entropy)):
            raise ValueError(f"{self.name}: views of hypotheses must be in order and below {len(self.entropy)}")
        if not all(np.isfinite(values).all() for values in (self.T_world_object, self.table, self.entropy)):
            raise ValueError(f"{self.name}: a number is not finite")
        if np.isnan(self.errors).any() or n == 0:
            raise ValueError(f"{self.name}: errors must not be NaN, and there must be an object")
        if self.evidence is not None and len(self.evidence.body) != len(self.entropy):
            raise ValueError(f"{self.name}: evidence is of {len(self.evidence.body)} views, not {len(self.entropy)}")


def build_bank(
    path: Path,
    object_name: str,
    scenes: Sequence[str],
    observe: Callable[[str, Path], BankScene],
    *,
    workers: int = 1,
    provenance: dict[str, Any] | None = None,
    sphere: ViewSphere | None = None,
    grid: WorkspaceGrid | None = None,
    on_drop: Callable[[list[str]], None] = lambda names: None,
) -> Iterator[str]:
    """Observe all scenes and write the bank; yields each scene's name as it is done.

    Finished scenes, and the views of unfinished ones, are kept beside ``path`` until the bank is complete, so an
    interrupted run continues where it stopped. An existing bank is extended: its other scenes stay, after the given
    ones. Scenes of another ``provenance`` cannot stay; the given ones are made again, the others dropped.

    Args:
        path: of the ``.npz`` to write.
        object_name: of the object.
        scenes: their names, in the bank's order.
        observe: name of a scene, and a folder for what is kept of its views until it is done, to what was seen. It
            must be picklable (a module's function, or a ``functools.partial`` of one).
        workers: processes.
        provenance: what the bank depends on and remembers: estimator, its parameters, noise, versions; JSON values.
        sphere: grid of the views, the default one when None.
        grid: of the surface, the object's usual one when None.
        on_drop: called before the work with the names of scenes that the existing bank has and the new one will not.
    """
    grid = grid or WorkspaceGrid.for_model(load_object(object_name))
    empty = SceneBank(object_name, sphere or ViewSphere(), grid, [], provenance or {})
    stored = _stored_bank(path)
    known = _scenes_made_as(stored, empty)
    dropped = [scene.name for scene in stored.scenes if scene.name not in {*known, *scenes}] if stored else []
    if dropped:
        on_drop(dropped)
    parts = path.with_suffix(".parts")
    make_folder(parts)
    files = {name: parts / (name.replace("/", "-") + ".npz") for name in scenes if name not in known}
    missing = [name for name, file in files.items() if not _scenes_made_as(_stored_bank(file), empty)]
    yield from (name for name in scenes if name not in missing)
    with worker_pool(max(1, min(workers, len(missing)))) as pool:
        running = {pool.submit(_observe_to_file, observe, name, files[name], empty): name for name in missing}
        for done in as_completed(running):
            done.result()
            yield running[done]
    made = known | {name: load_bank(file).scenes[0] for name, file in files.items()}
    others = [name for name in known if name not in scenes]
    replace(empty, scenes=[made[name] for name in (*scenes, *others)]).save(path)
    for file in files.values():
        file.unlink()
    for folder in parts.glob(f"*{_VIEWS_SUFFIX}"):  # of another provenance
        shutil.rmtree(folder)
    if not any(parts.iterdir()):
        parts.rmdir()


def _stored_bank(path: Path) -> "SceneBank | None":
    """The bank in a file; None if there is none, or none that can be read."""
    try:
        return load_bank(path)
    except ValueError:
        return None


def _scenes_made_as(bank: "SceneBank | None", like: "SceneBank") -> dict[str, BankScene]:
    """The scenes of a bank that was made the same way as ``like``, by name; none otherwise."""
    if bank is None:
        return {}
    made = bank.provenance, bank.sphere, bank.grid
    same = made == (json.loads(json.dumps(like.provenance)), like.sphere, like.grid)
    return {scene.name: scene for scene in bank.scenes} if same else {}


def _observe_to_file(observe: Callable[[str, Path], BankScene], name: str, path: Path, bank: "SceneBank") -> None:
    digest = hashlib.sha256(json.dumps(bank.header()).encode()).hexdigest()[:16]
    views = path.with_suffix(f".{digest}{_VIEWS_SUFFIX}")
    replace(bank, scenes=[observe(name, views)]).save(path)
    shutil.rmtree(views, ignore_errors=True)


@dataclass(frozen=True, eq=False)
class SceneBank:
    """All scenes of one object and split.

    Attributes:
        object_name: of the object.
        sphere: grid of the views.
        grid: of the surface.
        scenes: in order.
        provenance: how the bank was made.

    Raises:
        ValueError: a scene's surface is not of this grid and these views.
    """

    object_name: str
    sphere: ViewSphere
    grid: WorkspaceGrid
    scenes: Sequence[BankScene]
    provenance: dict[str, Any]

    def __post_init__(self) -> None:
        expected = len(self.sphere), -(-len(self.grid) // 8)
        for scene in self.scenes:
            if scene.surface.shape != expected or scene.surface.dtype != np.uint8:
                raise ValueError(f"{scene.name}: surface has shape {scene.surface.shape}, expected {expected} bytes")

    @cached_property
    def model(self) -> ObjectModel:
        """The object."""
        return load_object(self.object_name)

    def header(self) -> dict[str, Any]:
        """What the bank is of and how it was made, as JSON values."""
        return {
            "format": FORMAT,
            "object": self.object_name,
            "scenes": [scene.name for scene in self.scenes],
            "radius": self.sphere.radius,
            "elevations_degrees": list(self.sphere.elevations_degrees),
            "azimuths": self.sphere.azimuths,
            "surface": asdict(self.grid),
            "provenance": self.provenance,
        }

    def save(self, path: Path) -> None:
        """Write one compressed ``.npz``; it appears under its name only when it is complete."""
        pairs = [np.nonzero(np.isfinite(scene.errors)) for scene in self.scenes]
        evidence = [scene.evidence for scene in self.scenes if scene.evidence is not None]
        tables: dict[str, Any] = _evidence_arrays(evidence) if len(evidence) == len(self.scenes) > 0 else {}
        with atomic_file(path) as unfinished:
            np.savez_compressed(
                unfinished,
                header=json.dumps(self.header()),
                object_count=[len(scene.T_world_object) for scene in self.scenes],
                T_world_object=np.concatenate([scene.T_world_object for scene in self.scenes]),
                hypothesis_count=[np.bincount(s.view, minlength=len(self.sphere)) for s in self.scenes],
                table=np.concatenate([scene.table for scene in self.scenes]),
                pair_count=[len(rows) for rows, _ in pairs],
                pair_hypothesis=np.concatenate([rows for rows, _ in pairs]).astype(np.int32),
                pair_object=np.concatenate([columns for _, columns in pairs]).astype(np.int16),
                pair_error=np.concatenate([s.errors[pair] for s, pair in zip(self.scenes, pairs, strict=True)]),
                entropy=[scene.entropy for scene in self.scenes],
                # View by view for each cell: a cell is mostly seen from many neighbouring views or from none, which
                # compresses to a fraction of what cell by cell for each view does.
                surface=[_transpose_bits(scene.surface, len(self.grid)) for scene in self.scenes],
                **tables,
            )


def cached_banks() -> Path:
    """Default folder of banks that are made here."""
    return cache_folder("banks")


def bank_path(folder: Path, object_name: str, split: str, seed: int = 0) -> Path:
    """Path of the bank of an object and split in a folder of banks; other seeds of the noise have their own files."""
    return folder / f"{object_name}_{split}{f'_seed{seed}' if seed else ''}.npz"


def find_bank(object_name: str, split: str, folder: Path | None = None, seed: int = 0) -> Path:
    """Path of an existing bank in ``folder``; when None, in the cache or else among the shipped ones.

    Raises:
        ValueError: there is none; the message has the command that makes it.
    """
    folders = (cached_banks(), SHIPPED_BANKS) if folder is None else (folder,)
    for path in (bank_path(each, object_name, split, seed) for each in folders):
        if path.is_file():
            return path
    options = (f" --seed {seed}" if seed else "") + ("" if folder is None else f" --banks {folder}")
    raise ValueError(
        f"there is no {split} bank of '{object_name}'{f' with seed {seed}' if seed else ''} in {folders[0]}; "
        f"make it with: active6d bank --object {object_name} --split {split}{options}"
    )


def load_bank(path: Path) -> SceneBank:
    """Read a file that :meth:`SceneBank.save` wrote.

    Raises:
        ValueError: the file is missing, damaged, of another format or not a bank; the message names it.
    """
    try:
        data = read_archive(path)
        header = parse_json(str(data["header"]))
        if header["format"] not in (FORMAT, _WITHOUT_EVIDENCE):
            raise ValueError(f"format {header['format']}, this version reads {FORMAT}")
        sphere = ViewSphere(header["radius"], tuple(header["elevations_degrees"]), header["azimuths"])
        surface = header["surface"]
        grid = WorkspaceGrid(**{**surface, "width": tuple(surface["width"])})
        _check_counts(data, len(header["scenes"]), len(sphere))
        scenes = [_read_scene(data, index, name) for index, name in enumerate(header["scenes"])]
        return SceneBank(header["object"], sphere, grid, scenes, header["provenance"])
    except Exception as error:  # a wrong value fails in whichever library meets it first
        raise ValueError(f"{path}: not a scene bank ({error}); make it again with 'active6d bank'") from error


def _check_counts(data: dict[str, np.ndarray], scenes: int, views: int) -> None:
    """Check the numbers of rows of each scene against the tables, before tables of that size are made.

    Raises:
        ValueError: they do not add up, or a scene is too large.
    """
    rows = {"object_count": "T_world_object", "hypothesis_count": "table", "pair_count": "pair_error"}
    for count, table in rows.items():
        shape = (scenes, views) if count == "hypothesis_count" else (scenes,)
        if data[count].shape != shape or data[count].dtype.kind != "i" or (data[count] < 0).any():
            raise ValueError(f"{count} must be {shape} numbers from 0")
        # As Python's integers, which do not overflow.
        if sum(data[count].ravel().tolist()) != len(data[table]):
            raise ValueError(f"{count} does not add up to the {len(data[table])} rows of {table}")
    if "candidate_count" in data:
        found = data["candidate_count"]
        if found.shape != (scenes,) or found.dtype.kind != "i" or (found < 0).any():
            raise ValueError(f"candidate_count must be {(scenes,)} numbers from 0")
        if any(
            sum(found.tolist()) != len(data[name])
            for name in data
            if name.startswith("candidate_") and name != "candidate_count"
        ):
            raise ValueError("candidate_count does not add up to the rows of the tables")
    largest = (data["object_count"] * data["hypothesis_count"].sum(axis=1)).max(initial=0)
    if largest > _MOST_PAIRS:
        raise ValueError(f"a scene has {largest} pairs of hypotheses and objects, at most {_MOST_PAIRS} are read")


def _read_scene(data: dict[str, np.ndarray], index: int, name: str) -> BankScene:
    """Cut one scene out of the concatenated tables."""

    def part(counts: np.ndarray) -> slice:
        end = int(counts[: index + 1].sum())
        return slice(end - int(counts[index]), end)

    per_view = data["hypothesis_count"]
    rows, objects = part(per_view.sum(axis=1)), part(data["object_count"])
    pairs = part(data["pair_count"])
    errors = np.full((rows.stop - rows.start, objects.stop - objects.start), np.inf, np.float32)
    errors[data["pair_hypothesis"][pairs], data["pair_object"][pairs]] = data["pair_error"][pairs]
    view = np.repeat(np.arange(per_view.shape[1]), per_view[index])
    return BankScene(
        name,
        data["T_world_object"][objects],
        view,
        data["table"][rows],
        errors,
        data["entropy"][index],
        _transpose_bits(data["surface"][index], per_view.shape[1]),
        _read_evidence(data, part(data["candidate_count"])) if "candidate_count" in data else None,
    )


def _evidence_arrays(evidence: Sequence[EvidenceTables]) -> dict[str, np.ndarray]:
    """The tables of all scenes, candidates one after the other; poses without their last row."""
    arrays: dict[str, Any] = {"candidate_count": [len(tables.place) for tables in evidence]}
    for name in ("T_world_body", "T_world_object"):
        rows = np.concatenate([getattr(tables, name) for tables in evidence])
        arrays[f"candidate_{name}"] = rows[..., :3, :].astype(np.float32)
    arrays["candidate_place"] = np.concatenate([tables.place for tables in evidence]).astype(np.int16)
    for name in ("body", "twin", "telling"):
        # Views last: neighbouring views say the same of a candidate, which compresses well.
        arrays[f"candidate_{name}"] = np.concatenate([np.moveaxis(getattr(t, name), 0, -1) for t in evidence])
    return arrays


def _read_evidence(data: dict[str, np.ndarray], part: slice) -> EvidenceTables:
    """The inverse of :func:`_evidence_arrays` for one scene."""
    poses = []
    for name in ("T_world_body", "T_world_object"):
        rows = data[f"candidate_{name}"][part].astype(float)
        last = np.broadcast_to([0.0, 0.0, 0.0, 1.0], (*rows.shape[:-2], 1, 4))
        poses.append(np.concatenate([rows, last], axis=-2))
    roots = (
        np.ascontiguousarray(np.moveaxis(data[f"candidate_{name}"][part], -1, 0))
        for name in ("body", "twin", "telling")
    )
    return EvidenceTables(poses[0], data["candidate_place"][part].astype(int), poses[1], *roots)


def _transpose_bits(packed: np.ndarray, count: int) -> np.ndarray:
    """(a, ceil(count / 8)) uint8, rows of packed bits, to (count, ceil(a / 8))."""
    return np.packbits(np.unpackbits(packed, axis=1, count=count).T, axis=1)


def world_poses(table: np.ndarray, view: np.ndarray, sphere: ViewSphere) -> np.ndarray:
    """(H, 4, 4) ``T_world_object`` of the hypotheses in a :class:`BankScene`'s table."""
    T_world_camera = np.stack([sphere.pose(position) for position in sphere.positions])
    rows = table.astype(float)
    return T_world_camera[view] @ transform_from_quaternion(rows[:, 3:7], rows[:, :3])
