"""``active6d train fusion``: weights of fusion from scenes whose true poses are known."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from active6d_tools.cli.options import Imports, JsonFile, ObjectName, Seed
from active6d_tools.cli.output import write_json
from active6d_tools.cli.terminal import console, messages, progress_bar

if TYPE_CHECKING:
    from active6d_perception.scene.belief_weights import BeliefWeights


def fusion(
    object_name: ObjectName = "mug",
    episodes: Annotated[int, typer.Option(min=1, help="Number of episodes per scene.")] = 24,
    scenes: Annotated[
        int | None, typer.Option(min=1, help="Largest number of scenes per split; by default all.")
    ] = None,
    estimator: Annotated[str, typer.Option(help="Estimator for each view: auto, {estimators}.")] = "auto",
    export: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Write the weights to this folder, as OBJECT_fusion.*.")
    ] = None,
    bank_files: Annotated[
        list[Path] | None,
        typer.Option(
            "--bank", metavar="FILE", help="Fit only the probability, to the scenes of this bank; repeatable."
        ),
    ] = None,
    workers: Annotated[int, typer.Option(min=0, help="Number of processes; 0 for one per core.")] = 0,
    imports: Imports = None,
    seed: Seed = 0,
    json_file: JsonFile = None,
) -> None:
    """Fit the weights by which fusion believes in poses, and the probability of an object.

    The belief is fitted to the scenes of the train split, the probability to those of val and wild_val. The name
    "any" stands for all shipped objects; its weights serve objects without weights of their own. With --bank, the
    belief stays as it is, scenes of the train split in the bank are left out, and --scenes, --estimator and --workers
    have no effect.

    Example: [bold]active6d train fusion --object mug --export weights[/bold]
    """
    from active6d_perception.scene.belief_weights import belief_file

    if bank_files:
        weights, measured = _refit(object_name, bank_files, episodes, seed)
    else:
        common: dict[str, Any] = {"episodes": episodes, "scenes": scenes, "estimator": estimator, "seed": seed}
        weights, measured = _fit(object_name, workers or os.cpu_count() or 1, common)
    for key, value in measured.items():
        console.print(f"{key:24} {value:.3f}" if isinstance(value, float) else f"{key:24} {value}")
    if export is not None:
        path = export / belief_file(object_name)
        weights.save(path, object_name)
        messages.print(f"wrote {path}", highlight=False, markup=False)
    write_json(json_file, {"object": object_name, "seed": seed, **measured})


def _fit(object_name: str, workers: int, settings: dict[str, Any]) -> tuple["BeliefWeights", dict[str, Any]]:
    from active6d_perception.scene.belief_weights import ANY_OBJECT
    from active6d_sim.scenes.scene_store import SHIPPED_SCENES
    from active6d_tools.fusion_training import count_scenes, fit_fusion
    from active6d_tools.threads import single_threaded

    names = [object_name]
    if object_name == ANY_OBJECT:
        names = sorted(folder.name for folder in SHIPPED_SCENES.iterdir() if folder.is_dir())
    with progress_bar() as progress, single_threaded():
        task = progress.add_task(object_name, total=count_scenes(names, settings["scenes"]))
        return fit_fusion(
            names,
            workers=workers,
            on_scene=lambda name: progress.update(task, advance=1, description=name),
            **settings,
        )


def _refit(object_name: str, banks: list[Path], episodes: int, seed: int) -> tuple["BeliefWeights", dict[str, Any]]:
    from active6d_agent.bank.scene_bank import load_bank
    from active6d_core.object_model import load_object
    from active6d_perception.scene.belief_weights import belief_path, load_belief
    from active6d_tools.fusion_training import refit_probability

    load_object(object_name)  # names the known ones
    with messages.status("reading the banks"):
        loaded = [load_bank(path) for path in banks]
    for path, bank in zip(banks, loaded, strict=True):
        if bank.object_name != object_name:
            raise ValueError(f"{path}: is a bank of '{bank.object_name}', not of '{object_name}'")
    with messages.status("fusing views of the banks"):
        return refit_probability(load_belief(belief_path(object_name)), loaded, episodes=episodes, seed=seed)
