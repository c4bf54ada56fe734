"""The interface of pose estimators, and the registry that creates them by name."""

from pathlib import Path
from typing import Protocol

from active6d_core.camera import View
from active6d_core.hypotheses import Hypotheses
from active6d_core.object_model import find_beside
from active6d_core.registry import Registry

#: Folder of the shipped networks of the learned estimator.
SHIPPED_WEIGHTS = Path(__file__).parent / "dense" / "weights"


class Estimator(Protocol):
    """Estimates the poses of all instances of one object in a view."""

    def estimate(self, view: View) -> Hypotheses:
        """Estimate pose hypotheses in the optical frame, with boxes and masks (paper, "6D object pose estimation").

        An estimator is deterministic: the same view gives the same hypotheses.

        Raises:
            ValueError: the images cannot be meant, see :func:`active6d_core.rgbd.check_view`.
        """
        ...


def choose_estimator(object_name: str) -> str:
    """The estimator that ``auto`` selects: the learned one if the object has weights, else the training-free one."""
    return "dense" if weights_path(object_name).is_file() else "geometric"


def weights_path(object_name: str) -> Path:
    """Path of the object's network: beside the object's description if it is there, else among the shipped ones."""
    return find_beside(f"{object_name}.safetensors", SHIPPED_WEIGHTS)


_registry: Registry[Estimator] = Registry(
    "estimator",
    choose_estimator,
    {
        "dense": "active6d_perception.estimators.dense.dense_estimator",
        "geometric": "active6d_perception.estimators.geometric.geometric_estimator",
    },
    "active6d.estimators",
)
#: Decorates a factory ``(model, **parameters) -> Estimator``.
register_estimator = _registry.register
#: All names, without ``auto``; and the same with where each comes from.
list_estimators, estimator_origins = _registry.names, _registry.origins
#: Makes one by name; see :meth:`active6d_core.registry.Registry.create`.
create_estimator = _registry.create
