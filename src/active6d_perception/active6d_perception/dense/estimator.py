"""The learned estimator: pixel-wise regression of object coordinates (paper, "6D object pose estimation")."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter

import numpy as np
import torch
from scipy.spatial import cKDTree

from active6d_core.camera import View, backproject, normals_from_points
from active6d_core.hypotheses import Hypotheses
from active6d_core.object_model import ObjectModel
from active6d_perception.dense.decoding import TURNS, DecodingParameters, Instances, decode
from active6d_perception.dense.gauge import Turn, turn_about_z
from active6d_perception.dense.network import fused, has_fast_bfloat16
from active6d_perception.dense.network_input import (
    OUTPUT_STRIDE,
    ReducedView,
    network_input,
    output_camera,
    pad,
    pool_depth,
    reduce_view,
    reduction,
)
from active6d_perception.dense.turns import feature_samples, turn_evidence
from active6d_perception.dense.weights_file import TrainedNetwork, load_network, weights_path
from active6d_perception.estimator import register_estimator
from active6d_perception.model_views import model_views
from active6d_perception.refinement import claim_pixels, refine, suppress, weigh_evidence
from active6d_perception.symmetric_distance import SymmetricDistance

# Turns this close to the chosen one count as the same answer when its certainty is told.
_SAME_TURN = np.radians(30.0)
# Share of an object's visible surface below which the unhidden part of it proves little.
_SLIVER = 0.1


@dataclass(frozen=True)
class DenseParameters:
    """Settings of :class:`DenseEstimator`.

    Attributes:
        min_score: hypotheses scoring less are not reported, in [0, 1].
        refined: whether poses are refined against depth.
        alternatives: most hypotheses per instance; more than one only where the turn about the axis is ambiguous.
        decoding: thresholds of decoding the network's answer.

    Raises:
        ValueError: a value is out of range.
    """

    min_score: float = 0.25
    refined: bool = True
    alternatives: int = 1
    decoding: DecodingParameters = field(default_factory=DecodingParameters)

    def __post_init__(self) -> None:
        if not 0 <= self.min_score <= 1:
            raise ValueError(f"dense estimator: min_score must be in [0, 1], got {self.min_score}")
        if self.alternatives < 1:
            raise ValueError(f"dense estimator: alternatives must be at least 1, got {self.alternatives}")


@dataclass(frozen=True, eq=False)
class Poses:
    """k scored poses of one view.

    Attributes:
        T_camera_object: (k, 4, 4).
        score: (k,) in [0, 1].
        instance: (k,) which instance; several poses of one are alternatives.
        certainty: (k,) probability of the pose's turn about the axis among all turns, 1 where it cannot be mistaken.
    """

    T_camera_object: np.ndarray
    score: np.ndarray
    instance: np.ndarray
    certainty: np.ndarray

    def take(self, index: np.ndarray) -> "Poses":
        """The poses at ``index``, in that order."""
        return Poses(self.T_camera_object[index], self.score[index], self.instance[index], self.certainty[index])


class DenseEstimator:
    """Network, instances from votes, robust rigid fits, visible-surface ICP, judgement by the depth image.

    Attributes:
        stage_ms: duration of each stage of the last view, milliseconds.
    """

    def __init__(self, model: ObjectModel, trained: TrainedNetwork, parameters: DenseParameters | None = None) -> None:
        self.model = model
        self.parameters = parameters or DenseParameters()
        self.stage_ms: dict[str, float] = {}
        self._trained = trained
        self._precision = torch.bfloat16 if has_fast_bfloat16() else torch.float32
        self._network = fused(trained.network).to(dtype=self._precision, memory_format=torch.channels_last)
        self._views = model_views(model)
        self._distance = SymmetricDistance(model)
        samples = model.surface[0]
        masks = [model.feature_mask(feature, samples) for feature in model.features]
        self._part = feature_samples(samples, np.any(masks, axis=0)) if masks else np.zeros((0, 3))

    def estimate(self, view: View) -> Hypotheses:
        """See :meth:`active6d_perception.estimator.Estimator.estimate`."""
        self.stage_ms = {}
        reduced = self._timed("input", reduce_view, view)
        poses, label = self.locate(reduced)
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

    def locate(self, view: ReducedView) -> tuple[Poses, np.ndarray]:
        """Poses in a reduced view, best first, and its (h, w) label image: 1 + ``Poses.instance``, 0 for none."""
        answer = self._timed("network", self.ask, view)
        depth = pool_depth(view.depth, OUTPUT_STRIDE)
        instances = self._timed(
            "decoding",
            decode,
            answer,
            depth,
            output_camera(view.camera),
            self._trained.gauge,
            self.model.diameter,
            self.parameters.decoding,
        )
        if not len(instances):
            nothing = np.zeros(0)
            return Poses(np.zeros((0, 4, 4)), nothing, nothing.astype(int), nothing), np.zeros(
                view.depth.shape, np.uint16
            )
        poses = self._timed("turns", self._choose_turns, instances, view)
        return self._timed("refinement", self._refine_and_judge, poses, instances, view)

    def ask(self, view: ReducedView) -> np.ndarray:
        """(channels, h, w) answer of the network."""
        tensor = torch.from_numpy(pad(network_input(view, self.model.diameter)))[None]
        with torch.inference_mode():
            inputs = tensor.to(dtype=self._precision, memory_format=torch.channels_last)
            answer = self._network(inputs)[0].float()
        height, width = (size // OUTPUT_STRIDE for size in view.depth.shape)
        return answer[:, :height, :width].contiguous().numpy()

    def _choose_turns(self, instances: Instances, view: ReducedView) -> Poses:
        """The most likely turn of each instance, and further ones where they are wanted and possible."""
        gauge = self._trained.gauge
        count = len(instances)
        score = instances.agreement * instances.confidence
        if gauge.turn is not Turn.TOLD_BY_FEATURE:
            return Poses(gauge.object_pose(instances.T_camera_axis), score, np.arange(count), np.ones(count))
        turned = instances.T_camera_axis[:, None] @ turn_about_z(TURNS)
        T_camera_object = gauge.object_pose(turned)
        evidence = turn_evidence(T_camera_object, self._part, view.depth, view.camera)
        likelihood = instances.turn * np.exp(evidence - evidence.max(axis=1, keepdims=True))
        likelihood /= np.maximum(likelihood.sum(axis=1, keepdims=True), 1e-12)
        chosen, certainty = [], []
        for _ in range(self.parameters.alternatives):
            best = likelihood.argmax(axis=1)
            near = np.abs((TURNS - TURNS[best][:, None] + np.pi) % (2 * np.pi) - np.pi) < _SAME_TURN
            chosen.append(best)
            certainty.append((likelihood * near).sum(axis=1))
            likelihood = np.where(near, 0.0, likelihood)
        certainty = np.concatenate(certainty)
        instance = np.tile(np.arange(count), self.parameters.alternatives)
        poses = Poses(T_camera_object[instance, np.concatenate(chosen)], score[instance], instance, certainty)
        return poses.take(np.flatnonzero((np.arange(len(certainty)) < count) | (certainty > 0.2)))

    def _refine_and_judge(self, poses: Poses, instances: Instances, view: ReducedView) -> tuple[Poses, np.ndarray]:
        # The reduced depth is a mean of pixels already; smoothing it more rounds edges off and lets poses slide.
        depth = view.depth
        points = backproject(depth, view.camera)
        normals = normals_from_points(points, reach=1)
        T = poses.T_camera_object
        candidates = self._object_pixels(instances, view) & np.isfinite(depth)
        usable = candidates & np.isfinite(normals).all(axis=-1)
        if self.parameters.refined and usable.sum() > 6:
            T = refine(self._views, T, cKDTree(points[usable]), normals[usable])
        evidence = weigh_evidence(self._views, T, depth, normals, view.camera)
        # Of the surface that nothing hides, how much is measured where it should be; a sliver is weak evidence.
        fit = np.clip(evidence.fitting - evidence.violated, 0.0, 1.0) / np.maximum(1.0 - evidence.occluded, _SLIVER)
        # An instance is there whichever way it is turned, so an unknown turn halves the score at most.
        score = np.sqrt(fit * poses.score) * 0.5 * (1.0 + poses.certainty)
        judged = Poses(T, score, poses.instance, poses.certainty)
        return self._report(judged, points, candidates, view)

    def _report(
        self, poses: Poses, points: np.ndarray, candidates: np.ndarray, view: ReducedView
    ) -> tuple[Poses, np.ndarray]:
        """Without duplicates and without poses that score too little or explain no pixels; instances renumbered."""
        distance = self._distance.between(poses.T_camera_object, poses.T_camera_object)
        # Alternatives of one instance are no duplicates unless refinement made them the same.
        rivals = np.where(
            poses.instance[:, None] == poses.instance, distance, np.minimum(distance, self._centres(poses))
        )
        kept = suppress(rivals, poses.score, 0.15 * self.model.diameter)
        poses = poses.take(kept[poses.score[kept] >= self.parameters.min_score])
        _, first = np.unique(poses.instance, return_index=True)
        first = np.sort(first)
        label = claim_pixels(self._views, poses.T_camera_object[first], points, candidates, view.camera, min_pixels=8)
        seen = np.unique(label[label > 0]).astype(int) - 1
        number = np.full(poses.instance.max(initial=0) + 1, -1)
        number[poses.instance[first[seen]]] = np.arange(len(seen))
        relabel = np.zeros(len(first) + 1, np.uint16)
        relabel[seen + 1] = np.arange(1, len(seen) + 1)
        poses = poses.take(np.flatnonzero(number[poses.instance] >= 0))
        renumbered = Poses(poses.T_camera_object, poses.score, number[poses.instance], poses.certainty)
        return renumbered, relabel[label]

    def _centres(self, poses: Poses) -> np.ndarray:
        """(k, k) distances between the axis frames' origins, metres."""
        origin = (poses.T_camera_object @ self._trained.gauge.T_object_axis)[:, :3, 3]
        return np.linalg.norm(origin[:, None] - origin, axis=-1)

    @staticmethod
    def _object_pixels(instances: Instances, view: ReducedView) -> np.ndarray:
        """(h, w) bool at the input's resolution: pixels of any instance."""
        height, width = view.depth.shape
        coarse = np.zeros((height // OUTPUT_STRIDE, width // OUTPUT_STRIDE), bool)
        coarse.ravel()[instances.pixel] = True
        fine = np.zeros((height, width), bool)
        enlarged = coarse.repeat(OUTPUT_STRIDE, axis=0).repeat(OUTPUT_STRIDE, axis=1)
        fine[: enlarged.shape[0], : enlarged.shape[1]] = enlarged
        return fine

    def _timed(self, stage: str, function: Callable, *arguments):
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
    """Factory; ``weights`` is a ``.safetensors`` file, by default the shipped one of the object.

    Raises:
        ValueError: the weights are missing, damaged or of another object.
    """
    path = Path(weights) if weights else weights_path(model.name)
    return DenseEstimator(
        model, load_network(path, model), DenseParameters(min_score=min_score, alternatives=alternatives)
    )
