"""Parts that are chosen by name, such as estimators and policies: those that come along, and those that others add."""

import inspect
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any, TypeVar

from active6d_core.object_model import ObjectModel

#: The name that stands for whatever is best for the object at hand.
AUTOMATIC = "auto"

_Factory = TypeVar("_Factory", bound=Callable[..., Any])


class Registry:
    """Factories ``(model, **parameters)`` of parts of one kind, by name.

    Args:
        kind: what the parts are called in messages.
        choose: from an object's name to the name that ``auto`` stands for.
        built_in: module by name of the parts that come along. Modules register their parts when imported, and are
            imported when a part is asked for, so that a simple part does not wait for the libraries of a learned one.
    """

    def __init__(self, kind: str, choose: Callable[[str], str], built_in: Mapping[str, str]) -> None:
        self._kind = kind
        self._choose = choose
        self._built_in = built_in
        self._factories: dict[str, Callable[..., Any]] = {}

    def register(self, name: str) -> Callable[[_Factory], _Factory]:
        """Decorator that makes a factory available as ``create(name, ...)``.

        Raises:
            ValueError: another factory has that name.
        """

        def register(factory: _Factory) -> _Factory:
            if self._factories.setdefault(name, factory) is not factory:
                raise ValueError(f"{self._kind} '{name}' is registered already")
            return factory

        return register

    def names(self) -> list[str]:
        """All names, which ``auto`` is none of."""
        return sorted(self._built_in.keys() | self._factories.keys())

    def create(self, name: str, model: ObjectModel, **parameters: Any) -> Any:
        """Make the part of that name, or with ``auto`` the chosen one, for one object.

        Raises:
            ValueError: no such part, no such parameter, or what the factory refuses; the message names it.
        """
        if name == AUTOMATIC:
            name = self._choose(model.name)
        if name not in self._factories and name in self._built_in:
            import_module(self._built_in[name])
        if name not in self._factories:
            raise ValueError(f"unknown {self._kind} '{name}'; known: {', '.join([AUTOMATIC, *self.names()])}")
        factory = self._factories[name]
        accepted = [parameter for parameter in inspect.signature(factory).parameters if parameter != "model"]
        unknown = sorted(parameters.keys() - set(accepted))
        if unknown:
            known = ", ".join(accepted) if accepted else "none"
            raise ValueError(f"{self._kind} '{name}' has no parameter '{unknown[0]}'; it has: {known}")
        try:
            return factory(model, **parameters)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{self._kind} '{name}': {error}") from error
