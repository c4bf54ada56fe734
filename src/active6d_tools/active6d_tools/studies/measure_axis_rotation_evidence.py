#!/usr/bin/env python3
"""Count pixels of depth images at the place of a handle, for right and for wrong rotations about the axis.

Prints the ratios in dense/axis_rotation.py, and the likelihood of the true rotation for several weights of a pixel. The
shards are training views that the network was not trained on.

Example: python -m active6d_tools.studies.measure_axis_rotation_evidence mug
    src/active6d_perception/active6d_perception/estimators/dense/weights/mug.safetensors
    ~/.cache/active6d/training/mug/val/*.npz
"""

import numpy as np
from rich.progress import track
from scipy.special import softmax

from active6d_core.camera import pool_depth
from active6d_core.training_view import TrainingView
from active6d_perception.estimators.dense.axis_rotation import AxisRotationSearch
from active6d_perception.estimators.dense.canonical_frame import AXIS_ANGLES, CanonicalFrame
from active6d_perception.estimators.dense.decoding import decode
from active6d_perception.estimators.dense.dense_estimator import DenseEstimator
from active6d_perception.estimators.dense.measured_surface import MeasuredSurface
from active6d_perception.estimators.dense.network_input import OUTPUT_STRIDE, output_camera
from active6d_perception.estimators.dense.pose_search import PoseSearch
from active6d_tools.studies.arguments import read_arguments

SHAPE = 7, 4
RIGHT, WRONG, TOLERATED = np.radians([2.6, 30.0, 22.0])


def count(
    sample: TrainingView, estimator: DenseEstimator, search: AxisRotationSearch, canonical_frame: CanonicalFrame
) -> tuple[np.ndarray, np.ndarray]:
    """(n, turns, 28) pixels by case, and (n,) true turn, of the instances whose centre and axis are right."""
    model, view = estimator.model, sample.view
    depth = pool_depth(view.depth, OUTPUT_STRIDE)
    instances = decode(estimator.ask(view), depth, output_camera(view.camera), canonical_frame, model.diameter)
    surface = MeasuredSurface.of(view, instances)
    if not len(instances) or not len(sample.T_camera_object):
        return np.zeros((0, len(AXIS_ANGLES), SHAPE[0] * SHAPE[1])), np.zeros(0)
    T = PoseSearch(model, canonical_frame).poses(instances, surface)
    T = T @ canonical_frame.T_object_axis
    true = canonical_frame.axis_pose(sample.T_camera_object)
    distance = np.linalg.norm(T[:, None, :3, 3] - true[:, :3, 3], axis=-1)
    true = true[distance.argmin(axis=1)]
    R = np.swapaxes(T[:, :3, :3], 1, 2) @ true[:, :3, :3]
    right = (distance.min(axis=1) < 0.008) & (R[:, 2, 2] > np.cos(np.radians(8)))
    instance, turn, case, pixels = search.cases(T, surface)
    shape = len(T), len(AXIS_ANGLES), SHAPE[0] * SHAPE[1]
    table = np.bincount(np.ravel_multi_index((instance, turn, case), shape), pixels, np.prod(shape)).reshape(shape)
    return table[right], np.arctan2(R[:, 1, 0] - R[:, 0, 1], R[:, 0, 0] + R[:, 1, 1])[right]


def main() -> None:
    model, trained, samples = read_arguments(__doc__, every=6)
    estimator, search = DenseEstimator(model, trained), AxisRotationSearch(model, trained.canonical_frame)
    tables, turns = zip(
        *(count(sample, estimator, search, trained.canonical_frame) for sample in track(samples)), strict=True
    )
    tables, turns = np.concatenate(tables), np.concatenate(turns)
    off = np.abs((AXIS_ANGLES - turns[:, None] + np.pi) % (2 * np.pi) - np.pi)
    right, wrong = (tables[mask].sum(axis=0) for mask in (off < RIGHT, off > WRONG))
    ratio = np.log((right / right.sum() + 3e-4) / (wrong / wrong.sum() + 3e-4))
    print(f"{len(turns)} instances; rows and columns as in dense/axis_rotation.py\n{ratio.reshape(SHAPE).round(1)}")
    for share in (0.01, 0.02, 0.03, 0.05, 0.1):
        probability = (softmax(share * tables @ ratio, axis=1) * (off < TOLERATED)).sum(axis=1)
        likelihood = np.log(probability + 1e-3).mean()
        print(f"weight of a pixel {share}: mean log-likelihood of the true rotation {likelihood:.3f}")


if __name__ == "__main__":
    main()
