"""The part of the greedy oracle's lead that is noise: the same views of the same scenes with other sensor noise.

A bank holds one image per view, and the oracle knows the estimator's result on that image before it takes the view. No
planner can predict the noise of an image that it has not taken. So a part of the oracle's lead is out of reach.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from active6d_agent.bank.best_view_lookup import BestViewLookup
from active6d_agent.bank.scene_bank import SceneBank
from active6d_agent.bank.scene_lookup import SceneLookup
from active6d_agent.environment.rollout import measure
from active6d_agent.evaluation.oracle import worth
from active6d_agent.evaluation.policy_evaluation import Intervals, Measures, describe, describe_ratio, run_named
from active6d_core.view_sphere import ViewSphere


def ablate_noise_resampling(
    lookups: tuple[SceneLookup, SceneLookup],
    names: Sequence[str],
    starts: np.ndarray,
    steps: int,
    *,
    seed: int = 0,
    parameters: dict[str, dict[str, Any]] | None = None,
) -> Iterator[dict[str, Any]]:
    """Policies choose their views on either bank; the views are scored on that bank and on the other one.

    Yields a row for each ``policy`` and ``noise``, the mean over both banks. Noise "own" is that of the images that the
    views were chosen with, "other" that of the other bank. The oracle also has "unforeseen": it knows the truth and the
    results of its images so far, but predicts the next view by the other bank's image. Rows are compared with the one
    of own noise (``against_first``). ``gap_closed`` is the share of the way from Random's detection rate to the
    oracle's on own noise.

    Args:
        lookups: of two banks of the same scenes.
        names: of policies; ``random`` and ``oracle`` are always among them, first and last.
        starts: (E, 2) scenes and first views.
        steps: budget T.
        seed: of the policies' randomness.
        parameters: name of a policy to its parameters.

    Raises:
        ValueError: the banks differ in more than their seed, or the oracle finds no more than Random.
    """
    _refuse_other_scenes(*(lookup.bank for lookup in lookups))
    scene, intervals = starts[:, 0], Intervals(starts[:, 0], seed)

    def choose(name: str) -> list[np.ndarray]:
        own = (parameters or {}).get(name)
        return [run_named(lookup, name, starts, steps, seed=seed, parameters=own).views for lookup in lookups]

    def score(views: list[np.ndarray], noise: Sequence[SceneLookup] = lookups) -> Measures:
        ways = [measure(lookup, scene, own).measures for lookup, own in zip(noise, views, strict=True)]
        return {key: np.mean([way[key] for way in ways], axis=0) for key in ways[0]}

    ends = {name: choose(name) for name in ("random", "oracle")}
    low, high = (score(ends[name])["detection_rate"] for name in ("random", "oracle"))
    if high.mean() <= low.mean():
        raise ValueError("the oracle finds no more than Random from these starts; take more of them")

    def row(name: str, noise: str, measures: Measures, first: Measures | None = None) -> dict[str, Any]:
        lead, gap = measures["detection_rate"] - low, high - low
        gap_closed = describe_ratio("gap_closed", lead, gap, intervals)
        variant = {"variant": f"{name}, {noise} noise", "policy": name, "noise": noise}
        return {**variant, **describe(measures, intervals, first), **gap_closed}

    for name in ("random", *(name for name in names if name not in ends), "oracle"):
        views = ends.get(name) or choose(name)
        own = score(views)
        yield row(name, "own", own)
        if name == "oracle":
            pairs = (lookups, lookups[::-1])
            unforeseen = [search_unforeseen(join_banks(*(each.bank for each in pair)), starts, steps) for pair in pairs]
            yield row(name, "unforeseen", score(unforeseen), own)
        yield row(name, "other", score(views, lookups[::-1]), own)


def _refuse_other_scenes(bank: SceneBank, other: SceneBank) -> None:
    """Raise ValueError unless two banks differ in nothing but the seed of the noise."""

    def made(bank: SceneBank) -> tuple[Any, ...]:
        scenes = [(scene.name, scene.T_world_object.tolist()) for scene in bank.scenes]
        return bank.sphere, bank.grid, {**bank.provenance, "seed": None}, scenes

    if made(bank) != made(other):
        raise ValueError(
            f"the two banks of '{bank.object_name}' differ in more than their seed (scenes, estimator or factor on the "
            "noise); make both again with 'active6d bank'"
        )


def join_banks(bank: SceneBank, other: SceneBank) -> SceneLookup:
    """One look-up of two banks of the same scenes: view ``v`` of the second bank is view ``M + v``."""
    grid = bank.sphere
    twice = ViewSphere(grid.radius, grid.elevations_degrees * 2, grid.azimuths)
    scenes = [
        replace(
            first,
            view=np.concatenate([first.view, len(grid) + second.view]),
            table=np.concatenate([first.table, second.table]),
            errors=np.concatenate([first.errors, second.errors]),
            entropy=np.concatenate([first.entropy, second.entropy]),
            surface=np.concatenate([first.surface, second.surface]),
            evidence=None,
        )
        for first, second in zip(bank.scenes, other.scenes, strict=True)
    ]
    return BestViewLookup(replace(bank, sphere=twice, scenes=scenes))


def search_unforeseen(joined: SceneLookup, starts: np.ndarray, steps: int) -> np.ndarray:
    """(E, T + 1) views of a greedy search that knows the ground truth but not the noise of its next image.

    Args:
        joined: of :func:`join_banks`: images are taken in the first bank and predicted by the second.
        starts: (E, 2) scenes and first views.
        steps: moves T, fewer than there are views.
    """
    M = len(joined.sphere) // 2
    views = starts[:, 1:]
    for _ in range(steps):
        chosen = []
        for scene, path in zip(starts[:, 0], views, strict=True):
            free = np.setdiff1d(np.arange(M), path)
            predicted = np.column_stack([np.tile(path, (len(free), 1)), M + free])
            chosen.append(free[worth(joined, np.full(len(free), scene), predicted).argmax()])
        views = np.column_stack([views, chosen])
    return views
