"""How well and how fast estimators find objects in single views of stored scenes, and how much fusion adds."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import islice
from typing import Any

import numpy as np

from active6d_core.object_model import ObjectModel, load_object
from active6d_core.view_sphere import ViewSphere
from active6d_perception.estimator import create_estimator
from active6d_perception.evaluation import EstimatorResult, LabelledView, detection_over_views, evaluate_estimator
from active6d_sim.scene import Scene
from active6d_sim.scene_store import SPLITS, load_scene
from active6d_sim.sensor import SensorNoise
from active6d_sim.simulator import Simulator

#: Visible fractions from which on objects are counted.
VISIBLE = (0.5, 0.1)
OnProgress = Callable[[str, int, int], None]


def measure_estimators(
    object_name: str,
    split: str,
    estimators: Sequence[str],
    *,
    sample: int | None = None,
    moves: int = 5,
    seed: int = 0,
    noise: float = 1.0,
    on_progress: OnProgress = lambda what, done, total: None,
) -> dict[str, Any]:
    """Run estimators on the same views of stored scenes.

    Args:
        object_name: what is in the bins.
        split: of the stored scenes.
        estimators: their names.
        sample: number of (scene, view) pairs drawn by ``seed``; None takes every view of every scene.
        moves: views after the first in one random walk a scene, for what fusion finds; 0 leaves that out.
        seed: of the sample, the walks and the sensor's noise.
        noise: factor on the sensor's noise; 0 switches it off.
        on_progress: called with what is being done, and how much of it is done.

    Returns:
        The table that ``active6d benchmark estimator --json`` writes.

    Raises:
        ValueError: a name or the split is not known.
    """
    if split not in SPLITS:
        raise ValueError(f"unknown split '{split}'; known: {', '.join(SPLITS)}")
    model = load_object(object_name)
    made = {name: create_estimator(name, model) for name in estimators}
    scenes = [load_scene(object_name, split, index) for index in range(SPLITS[split])]
    rng = np.random.default_rng(seed)
    grid = len(ViewSphere())
    pairs = [(scene, view) for scene in range(len(scenes)) for view in range(grid)]
    if sample is not None and sample < len(pairs):
        pairs = [pairs[i] for i in sorted(rng.choice(len(pairs), sample, replace=False))]
    walks = [[(scene, int(view)) for view in rng.permutation(grid)[: moves + 1]] for scene in range(len(scenes))]
    views = _Views(scenes, seed, noise)
    results = {}
    for name, estimator in made.items():
        drawn = views.of(pairs, partial(on_progress, name))
        results[name] = summarise(model, evaluate_estimator(estimator, model, drawn))
        if moves:
            walked = views.of([pair for walk in walks for pair in walk], partial(on_progress, f"{name}, fused"))
            episodes = (list(islice(walked, moves + 1)) for _ in walks)
            results[name]["fused"] = detection_over_views(estimator, model, episodes).mean(axis=0).tolist()
    return {
        "object": object_name,
        "split": split,
        "views": len(pairs),
        "seed": seed,
        "noise": noise,
        "estimators": results,
    }


def summarise(model: ObjectModel, result: EstimatorResult) -> dict[str, Any]:
    """Rates by visible fraction, precision and time of one estimator.

    ``precision`` counts ADD-S for an object with a part that can hide (the mug's handle): a view may not tell it.
    """
    by = "adds" if model.features else "add"
    precision = {kind: _mean(right) for kind, right in (("add", result.right_add), ("adds", result.right_adds))}
    return {
        **{kind: {str(least): _rate(result, least, kind) for least in VISIBLE} for kind in ("add", "adds")},
        "precision": precision[by],
        "precision_add": precision["add"],
        "precision_adds": precision["adds"],
        "hypotheses_per_view": len(result.score) / len(result.seconds),
        "ms_median": 1e3 * float(np.median(result.seconds)),
    }


def _rate(result: EstimatorResult, least_visible: float, by: str) -> float | None:
    rate = result.detection_rate(least_visible, by)
    return rate if np.isfinite(rate) else None


def _mean(right: np.ndarray) -> float | None:
    return float(right.mean()) if len(right) else None


class _Views:
    """Captures views of stored scenes; keeps one scene's simulator at a time, since each holds its triangles."""

    def __init__(self, scenes: list[Scene], seed: int, noise: float) -> None:
        self._scenes = scenes
        self._seed = seed
        self._noise = SensorNoise().scaled(noise)
        self._current: tuple[int, Simulator] | None = None

    def of(self, pairs: Sequence[tuple[int, int]], on_view: Callable[[int, int], None]) -> Iterator[LabelledView]:
        """The views of (scene, view) pairs, one by one."""
        sphere = ViewSphere()
        for done, (index, number) in enumerate(pairs):
            on_view(done + 1, len(pairs))
            if self._current is None or self._current[0] != index:
                self._current = index, Simulator(self._scenes[index], noise=self._noise, seed=self._seed)
            scene = self._scenes[index]
            view = self._current[1].capture(sphere.pose(sphere.positions[number]), (number + 1) * 1_000_000_000)
            yield LabelledView(view, scene.T_world_object, scene.visible_fraction[number])
