"""Weights that turn evidence into probabilities: fitted from scenes of an object, stored as safetensors and JSON."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import save_file

from active6d_core.files import atomic_file, write_file
from active6d_core.object_model import find_beside
from active6d_core.structured_text import read_json
from active6d_perception.scene.object_probability import OBJECT_COLUMNS
from active6d_perception.scene.scene_evidence import BODY_COLUMNS, ROTATION_COLUMNS
from active6d_perception.tensor_file import read_tensors

SHIPPED_BELIEFS = Path(__file__).parent / "weights"
#: Stands for an object without weights of its own.
ANY_OBJECT = "any"
_FORMAT = 1


@dataclass(frozen=True, eq=False)
class Scorer:
    """A linear function of standardised columns plus a layer of h rectified units, all float32.

    Attributes:
        mean: (c,) of the columns.
        scale: (c,) of the columns.
        linear: (c,) weights.
        hidden: (c, h) weights of the units.
        offset: (h,) of the units.
        out: (h,) weights of the units' values.

    Raises:
        ValueError: shapes disagree, or a number is not finite.
    """

    mean: np.ndarray
    scale: np.ndarray
    linear: np.ndarray
    hidden: np.ndarray
    offset: np.ndarray
    out: np.ndarray

    def __post_init__(self) -> None:
        c, h = len(self.linear), len(self.out)
        shapes = {"mean": (c,), "scale": (c,), "linear": (c,), "hidden": (c, h), "offset": (h,), "out": (h,)}
        for name, shape in shapes.items():
            values = getattr(self, name)
            if values.shape != shape or not np.isfinite(values).all():
                raise ValueError(f"'{name}' must be {shape} finite numbers, got {values.shape}")

    def __call__(self, columns: np.ndarray) -> np.ndarray:
        """(...,) log-odds of (..., c) float32 columns."""
        standard = ((columns - self.mean) / self.scale).reshape(-1, len(self.mean))
        units = np.maximum(standard @ self.hidden + self.offset, 0.0)
        return (standard @ self.linear + units @ self.out).reshape(columns.shape[:-1])

    @classmethod
    def of_weights(cls, linear: np.ndarray) -> "Scorer":
        """The linear function of (c,) weights alone."""
        c = len(linear)
        empty = np.zeros((c, 0), np.float32), np.zeros(0, np.float32), np.zeros(0, np.float32)
        return cls(np.zeros(c, np.float32), np.ones(c, np.float32), linear.astype(np.float32), *empty)


@dataclass(frozen=True, eq=False)
class BeliefWeights:
    """Weights of one object.

    Attributes:
        rotation: scores :data:`.ROTATION_COLUMNS`, log-odds.
        body: scores :data:`.BODY_COLUMNS`, log-odds.
        probability: scores :data:`.OBJECT_COLUMNS`, log-odds.
        provenance: how they were fitted; JSON values.

    Raises:
        ValueError: a scorer has another number of columns.
    """

    rotation: Scorer
    body: Scorer
    probability: Scorer
    provenance: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, columns in _COLUMNS.items():
            if len(getattr(self, name).linear) != len(columns):
                raise ValueError(f"'{name}' must have {len(columns)} columns, got {len(getattr(self, name).linear)}")

    @classmethod
    def indifferent(cls) -> "BeliefWeights":
        """Weights by which everything is equally probable."""
        rotation, body, probability = (Scorer.of_weights(np.zeros(len(columns))) for columns in _COLUMNS.values())
        return cls(rotation, body, probability)

    def save(self, path: Path, object_name: str) -> None:
        """Write ``path`` (.safetensors), and what the columns mean beside it (.json)."""
        tensors = {f"{name}.{part}": value for name in _COLUMNS for part, value in vars(getattr(self, name)).items()}
        with atomic_file(path) as unfinished:
            save_file({name: np.ascontiguousarray(value, np.float32) for name, value in tensors.items()}, unfinished)
        document = {"format": _FORMAT, "object": object_name, "columns": _COLUMNS, "provenance": self.provenance}
        write_file(path.with_suffix(".json"), json.dumps(document, indent=1) + "\n")


_COLUMNS = {"rotation": ROTATION_COLUMNS, "body": BODY_COLUMNS, "probability": OBJECT_COLUMNS}


def belief_file(object_name: str) -> str:
    """Name of the file with an object's weights."""
    return f"{object_name}_fusion.safetensors"


def belief_path(object_name: str) -> Path:
    """Path of the object's weights: beside its description if they are there, else among the shipped ones.

    An object without weights of its own uses those of :data:`ANY_OBJECT`, fitted on all shipped objects.
    """
    own = find_beside(belief_file(object_name), SHIPPED_BELIEFS)
    return own if own.is_file() else SHIPPED_BELIEFS / belief_file(ANY_OBJECT)


def load_belief(path: Path) -> BeliefWeights:
    """Read what :meth:`BeliefWeights.save` wrote. Nothing in the files is executed.

    Raises:
        ValueError: a file is missing, damaged or of another version; the message names it.
    """
    try:
        document = read_json(path.with_suffix(".json"))
        if document["format"] != _FORMAT:
            raise ValueError(f"format {document['format']}, this version reads {_FORMAT}")
        for name, columns in _COLUMNS.items():
            if document["columns"][name] != list(columns):
                raise ValueError(f"'{name}' has other columns than this version")
        tensors: dict[str, dict[str, np.ndarray]] = {name: {} for name in _COLUMNS}
        for key, value in read_tensors(path).items():
            name, _, part = key.partition(".")
            tensors[name][part] = value
        scorers = {name: Scorer(**parts) for name, parts in tensors.items()}
        return BeliefWeights(**scorers, provenance=document.get("provenance") or {})
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(f"{path}: no weights of fusion ({reason}); fit them with: active6d train fusion") from error
