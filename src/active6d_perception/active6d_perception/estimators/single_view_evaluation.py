"""Evaluation of an estimator against ground truth: in single views, and after fusing several views."""

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from active6d_core.camera import PinholeCamera, View, project
from active6d_core.hypotheses import Hypotheses
from active6d_core.metrics import DETECTION_FRACTION, add_s, e_add, evaluate_scene, mspd, mssd
from active6d_core.object_model import ObjectModel
from active6d_core.se3 import invert, rotation_angle
from active6d_perception.estimators.registry import Estimator
from active6d_perception.scene.best_view_fusion import BestViewFusion
from active6d_perception.scene.fusion_parameters import FusionParameters
from active6d_perception.scene.verification import Verifier

#: A hypothesis and a true object are compared if their origins are closer than this, in diameters...
_NEAR = 0.5
#: ...or appear closer than this, as a share of the image width. BOP's largest thresholds are these values.
_NEAR_IN_IMAGE = 60.0 / 640.0


@dataclass(frozen=True, eq=False)
class LabelledView:
    """A view with ground truth.

    Attributes:
        view: input of the estimator.
        T_world_object: (n, 4, 4) true poses, metres.
        visible_fraction: (n,) share in [0, 1] of each object's silhouette that this view shows.
        feature_seen: (n,) share of the surface of the object's named parts that this view shows, NaN without parts.
    """

    view: View
    T_world_object: np.ndarray
    visible_fraction: np.ndarray
    feature_seen: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class ViewResult:
    """Result in one view: n true objects, k hypotheses, and the errors of p pairs that are near each other.

    All other pairs are wrong at every threshold in use.

    Attributes:
        visible_fraction: (n,) of each true object.
        feature_seen: (n,) see :class:`LabelledView`.
        score: (k,) score of the estimator.
        certainty: (k,) probability that the rotation about the axis is right, NaN if the estimator does not report it.
        verification: (k,) verification score (equation 1).
        hypothesis: (p,) index of the pair's hypothesis.
        object: (p,) index of the pair's true object.
        add: (p,) ADD, least over the symmetries, metres.
        adds: (p,) ADD-S, metres.
        mssd: (p,) metres.
        mspd: (p,) pixels.
        rotation: (p,) angle between the orientations, least over the symmetries, degrees.
        width: image width in pixels.
        seconds: wall-clock time of the estimator.
        cpu_seconds: CPU time of all threads of this process meanwhile.
        stage_ms: milliseconds of each stage, empty if the estimator does not report them.
    """

    visible_fraction: np.ndarray
    feature_seen: np.ndarray
    score: np.ndarray
    certainty: np.ndarray
    verification: np.ndarray
    hypothesis: np.ndarray
    object: np.ndarray
    add: np.ndarray
    adds: np.ndarray
    mssd: np.ndarray
    mspd: np.ndarray
    rotation: np.ndarray
    width: int
    seconds: float
    cpu_seconds: float
    stage_ms: dict[str, float] = field(default_factory=dict)

    def match(self, error: str, limit: float, candidates: np.ndarray | None = None) -> np.ndarray:
        """One-to-one matching as in BOP: hypotheses by falling score, each takes the nearest object that is still free.

        Args:
            error: name of the attribute with the error.
            limit: pairs match if their error is below this.
            candidates: (n,) int preference of each object, lower first, negative for objects that cannot be matched.

        Returns:
            (k,) index of the matched object, -1 without a match.
        """
        preference = np.zeros(len(self.visible_fraction), int) if candidates is None else candidates
        errors = getattr(self, error)
        usable = np.flatnonzero((errors < limit) & (preference[self.object] >= 0))
        rank = np.empty(len(self.score), int)
        rank[np.argsort(-self.score, kind="stable")] = np.arange(len(self.score))
        keys = errors[usable], preference[self.object[usable]], rank[self.hypothesis[usable]]
        matched, taken = np.full(len(self.score), -1), set()
        for pair in usable[np.lexsort(keys)]:
            hypothesis, found = self.hypothesis[pair], self.object[pair]
            if matched[hypothesis] < 0 and found not in taken:
                matched[hypothesis] = found
                taken.add(found)
        return matched

    def least(self, error: str) -> np.ndarray:
        """(k,) the smallest error of each hypothesis over all objects, ``inf`` without a near object."""
        result = np.full(len(self.score), np.inf)
        np.minimum.at(result, self.hypothesis, getattr(self, error))
        return result


@dataclass(frozen=True, eq=False)
class EstimatorResult:
    """Results of one estimator in all views.

    Attributes:
        diameter: the object's, metres.
        views: result in each view.
    """

    diameter: float
    views: tuple[ViewResult, ...]

    @property
    def limit(self) -> float:
        """Metres; a pose is right if its ADD or ADD-S is below this."""
        return DETECTION_FRACTION * self.diameter

    def gather(self, name: str) -> np.ndarray:
        """An attribute of :class:`ViewResult`, concatenated over all views."""
        return np.concatenate([getattr(view, name) for view in self.views])

    def right(self, by: str = "add") -> np.ndarray:
        """Whether each hypothesis of each view is matched with an object, by ``add`` or ``adds``."""
        return np.concatenate([view.match(by, self.limit) >= 0 for view in self.views])

    def found(self, by: str = "add") -> np.ndarray:
        """Whether each true object of each view is matched with a hypothesis, by ``add`` or ``adds``."""
        matches = [(len(view.visible_fraction), view.match(by, self.limit)) for view in self.views]
        return np.concatenate([np.isin(np.arange(count), matched) for count, matched in matches])

    def detection_rate(self, least_visible: float, by: str = "add") -> float:
        """Share found of the objects visible by at least ``least_visible``, by ``add`` or ``adds``; NaN without any."""
        counted = self.gather("visible_fraction") >= least_visible
        return float(self.found(by)[counted].mean()) if counted.any() else float("nan")


def evaluate_estimator(estimator: Estimator, model: ObjectModel, views: Iterable[LabelledView]) -> EstimatorResult:
    """Run an estimator on single views; they are taken one by one, so that they need not all be in memory."""
    verifier = Verifier(model)
    return EstimatorResult(
        model.diameter, tuple(evaluate_view(estimator, verifier, model, labelled) for labelled in views)
    )


def evaluate_view(estimator: Estimator, verifier: Verifier, model: ObjectModel, labelled: LabelledView) -> ViewResult:
    """Run an estimator on one view and compare its hypotheses with the ground truth."""
    view = labelled.view
    started, cpu_started = time.perf_counter(), time.process_time()
    found = estimator.estimate(view)
    seconds, cpu_seconds = time.perf_counter() - started, time.process_time() - cpu_started
    T_camera_true = invert(view.T_world_camera) @ labelled.T_world_object
    unknown = np.full(len(labelled.visible_fraction), np.nan)
    return ViewResult(
        visible_fraction=np.asarray(labelled.visible_fraction, float),
        feature_seen=unknown if labelled.feature_seen is None else labelled.feature_seen,
        score=found.score,
        certainty=getattr(estimator, "certainty", np.full(len(found), np.nan)),
        verification=verifier.score(view.depth, view.camera, found),
        **_pair_errors(model, found, T_camera_true, view.camera),
        width=view.camera.width,
        seconds=seconds,
        cpu_seconds=cpu_seconds,
        stage_ms=dict(getattr(estimator, "stage_ms", {})),
    )


def _pair_errors(
    model: ObjectModel, found: Hypotheses, T_camera_true: np.ndarray, camera: PinholeCamera
) -> dict[str, np.ndarray]:
    """The attributes of :class:`ViewResult` with one entry per pair."""
    t_est, t_gt = found.T_camera_object[:, :3, 3], T_camera_true[:, :3, 3]
    near = np.linalg.norm(t_est[:, None] - t_gt, axis=-1) < _NEAR * model.diameter
    apart = np.linalg.norm(project(t_est, camera)[:, None] - project(t_gt, camera), axis=-1)
    hypothesis, true = np.nonzero(near | (apart < _NEAR_IN_IMAGE * camera.width))
    pairs = found.T_camera_object[hypothesis], T_camera_true[true]
    symmetric = pairs[1][:, None, :3, :3] @ model.symmetry.rotations()
    return {
        "hypothesis": hypothesis,
        "object": true,
        "add": e_add(model, *pairs),
        "adds": add_s(model, *pairs),
        "mssd": mssd(model, *pairs),
        "mspd": mspd(model, *pairs, camera),
        "rotation": np.degrees(rotation_angle(pairs[0][:, None, :3, :3], symmetric).min(axis=1)),
    }


def detection_over_views(
    estimator: Estimator,
    model: ObjectModel,
    episodes: Iterable[Sequence[LabelledView]],
    parameters: FusionParameters | None = None,
) -> np.ndarray:
    """Detection rate of the fused objects after 1, 2, ... views of each scene.

    Args:
        estimator: gets only :attr:`LabelledView.view`.
        model: the object.
        episodes: e sequences of v views of one scene each.
        parameters: settings of the fusion.

    Returns:
        (e, v) share of the scene's true objects detected (one to one, ADD below 10 % of the diameter).
    """
    verifier = Verifier(model)
    rates: list[list[float]] = []
    for episode in episodes:
        fusion = BestViewFusion(model, parameters)
        rates.append([])
        for labelled in episode:
            view = labelled.view
            found = estimator.estimate(view)
            fusion.add_view(view.stamp, view.T_world_camera, found, verifier.score(view.depth, view.camera, found))
            objects = fusion.objects(view.stamp, view.T_world_camera, view.camera)
            rates[-1].append(evaluate_scene(model, objects.T_world_object, labelled.T_world_object).detection_rate)
    return np.array(rates)
