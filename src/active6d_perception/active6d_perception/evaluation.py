"""How much of a scene an estimator finds in one view, and how much fusion finds after several; needs ground truth."""

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from active6d_core.camera import View
from active6d_core.metrics import DETECTION_FRACTION, add_s, e_add, evaluate_scene
from active6d_core.object_model import ObjectModel
from active6d_core.se3 import invert
from active6d_perception.estimator import Estimator
from active6d_perception.fusion import FusionParameters, SceneFusion
from active6d_perception.verification import Verifier


@dataclass(frozen=True, eq=False)
class LabelledView:
    """A view and what is truly there.

    Attributes:
        view: what the estimator gets.
        T_world_object: (n, 4, 4) true poses, metres.
        visible_fraction: (n,) share of each object's silhouette that this view shows, in [0, 1].
    """

    view: View
    T_world_object: np.ndarray
    visible_fraction: np.ndarray


@dataclass(frozen=True, eq=False)
class EstimatorResult:
    """Over all views: o true objects and k hypotheses.

    Attributes:
        visible_fraction: (o,) of each true object in its view.
        found_add: (o,) bool, a hypothesis is within 10 % of the diameter by e_ADD with symmetries.
        found_adds: (o,) bool, by ADD-S.
        right_add: (k,) bool, a true object is within 10 % of the diameter by e_ADD.
        right_adds: (k,) bool, by ADD-S.
        score: (k,) the estimator's.
        verification: (k,) equation 1.
        seconds: (v,) per view.
    """

    visible_fraction: np.ndarray
    found_add: np.ndarray
    found_adds: np.ndarray
    right_add: np.ndarray
    right_adds: np.ndarray
    score: np.ndarray
    verification: np.ndarray
    seconds: np.ndarray

    def detection_rate(self, least_visible: float, by: str = "add") -> float:
        """Share found of the objects visible by at least that fraction; ``by`` is add or adds. NaN without any."""
        counted = self.visible_fraction >= least_visible
        found = self.found_add if by == "add" else self.found_adds
        return float(found[counted].mean()) if counted.any() else float("nan")


def evaluate_estimator(estimator: Estimator, model: ObjectModel, views: Iterable[LabelledView]) -> EstimatorResult:
    """Run an estimator on single views.

    Args:
        estimator: sees only :attr:`LabelledView.view`.
        model: the object it looks for.
        views: drawn one by one, so that they need not all be in memory.
    """
    verifier = Verifier(model)
    limit = DETECTION_FRACTION * model.diameter
    objects, hypotheses, seconds = [], [], []
    for labelled in views:
        view = labelled.view
        started = time.perf_counter()
        found = estimator.estimate(view)
        seconds.append(time.perf_counter() - started)
        T_camera_true = invert(view.T_world_camera) @ labelled.T_world_object
        pairs = (model, found.T_camera_object[:, None], T_camera_true[None])
        add = e_add(*pairs, cutoff=limit) < limit
        adds = add_s(*pairs, cutoff=limit) < limit
        verification = verifier.score(view.depth, view.camera, found)
        objects.append(np.column_stack([labelled.visible_fraction, add.any(axis=0), adds.any(axis=0)]))
        hypotheses.append(np.column_stack([add.any(axis=1), adds.any(axis=1), found.score, verification]))
    o, h = np.concatenate(objects), np.concatenate(hypotheses)
    return EstimatorResult(
        o[:, 0], o[:, 1] > 0, o[:, 2] > 0, h[:, 0] > 0, h[:, 1] > 0, h[:, 2], h[:, 3], np.array(seconds)
    )


def detection_over_views(
    estimator: Estimator,
    model: ObjectModel,
    episodes: Iterable[Sequence[LabelledView]],
    parameters: FusionParameters | None = None,
) -> np.ndarray:
    """Detection rate of the fused objects after 1, 2, ... views of each scene.

    Args:
        estimator: sees only :attr:`LabelledView.view`.
        model: the object.
        episodes: views of one scene each, all of the same length v.
        parameters: of the fusion.

    Returns:
        (e, v) share of the scene's true objects detected (one to one, e_ADD below 10 % of the diameter).
    """
    verifier = Verifier(model)
    rates = []
    for episode in episodes:
        fusion = SceneFusion(model, parameters)
        rates.append([])
        for labelled in episode:
            view = labelled.view
            found = estimator.estimate(view)
            fusion.add_view(view.stamp, view.T_world_camera, found, verifier.score(view.depth, view.camera, found))
            objects = fusion.objects(view.stamp, view.T_world_camera, view.camera)
            rates[-1].append(evaluate_scene(model, objects.T_world_object, labelled.T_world_object).detection_rate)
    return np.array(rates)
