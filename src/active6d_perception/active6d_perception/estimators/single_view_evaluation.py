"""What an estimator finds of a scene in one view, and fusion after several, next to the truth; needs ground truth."""

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
from active6d_perception.scene.fusion import FusionParameters, SceneFusion
from active6d_perception.scene.verification import Verifier

#: Pairs of a hypothesis and a true object are compared when their origins are closer than this, in diameters...
_NEAR = 0.5
#: ...or appear closer than this, as a share of the image's width: BOP's thresholds end at these values.
_NEAR_IN_IMAGE = 60.0 / 640.0


@dataclass(frozen=True, eq=False)
class LabelledView:
    """A view and what is truly there.

    Attributes:
        view: what the estimator gets.
        T_world_object: (n, 4, 4) true poses, metres.
        visible_fraction: (n,) share of each object's silhouette that this view shows, in [0, 1].
        feature_seen: (n,) share of the surface of the object's named parts that this view shows, NaN where it has none.
    """

    view: View
    T_world_object: np.ndarray
    visible_fraction: np.ndarray
    feature_seen: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class ViewResult:
    """One view: n true objects, k hypotheses, and the errors of p pairs of them that are near each other.

    All other pairs are wrong at every threshold that is in use.

    Attributes:
        visible_fraction: (n,) of each true object.
        feature_seen: (n,) see :class:`LabelledView`.
        score: (k,) the estimator's.
        certainty: (k,) probability that the turn about the axis is right, where the estimator tells it, else NaN.
        verification: (k,) equation 1.
        hypothesis: (p,) int.
        object: (p,) int.
        add: (p,) e_ADD with symmetries, metres.
        adds: (p,) ADD-S, metres.
        mssd: (p,) metres.
        mspd: (p,) pixels.
        rotation: (p,) degrees between the orientations, the least over the symmetries.
        width: of the image, pixels.
        seconds: that the estimator took by the clock.
        cpu_seconds: that all threads of this process worked meanwhile.
        stage_ms: of its stages, where it tells.
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
        """One-to-one matching as in BOP: the best-scored hypothesis first, each takes the nearest object still free.

        Args:
            error: name of an attribute.
            limit: errors from here on are no match.
            candidates: (n,) int preference of each object, lower first, negative for objects that cannot be matched.

        Returns:
            (k,) index of the matched object, -1 without one.
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
        """(k,) the smallest error of each hypothesis over all objects, inf when none is near."""
        result = np.full(len(self.score), np.inf)
        np.minimum.at(result, self.hypothesis, getattr(self, error))
        return result


@dataclass(frozen=True, eq=False)
class EstimatorResult:
    """All views of one estimator.

    Attributes:
        diameter: of the object, metres.
        views: one result each.
    """

    diameter: float
    views: tuple[ViewResult, ...]

    @property
    def limit(self) -> float:
        """Metres below which a pose is right by e_ADD or ADD-S."""
        return DETECTION_FRACTION * self.diameter

    def gather(self, name: str) -> np.ndarray:
        """An attribute of :class:`ViewResult`, of all views in order."""
        return np.concatenate([getattr(view, name) for view in self.views])

    def right(self, by: str = "add") -> np.ndarray:
        """Whether each hypothesis of each view found an object that no better-scored one found; ``by`` add or adds."""
        return np.concatenate([view.match(by, self.limit) >= 0 for view in self.views])

    def found(self, by: str = "add") -> np.ndarray:
        """Whether each true object of each view was found; ``by`` is add or adds."""
        matches = [(len(view.visible_fraction), view.match(by, self.limit)) for view in self.views]
        return np.concatenate([np.isin(np.arange(count), matched) for count, matched in matches])

    def detection_rate(self, least_visible: float, by: str = "add") -> float:
        """Share found of the objects visible by at least that fraction; ``by`` is add or adds. NaN without any."""
        counted = self.gather("visible_fraction") >= least_visible
        return float(self.found(by)[counted].mean()) if counted.any() else float("nan")


def evaluate_estimator(estimator: Estimator, model: ObjectModel, views: Iterable[LabelledView]) -> EstimatorResult:
    """Run an estimator on single views, which are drawn one by one, so that they need not all be in memory."""
    verifier = Verifier(model)
    return EstimatorResult(
        model.diameter, tuple(evaluate_view(estimator, verifier, model, labelled) for labelled in views)
    )


def evaluate_view(estimator: Estimator, verifier: Verifier, model: ObjectModel, labelled: LabelledView) -> ViewResult:
    """Run an estimator on one view and compare what it says with the truth, which it does not see."""
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
    """The attributes of :class:`ViewResult` that are of pairs."""
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
