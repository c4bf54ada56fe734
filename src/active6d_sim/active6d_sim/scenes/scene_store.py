"""Stored scenes: 40 heaps per object in fixed splits for training, validation and test, and 16 wild scenes.

The seed of a stored scene is ``SPLIT_SEEDS[split] + index``. The scenes are shipped as small ``.npz`` files, so that
evaluations use the same heaps with every version of the physics engine.
"""

import os
from collections.abc import Iterator
from concurrent.futures import as_completed
from dataclasses import replace
from pathlib import Path

import numpy as np

from active6d_core.files import atomic_file
from active6d_core.interrupts import worker_pool
from active6d_core.object_model import list_objects, load_object
from active6d_core.view_sphere import ViewSphere
from active6d_sim.physics.heap import collision_file, simulate_heap
from active6d_sim.scenes.scene import Scene
from active6d_sim.scenes.wild_scene import wild_scene

#: Scenes per split: 30 for training (6 of them for validation) and 10 for test, as in the paper; and wild scenes.
SPLITS = {"train": 24, "val": 6, "test": 10, "wild_val": 6, "wild_test": 10}
SPLIT_SEEDS = {"train": 100_000, "val": 200_000, "test": 300_000, "wild_val": 400_000, "wild_test": 500_000}
#: Heaps that are simulated on demand have smaller seeds than this, so that none of them is a stored one.
FIRST_STORED_SEED = min(SPLIT_SEEDS.values())

SHIPPED_SCENES = Path(__file__).parent / "stored"


def scene_path(object_name: str, split: str, index: int) -> Path:
    """Path of a stored scene: in a folder of ``ACTIVE6D_SCENE_PATH`` that has it, else among the shipped ones."""
    relative = Path(object_name) / f"{split}_{index:02d}.npz"
    extra = [Path(folder) for folder in os.environ.get("ACTIVE6D_SCENE_PATH", "").split(os.pathsep) if folder]
    return next((folder / relative for folder in extra if (folder / relative).is_file()), SHIPPED_SCENES / relative)


def stored_names(object_name: str, split: str, most: int | None = None) -> list[str]:
    """Names of the stored scenes of a split, such as ``mug/test/3``: all, or the first ``most``."""
    return [f"{object_name}/{split}/{index}" for index in range(min(most or SPLITS[split], SPLITS[split]))]


def load_scene(object_name: str, split: str, index: int) -> Scene:
    """Load a stored scene.

    Raises:
        ValueError: there is no such object or scene (the message lists the known ones), or the file is damaged.
    """
    if split not in SPLITS or not 0 <= index < SPLITS[split]:
        known = ", ".join(f"{name}/0..{count - 1}" for name, count in SPLITS.items())
        raise ValueError(f"no scene '{object_name}/{split}/{index}'; there are {object_name}/ {known}")
    if object_name not in list_objects():
        raise ValueError(f"unknown object '{object_name}'; known: {', '.join(list_objects())}")
    path = scene_path(object_name, split, index)
    if not path.is_file():
        raise ValueError(
            f"no stored scenes of '{object_name}'; make them with: active6d scenes generate --object {object_name}"
        )
    scene = Scene.load(path)
    if scene.object_name != object_name:
        raise ValueError(f"{path}: is a scene of '{scene.object_name}', not of '{object_name}'")
    return scene


def find_scene(object_name: str, name: str, seed: int) -> Scene:
    """Load the stored scene ``name`` (``mug/test/3`` or ``test/3``); without a name, simulate a heap from ``seed``.

    Raises:
        ValueError: the name has another form or another object, or the seed belongs to a stored scene.
    """
    if not name:
        if not 0 <= seed < FIRST_STORED_SEED:
            raise ValueError(f"seed must be within 0 and {FIRST_STORED_SEED - 1} (others are stored), got {seed}")
        return simulate_heap(load_object(object_name), seed)
    parts = name.removeprefix(f"{object_name}/").split("/")
    if len(parts) != 2 or not parts[1].isdecimal():
        raise ValueError(f"scene '{name}' is not of the form {object_name}/test/3")
    return load_scene(object_name, parts[0], int(parts[1]))


def generate(
    object_name: str, folder: Path, *, splits: tuple[str, ...] = tuple(SPLITS), workers: int | None = None
) -> Iterator[Path]:
    """Simulate and store the missing scenes of an object on several cores; yields each file when it is finished.

    Args:
        object_name: name of the object.
        folder: folder to write to, with a folder per object.
        splits: names of the splits.
        workers: number of processes, one per core when None.

    Raises:
        ValueError: an unknown object or split.
    """
    load_object(object_name)
    missing = []
    for split in splits:
        if split not in SPLITS:
            raise ValueError(f"unknown split '{split}'; there are {', '.join(SPLITS)}")
        for index in range(SPLITS[split]):
            path = folder / object_name / f"{split}_{index:02d}.npz"
            if not path.is_file():
                missing.append((object_name, split, index, path))
    if not missing:
        return
    collision_file(load_object(object_name))  # once, so that not every process computes it
    with worker_pool(workers or os.cpu_count() or 1) as pool:
        for done in as_completed([pool.submit(_store_scene, *job) for job in missing]):
            yield done.result()


def _store_scene(object_name: str, split: str, index: int, path: Path) -> Path:
    simulate = wild_scene if split.startswith("wild") else simulate_heap
    scene = simulate(load_object(object_name), SPLIT_SEEDS[split] + index, name=f"{object_name}/{split}/{index}")
    with atomic_file(path) as unfinished:
        replace(scene, visible_fraction=np.round(scene.visible_fraction, 3)).save(unfinished)
    return path


def density_report(
    scenes: list[Scene], rng: np.random.Generator, *, moves: int = 5, starts: int = 20
) -> dict[str, float]:
    """Measure how much the choice of views matters, by the share of objects that some view shows at least half of.

    Args:
        scenes: stored scenes of one object.
        rng: random generator of views and starting azimuths.
        moves: number of moves T; T + 1 views are taken.
        starts: number of random starts per scene.

    Returns:
        Means over objects, starts and scenes: ``one_view``, ``random`` (T + 1 random views), ``revolution`` (evenly
        spaced at 45 degrees), ``oracle`` (greedy, with knowledge of what each view shows) and ``all_views``.
    """
    sphere = ViewSphere()
    shares: dict[str, list[float]] = {name: [] for name in ("one_view", "random", "revolution", "oracle", "all_views")}
    ring = np.flatnonzero(np.isclose(np.degrees(sphere.angles(sphere.positions)[:, 1]), 45.0))
    spaced = np.round(np.arange(moves + 1) * len(ring) / (moves + 1)).astype(int)
    for scene in scenes:
        seen = scene.visible_fraction >= 0.5
        for _ in range(starts):
            views = rng.choice(len(sphere), moves + 1, replace=False)
            around = ring[(rng.integers(len(ring)) + spaced) % len(ring)]
            shares["one_view"].append(seen[views[0]].mean())
            shares["random"].append(seen[views].any(axis=0).mean())
            shares["revolution"].append(seen[around].any(axis=0).mean())
            shares["oracle"].append(_greedy(seen, int(views[0]), moves).mean())
        shares["all_views"].append(seen.any(axis=0).mean())
    return {name: float(np.mean(values)) for name, values in shares.items()}


def _greedy(seen: np.ndarray, start: int, moves: int) -> np.ndarray:
    """(n,) bool, which objects are seen after ``moves`` moves, each to the view that shows most unseen objects."""
    found = seen[start].copy()
    for _ in range(moves):
        found |= seen[np.argmax((seen & ~found).sum(axis=1))]
    return found
