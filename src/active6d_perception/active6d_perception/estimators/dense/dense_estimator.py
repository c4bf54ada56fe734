"""The learned estimator: pixel-wise regression and depth registration (paper, "6D object pose estimation")."""

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from time import perf_counter
from typing import Any, TypeVar

import numpy as np
import torch
from scipy.special import logit, softmax

from active6d_core.camera import View, pool_depth
from active6d_core.hypotheses import Hypotheses
from active6d_core.object_model import ObjectModel
from active6d_core.rgbd import check_view
from active6d_perception.estimators.dense.axis_rotation import AxisRotationSearch, likely_axis_rotations
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
from active6d_perception.estimators.dense.pose_search import PoseSearch
from active6d_perception.estimators.dense.trained_network import SCORE_FEATURES, TrainedNetwork, load_network
from active6d_perception.estimators.masks import claim_pixels
from active6d_perception.estimators.measured_image import MeasuredImage, measure_image
from active6d_perception.estimators.pose_selection import judge_of, pose_features
from active6d_perception.estimators.registry import register_estimator, weights_path
from active6d_perception.estimators.score_model import ScoreModel
from active6d_perception.model.model_views import model_views
from active6d_perception.model.surface_grid import surface_grid
from active6d_perception.model.symmetric_distance import SymmetricDistance
from active6d_perception.suppression import suppress

_Result = TypeVar("_Result")

# A further rotation of an instance about its axis is reported only if it is at least this likely.
_LEAST_CERTAINTY = 0.1
# Exponent of the network's distribution of the rotation, relative to the likelihood of the depth image.
_NETWORK_TRUST = 0.6
# Width of the images that poses are judged by, pixels; more detail is in the noise of today's sensors.
_DETAIL_WIDTH = 640
# The probability that an instance is there and its body is right, for networks whose score was not fitted. Fitted ones
# have their regression beside the weights (active6d_tools.score_fitting).
_UNFITTED_SCORE = ScoreModel(
    SCORE_FEATURES, np.array([{"fitting": 14.0, "violated": -14.0}.get(name, 0.0) for name in SCORE_FEATURES]), -0.8
)


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
        certainty: (k,) probability of the rotation about the axis if the body is right, 1 where it is not ambiguous.
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
        self._search = PoseSearch(model, trained.canonical_frame)
        self._judge, self._grid = judge_of(model), surface_grid(model)
        self._axis_rotations = AxisRotationSearch(model, trained.canonical_frame) if by_feature else None

    def estimate(self, view: View) -> Hypotheses:
        """See :meth:`active6d_perception.estimators.registry.Estimator.estimate`."""
        view = check_view(view)
        self.stage_ms = {}
        poses, label = self.locate(view)
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
        """Find poses in a view.

        Returns:
            The poses, best first, and the label image: 1 + ``Poses.instance``, 0 for none. It is (h, w) uint16 at the
            network's resolution, see :func:`.reduce_view`.
        """
        instances, surface = self._measure(view)
        if not len(instances):
            nothing, features = np.zeros(0), np.zeros((0, len(SCORE_FEATURES)))
            poses = Poses(np.zeros((0, 4, 4)), nothing, nothing.astype(int), nothing, features)
            return poses, np.zeros(surface.depth.shape, np.uint16)
        candidates = self._timed("poses", self._find_poses, instances, surface)
        return self._timed("judging", self._judge_poses, *candidates, surface)

    def compare(self, view: View) -> tuple[np.ndarray, np.ndarray]:
        """The candidates between which the poses of the n instances are selected, see :meth:`.PoseSearch.compare`.

        Returns:
            (n, c, 4, 4) ``T_camera_object``, metres, and (n, c, f) their :data:`.FEATURES`.
        """
        return self._search.compare(*self._measure(view))

    def _measure(self, view: View) -> tuple[Instances, MeasuredSurface]:
        reduced = self._timed("input", reduce_view, view)
        answer = self._timed("network", self.ask, reduced)
        instances = self._timed(
            "decoding",
            decode,
            answer,
            pool_depth(reduced.depth, OUTPUT_STRIDE),
            output_camera(reduced.camera),
            self._trained.canonical_frame,
            self.model.diameter,
            self.parameters.decoding,
        )
        detail = self._timed("detail", _measure_detail, view)
        return instances, self._timed("surface", MeasuredSurface.of, reduced, instances, detail)

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
        canonical_frame = self._trained.canonical_frame
        if self.parameters.refined:
            T = self._search.poses(instances, surface)
        else:
            T = canonical_frame.object_pose(instances.T_camera_axis)
        if self._axis_rotations is None:
            return self._refined(T, surface), np.arange(len(T)), np.ones(len(T))
        T = T @ canonical_frame.T_object_axis
        measured = self._axis_rotations.log_likelihood(T, surface)
        predicted = _NETWORK_TRUST * np.log(axis_rotation_probability(T, instances.direction) + 1e-6)
        chosen, certainty = likely_axis_rotations(softmax(measured + predicted, axis=1), self.parameters.alternatives)
        instance, rank = np.nonzero((np.arange(chosen.shape[1]) == 0) | (certainty > _LEAST_CERTAINTY))
        T = canonical_frame.object_pose(T[instance] @ rotation_about_z(AXIS_ANGLES[chosen[instance, rank]]))
        return self._refined(T, surface), instance, certainty[instance, rank]

    def _refined(self, T_camera_object: np.ndarray, surface: MeasuredSurface) -> np.ndarray:
        return self._search.refine(T_camera_object, surface) if self.parameters.refined else T_camera_object

    def _judge_poses(
        self, T_camera_object: np.ndarray, instance: np.ndarray, certainty: np.ndarray, surface: MeasuredSurface
    ) -> tuple[Poses, np.ndarray]:
        pixels = np.bincount(surface.owner[surface.owner >= 0], minlength=instance.max(initial=0) + 1)[instance]
        points, normals, number = surface.compared_points
        of_instances = points[instance], normals[instance], number[instance]
        compared = pose_features(T_camera_object[:, None], self._judge, self._grid, surface.detail, of_instances)
        features = np.column_stack([compared[:, 0], np.log(np.maximum(pixels, 1))])
        if self._axis_rotations is not None and self._trained.certainty is not None:
            certainty = self._trained.certainty.probability(log_odds(certainty)[:, None])
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


def log_odds(probability: np.ndarray) -> np.ndarray:
    """Log-odds of probabilities between .02 and .98; beyond, a posterior from correlated pixels says no more."""
    return np.asarray(logit(np.clip(probability, 0.02, 0.98)))


def _measure_detail(view: View) -> MeasuredImage:
    factor = max(1, round(view.camera.width / _DETAIL_WIDTH))
    return measure_image(pool_depth(view.depth, factor), view.camera.reduced(factor))


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
