"""Validation of a network during training: its loss and its detection rates on the validation split."""

from collections.abc import Sequence

import numpy as np
import torch
from scipy.spatial import cKDTree

from active6d_core.metrics import DETECTION_FRACTION, add_s, e_add, match
from active6d_core.object_model import ObjectModel
from active6d_core.training_view import TrainingView
from active6d_perception.estimators.dense.canonical_frame import AxisRotation
from active6d_perception.estimators.dense.dense_estimator import DenseEstimator, DenseParameters
from active6d_perception.estimators.dense.trained_network import TrainedNetwork
from active6d_perception.estimators.dense.training.batches import input_tensor
from active6d_perception.estimators.dense.training.losses import loss_terms
from active6d_perception.estimators.dense.training.targets import make_targets

#: Visible fraction from which an object has to be found, by the name of the rate.
_VISIBLE = {"half": 0.5, "tenth": 0.1}


def validate(model: ObjectModel, trained: TrainedNetwork, samples: Sequence[TrainingView]) -> dict[str, float]:
    """:func:`pose_rates` of a network, and its loss without augmentation as ``loss_<term>``."""
    return {**pose_rates(model, trained, samples), **_losses(model, trained, samples)}


def pose_rates(
    model: ObjectModel,
    trained: TrainedNetwork,
    samples: Sequence[TrainingView],
    parameters: DenseParameters = DenseParameters(),
) -> dict[str, float]:
    """Detection rates and precision in [0, 1] over all views together.

    Args:
        model: the object.
        trained: its network.
        samples: training views at the network's resolution.
        parameters: settings of the estimator that uses the network.

    Returns:
        ``add_half`` and ``add_tenth``: share detected (ADD below 10 % of the diameter) of the objects at least half or
        a tenth visible. ``adds_half`` and ``adds_tenth``: the same by ADD-S. ``precision``: share of right hypotheses,
        by ADD-S where only a named part shows the rotation about the axis.
    """
    estimator = DenseEstimator(model, trained, parameters)
    limit = DETECTION_FRACTION * model.diameter
    found: dict[str, list[np.ndarray]] = {"add": [], "adds": []}
    visible, right, reported = [], 0, 0
    for sample in samples:
        T = estimator.locate(sample.view)[0].T_camera_object
        errors = {
            "add": e_add(model, T[:, None], sample.T_camera_object[None], cutoff=limit),
            "adds": _near_add_s(model, T, sample.T_camera_object, limit),
        }
        for name, table in errors.items():
            found[name].append(match(table, limit) >= 0)
        visible.append(sample.visible_fraction)
        judged = "adds" if trained.canonical_frame.axis_rotation is AxisRotation.SHOWN_BY_FEATURE else "add"
        right += found[judged][-1].sum()
        reported += len(T)
    fraction = np.concatenate(visible)
    rates = {
        f"{name}_{what}": float(np.concatenate(found[name])[fraction >= least].mean())
        for name in found
        for what, least in _VISIBLE.items()
    }
    return {**rates, "precision": float(right / max(reported, 1))}


def _near_add_s(model: ObjectModel, T_est: np.ndarray, T_gt: np.ndarray, limit: float) -> np.ndarray:
    """(k, n) ADD-S, metres; ``inf`` for pairs whose origins are too far apart to be below the limit."""
    errors = np.full((len(T_est), len(T_gt)), np.inf)
    if len(T_est):
        near = cKDTree(T_est[:, :3, 3]).query_ball_point(T_gt[:, :3, 3], 4 * limit)
        for column, rows in enumerate(near):
            errors[rows, column] = add_s(model, T_est[rows], T_gt[column], cutoff=limit)
    return errors


def _losses(model: ObjectModel, trained: TrainedNetwork, samples: Sequence[TrainingView]) -> dict[str, float]:
    totals: dict[str, float] = {}
    with torch.inference_mode():
        for sample in samples:
            answer = trained.network(input_tensor(sample.view, model.diameter)[None])
            terms = loss_terms(answer, [make_targets(sample, trained.canonical_frame, model.diameter)])
            for name, value in terms.items():
                totals[f"loss_{name}"] = totals.get(f"loss_{name}", 0.0) + float(value) / len(samples)
    return totals
