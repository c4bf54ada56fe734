"""Files of trained networks: tensors in safetensors, everything else in a JSON file beside them."""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.torch import save_file

from active6d_core.files import atomic_file, write_file
from active6d_core.object_model import ObjectModel
from active6d_core.se3 import is_rigid
from active6d_core.structured_text import read_json
from active6d_perception.estimators.dense.canonical_frame import AxisRotation, CanonicalFrame
from active6d_perception.estimators.dense.network import HEADS, DenseNetwork, NetworkSize
from active6d_perception.estimators.dense.network_input import CHANNELS
from active6d_perception.estimators.pose_selection import FEATURES
from active6d_perception.estimators.score_model import ScoreModel
from active6d_perception.tensor_file import load_module

_FORMAT = 1
#: Regressors of the score: what poses are compared by, and the logarithm of the number of the instance's pixels at the
#: network's resolution.
SCORE_FEATURES = (*FEATURES, "log_pixels")
#: Regressor of the certainty.
CERTAINTY_FEATURES = ("log_odds",)
#: Features that can only lower the score.
SCORE_LOWERED_BY = ("violated", "violated_comparable", "continued")


@dataclass(frozen=True, eq=False)
class TrainedNetwork:
    """A network and the object that it was trained for.

    Attributes:
        network: the network, in evaluation mode.
        canonical_frame: the frame that it was trained with.
        object_name: name of the object.
        diameter: the object's, metres.
        size: channels of the network's layers.
        training: options and validation results of the training; kept for information only.
        score: from features of a pose to the probability that it is right; None if it was not fitted.
        certainty: from the log-odds of the rotation's posterior probability to the probability that the rotation is
            right where the body is; None if it was not fitted.
    """

    network: DenseNetwork
    canonical_frame: CanonicalFrame
    object_name: str
    diameter: float
    size: NetworkSize
    training: dict[str, Any] = field(default_factory=dict)
    score: ScoreModel | None = None
    certainty: ScoreModel | None = None


def save_network(path: Path, trained: TrainedNetwork) -> None:
    """Write ``path`` (``.safetensors``, float16) and the JSON file of the same name beside it."""
    # Half precision halves the file, and its rounding is far below the noise of training.
    tensors = {
        name: (tensor.half() if tensor.is_floating_point() else tensor).contiguous()
        for name, tensor in trained.network.state_dict().items()
    }
    with atomic_file(path) as unfinished:
        save_file(tensors, unfinished)
    description = {
        "format": _FORMAT,
        "object": trained.object_name,
        "diameter": trained.diameter,
        "input_channels": CHANNELS,
        "heads": HEADS,
        "size": asdict(trained.size),
        "turn": trained.canonical_frame.axis_rotation.value,
        "T_object_axis": trained.canonical_frame.T_object_axis.tolist(),
        "training": trained.training,
    }
    write_file(path.with_suffix(".json"), json.dumps(description, indent=1) + "\n")


def save_score(path: Path, score: ScoreModel, certainty: ScoreModel | None = None) -> None:
    """Write a fitted score, and the certainty where it was fitted, into the JSON file beside the weights ``path``."""
    described = path.with_suffix(".json")
    description = json.loads(described.read_text()) | {"score": score.as_dict()}
    if certainty is not None:
        description["certainty"] = certainty.as_dict()
    write_file(described, json.dumps(description, indent=1) + "\n")


def load_network(path: Path, model: ObjectModel) -> TrainedNetwork:
    """Read a trained network for an object. Nothing in the files is executed.

    Raises:
        ValueError: a file is missing or damaged, or belongs to another object or another version of the network. The
            message names the file and what to do.
    """
    description = _read_description(path, model)
    try:
        size = NetworkSize(tuple(description["size"]["widths"]), description["size"]["last"])
        canonical_frame = CanonicalFrame(
            AxisRotation(description["turn"]), np.array(description["T_object_axis"], float), model.symmetry.discrete
        )
        if not is_rigid(canonical_frame.T_object_axis, 1e-5):
            raise ValueError("T_object_axis is not a rigid transform")
        fitted = {"score": SCORE_FEATURES, "certainty": CERTAINTY_FEATURES}
        score, certainty = (
            ScoreModel.from_dict(description[name], features) if name in description else None
            for name, features in fitted.items()
        )
    # A wrong value fails in whichever library meets it first.
    except Exception as error:
        raise ValueError(f"{path.with_suffix('.json')}: bad description of a network ({error})") from error
    try:
        network = load_module(path, lambda: DenseNetwork(size))
    except (OSError, ValueError, RuntimeError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(
            f"{path}: damaged, or not the weights that its .json describes ({reason}); {_advice(model)}"
        ) from error
    training = description.get("training") or {}
    return TrainedNetwork(network.eval(), canonical_frame, model.name, model.diameter, size, training, score, certainty)


def _read_description(path: Path, model: ObjectModel) -> dict[str, Any]:
    described = path.with_suffix(".json")
    missing = [file for file in (path, described) if not file.is_file()]
    if missing:
        raise ValueError(f"{missing[0]}: no such file of weights; {_advice(model)}")
    try:
        description = read_json(described)
        made_for, diameter = description["object"], float(description["diameter"])
    except (ArithmeticError, ValueError, TypeError, KeyError) as error:
        raise ValueError(f"{described}: damaged ({error}); {_advice(model)}") from error
    if made_for != model.name or abs(diameter - model.diameter) > 1e-3 * model.diameter:
        raise ValueError(
            f"{described}: made for {made_for} ({1000 * diameter:.1f} mm), "
            f"not for {model.name} ({1000 * model.diameter:.1f} mm); {_advice(model)}"
        )
    version = description.get("format"), description.get("input_channels")
    if version != (_FORMAT, CHANNELS) or description.get("heads") != HEADS:
        raise ValueError(f"{described}: made by another version of the network; {_advice(model)}")
    return description


def _advice(model: ObjectModel) -> str:
    return f"train them with 'active6d train estimator --object {model.name}'"
