"""Compares the methods of fusion on the same views of stored scenes."""

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from active6d_core.metrics import DETECTION_FRACTION, MISSED_E_ADD, e_add, score_errors
from active6d_core.registry import AUTOMATIC
from active6d_perception.estimators.detection_rates import area_under_curve, calibration_error
from active6d_perception.scene.all_views_fusion import AllViewsFusion
from active6d_perception.scene.best_view_fusion import BestViewFusion
from active6d_perception.scene.fusion_parameters import FusionParameters
from active6d_tools.processed_scene import RING_VIEWS, ProcessedScene, ProcessedView, add_view

#: The views of an episode: six evenly on a ring at 45 degrees, six at random, or all of the grid.
KINDS = ("ring", "random", "all")


@dataclass(eq=False)
class MethodResults:
    """What one method fused in several episodes.

    Attributes:
        diameter: of the object, metres.
        errors: of each episode, (k, n) ADD of its k reported objects to the n true ones, metres, ``inf`` from 50 mm on.
        probability: of each episode, (k,) of its reported objects.
        milliseconds: for each added view.
    """

    diameter: float
    errors: list[np.ndarray] = field(default_factory=list)
    probability: list[np.ndarray] = field(default_factory=list)
    milliseconds: list[float] = field(default_factory=list)

    def summarise(self, confirmed: float) -> dict[str, float | None]:
        """What counts if objects must have a probability of at least ``confirmed``.

        Returns:
            ``found`` and ``e_add_mm`` of the confirmed objects, ``median_e_add_mm`` of those found, ``wrong`` as a
            share of them and ``confirmed`` per episode. ``found_of_all``, ``wrong_of_all`` and ``reported`` are the
            same of all objects that were reported. ``auc`` and ``calibration_error`` are of the probability, and
            ``ms`` is the median time for a new view.
        """
        limit = DETECTION_FRACTION * self.diameter
        sure = [p >= confirmed for p in self.probability]
        scores = [score_errors(errors[own], self.diameter) for errors, own in zip(self.errors, sure, strict=True)]
        every = [score_errors(errors, self.diameter) for errors in self.errors]
        right = np.concatenate([(errors < limit).any(axis=1) for errors in self.errors])
        found = np.concatenate([score.e_add_mm[score.detected] for score in scores])
        kept, probability = np.concatenate(sure), np.concatenate(self.probability)
        return {
            "found": float(np.mean([score.detection_rate for score in scores])),
            "e_add_mm": float(np.mean([score.mean_e_add_mm for score in scores])),
            "median_e_add_mm": float(np.median(found)) if len(found) else None,
            "wrong": float(1 - right[kept].mean()) if kept.any() else None,
            "confirmed": float(kept.sum() / len(sure)),
            "found_of_all": float(np.mean([score.detection_rate for score in every])),
            "wrong_of_all": float(1 - right.mean()) if len(right) else None,
            "reported": len(right) / len(sure),
            "auc": area_under_curve(probability, right),
            "calibration_error": calibration_error(probability, right),
            "ms": float(np.median(self.milliseconds)),
        }


def compare_methods(
    names: Sequence[str],
    *,
    kinds: Sequence[str] = KINDS[:2],
    episodes: int = 4,
    estimator: str = AUTOMATIC,
    seed: int = 0,
    vary_shapes: bool = False,
    parameters: FusionParameters | None = None,
    on_progress: Callable[[str, int, int], None] = lambda what, done, total: None,
) -> dict[str, dict[str, dict[str, float | None]]]:
    """Fuse the same views by every method.

    Args:
        names: of stored scenes of one object.
        kinds: among :data:`KINDS`.
        episodes: of six views of each kind in each scene; one of all views.
        estimator: name of the deployed one.
        seed: of the views and of the sensor's noise.
        vary_shapes: whether the objects of each scene deviate from the mesh.
        parameters: of the fusion.
        on_progress: called with a scene's name, the number of scenes done and that of all.

    Returns:
        Kind to method to :meth:`MethodResults.summarise`.
    """
    parameters = parameters or FusionParameters()
    results: dict[str, dict[str, MethodResults]] = {kind: {} for kind in kinds}
    for done, name in enumerate(names):
        on_progress(name, done, len(names))
        processed = ProcessedScene(name, estimator, seed=seed, vary_shapes=vary_shapes)
        methods: dict[str, BestViewFusion | AllViewsFusion] = {
            "best-view": BestViewFusion(processed.model, parameters),
            "all-views": AllViewsFusion(processed.model, parameters),
        }
        rng = np.random.default_rng([seed + 1, int(name.split("/")[-1])])
        for kind, views in draw_episodes(processed, kinds, episodes, rng):
            for method, fusion in methods.items():
                result = results[kind].setdefault(method, MethodResults(processed.model.diameter))
                fuse_episode(fusion, views, result, processed)
    return {
        kind: {method: result.summarise(parameters.confirmed) for method, result in own.items()}
        for kind, own in results.items()
    }


def draw_episodes(
    processed: ProcessedScene, kinds: Sequence[str], episodes: int, rng: np.random.Generator
) -> Iterator[tuple[str, list[ProcessedView]]]:
    """The views of ``episodes`` episodes of each kind in a scene, with their kind; one of all views."""
    for kind in kinds:
        for _ in range(1 if kind == "all" else episodes):
            drawn: Iterable[int] = range(len(processed.sphere))
            if kind != "all":
                drawn = processed.pool.draw(RING_VIEWS, ring=kind == "ring", rng=rng)
            yield kind, [processed.view(index) for index in drawn]


def fuse_episode(
    fusion: AllViewsFusion | BestViewFusion,
    views: Sequence[ProcessedView],
    result: MethodResults,
    processed: ProcessedScene,
) -> None:
    """Fuse the views of one episode of a scene from the beginning, and add what came of it to ``result``."""
    fusion.reset()
    few = len(views) <= RING_VIEWS
    for view in views:
        began = time.perf_counter()
        add_view(fusion, view)
        if few or view is views[-1]:
            objects = fusion.objects(view.stamp, view.T_world_camera, view.camera)
            result.milliseconds.append(1e3 * (time.perf_counter() - began))
    errors = e_add(
        processed.model, objects.T_world_object[:, None], processed.scene.T_world_object[None], cutoff=MISSED_E_ADD
    )
    result.errors.append(np.where(errors < MISSED_E_ADD, errors, np.inf))
    result.probability.append(objects.probability)
