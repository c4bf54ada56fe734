"""Weights that turn evidence into probabilities: fitted from scenes of an object, stored as JSON."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from active6d_core.files import write_file
from active6d_core.object_model import find_beside
from active6d_perception.scene.object_probability import OBJECT_COLUMNS
from active6d_perception.scene.scene_evidence import BODY_COLUMNS, ROTATION_COLUMNS

SHIPPED_BELIEFS = Path(__file__).parent / "weights"
#: Stands for an object without weights of its own.
ANY_OBJECT = "any"
_FORMAT = 1


@dataclass(frozen=True, eq=False)
class BeliefWeights:
    """Weights of one object.

    Attributes:
        rotation: of :data:`.ROTATION_COLUMNS`, log-odds.
        body: of :data:`.BODY_COLUMNS`, log-odds.
        probability: of :data:`.OBJECT_COLUMNS`, log-odds.
        provenance: how they were fitted; JSON values.

    Raises:
        ValueError: the number of weights is wrong, or one is not finite.
    """

    rotation: np.ndarray
    body: np.ndarray
    probability: np.ndarray
    provenance: dict = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, columns in _TABLES.items():
            values = getattr(self, name)
            if values.shape != (len(columns),) or not np.isfinite(values).all():
                raise ValueError(f"belief weights: '{name}' needs {len(columns)} finite numbers, got {values.shape}")

    def save(self, path: Path, object_name: str) -> None:
        """Write the weights with the names of their columns."""
        tables = {
            name: dict(zip(columns, np.round(getattr(self, name), 4).tolist(), strict=True))
            for name, columns in _TABLES.items()
        }
        document = {"format": _FORMAT, "object": object_name, **tables, "provenance": self.provenance}
        write_file(path, json.dumps(document, indent=1) + "\n")


_TABLES: dict[str, Sequence[str]] = {
    "rotation": ROTATION_COLUMNS,
    "body": BODY_COLUMNS,
    "probability": OBJECT_COLUMNS,
}


def belief_path(object_name: str) -> Path:
    """Path of the object's weights: beside its description if they are there, else among the shipped ones.

    An object without weights of its own uses those of :data:`ANY_OBJECT`, fitted on all shipped objects.
    """
    own = find_beside(f"{object_name}_fusion.json", SHIPPED_BELIEFS)
    return own if own.is_file() else SHIPPED_BELIEFS / f"{ANY_OBJECT}_fusion.json"


def load_belief(path: Path) -> BeliefWeights:
    """Read what :meth:`BeliefWeights.save` wrote.

    Raises:
        ValueError: the file is missing, damaged or of another version; the message names it.
    """
    try:
        document = json.loads(path.read_text())
        if document["format"] != _FORMAT:
            raise ValueError(f"format {document['format']}, this version reads {_FORMAT}")
        values = {}
        for name, columns in _TABLES.items():
            if document[name].keys() != set(columns):
                raise ValueError(f"'{name}' has other columns than this version")
            values[name] = np.array([document[name][column] for column in columns], float)
        return BeliefWeights(**values, provenance=document.get("provenance") or {})
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path}: no weights of fusion ({error}); fit them with: active6d train fusion") from error
