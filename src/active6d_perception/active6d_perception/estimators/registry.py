"""What a pose estimator is, and how one is found by name. The graph knows estimators only through this module."""

from pathlib import Path
from typing import Any, Protocol

from active6d_core.camera import View
from active6d_core.hypotheses import Hypotheses
from active6d_core.object_model import ObjectModel, find_beside
from active6d_core.registry import Registry

#: Networks of the learned estimator that come with this package.
SHIPPED_WEIGHTS = Path(__file__).parent / "dense" / "weights"


class Estimator(Protocol):
    """Says which instances of one object a view shows, and where."""

    def estimate(self, view: View) -> Hypotheses:
        """Pose hypotheses of ``view`` in its optical frame, with boxes and masks (paper, "6D object pose estimation").

        An estimator is deterministic: the same view gives the same hypotheses.
        """
        ...


def choose_estimator(object_name: str) -> str:
    """What ``auto`` stands for: the learned estimator if the object has weights, else the training-free one."""
    return "dense" if weights_path(object_name).is_file() else "geometric"


def weights_path(object_name: str) -> Path:
    """The object's network: beside its description if it is one that was added, else where shipped ones are."""
    return find_beside(f"{object_name}.safetensors", SHIPPED_WEIGHTS)


_registry = Registry(
    "estimator",
    choose_estimator,
    {
        "dense": "active6d_perception.estimators.dense.dense_estimator",
        "geometric": "active6d_perception.estimators.geometric.geometric_estimator",
    },
)
#: Decorates a factory ``(model, **parameters) -> Estimator``; see :meth:`active6d_core.registry.Registry.register`.
register_estimator = _registry.register
#: Names that :func:`create_estimator` knows beside ``auto``.
list_estimators = _registry.names


def create_estimator(name: str, model: ObjectModel, **parameters: Any) -> Estimator:
    """Make an estimator for one object.

    Args:
        name: one of :func:`list_estimators`, or ``auto`` for :func:`choose_estimator`'s choice.
        model: the object that it looks for.
        **parameters: keyword arguments of the estimator's factory.

    Raises:
        ValueError: unknown name, unknown parameter or bad value; the message names it and what is known.
    """
    return _registry.create(name, model, **parameters)
