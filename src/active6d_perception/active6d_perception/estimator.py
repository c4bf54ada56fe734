"""What a pose estimator is, and how one is found by name. The graph knows estimators only through this module."""

import inspect
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Protocol

from active6d_core.camera import View
from active6d_core.hypotheses import Hypotheses
from active6d_core.object_model import ObjectModel, search_folders

#: The name of what :func:`choose_estimator` chooses.
AUTOMATIC = "auto"
#: Networks of the learned estimator that come with this package.
SHIPPED_WEIGHTS = Path(__file__).parent / "weights"
#: Modules that register the estimators of this package. Imported on first use, so that a depth-only estimator
#: does not pay for the libraries of a learned one.
_BUILT_IN = {
    "dense": "active6d_perception.dense.estimator",
    "geometric": "active6d_perception.geometric.estimator",
}
_factories: dict[str, Callable[..., "Estimator"]] = {}


class Estimator(Protocol):
    """Says which instances of one object a view shows, and where."""

    def estimate(self, view: View) -> Hypotheses:
        """Pose hypotheses of ``view`` in its optical frame, with boxes and masks (paper, "6D object pose estimation").

        An estimator is deterministic: the same view gives the same hypotheses.
        """
        ...


def register_estimator(name: str) -> Callable:
    """Decorate a factory ``(model, **parameters) -> Estimator`` so that :func:`create_estimator` finds it by ``name``.

    Raises:
        ValueError: another factory has that name.
    """

    def register(factory: Callable[..., Estimator]) -> Callable[..., Estimator]:
        if _factories.setdefault(name, factory) is not factory:
            raise ValueError(f"an estimator named '{name}' is registered already")
        return factory

    return register


def list_estimators() -> list[str]:
    """Names that :func:`create_estimator` knows beside ``auto``."""
    return sorted(_BUILT_IN.keys() | _factories.keys())


def choose_estimator(object_name: str) -> str:
    """What ``auto`` stands for: the learned estimator if the object has weights, else the training-free one."""
    return "dense" if weights_path(object_name).is_file() else "geometric"


def weights_path(object_name: str) -> Path:
    """The object's network: beside its description if it is one that was added, else where shipped ones are."""
    beside = [folder / f"{object_name}.safetensors" for folder in search_folders()]
    return next((path for path in beside if path.is_file()), SHIPPED_WEIGHTS / f"{object_name}.safetensors")


def create_estimator(name: str, model: ObjectModel, **parameters) -> Estimator:
    """Make an estimator for one object.

    Args:
        name: one of :func:`list_estimators`, or ``auto`` for :func:`choose_estimator`'s choice.
        model: the object that it looks for.
        **parameters: keyword arguments of the estimator's factory.

    Raises:
        ValueError: unknown name, unknown parameter or bad value; the message names it and what is known.
    """
    if name == AUTOMATIC:
        name = choose_estimator(model.name)
    if name not in _factories and name in _BUILT_IN:
        import_module(_BUILT_IN[name])
    if name not in _factories:
        raise ValueError(f"unknown estimator '{name}'; known: {', '.join([AUTOMATIC, *list_estimators()])}")
    factory = _factories[name]
    known = list(inspect.signature(factory).parameters)[1:]
    unknown = sorted(parameters.keys() - set(known))
    if unknown:
        raise ValueError(f"estimator '{name}' has no parameter '{unknown[0]}'; known: {', '.join(known)}")
    try:
        return factory(model, **parameters)
    except TypeError as error:
        raise ValueError(f"estimator '{name}': {error}") from error
