"""``active6d bank``: the estimator's hypotheses in every view of every scene."""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from active6d_tools.cli.options import Banks, Imports, JsonFile, ObjectName, Seed, Split
from active6d_tools.cli.output import write_json
from active6d_tools.cli.terminal import console, messages, progress_bar

if TYPE_CHECKING:
    from active6d_agent.bank.scene_bank import SceneBank


def bank(
    object_name: ObjectName = "mug",
    split: Split = "test",
    estimator: Annotated[str, typer.Option(help="Estimator for each view: auto, {estimators}.")] = "auto",
    scenes: Annotated[int | None, typer.Option(min=1, help="Number of stored scenes; by default all.")] = None,
    heaps: Annotated[int, typer.Option(min=0, help="Number of additional simulated piles.")] = 0,
    wild: Annotated[int, typer.Option(min=0, help="Number of additional simulated wild scenes.")] = 0,
    noise: Annotated[float, typer.Option(min=0.0, help="Factor on the noise of the simulated sensor.")] = 1.0,
    workers: Annotated[int, typer.Option(min=0, help="Number of processes; 0 for one per core.")] = 0,
    imports: Imports = None,
    banks: Banks = None,
    seed: Seed = 0,
    json_file: JsonFile = None,
) -> None:
    """Run the estimator on every view of every scene of a split and store the verified hypotheses.

    An interrupted run continues where it stopped. A bank that is there keeps its other scenes if they were made in
    the same way; those that it drops are named. Policies are trained and evaluated on the banks with seed 0. Another
    --seed gives other sensor noise; that bank is a file of its own, for
    [bold]active6d ablate noise-resampling[/bold].

    Example: [bold]active6d bank --object mug --split test[/bold]
    """
    from functools import partial

    from active6d_agent.bank.scene_bank import bank_path, build_bank, cached_banks, load_bank
    from active6d_core.object_model import load_object
    from active6d_core.registry import AUTOMATIC
    from active6d_perception.estimators.registry import choose_estimator, create_estimator
    from active6d_tools.bank_building import bank_provenance, observe_scene_by_name, scene_names, summarise_bank
    from active6d_tools.threads import single_threaded

    names = scene_names(object_name, split, scenes, heaps, wild)
    if estimator == AUTOMATIC:
        estimator = choose_estimator(object_name)
    create_estimator(estimator, load_object(object_name))  # refuses a wrong name or missing weights before any process
    path = bank_path(banks or cached_banks(), object_name, split, seed)
    observe = partial(observe_scene_by_name, estimator=estimator, noise=noise, seed=seed)
    provenance = bank_provenance(object_name, estimator, noise, seed)
    with progress_bar() as progress, single_threaded():
        task = progress.add_task(f"{object_name} {split}", total=len(names))
        for name in build_bank(
            path,
            object_name,
            names,
            observe,
            workers=workers or os.cpu_count() or 1,
            provenance=provenance,
            on_drop=partial(_say_dropped, path),
        ):
            progress.update(task, advance=1, description=name)
    summary = summarise_bank(_requested(load_bank(path), names, path))
    for key, value in summary.items():
        console.print(f"{key.replace('_', ' '):24} {value:.3f}" if isinstance(value, float) else f"{key:24} {value}")
    console.print(f"{path} ({path.stat().st_size / 1e6:.1f} MB)", highlight=False, markup=False)
    write_json(json_file, {"object": object_name, "split": split, "path": str(path), **provenance, **summary})


def _say_dropped(path: Path, names: Sequence[str]) -> None:
    messages.print(
        f"{path} was made with another estimator, weights, noise or seed; these scenes of it are dropped: "
        f"{', '.join(names)}. To keep them, stop now and give another folder with --banks.",
        highlight=False,
        markup=False,
    )


def _requested(bank: "SceneBank", names: Sequence[str], path: Path) -> "SceneBank":
    """The bank with the requested scenes only, which come first; says how many others it keeps."""
    others = len(bank.scenes) - len(names)
    if others:
        messages.print(
            f"{path} also keeps {others} scenes from before; to have the requested ones alone, delete it first",
            highlight=False,
            markup=False,
        )
    return replace(bank, scenes=bank.scenes[: len(names)])
