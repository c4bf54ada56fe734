"""The interface of pose estimators, and the registry that creates them by name."""

from pathlib import Path
from typing import Any, Protocol

from active6d_core.camera import View
from active6d_core.hypotheses import Hypotheses
from active6d_core.object_model import ObjectModel, find_beside
from active6d_core.registry import Registry

#: Folder of the shipped networks of the learned estimator.
SHIPPED_WEIGHTS = Path(__file__).parent / "dense" / "weights"


class Estimator(Protocol):
    """Estimates the poses of all instances of one object in a view."""

    def estimate(self, view: View) -> Hypotheses:
        """Estimate pose hypotheses in the optical frame, with boxes and masks (paper, "6D object pose estimation").

        An estimator is deterministic: the same view gives the same hypotheses.
        """
        ...


def choose_estimator(object_name: str) -> str:
    """The estimator that ``auto`` selects: the learned one if the object has weights, else the training-free one."""
    return "dense" if weights_path(object_name).is_file() else "geometric"


def weights_path(object_name: str) -> Path:
    """Path of the object's network: beside the object's description if it is there, else among the shipped ones."""
    return find_beside(f"{object_name}.safetensors", SHIPPED_WEIGHTS)


_registry = Registry(
    "estimator",
    choose_estimator,
    {
        "dense": "active6d_perception.estimators.dense.dense_estimator",
        "geometric": "active6d_perception.estimators.geometric.geometric_estimator",
    },
    "active6d.estimators",
)
#: Decorates a factory ``(model, **parameters) -> Estimator``; see :meth:`active6d_core.registry.Registry.register`.
register_estimator = _registry.register
#: Names of all estimators, without ``auto``.
list_estimators = _registry.names
#: Those names with where each estimator comes from; see :meth:`active6d_core.registry.Registry.origins`.
estimator_origins = _registry.origins


def create_estimator(name: str, model: ObjectModel, **parameters: Any) -> Estimator:
    """Make an estimator for one object.

    Args:
        name: one of :func:`list_estimators`, or ``auto`` for :func:`choose_estimator`'s choice.
        model: the object to estimate poses of.
        **parameters: keyword arguments of the estimator's factory.

    Raises:
        ValueError: unknown name, unknown parameter or bad value; the message names it and lists the known ones.
    """
    return _registry.create(name, model, **parameters)
