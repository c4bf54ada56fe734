"""Training and validation views for the dense estimator: simulated and rendered, one file for each pile."""

from collections.abc import Callable, Iterable
from concurrent.futures import as_completed
from pathlib import Path
from typing import Any

import numpy as np

from active6d_core.interrupts import worker_pool
from active6d_core.object_model import load_object
from active6d_core.training_view import TrainingView
from active6d_perception.estimators.dense.training.samples import make_sample, write_shard
from active6d_sim.datasets.training_views import (
    FIRST_SEED,
    training_scene,
    training_views,
    validation_views,
)
from active6d_sim.scenes.scene_store import SPLITS, load_scene
from active6d_tools.threads import single_threaded

#: Splits of the stored scenes whose views choose the best weights.
VALIDATION_SPLITS = ("val", "wild_val")


def render_missing(
    object_name: str,
    folder: Path,
    heaps: int,
    views: int,
    cores: int,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, list[Path]]:
    """Paths of all files of views: of "training" and of each of :data:`VALIDATION_SPLITS`.

    Missing ones are rendered first, on several cores.

    Args:
        object_name: of the objects in the piles.
        folder: of the files.
        heaps: number of simulated scenes to train on; validation uses the stored scenes.
        views: number of views of each scene to train on.
        cores: number of processes.
        on_progress: called with the number of files rendered so far and of all files to render.

    Raises:
        ValueError: the stored scenes are missing; the message says how to make them.
    """
    tasks: dict[Path, tuple[Callable[..., None], tuple[Any, ...]]] = {}
    for split in VALIDATION_SPLITS:
        for index in range(SPLITS[split]):
            path = folder / split / f"{index}.npz"
            tasks[path] = (render_validation, (object_name, split, index, path))
    for seed in range(FIRST_SEED, FIRST_SEED + heaps):
        path = folder / f"training-{views}" / f"{seed}.npz"
        tasks[path] = (render_training, (object_name, seed, views, path))
    missing = [path for path in tasks if not path.is_file()]
    if missing:
        load_scene(object_name, "val", 0)  # says how to make the stored scenes if they are missing
        on_progress(0, len(missing))
        with single_threaded(), worker_pool(min(cores, len(missing))) as pool:
            jobs = [pool.submit(tasks[path][0], *tasks[path][1]) for path in missing]
            for done, job in enumerate(as_completed(jobs), start=1):
                job.result()
                on_progress(done, len(missing))
    kinds = ("training", *VALIDATION_SPLITS)
    return {kind: [path for path in tasks if path.parent.name.split("-")[0] == kind] for kind in kinds}


def render_training(object_name: str, seed: int, views: int, path: Path) -> None:
    """Simulate one scene to train on and write ``views`` views of it; runs in its own process."""
    model = load_object(object_name)
    scene = training_scene(model, seed)
    _write(path, training_views(scene, model, views, np.random.default_rng([seed, 2]), threads=1))


def render_validation(object_name: str, split: str, index: int, path: Path) -> None:
    """Write views of one stored scene of a validation split; runs in its own process."""
    _write(path, validation_views(object_name, split, index, threads=1))


def _write(path: Path, views: Iterable[TrainingView]) -> None:
    write_shard(path, [make_sample(item) for item in views])
