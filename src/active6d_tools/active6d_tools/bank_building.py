"""Scene banks from simulated scenes: which scenes a bank holds, and what the estimator finds in each view of them."""

from pathlib import Path
from typing import Any

import numpy as np

from active6d_agent.bank.candidate_pruning import prune_candidates
from active6d_agent.bank.observation import observe_scene
from active6d_agent.bank.scene_bank import BankScene, SceneBank
from active6d_core.files import sha256_of
from active6d_core.metrics import DETECTION_FRACTION
from active6d_core.object_model import load_object
from active6d_core.registry import AUTOMATIC
from active6d_core.view_sphere import ViewSphere
from active6d_perception.estimators.registry import create_estimator, weights_path
from active6d_perception.scene.observed_surface import WorkspaceGrid
from active6d_perception.scene.verification import Verifier
from active6d_sim.rendering.random_sensor import sensor_of
from active6d_sim.rendering.simulator import Simulator
from active6d_sim.scenes.scene_store import SPLITS, find_scene, load_scene, stored_names
from active6d_sim.scenes.wild_scene import wild_scene

#: Seeds of the piles and wild scenes beside a split's stored scenes start here. No stored scene and no scene that an
#: estimator is trained on has such a seed.
FIRST_HEAP = {"train": 50_000, "val": 60_000, "test": 70_000}


def scene_names(object_name: str, split: str, scenes: int | None, heaps: int = 0, wild: int = 0) -> list[str]:
    """Names of scenes: stored scenes of the split, then piles and wild scenes that are simulated by their seed.

    Args:
        object_name: of the objects in the scenes.
        split: of the stored scenes.
        scenes: number of stored scenes; None for all.
        heaps: number of simulated piles.
        wild: number of simulated wild scenes.

    Raises:
        ValueError: an unknown object or split, piles for a split of wild scenes, or missing stored scenes.
    """
    if split not in SPLITS:
        raise ValueError(f"--split '{split}' is not among {', '.join(SPLITS)}")
    for option, count in (("--heaps", heaps), ("--wild", wild)):
        if count and split not in FIRST_HEAP:
            raise ValueError(f"{option} adds to the scenes of {', '.join(FIRST_HEAP)}, not to split '{split}'")
    load_object(object_name)
    load_scene(object_name, split, 0)  # says how to make the stored scenes if they are missing
    simulated = [
        f"{object_name}/{kind}/{FIRST_HEAP[split] + index}"
        for kind, count in (("seed", heaps), ("wild", wild))
        for index in range(count)
    ]
    return stored_names(object_name, split, scenes) + simulated


def bank_provenance(object_name: str, estimator: str, noise: float, seed: int) -> dict[str, Any]:
    """What a bank depends on; a bank of other weights is another bank."""
    provenance: dict[str, Any] = {"estimator": estimator, "noise": noise, "seed": seed}
    weights = weights_path(object_name)
    if estimator == "dense" and weights.is_file():
        provenance["weights_sha256"] = sha256_of(weights)
    return provenance


def observe_scene_by_name(
    name: str, views: Path | None = None, *, estimator: str, noise: float, seed: int, sensor: str = AUTOMATIC
) -> BankScene:
    """Observe one scene from every view with the deployed estimator and verification; runs in its own process.

    Views are kept in the folder ``views`` until the scene is done. Candidates that hardly any choice of views
    makes probable are left out, see :mod:`.candidate_pruning`.
    """
    object_name, kind, number = name.split("/")
    model = load_object(object_name)
    if kind == "wild":
        scene = wild_scene(model, int(number), name)
    else:
        scene = find_scene(object_name, "", int(number)) if kind == "seed" else find_scene(object_name, name, 0)
    simulator = Simulator(scene, noise=sensor_of(sensor, model, scene).scaled(noise), seed=seed)
    sphere, grid = ViewSphere(), WorkspaceGrid.for_model(model)
    observed = observe_scene(
        name,
        scene.T_world_object,
        simulator.capture,
        create_estimator(estimator, model),
        Verifier(model),
        model,
        sphere,
        grid,
        views=views,
    )
    bank = SceneBank(object_name, sphere, grid, [observed], {})
    return prune_candidates(bank, np.random.default_rng(seed)).scenes[0]


def summarise_bank(bank: SceneBank) -> dict[str, Any]:
    """How much one view finds: hypotheses per view, and the share of objects within 10 % of the diameter."""
    limit, views = DETECTION_FRACTION * bank.model.diameter, len(bank.sphere)
    found = []
    for scene in bank.scenes:
        hypothesis, instance = np.nonzero(scene.errors < limit)
        pairs = np.unique(np.column_stack([scene.view[hypothesis], instance]), axis=0)
        found.append(len(pairs) / (views * len(scene.T_world_object)))
    hypotheses = sum(len(scene.view) for scene in bank.scenes) / (views * len(bank.scenes))
    return {
        "scenes": len(bank.scenes),
        "hypotheses_per_view": float(hypotheses),
        "found_in_one_view": float(np.mean(found)),
    }
