"""``active6d bank``: what the estimator says in every view of every scene, once and for all."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from active6d_tools.cli.estimator_training import single_threaded
from active6d_tools.cli.output import JsonFile, ObjectName, Seed, console, progress_bar, write_json

if TYPE_CHECKING:
    from active6d_agent.bank.scene_bank import BankScene, SceneBank

#: Heaps beside a split's stored scenes have seeds from here on: of no stored scene, and of no heap that an estimator
#: learns from. Test scenes are the stored ones only.
FIRST_HEAP = {"train": 50_000, "val": 60_000}
Banks = Annotated[Path | None, typer.Option("--banks", metavar="DIR", help="Folder of the banks; the cache's.")]


def bank(
    object_name: ObjectName = "mug",
    split: Annotated[str, typer.Option(help="Which stored scenes: train, val or test.")] = "test",
    estimator: Annotated[str, typer.Option(help="Who finds poses in one view.")] = "auto",
    scenes: Annotated[int | None, typer.Option(min=1, help="That many of the scenes; all by default.")] = None,
    heaps: Annotated[int, typer.Option(min=0, help="That many more heaps, dropped by seed; for train and val.")] = 0,
    noise: Annotated[float, typer.Option(min=0.0, help="Factor on the sensor's noise.")] = 1.0,
    workers: Annotated[int, typer.Option(min=0, help="Processes; 0 for one a core.")] = 0,
    banks: Banks = None,
    seed: Seed = 0,
    json_file: JsonFile = None,
) -> None:
    """Look at every scene of a split from every view, and store what the estimator and verification said.

    Goes on where it was interrupted. Policies are trained and evaluated on such banks, those of seed 0; with another
    --seed the sensor noise differs, and the bank is stored beside, for [bold]active6d ablate noise-resampling[/bold].

    Example: [bold]active6d bank --object mug --split test[/bold]
    """
    from functools import partial

    from active6d_agent.bank.scene_bank import bank_path, build_bank, cached_banks, load_bank
    from active6d_core.object_model import load_object
    from active6d_core.registry import AUTOMATIC
    from active6d_perception.estimators.registry import choose_estimator, create_estimator

    names = _scene_names(object_name, split, scenes, heaps)
    if estimator == AUTOMATIC:
        estimator = choose_estimator(object_name)
    create_estimator(estimator, load_object(object_name))  # refuses a wrong name or missing weights before any process
    path = bank_path(banks or cached_banks(), object_name, split, seed)
    observe = partial(observe_scene_by_name, estimator=estimator, noise=noise, seed=seed)
    provenance = _provenance(object_name, estimator, noise, seed)
    with progress_bar() as progress, single_threaded():
        task = progress.add_task(f"{object_name} {split}", total=len(names))
        for name in build_bank(
            path, object_name, names, observe, workers=workers or os.cpu_count() or 1, provenance=provenance
        ):
            progress.update(task, advance=1, description=name)
    summary = _summarise(load_bank(path))
    for key, value in summary.items():
        console.print(f"{key.replace('_', ' '):24} {value:.3f}" if isinstance(value, float) else f"{key:24} {value}")
    console.print(f"{path} ({path.stat().st_size / 1e6:.1f} MB)", highlight=False, markup=False)
    write_json(json_file, {"object": object_name, "split": split, "path": str(path), **provenance, **summary})


def _scene_names(object_name: str, split: str, scenes: int | None, heaps: int) -> list[str]:
    from active6d_core.object_model import load_object
    from active6d_sim.scenes.scene_store import SPLITS, load_scene

    if split not in SPLITS:
        raise ValueError(f"--split '{split}' is not among {', '.join(SPLITS)}")
    if heaps and split not in FIRST_HEAP:
        raise ValueError(f"--heaps adds to the scenes of {' and '.join(FIRST_HEAP)}, not to split '{split}'")
    load_object(object_name)
    load_scene(object_name, split, 0)  # says how to make the stored scenes where they are missing
    stored = [f"{object_name}/{split}/{index}" for index in range(min(scenes or SPLITS[split], SPLITS[split]))]
    return stored + [f"{object_name}/seed/{FIRST_HEAP[split] + index}" for index in range(heaps)]


def _provenance(object_name: str, estimator: str, noise: float, seed: int) -> dict[str, Any]:
    """What the bank depends on: a bank of other weights is another bank."""
    from active6d_core.files import sha256_of
    from active6d_perception.estimators.registry import weights_path

    provenance: dict[str, Any] = {"estimator": estimator, "noise": noise, "seed": seed}
    weights = weights_path(object_name)
    if estimator == "dense" and weights.is_file():
        provenance["weights_sha256"] = sha256_of(weights)
    return provenance


def observe_scene_by_name(name: str, *, estimator: str, noise: float, seed: int) -> "BankScene":
    """Look at one scene from everywhere, with the deployed estimator and verification; runs in its own process."""
    from active6d_agent.bank.scene_bank import observe_scene
    from active6d_core.object_model import load_object
    from active6d_core.view_sphere import ViewSphere
    from active6d_perception.estimators.registry import create_estimator
    from active6d_perception.scene.observed_surface import SurfaceGrid
    from active6d_perception.scene.verification import Verifier
    from active6d_sim.rendering.sensor import SensorNoise
    from active6d_sim.rendering.simulator import Simulator
    from active6d_sim.scenes.scene_store import find_scene

    object_name, kind, number = name.split("/")
    model = load_object(object_name)
    scene = find_scene(object_name, "", int(number)) if kind == "seed" else find_scene(object_name, name, 0)
    simulator = Simulator(scene, noise=SensorNoise().scaled(noise), seed=seed)
    return observe_scene(
        name,
        scene.T_world_object,
        simulator.capture,
        create_estimator(estimator, model),
        Verifier(model),
        model,
        ViewSphere(),
        SurfaceGrid.for_model(model),
    )


def _summarise(made: "SceneBank") -> dict[str, Any]:
    """How much one view finds: hypotheses a view, and the share of objects within 10 % of the diameter."""
    import numpy as np

    from active6d_core.metrics import DETECTION_FRACTION

    limit, views = DETECTION_FRACTION * made.model.diameter, len(made.sphere)
    found = []
    for scene in made.scenes:
        hypothesis, instance = np.nonzero(scene.errors < limit)
        pairs = np.unique(np.column_stack([scene.view[hypothesis], instance]), axis=0)
        found.append(len(pairs) / (views * len(scene.T_world_object)))
    hypotheses = sum(len(scene.view) for scene in made.scenes) / (views * len(made.scenes))
    return {
        "scenes": len(made.scenes),
        "hypotheses_per_view": float(hypotheses),
        "found_in_one_view": float(np.mean(found)),
    }
