"""Fits the weights of fusion: episodes on stored scenes with the deployed estimator, scored by the true poses."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from active6d_agent.bank.all_views_lookup import AllViewsLookup
from active6d_agent.bank.scene_bank import SceneBank
from active6d_core.interrupts import worker_pool
from active6d_core.metrics import DETECTION_FRACTION, e_add
from active6d_core.registry import AUTOMATIC
from active6d_perception.scene.all_views_fusion import AllViewsFusion
from active6d_perception.scene.belief_training import LabelledPlaces, fit_belief, fit_probability, label_places
from active6d_perception.scene.belief_weights import BeliefWeights
from active6d_sim.scenes.scene_store import scene_path, stored_names
from active6d_tools.processed_scene import ProcessedScene, ProcessedView, add_view

#: Scenes to fit the belief to, and scenes to fit the probability to, which are others: a belief is too sure of the
#: scenes that it was fitted to.
BELIEF_SPLIT, PROBABILITY_SPLITS = "train", ("val", "wild_val")
# Views per episode, in turn.
_VIEWS = (6, 2, 6, 3, 6, 1, 6, 10, 6, 4, 6, 20)


def fit_fusion(
    objects: Sequence[str],
    *,
    episodes: int = 24,
    scenes: int | None = None,
    estimator: str = AUTOMATIC,
    workers: int = 1,
    seed: int = 0,
    on_scene: Callable[[str], None] = lambda name: None,
) -> tuple[BeliefWeights, dict[str, Any]]:
    """Fit weights to the scenes of one or several objects.

    Args:
        objects: their names.
        episodes: per scene.
        scenes: largest number of scenes per split; None for all.
        estimator: name of the deployed one.
        workers: processes.
        seed: of views and of the sensor's noise.
        on_scene: called with the name of each scene that is done.

    Returns:
        The weights, and what was measured: numbers of places and of objects, and the share of right objects.
    """
    common: dict[str, Any] = {"episodes": episodes, "estimator": estimator, "seed": seed}
    labelled, described = [], []
    fitted, checked = (_names(objects, splits, scenes) for splits in ((BELIEF_SPLIT,), PROBABILITY_SPLITS))
    for name, found in _in_processes(partial(label_scene, **common), fitted, workers):
        labelled += found
        on_scene(name)
    rotation, body = fit_belief(labelled, seed)
    weights = replace(BeliefWeights.indifferent(), rotation=rotation, body=body)
    describe = partial(describe_scene, weights=weights, **common)
    for name, rows in _in_processes(describe, checked, workers):
        described.append(rows)
        on_scene(name)
    table = np.concatenate(described)
    right = table[:, -1] > 0
    measured = {
        "places": int(sum(episode.place.max(initial=-1) + 1 for episode in labelled)),
        "fused_objects": len(right),
        "right": float(right.mean()),
    }
    counts = {"belief_scenes": len(fitted), "probability_scenes": len(checked)}
    provenance = {"objects": list(objects), **common, **counts, **measured}
    return BeliefWeights(rotation, body, fit_probability(table[:, :-1], right), provenance), measured


def refit_probability(
    weights: BeliefWeights, banks: Sequence[SceneBank], *, episodes: int = 24, seed: int = 0
) -> tuple[BeliefWeights, dict[str, Any]]:
    """Fit only the probability, to scenes of banks that the belief was not fitted to.

    Args:
        weights: whose belief is kept.
        banks: of one object, with evidence; scenes of the train split are left out.
        episodes: per scene, of random views.
        seed: of the views.

    Returns:
        The weights, and what was measured: numbers of scenes and of objects, and the share of right objects.

    Raises:
        ValueError: a bank has no evidence, or there is no other scene.
    """
    rows, right, names = [], [], []
    # Objects are suppressed by their probability. An earlier fit must not decide which ones the new fit sees.
    belief = replace(weights, probability=BeliefWeights.indifferent().probability)
    for bank in banks:
        lookup = AllViewsLookup(bank, weights=belief)
        for index, scene in enumerate(bank.scenes):
            if scene.name.split("/")[1] == BELIEF_SPLIT:
                continue
            names.append(scene.name)
            rng = np.random.default_rng([seed, int(scene.name.split("/")[-1])])
            draws = (rng.choice(len(lookup.sphere), _VIEWS[e % len(_VIEWS)], replace=False) for e in range(episodes))
            described, found = zip(*(lookup.describe_fused(index, views) for views in draws), strict=True)
            rows += described
            right += found
    if not names:
        raise ValueError(f"the banks have only scenes of the split {BELIEF_SPLIT}, to which the belief was fitted")
    correct = np.concatenate(right)
    measured = {"probability_scenes": len(names), "fused_objects": len(correct), "right": float(correct.mean())}
    provenance = {**weights.provenance, **measured, "probability_from": "banks", "probability_seed": seed}
    probability = fit_probability(np.concatenate(rows), correct)
    return replace(weights, probability=probability, provenance=provenance), measured


def count_scenes(objects: Sequence[str], scenes: int | None) -> int:
    """How many scenes :func:`fit_fusion` looks at."""
    return len(_names(objects, (BELIEF_SPLIT, *PROBABILITY_SPLITS), scenes))


def _names(objects: Sequence[str], splits: Sequence[str], scenes: int | None) -> list[str]:
    """Names of the stored scenes; an object need not have wild ones."""
    return [
        scene
        for name in objects
        for split in splits
        if scene_path(name, split, 0).is_file() or not split.startswith("wild")
        for scene in stored_names(name, split, scenes)
    ]


def _in_processes(work: Callable[[str], Any], names: Sequence[str], workers: int) -> Iterator[tuple[str, Any]]:
    """Results in the order of the names, so that they do not depend on the speed of the processes."""
    with worker_pool(max(1, min(workers, len(names)))) as pool:
        yield from zip(names, pool.map(work, names), strict=True)


def label_scene(name: str, *, episodes: int, estimator: str, seed: int) -> list[LabelledPlaces]:
    """The places of each episode on a scene, with their right poses; runs in its own process."""
    weights, labelled = BeliefWeights.indifferent(), []
    for fusion, _, T_world_object in _episodes(name, weights, episodes, estimator, seed):
        labelled.append(label_places(fusion.evidence(), fusion.ambiguity.model, T_world_object))
    return labelled


def describe_scene(name: str, *, weights: BeliefWeights, episodes: int, estimator: str, seed: int) -> np.ndarray:
    """(n, columns + 1) descriptions of the objects of each episode on a scene, and 1 for those that are right."""
    rows = []
    for fusion, last, T_world_object in _episodes(name, weights, episodes, estimator, seed):
        model = fusion.ambiguity.model
        described = fusion.describe(last.stamp, last.T_world_camera, last.camera)
        limit = DETECTION_FRACTION * model.diameter
        errors = e_add(model, described.objects.T_world_object[:, None], T_world_object, cutoff=limit)
        right = (errors < limit).any(axis=1)
        rows.append(np.column_stack([described.description, right]))
    return np.concatenate(rows)


def _episodes(
    name: str, weights: BeliefWeights, episodes: int, estimator: str, seed: int
) -> Iterator[tuple[AllViewsFusion, ProcessedView, np.ndarray]]:
    """Fusion after each episode's views, its last view, and the true poses."""
    processed = ProcessedScene(name, estimator, seed=seed)
    # The poses of the simulated camera are right.
    fusion = AllViewsFusion(processed.model, weights=weights, align=False)
    rng = np.random.default_rng([seed, int(name.split("/")[-1])])
    for episode in range(episodes):
        fusion.reset()
        for index in processed.pool.draw(_VIEWS[episode % len(_VIEWS)], ring=episode % 4 == 0, rng=rng):
            view = processed.view(index)
            add_view(fusion, view)
        yield fusion, view, processed.scene.T_world_object
