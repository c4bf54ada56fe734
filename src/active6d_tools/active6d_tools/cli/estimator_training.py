"""``active6d train``: rendering what the learned estimator learns from, and training it."""

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Any

import typer

from active6d_tools.cli.output import JsonFile, ObjectName, Seed, export_weights, progress_bar, write_json

app = typer.Typer(help="Train what is learned.", rich_markup_mode="rich")

_DATA = "Folder for training views and the training's state; by default active6d/training/OBJECT in the cache folder."


@app.command()
def estimator(
    object_name: ObjectName,
    data: Annotated[Path | None, typer.Option(metavar="DIR", help=_DATA)] = None,
    heaps: Annotated[int, typer.Option(help="Heaps to render views of.", min=1)] = 110,
    views: Annotated[int, typer.Option(help="Views per heap.", min=1)] = 32,
    steps: Annotated[int, typer.Option(help="Steps of the optimiser in all.", min=1)] = 5_500,
    batch: Annotated[int, typer.Option(help="Views per step.", min=1)] = 8,
    run: Annotated[str, typer.Option(help="Name of the training; an interrupted one of that name goes on.")] = "run",
    export: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Copy the best weights there, as OBJECT.*.")
    ] = None,
    render_only: Annotated[bool, typer.Option("--render-only", help="Stop when the views are there.")] = False,
    threads: Annotated[int, typer.Option(help="Cores to use; 0 for all.", min=0)] = 0,
    seed: Seed = 0,
    json_file: JsonFile = None,
) -> None:
    """Train the learned pose estimator of one object: render views of random heaps, then train on them.

    Both parts go on where they were interrupted. Curves are drawn to DIR/RUN/curves.png as it learns, and the weights
    that do best on the validation split are DIR/RUN/best.safetensors. Uses CUDA where there is any.

    Example: [bold]active6d train estimator --object mug --export weights[/bold]
    """
    from active6d_core.files import cache_folder
    from active6d_core.object_model import load_object

    model = load_object(object_name)
    folder = data or cache_folder("training") / object_name
    cores = threads or os.cpu_count() or 1
    shards = _render_missing(object_name, folder, heaps, views, cores)
    if render_only:
        return
    best, history = _train(model, shards, folder, run, _options(steps, batch, seed), cores)
    if export is not None:
        export_weights(best, export, object_name)
    write_json(json_file, {"object": object_name, "weights": str(best), "validation": history})


def _options(steps: int, batch: int, seed: int) -> Any:
    from active6d_perception.estimators.dense.training.loop import TrainingOptions

    return TrainingOptions(steps=steps, batch=batch, seed=seed)


def _render_missing(object_name: str, folder: Path, heaps: int, views: int, cores: int) -> dict[str, list[Path]]:
    """Paths of all files of training and validation views; those that are not there yet are rendered on all cores."""
    from active6d_sim.datasets.training_views import FIRST_SEED
    from active6d_sim.scenes.scene_store import SPLITS, load_scene

    tasks: dict[Path, tuple[Callable, tuple]] = {}
    for index in range(SPLITS["val"]):
        path = folder / "validation" / f"{index}.npz"
        tasks[path] = (render_validation, (object_name, index, path))
    for seed in range(FIRST_SEED, FIRST_SEED + heaps):
        path = folder / f"training-{views}" / f"{seed}.npz"
        tasks[path] = (render_training, (object_name, seed, views, path))
    missing = [path for path in tasks if not path.is_file()]
    if missing:
        load_scene(object_name, "val", 0)  # says how to make the stored scenes where they are missing
        for parent in {path.parent for path in missing}:
            parent.mkdir(parents=True, exist_ok=True)
        # Threads do not survive a fork, and the ray caster and the network library have some.
        with (
            progress_bar() as bar,
            single_threaded(),
            ProcessPoolExecutor(min(cores, len(missing)), mp_context=get_context("spawn")) as pool,
        ):
            task = bar.add_task(f"{object_name}: rendering heaps", total=len(missing))
            jobs = [pool.submit(tasks[path][0], *tasks[path][1]) for path in missing]
            for job in as_completed(jobs):
                job.result()
                bar.advance(task)
    return {kind: [path for path in tasks if path.parent.name.startswith(kind)] for kind in ("training", "validation")}


@contextmanager
def single_threaded() -> Iterator[None]:
    """Processes started inside use one thread each: there is one for every core."""
    before = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ["OMP_NUM_THREADS"]
        else:
            os.environ["OMP_NUM_THREADS"] = before


def render_training(object_name: str, seed: int, views: int, path: Path) -> None:
    """Drop one heap to learn from and write ``views`` views of it; runs in a process of its own."""
    import numpy as np

    from active6d_core.object_model import load_object
    from active6d_sim.datasets.training_views import training_heap, training_views

    model = load_object(object_name)
    scene = training_heap(model, seed)
    _write(path, training_views(scene, model, views, np.random.default_rng([seed, 2]), threads=1))


def render_validation(object_name: str, index: int, path: Path) -> None:
    """Write views of one stored scene of the validation split; runs in a process of its own."""
    from active6d_sim.datasets.training_views import validation_views

    _write(path, validation_views(object_name, index, threads=1))


def _write(path: Path, views: Any) -> None:
    from active6d_perception.estimators.dense.training.samples import make_sample, write_shard

    write_shard(path, [make_sample(item) for item in views])


def _train(
    model: Any, shards: dict[str, list[Path]], folder: Path, run: str, options: Any, cores: int
) -> tuple[Path, list]:
    """Path of the best weights, and the history of validations."""
    import json

    import torch

    from active6d_perception.estimators.dense.training.loop import Report, train
    from active6d_perception.estimators.dense.training.samples import read_shard

    torch.set_num_threads(cores)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    validation = [sample for path in shards["validation"] for sample in read_shard(path)]
    with progress_bar() as bar:
        task = bar.add_task(f"{model.name}: training on {device}", total=options.steps)

        def on_step(report: Report) -> None:
            found = report.validation
            rates = f", finds {found['add_half']:.2f} / {found['add_tenth']:.2f}" if found else ""
            bar.update(task, completed=report.step, description=f"{model.name}: loss {report.loss:.2f}{rates}")

        best = train(model, shards["training"], validation, folder / run, options, device, on_step)
    return best, json.loads((folder / run / "curves.json").read_text())
