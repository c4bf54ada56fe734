#!/usr/bin/env python3
"""Measure what the paper's policy attends to, what it is rewarded for, and how far it explores, on validation scenes.

Example: python -m active6d_tools.studies.examine_attention mug --weights trained/best.safetensors
"""

from pathlib import Path

import numpy as np
import torch

from active6d_agent.bank.all_views_lookup import make_lookup
from active6d_agent.bank.scene_bank import find_bank, load_bank
from active6d_agent.bank.scene_lookup import SceneLookup
from active6d_agent.environment.episodes import Episodes
from active6d_agent.evaluation.policy_evaluation import all_starts
from active6d_agent.policies.attention.network import AttentionNetwork, load_network
from active6d_agent.policies.registry import weights_path
from active6d_core.metrics import DETECTION_FRACTION
from active6d_tools.studies.arguments import study_parser

_TERMS = ("error", "distance", "motion")


def follow(network: AttentionNetwork, lookup: SceneLookup, steps: int) -> dict[str, np.ndarray]:
    """Run the mean actions from all starts.

    Returns:
        Of every move (T, 3, E): ``terms`` of the reward. Of every move (T, E): ``attended_right``, whether the attended
        object is right before it. ``right``, the share of the accumulated objects that are. ``lowest``, whether the
        attended one has the lowest score. ``drop`` and ``all_drops``, the fall of its error and of all errors over 10 %
        of the diameter. Of every episode (E,): ``metres`` and ``found``.
    """
    starts, limit = all_starts(lookup), DETECTION_FRACTION * lookup.model.diameter
    episodes = Episodes(lookup, len(starts), steps)
    episodes.begin(np.arange(len(starts)), np.random.default_rng(0), starts[:, 0], starts[:, 1])
    each, rows = np.arange(len(starts)), []
    for _ in range(steps):
        observation = {name: torch.from_numpy(values) for name, values in episodes.observe().items()}
        with torch.inference_mode():
            mean, _, index = network(observation)
        before, errors = episodes.fused, lookup.object_errors(episodes.fused)
        present = before.objects >= 0
        column = np.minimum(index.numpy(), before.objects.shape[1] - 1)
        correct = lookup.pair_errors(before).min(axis=2) < limit
        score = np.where(present, lookup.verification[before.best], np.inf)
        target = lookup.nearest_object[before.objects[each, column]]
        episodes.move(np.column_stack([mean.double().clamp(-1, 1).numpy(), index.numpy()]))
        falls = (errors - lookup.object_errors(episodes.fused)) / limit
        rows.append(
            {
                "terms": episodes.terms,
                "attended_right": correct[each, column],
                "right": (correct & present).sum(axis=1) / np.maximum(present.sum(axis=1), 1),
                "lowest": score.argmin(axis=1) == column,
                "drop": falls[each, target],
                "all_drops": falls.sum(axis=1),
            }
        )
    results = episodes.results()
    ends = {"metres": results["distance_m"], "found": results["detection_rate"]}
    return {**{name: np.stack([row[name] for row in rows]) for name in rows[0]}, **ends}


def main() -> None:
    parser = study_parser(__doc__)
    parser.add_argument("--weights", type=Path, nargs="+", help="trained weights (default: those that ship)")
    parser.add_argument("--banks", type=Path, help="folder of the banks (default: that of 'active6d bank')")
    parser.add_argument("--steps", type=int, default=5, help="moves (default: %(default)s)")
    arguments = parser.parse_args()
    lookup = make_lookup(load_bank(find_bank(arguments.object, "val", folder=arguments.banks)))
    for path in arguments.weights or [weights_path("attention", arguments.object)]:
        network = load_network(path)
        measured = follow(network, lookup, arguments.steps)
        std = network.log_std.exp().tolist()
        entropy = float(torch.distributions.Normal(0.0, network.log_std.detach().exp()).entropy().sum())
        sums = measured["terms"].sum(axis=0).mean(axis=1)
        terms = ", ".join(f"{name} {value:+.3f}" for name, value in zip(_TERMS, sums, strict=True))
        print(f"{path}: finds {measured['found'].mean():.3f} in {measured['metres'].mean():.2f} m")
        print(f"  deviation of actions {180 * std[0]:.0f} and {45 * std[1]:.0f} degrees, entropy {entropy:+.2f} nats")
        print(f"  reward of an episode by term: {terms}")
        right, every, lowest = (measured[name].mean() for name in ("attended_right", "right", "lowest"))
        print(f"  right before the move: {right:.3f} of the attended objects, {every:.3f} of all objects")
        print(f"  attended objects with the lowest score: {lowest:.3f}")
        print(
            f"  a move lowers the attended object's error by {measured['drop'].mean():.3f} and all errors by"
            f" {measured['all_drops'].mean():.3f} (tenths of the diameter)"
        )


if __name__ == "__main__":
    main()
