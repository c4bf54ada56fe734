"""A made-up bank: an estimator that errs the more, the more other objects stand in its line of sight."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from active6d_agent.bank.scene_bank import BankScene, SceneBank, world_poses
from active6d_agent.policies.baselines import line_of_sight
from active6d_core.metrics import e_add
from active6d_core.object_model import ObjectModel, load_object
from active6d_core.se3 import invert, make_transform, quaternion_from_transform
from active6d_core.view_sphere import ViewSphere
from active6d_perception.scene.observed_surface import WorkspaceGrid, explainer


def synthetic_scene(object_name: str, seed: int, objects: int, sphere: ViewSphere, noise: int = 0) -> BankScene:
    """One scene of randomly placed objects; the same with other errors for another ``noise``."""
    model, rng = load_object(object_name), np.random.default_rng(seed)
    centres = rng.uniform(-0.15, 0.15, (objects, 3)) * [1, 1, 0.3] + [0, 0, 0.05]
    T_world_object = make_transform(Rotation.random(objects, rng=rng).as_matrix(), centres)
    sight = np.stack([line_of_sight(centres, i, sphere.positions, model.diameter) for i in range(objects)], axis=1)
    rng = np.random.default_rng([seed, noise]) if noise else rng
    views, tables = [], []
    for view, position in enumerate(sphere.positions):
        seen = np.flatnonzero(sight[view] > 0.2)
        error = (1.0 - sight[view, seen])[:, None] + 0.05
        turned = Rotation.from_rotvec(rng.normal(size=(len(seen), 3)) * 0.6 * error).as_matrix()
        slip = make_transform(turned, rng.normal(size=(len(seen), 3)) * 0.02 * error)
        T = invert(sphere.pose(position)) @ T_world_object[seen] @ slip
        verification = np.clip(sight[view, seen] + rng.normal(0, 0.1, len(seen)), 0, 1)
        box = np.tile([0.4, 0.4, 0.6, 0.6], (len(seen), 1)) + rng.uniform(-0.1, 0.1, (len(seen), 1))
        columns = [T[:, :3, 3], quaternion_from_transform(T), verification, verification, box, T[:, 2, 3]]
        tables.append(np.column_stack(columns).astype(np.float32))
        views.append(np.full(len(seen), view))
    view, table = np.concatenate(views), np.concatenate(tables)
    errors = e_add(model, world_poses(table, view, sphere)[:, None], T_world_object, cutoff=0.05)
    errors[errors >= 0.05] = np.inf
    return BankScene(
        f"{object_name}/synthetic/{seed}",
        T_world_object,
        view,
        table,
        errors.astype(np.float32),
        rng.uniform(0, 2, len(sphere)),
        _shown_surface(model, T_world_object, sight > 0.1),
    )


def _shown_surface(model: ObjectModel, T_world_object: np.ndarray, is_seen: np.ndarray) -> np.ndarray:
    """(M, b) packed bits: all cells that hold surface of the objects that a view sees, as (M, n) says."""
    grid = WorkspaceGrid.for_model(model)
    near = explainer(model, 0.05).explains(grid.centres, T_world_object)
    return np.packbits(is_seen.astype(np.uint8) @ near.astype(np.uint8) > 0, axis=1)


def synthetic_bank(object_name: str = "mug", scenes: int = 2, objects: int = 8, noise: int = 0) -> SceneBank:
    """A bank of such scenes."""
    sphere = ViewSphere()
    made = [synthetic_scene(object_name, seed, objects, sphere, noise) for seed in range(scenes)]
    return SceneBank(
        object_name, sphere, WorkspaceGrid.for_model(load_object(object_name)), made, {"estimator": "synthetic"}
    )


def observe_synthetic(name: str, views: Path | None, log: str) -> BankScene:
    """Picklable stand-in for simulator and estimator; notes down what it was asked for."""
    with open(log, "a") as file:
        file.write(name + "\n")
    return replace(synthetic_scene("mug", int(name.split("/")[-1]), 3, ViewSphere()), name=name)
