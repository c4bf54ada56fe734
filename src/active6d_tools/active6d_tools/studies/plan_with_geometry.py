#!/usr/bin/env python3
"""Plan with the true poses and the visible fraction of every object in every view, but without the estimator's results.

The result is an upper bound for planners that know the geometry. The probability that a hypothesis is right is learned
on the training scenes, from true poses and visible fractions.

Example: python -m active6d_tools.studies.plan_with_geometry mug --sample 200
"""

from dataclasses import replace

import numpy as np
import torch
from torch import nn

from active6d_agent.bank.all_views_lookup import make_lookup
from active6d_agent.bank.scene_bank import find_bank, load_bank
from active6d_agent.bank.scene_lookup import SceneLookup
from active6d_agent.environment.rollout import EpisodeResults, measure
from active6d_agent.evaluation.oracle import known
from active6d_agent.evaluation.policy_evaluation import Intervals, all_starts, run_named
from active6d_core.metrics import DETECTION_FRACTION
from active6d_sim.scenes.scene_store import load_scene, stored_names
from active6d_tools.results.tables import interval
from active6d_tools.studies.arguments import study_parser

STEPS = 5
UPDATES, BATCH = 1500, 1024


def read_split(name: str, split: str) -> tuple[SceneLookup, list[np.ndarray]]:
    """The bank of the stored scenes, and (M, n) what each view shows of each object of each scene."""
    bank = load_bank(find_bank(name, split))
    stored = {scene: index for index, scene in enumerate(stored_names(name, split))}
    scenes = [scene for scene in bank.scenes if scene.name in stored]
    shown = [load_scene(name, split, stored[scene.name]).visible_fraction for scene in scenes]
    return make_lookup(replace(bank, scenes=scenes)), shown


def describe(lookup: SceneLookup, scene: int, shown: np.ndarray) -> torch.Tensor:
    """(M, n, 9) share that is seen, distance, elevation, the direction to the view in the object's frame, and the
    object's vertical."""
    T, positions = lookup.bank.scenes[scene].T_world_object, lookup.sphere.positions
    ray = positions[:, None] - T[:, :3, 3]
    distance = np.linalg.norm(ray, axis=-1, keepdims=True)
    side = np.einsum("nij,mni->mnj", T[:, :3, :3], ray / distance)
    upright = np.broadcast_to(T[:, 2, :3], side.shape)
    elevation = np.broadcast_to(positions[:, None, 2:] / lookup.sphere.radius, distance.shape)
    columns = [shown[..., None], distance / lookup.sphere.radius, elevation, side, upright]
    return torch.from_numpy(np.concatenate(columns, axis=-1)).float()


def is_right(lookup: SceneLookup, scene: int) -> torch.Tensor:
    """(M, n) 1 where the view has a right hypothesis of the object."""
    stored = lookup.bank.scenes[scene]
    right = torch.zeros(len(lookup.sphere), len(stored.T_world_object))
    hypothesis, index = np.nonzero(stored.errors < DETECTION_FRACTION * lookup.model.diameter)
    right[stored.view[hypothesis], index] = 1.0
    return right


def learn(lookup: SceneLookup, shown: list[np.ndarray]) -> nn.Module:
    """A network from :func:`describe` to the logit of :func:`is_right`."""
    torch.manual_seed(0)
    inputs = torch.cat([describe(lookup, scene, each).flatten(0, 1) for scene, each in enumerate(shown)])
    labels = torch.cat([is_right(lookup, scene).flatten() for scene in range(len(shown))])
    network = nn.Sequential(nn.Linear(9, 64), nn.ReLU(), nn.Linear(64, 64), nn.ReLU(), nn.Linear(64, 1))
    optimizer = torch.optim.Adam(network.parameters(), 2e-3)
    for _ in range(UPDATES):
        drawn = torch.randint(len(inputs), (BATCH,))
        loss = nn.functional.binary_cross_entropy_with_logits(network(inputs[drawn])[:, 0], labels[drawn])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return network


def plan(lookup: SceneLookup, likely: list[np.ndarray], starts: np.ndarray) -> EpisodeResults:
    """Always to the view with the most right hypotheses to be expected of objects that are not detected yet."""
    views = starts[:, 1:]
    for _ in range(STEPS):
        found = known(lookup, starts[:, 0], views)[:, :, 0]
        worth = np.stack(
            [likely[scene] @ (1.0 - found[row, : likely[scene].shape[1]]) for row, scene in enumerate(starts[:, 0])]
        )
        np.put_along_axis(worth, views, -np.inf, axis=1)
        views = np.column_stack([views, worth.argmax(axis=1)])
    return measure(lookup, starts[:, 0], views)


def main() -> None:
    parser = study_parser(__doc__)
    parser.add_argument("--split", default="test", help="split of the scenes to plan in (default: %(default)s)")
    parser.add_argument("--sample", type=int, default=1000, help="number of episodes (default: %(default)s)")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    network = learn(*read_split(arguments.object, "train"))
    lookup, shown = read_split(arguments.object, arguments.split)
    with torch.inference_mode():
        likely = [
            torch.sigmoid(network(describe(lookup, scene, each)))[..., 0].numpy() for scene, each in enumerate(shown)
        ]
    starts = all_starts(lookup, arguments.sample, 0)
    results = {name: run_named(lookup, name, starts, STEPS) for name in ("random", "unidirectional", "oracle")}
    results["geometry"] = plan(lookup, likely, starts)
    low, high = (results[name].detection_rate.mean() for name in ("random", "oracle"))
    for name, result in results.items():
        rate = result.detection_rate
        ends = Intervals(starts[:, 0]).of(rate)["ci95_scenes"]
        share = (rate.mean() - low) / (high - low)
        print(f"{arguments.object} {name:15} {rate.mean():.3f} {interval(ends, 3)} gap closed {share:.0%}")


if __name__ == "__main__":
    main()
