"""The learned estimator: pixel-wise regression and depth registration (paper, "6D object pose estimation")."""

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from time import perf_counter
from typing import Any, TypeVar

import numpy as np
import torch
from scipy.special import softmax

from active6d_core.camera import View, pool_depth
from active6d_core.hypotheses import Hypotheses
from active6d_core.object_model import ObjectModel
from active6d_perception.estimators.dense.axis_rotation import AxisRotationSearch
from active6d_perception.estimators.dense.canonical_frame import AXIS_ANGLES, AxisRotation, rotation_about_z
from active6d_perception.estimators.dense.decoding import (
    DecodingParameters,
    Instances,
    axis_rotation_probability,
    decode,
)
from active6d_perception.estimators.dense.measured_surface import MeasuredSurface
from active6d_perception.estimators.dense.network import fused, has_fast_bfloat16
from active6d_perception.estimators.dense.network_input import (
    OUTPUT_STRIDE,
    network_input,
    output_camera,
    pad,
    reduce_view,
    reduction,
)
from active6d_perception.estimators.dense.orientation_search import OrientationSearch
from active6d_perception.estimators.dense.trained_network import SCORE_FEATURES, TrainedNetwork, load_network
from active6d_perception.estimators.refinement import claim_pixels, refine, weigh_evidence
from active6d_perception.estimators.registry import register_estimator, weights_path
from active6d_perception.estimators.score_model import ScoreModel
from active6d_perception.model.model_views import model_views
from active6d_perception.model.symmetric_distance import SymmetricDistance
from active6d_perception.suppression import suppress

_Result = TypeVar("_Result")

# Rotations about the axis this close to the chosen one count towards its certainty.
_SAME_ROTATION = np.radians(30.0)
# Rounds of (orientations refined per instance, gates in metres), where the whole surface shows the orientation. The
# second round takes the best of the first, with smaller gates. Votes for centres of slivers are 20 mm off.
_TRIED_ORIENTATIONS = ((20, (0.02,)), (12, (0.012, 0.008)))
# A further rotation of an instance about its axis is reported only if it is at least this likely.
_LEAST_CERTAINTY = 0.1
# Exponent of the network's distribution of the rotation, relative to the likelihood of the depth image.
_NETWORK_TRUST = 0.6
_GATES = (0.008, 0.004)  # metres, of refinement
_ITERATIONS = 3  # of refinement with each gate; more change nothing on the validation views
_SAMPLES = 192  # of the model's surface, in refinement
# The probability that an instance is there and its body is right, for networks whose score was not fitted. Fitted ones
# have their regression beside the weights (active6d_tools.score_fitting).
_UNFITTED_SCORE = ScoreModel(SCORE_FEATURES, np.array([14.0, -14.0, 0.0, 0.0]), -0.8)


@dataclass(frozen=True)
class DenseParameters:
    """Settings of :class:`DenseEstimator`.

    Attributes:
        min_score: instances less probable than this are not reported, however certain their rotation; in [0, 1].
        refined: whether poses are refined against depth.
        alternatives: largest number of hypotheses per instance; there are several only if the rotation is ambiguous.
        decoding: thresholds of decoding the network's output.

    Raises:
        ValueError: a value is out of range.
    """

    min_score: float = 0.15
    refined: bool = True
    alternatives: int = 1
    decoding: DecodingParameters = field(default_factory=DecodingParameters)

    def __post_init__(self) -> None:
        if not 0 <= self.min_score <= 1:
            raise ValueError(f"min_score must be in [0, 1], got {self.min_score}")
        if self.alternatives < 1:
            raise ValueError(f"alternatives must be at least 1, got {self.alternatives}")


@dataclass(frozen=True, eq=False)
class Poses:
    """k scored poses of one view.

    Attributes:
        T_camera_object: (k, 4, 4) poses in the optical frame, metres.
        score: (k,) probability that the pose is right: that the instance is there, times the certainty.
        instance: (k,) index of the instance; several poses of one instance are alternatives.
        certainty: (k,) posterior probability of the rotation about the axis, 1 where it is not ambiguous.
        features: (k, f) regressors of the probability that the instance is there, :data:`.SCORE_FEATURES`.
    """

    T_camera_object: np.ndarray
    score: np.ndarray
    instance: np.ndarray
    certainty: np.ndarray
    features: np.ndarray

    def take(self, index: np.ndarray) -> "Poses":
        """The poses at ``index``, in that order."""
        return Poses(*(getattr(self, item.name)[index] for item in fields(self)))


def likely_axis_rotations(probability: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The most likely rotations of each instance about its axis, at least 30 degrees apart.

    Args:
        probability: (n, len(AXIS_ANGLES)) rows that sum to 1.
        count: number of rotations per instance.

    Returns:
        (n, count) indices into :data:`AXIS_ANGLES`, and (n, count) the probability within 30 degrees of each.
    """
    chosen, certainty = [], []
    for _ in range(count):
        best = probability.argmax(axis=1)
        near = np.abs((AXIS_ANGLES - AXIS_ANGLES[best][:, None] + np.pi) % (2 * np.pi) - np.pi) < _SAME_ROTATION
        chosen.append(best)
        certainty.append((probability * near).sum(axis=1))
        probability = np.where(near, 0.0, probability)
    return np.stack(chosen, axis=1), np.stack(certainty, axis=1)


class DenseEstimator:
    """Estimates poses by a network, votes for centres, visible-surface ICP, and scores from the depth image.

    Attributes:
        stage_ms: duration of each stage of the last view, milliseconds.
        certainty: (k,) :attr:`Poses.certainty` of the hypotheses of the last view.
    """

    def __init__(self, model: ObjectModel, trained: TrainedNetwork, parameters: DenseParameters | None = None) -> None:
        self.model = model
        self.parameters = parameters or DenseParameters()
        self.stage_ms: dict[str, float] = {}
        self.certainty = np.zeros(0)
        self._trained = trained
        self._precision = torch.bfloat16 if has_fast_bfloat16() else torch.float32
        network: Any = fused(trained.network)  # torch's hints do not know the memory format of a module
        self._network = network.to(dtype=self._precision, memory_format=torch.channels_last)
        self._views = model_views(model)
        self._distance = SymmetricDistance(model)
        shown = trained.canonical_frame.axis_rotation
        by_feature = shown is AxisRotation.SHOWN_BY_FEATURE
        self._axis_rotations = AxisRotationSearch(model, trained.canonical_frame) if by_feature else None
        self._orientations = OrientationSearch(model) if shown is AxisRotation.VISIBLE else None

    def estimate(self, view: View) -> Hypotheses:
        """See :meth:`active6d_perception.estimators.registry.Estimator.estimate`."""
        self.stage_ms = {}
        reduced = self._timed("input", reduce_view, view)
        poses, label = self.locate(reduced)
        self.certainty = poses.certainty
        if not len(poses.score):
            return Hypotheses.empty(view.camera.height, view.camera.width)
        factor = reduction(view.camera)
        segmentation = np.zeros(view.depth.shape, np.uint16)
        enlarged = label.repeat(factor, axis=0).repeat(factor, axis=1)
        segmentation[: enlarged.shape[0], : enlarged.shape[1]] = enlarged
        return self._timed(
            "masks",
            Hypotheses.from_masks,
            poses.T_camera_object,
            poses.score,
            poses.instance + 1,
            segmentation,
            view.depth,
        )

    def locate(self, view: View) -> tuple[Poses, np.ndarray]:
        """Find poses in a view at the network's resolution, see :func:`.reduce_view`.

        Returns:
            The poses, best first, and the (h, w) uint16 label image: 1 + ``Poses.instance``, 0 for none.
        """
        answer = self._timed("network", self.ask, view)
        depth = pool_depth(view.depth, OUTPUT_STRIDE)
        instances = self._timed(
            "decoding",
            decode,
            answer,
            depth,
            output_camera(view.camera),
            self._trained.canonical_frame,
            self.model.diameter,
            self.parameters.decoding,
        )
        if not len(instances):
            nothing, features = np.zeros(0), np.zeros((0, len(SCORE_FEATURES)))
            poses = Poses(np.zeros((0, 4, 4)), nothing, nothing.astype(int), nothing, features)
            return poses, np.zeros(view.depth.shape, np.uint16)
        surface = self._timed("surface", MeasuredSurface.of, view, instances)
        candidates = self._timed("poses", self._find_poses, instances, surface)
        return self._timed("judging", self._judge, *candidates, surface)

    def ask(self, view: View) -> np.ndarray:
        """(channels, h, w) output of the network for a view at its resolution; channels last in memory."""
        tensor = torch.from_numpy(pad(network_input(view, self.model.diameter)))[None]
        with torch.inference_mode():
            inputs = tensor.to(dtype=self._precision, memory_format=torch.channels_last)
            answer = self._network(inputs)[0].float()
        height, width = (size // OUTPUT_STRIDE for size in view.depth.shape)
        return answer[:, :height, :width].numpy()

    def _find_poses(self, instances: Instances, surface: MeasuredSurface) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(k, 4, 4) refined ``T_camera_object``, and (k,) instance and certainty of each, likely ones first."""
        canonical_frame, T = self._trained.canonical_frame, instances.T_camera_axis
        if canonical_frame.axis_rotation is AxisRotation.INVISIBLE:
            return self._refined(canonical_frame.object_pose(T), surface, _GATES), np.arange(len(T)), np.ones(len(T))
        if canonical_frame.axis_rotation is AxisRotation.VISIBLE:
            return self._best_fitting_orientations(instances, surface)
        # The network's estimate of the rotation serves to refine the axis, and the axis to find the rotation.
        probability = axis_rotation_probability(T, instances.direction)
        T = T @ rotation_about_z(AXIS_ANGLES[probability.argmax(axis=1)])
        T = self._refined(canonical_frame.object_pose(T), surface, _GATES[:1]) @ canonical_frame.T_object_axis
        chosen, certainty = likely_axis_rotations(
            self._axis_rotation_probability(T, instances, surface), self.parameters.alternatives
        )
        instance, rank = np.nonzero((np.arange(chosen.shape[1]) == 0) | (certainty > _LEAST_CERTAINTY))
        T = canonical_frame.object_pose(T[instance] @ rotation_about_z(AXIS_ANGLES[chosen[instance, rank]]))
        return self._refined(T, surface, _GATES[1:]), instance, certainty[instance, rank]

    def _best_fitting_orientations(
        self, instances: Instances, surface: MeasuredSurface
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As :meth:`_find_poses`, where the whole surface shows the orientation: the best fitting of several."""
        count = len(instances)
        assert self._orientations is not None, "made where the whole surface shows the orientation"
        T = self._orientations.candidates(instances, surface, _TRIED_ORIENTATIONS[0][0])
        for number, gates in _TRIED_ORIENTATIONS:
            T = self._refined(T[:, :number].reshape(-1, 4, 4), surface, gates, iterations=2, samples=64)
            fit = self._fit(T, surface).reshape(count, number)
            best_first = np.argsort(-fit, axis=1, kind="stable")
            T = np.take_along_axis(T.reshape(count, number, 4, 4), best_first[..., None, None], axis=1)
        return self._refined(T[:, 0], surface, _GATES[1:]), np.arange(count), np.ones(count)

    def _axis_rotation_probability(self, T: np.ndarray, instances: Instances, surface: MeasuredSurface) -> np.ndarray:
        """(n, len(AXIS_ANGLES)) posterior of the rotation about the axis, from network and depth image."""
        assert self._axis_rotations is not None, "made where a part shows the rotation"
        measured = self._axis_rotations.log_likelihood(T, surface)
        predicted = _NETWORK_TRUST * np.log(axis_rotation_probability(T, instances.direction) + 1e-6)
        return softmax(measured + predicted, axis=1)

    def _refined(
        self,
        T: np.ndarray,
        surface: MeasuredSurface,
        gates: tuple[float, ...],
        iterations: int = _ITERATIONS,
        samples: int = _SAMPLES,
    ) -> np.ndarray:
        if not self.parameters.refined or surface.tree is None:
            return T
        return refine(
            self._views, T, surface.tree, surface.tree_normals, gates=gates, iterations=iterations, samples=samples
        )

    def _fit(self, T_camera_object: np.ndarray, surface: MeasuredSurface) -> np.ndarray:
        """(k,) share of each pose's visible surface that is measured there, less the share that is looked through."""
        evidence = weigh_evidence(self._views, T_camera_object, surface.depth, surface.normals, surface.camera)
        return evidence.fitting - evidence.violated

    def _judge(
        self, T_camera_object: np.ndarray, instance: np.ndarray, certainty: np.ndarray, surface: MeasuredSurface
    ) -> tuple[Poses, np.ndarray]:
        evidence = weigh_evidence(self._views, T_camera_object, surface.depth, surface.normals, surface.camera)
        pixels = np.bincount(surface.owner[surface.owner >= 0], minlength=instance.max(initial=0) + 1)[instance]
        features = np.column_stack(
            [
                evidence.fitting,
                evidence.violated,
                evidence.fitting / np.maximum(1.0 - evidence.occluded, 0.1),
                np.log(np.maximum(pixels, 1)),
            ]
        )
        presence = (self._trained.score or _UNFITTED_SCORE).probability(features)
        return self._report(Poses(T_camera_object, presence * certainty, instance, certainty, features), surface)

    def _report(self, poses: Poses, surface: MeasuredSurface) -> tuple[Poses, np.ndarray]:
        """Drop duplicates, poses with a low score and poses that explain no pixels; renumber the instances."""
        distance = self._distance.between(poses.T_camera_object, poses.T_camera_object)
        # Alternatives of one instance are duplicates only if refinement made them the same.
        rivals = np.where(
            poses.instance[:, None] == poses.instance, distance, np.minimum(distance, self._centres(poses))
        )
        kept = suppress(rivals, poses.score, 0.15 * self.model.diameter)
        poses = poses.take(kept[poses.score[kept] >= self.parameters.min_score * poses.certainty[kept]])
        _, first = np.unique(poses.instance, return_index=True)
        first = np.sort(first)
        label = claim_pixels(
            self._views,
            poses.T_camera_object[first],
            surface.points,
            surface.owner >= 0,
            surface.camera,
            min_pixels=8,
        )
        seen = np.unique(label[label > 0]).astype(int) - 1
        number = np.full(poses.instance.max(initial=0) + 1, -1)
        number[poses.instance[first[seen]]] = np.arange(len(seen))
        relabel = np.zeros(len(first) + 1, np.uint16)
        relabel[seen + 1] = np.arange(1, len(seen) + 1)
        poses = poses.take(np.flatnonzero(number[poses.instance] >= 0))
        return replace(poses, instance=number[poses.instance]), relabel[label]

    def _centres(self, poses: Poses) -> np.ndarray:
        """(k, k) distances between the axis frames' origins, metres."""
        origin = (poses.T_camera_object @ self._trained.canonical_frame.T_object_axis)[:, :3, 3]
        return np.linalg.norm(origin[:, None] - origin, axis=-1)

    def _timed(self, stage: str, function: Callable[..., _Result], *arguments: Any) -> _Result:
        start = perf_counter()
        result = function(*arguments)
        self.stage_ms[stage] = 1e3 * (perf_counter() - start)
        return result


@register_estimator("dense")
def create_dense(
    model: ObjectModel,
    weights: str = "",
    min_score: float = DenseParameters.min_score,
    alternatives: int = DenseParameters.alternatives,
) -> DenseEstimator:
    """Factory of the estimator ``dense``.

    Args:
        model: the object.
        weights: path of a ``.safetensors`` file; the object's shipped weights when empty.
        min_score: see :class:`DenseParameters`.
        alternatives: see :class:`DenseParameters`.

    Raises:
        ValueError: the weights are missing, damaged or of another object.
    """
    path = Path(weights) if weights else weights_path(model.name)
    return DenseEstimator(
        model, load_network(path, model), DenseParameters(min_score=min_score, alternatives=alternatives)
    )
