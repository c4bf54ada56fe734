"""How much a learned policy depends on the seed of its training."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from active6d_agent.bank.scene_lookup import SceneLookup
from active6d_agent.evaluation.policy_evaluation import Intervals, all_starts, describe, run_named
from active6d_agent.policies.registry import weights_path


def compare_seeds(
    validation: SceneLookup,
    test: SceneLookup,
    weights: dict[tuple[str, int], Path],
    starts: np.ndarray,
    steps: int,
    *,
    sample: int | None = None,
    seed: int = 0,
) -> Iterator[dict[str, Any]]:
    """Evaluate trainings of policies on test scenes and on the validation scenes that the shipped one is chosen by.

    Args:
        validation: look-up of the validation bank.
        test: look-up of the test bank.
        weights: policy and seed of the training to its weights; ``curve.jsonl`` lies beside them.
        starts: (E, 2) test scenes and first views.
        steps: budget T.
        sample: that many starts on validation scenes; None for all.
        seed: of that sample and of the intervals.
    """
    validation_starts, intervals = all_starts(validation, sample, seed), Intervals(starts[:, 0], seed)
    for (name, number), path in weights.items():
        own = {"weights": str(path)}
        chosen_on = run_named(validation, name, validation_starts, steps, parameters=own)
        results = run_named(test, name, starts, steps, parameters=own)
        shipped = weights_path(name, test.model.name)
        curve = (path.parent / "curve.jsonl").read_text().splitlines()
        yield {
            "variant": f"{name}, seed {number}",
            "policy": name,
            "training_seed": number,
            "training_minutes": json.loads(curve[-1])["seconds"] / 60,
            "validation_detection_rate": float(chosen_on.detection_rate.mean()),
            "validation_e_add_mm": float(chosen_on.e_add_mm.mean()),
            "shipped": shipped.is_file() and shipped.read_bytes() == path.read_bytes(),
            **describe(results.measures, intervals),
        }


def mark_best(rows: list[dict[str, Any]]) -> None:
    """Set ``best_on_validation`` in rows of :func:`compare_seeds`: the best of several trainings of a policy."""
    for policy in {row["policy"] for row in rows}:
        own = [row for row in rows if row["policy"] == policy]
        best = max(own, key=lambda row: (row["validation_detection_rate"], -row["validation_e_add_mm"]))
        for row in own:
            row["best_on_validation"] = row is best and len(own) > 1
