"""``active6d train estimator``: rendering of training views, and training of the dense estimator."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from active6d_tools.cli.options import JsonFile, ObjectName, Seed
from active6d_tools.cli.output import export_weights, write_json
from active6d_tools.cli.terminal import progress_bar

if TYPE_CHECKING:
    from active6d_core.object_model import ObjectModel
    from active6d_perception.estimators.dense.training.loop import TrainingOptions

app = typer.Typer(help="Train the pose estimator or a policy.", rich_markup_mode="rich")

#: Views of each validation scene that the score is fitted on.
_SCORE_VIEWS = 5
_DATA = "Folder of the views and checkpoints; by default active6d/training/OBJECT in the cache folder."


@app.command()
def estimator(
    object_name: ObjectName,
    data: Annotated[Path | None, typer.Option(metavar="DIR", help=_DATA)] = None,
    heaps: Annotated[int, typer.Option(help="Number of simulated scenes to render views of.", min=1)] = 110,
    views: Annotated[int, typer.Option(help="Number of views per scene.", min=1)] = 32,
    steps: Annotated[int, typer.Option(help="Number of optimiser steps.", min=1)] = 5_500,
    batch: Annotated[int, typer.Option(help="Batch size in views.", min=1)] = 8,
    rate: Annotated[float, typer.Option(help="Highest learning rate.", min=0.0)] = 2e-3,
    start: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Start from these weights; by default from random ones.")
    ] = None,
    run: Annotated[
        str, typer.Option(help="Name of the training; an interrupted training of that name is continued.")
    ] = "run",
    export: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Copy the best weights to this folder, as OBJECT.*.")
    ] = None,
    render_only: Annotated[bool, typer.Option("--render-only", help="Render the views and stop.")] = False,
    threads: Annotated[int, typer.Option(help="Number of cores to use; 0 for all.", min=0)] = 0,
    seed: Seed = 0,
    json_file: JsonFile = None,
) -> None:
    """Render views of simulated piles of one object and train the dense pose estimator on them.

    Rendering and training both continue where they were interrupted. Curves are drawn to DIR/RUN/curves.png during
    training. The weights with the best result on the validation split are DIR/RUN/best.safetensors. CUDA is used if
    it is available.

    Example: [bold]active6d train estimator --object mug --export weights[/bold]
    """
    from active6d_core.files import cache_folder
    from active6d_core.object_model import load_object
    from active6d_perception.estimators.dense.training.loop import TrainingOptions
    from active6d_tools.training_data import render_missing

    model = load_object(object_name)
    folder = data or cache_folder("training") / object_name
    cores = threads or os.cpu_count() or 1
    with progress_bar() as bar:
        task = bar.add_task(f"{object_name}: rendering piles", total=None, visible=False)

        def on_progress(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total, visible=True)

        shards = render_missing(object_name, folder, heaps, views, cores, on_progress)
    if render_only:
        return
    options = TrainingOptions(steps=steps, batch=batch, learning_rate=rate, seed=seed, start=str(start or ""))
    best, history = _train(model, shards, folder / run, options, cores)
    score = _fit_score(model, best, seed)
    if export is not None:
        export_weights(best, export, object_name)
    write_json(json_file, {"object": object_name, "weights": str(best), "validation": history, "score": score})


def _fit_score(model: "ObjectModel", weights: Path, seed: int) -> dict[str, float]:
    """Fit the score on validation views; its quality on them."""
    import numpy as np

    from active6d_tools.score_fitting import fit_dense_score

    with progress_bar() as bar:
        task = bar.add_task(f"{model.name}: fitting the score")
        return fit_dense_score(
            model,
            weights,
            _SCORE_VIEWS,
            np.random.default_rng(seed),
            lambda done, total: bar.update(task, completed=done, total=total),
        )


def _train(
    model: "ObjectModel", shards: dict[str, list[Path]], folder: Path, options: "TrainingOptions", cores: int
) -> tuple[Path, list[dict[str, float]]]:
    """Path of the best weights, and the validation results."""
    import json

    import torch

    from active6d_perception.estimators.dense.training.loop import Report, train
    from active6d_perception.estimators.dense.training.samples import read_shard
    from active6d_tools.training_data import VALIDATION_SPLITS

    torch.set_num_threads(cores)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    validation = [sample for split in VALIDATION_SPLITS for path in shards[split] for sample in read_shard(path)]
    with progress_bar() as bar:
        task = bar.add_task(f"{model.name}: training on {device}", total=options.steps)

        def on_step(report: Report) -> None:
            found = report.validation
            rates = f", finds {found['add_half']:.2f} / {found['add_tenth']:.2f}" if found else ""
            bar.update(task, completed=report.step, description=f"{model.name}: loss {report.loss:.2f}{rates}")

        best = train(model, shards["training"], validation, folder, options, device, on_step)
    return best, json.loads((folder / "curves.json").read_text())
