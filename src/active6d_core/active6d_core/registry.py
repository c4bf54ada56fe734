"""Parts that are chosen by name, such as estimators and policies: built in, or added by other packages and modules.

A package adds parts by entry points of the groups ``active6d.estimators``, ``active6d.policies`` and
``active6d.sensors``: the entry point's name is the part's name, its value a factory ``module:attribute``. A module adds
parts by registering them when it is imported. The environment variable ``ACTIVE6D_IMPORT`` names such modules,
separated by commas. Child processes and ROS nodes inherit it. A part's module is imported when a part is asked for.
"""

import inspect
import os
import sys
from collections.abc import Callable, Iterable, Mapping
from functools import cached_property
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from numbers import Real
from typing import Any, Generic, TypeVar

from active6d_core.nearest_name import did_you_mean
from active6d_core.object_model import ObjectModel

#: The name that stands for whatever is best for the object at hand.
AUTOMATIC = "auto"
#: Names modules to import, separated by commas.
IMPORT_VARIABLE = "ACTIVE6D_IMPORT"
#: What :meth:`Registry.origins` calls the parts of active6d itself.
BUILT_IN = "built in"

_Part = TypeVar("_Part")
_Factory = TypeVar("_Factory", bound=Callable[..., Any])


class Registry(Generic[_Part]):
    """Factories ``(model, **parameters)`` of parts of one kind, by name.

    Args:
        kind: what the parts are called in messages.
        choose: from an object's name to the name that ``auto`` stands for.
        built_in: module by name of the parts of active6d itself. Modules register their parts when imported, and are
            imported when a part is asked for, so that a simple part does not wait for the libraries of a learned one.
        group: of the entry points by which other packages add parts.
    """

    def __init__(
        self, kind: str, choose: Callable[[str], str], built_in: Mapping[str, str], group: str | None = None
    ) -> None:
        self._kind = kind
        self._choose = choose
        self._built_in = built_in
        self._group = group
        self._factories: dict[str, Callable[..., _Part]] = {}

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
        """All names, which ``auto`` is none of.

        Raises:
            ValueError: a module of ``ACTIVE6D_IMPORT`` cannot be imported, or two parts have one name.
        """
        return sorted(self.origins())

    def origins(self) -> dict[str, str]:
        """Every name and where its part comes from: "built in", the package with its version, or the module.

        Raises:
            ValueError: as :meth:`names`.
        """
        import_extensions()
        modules = {name: factory.__module__ for name, factory in self._factories.items()}
        packages = {name: _distribution(entry_point) for name, entry_point in self._entry_points.items()}
        return modules | packages | dict.fromkeys(self._built_in, BUILT_IN)

    def create(self, name: str, model: ObjectModel, **parameters: Any) -> _Part:
        """Make a part by name for one object.

        Args:
            name: of :meth:`names`, or ``auto`` for the chosen one.
            model: the object that fills the bin.
            parameters: of that part; its class or factory documents them.

        Raises:
            ValueError: no such part, no such parameter, a library that is missing, or what the factory refuses; the
                message names it.
        """
        name = self._choose(model.name) if name == AUTOMATIC else name
        factory = self._factory(name)
        accepted = [parameter for parameter in inspect.signature(factory).parameters if parameter != "model"]
        unknown = sorted(parameters.keys() - set(accepted))
        if unknown:
            known = ", ".join(accepted) if accepted else "none"
            hint = did_you_mean(unknown[0], accepted)
            raise ValueError(f"{self._kind} '{name}' has no parameter '{unknown[0]}'{hint}; it has: {known}")
        needed = [
            parameter.name
            for parameter in inspect.signature(factory).parameters.values()
            if parameter.name in accepted and parameter.name not in parameters and _is_needed(parameter)
        ]
        if needed:
            raise ValueError(
                f"{self._kind} '{name}' needs the parameter '{needed[0]}'; give it with --set, such as "
                f"{name}.{needed[0]}=VALUE, or for a node in {self._kind}_parameters"
            )
        for parameter, value in parameters.items():
            default = inspect.signature(factory).parameters[parameter].default
            if not _is_like(value, default):
                such = f"a {_KINDS[type(default)][0]} such as {default!r}"
                raise ValueError(f"{self._kind} '{name}': parameter '{parameter}' must be {such}, got {value!r:.60}")
        try:
            return factory(model, **parameters)
        except (TypeError, ValueError) as error:
            named = any(parameter in str(error) for parameter in parameters)
            given = "" if named else "".join(f"; {key} is {value!r:.60}" for key, value in parameters.items())
            raise ValueError(f"{self._kind} '{name}': {error}{given}") from error

    def _factory(self, name: str) -> Callable[..., _Part]:
        if name not in self._factories and name in self._built_in:
            try:
                import_module(self._built_in[name])
            except ModuleNotFoundError as error:
                raise ValueError(f"{self._kind} '{name}' needs {error.name}, which is not installed") from error
        if name not in self._factories:
            import_extensions()
        if name not in self._factories and name in self._entry_points:
            self._load(self._entry_points[name])
        if name not in self._factories:
            known = [AUTOMATIC, *self.names()]
            raise ValueError(f"unknown {self._kind} '{name}'{did_you_mean(name, known)}; known: {', '.join(known)}")
        return self._factories[name]

    def _load(self, entry_point: EntryPoint) -> None:
        """Load the factory that an entry point names; its module may have registered it itself.

        Raises:
            ValueError: it cannot be imported, or is no factory.
        """
        where = f"{self._kind} '{entry_point.name}' of {_distribution(entry_point)} ({entry_point.value})"
        try:
            factory = entry_point.load()
        except (ImportError, AttributeError) as error:
            raise ValueError(f"{where} cannot be imported: {error}") from error
        if not callable(self._factories.setdefault(entry_point.name, factory)):
            del self._factories[entry_point.name]
            raise ValueError(f"{where} cannot be called; an entry point names a factory, as in module:Class")

    @cached_property
    def _entry_points(self) -> dict[str, EntryPoint]:
        found: dict[str, EntryPoint] = {}
        for entry_point in entry_points(group=self._group) if self._group else ():
            first = BUILT_IN if entry_point.name in self._built_in else None
            if entry_point.name in found:
                first = _distribution(found[entry_point.name])
            if first is not None and first != _distribution(entry_point):
                raise ValueError(
                    f"two parts are called {self._kind} '{entry_point.name}': {first} and "
                    f"{_distribution(entry_point)}; rename or uninstall one"
                )
            found[entry_point.name] = entry_point
        return found


#: What a user calls the types of defaults, and what may stand for each of them.
_KINDS: dict[type, tuple[str, tuple[type, ...]]] = {
    bool: ("truth value", (bool,)),
    int: ("number", (Real,)),
    float: ("number", (Real,)),
    str: ("text", (str, os.PathLike)),
}


def _is_like(value: object, default: object) -> bool:
    """Whether a value may stand for a default: of its kind, as far as the default is of a simple one."""
    if type(default) not in _KINDS:
        return True
    return isinstance(value, _KINDS[type(default)][1]) and isinstance(value, bool) == isinstance(default, bool)


def request_imports(modules: Iterable[str]) -> None:
    """Import these modules wherever parts are asked for: in this process, its children and their ROS nodes.

    Args:
        modules: dotted names; found where ``python -m`` finds modules, in the current folder among others.
    """
    wanted = _requested_modules()
    wanted += [module for module in modules if module not in wanted]
    if not wanted:
        return
    os.environ[IMPORT_VARIABLE] = ",".join(wanted)
    here = os.getcwd()
    if here not in sys.path and "" not in sys.path:
        sys.path.append(here)
    paths = [path for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path]
    if here not in paths:
        os.environ["PYTHONPATH"] = os.pathsep.join([*paths, here])


def import_extensions() -> None:
    """Import the modules that ``ACTIVE6D_IMPORT`` names.

    Raises:
        ValueError: one cannot be imported; the message names it.
    """
    for module in _requested_modules():
        if module not in sys.modules:
            try:
                import_module(module)
            except Exception as error:  # a stranger's module raises what it likes
                raise ValueError(f"module {module} (--import or {IMPORT_VARIABLE}): {error}") from error


def leave_out_broken_imports() -> list[str]:
    """Import what ``ACTIVE6D_IMPORT`` names, and take modules that fail out of it; returns why, one text for each."""
    wanted, failures = _requested_modules(), []
    for module in wanted.copy():
        os.environ[IMPORT_VARIABLE] = module
        try:
            import_extensions()
        except ValueError as error:
            wanted.remove(module)
            failures.append(str(error))
    os.environ[IMPORT_VARIABLE] = ",".join(wanted)
    return failures


def _requested_modules() -> list[str]:
    return [module.strip() for module in os.environ.get(IMPORT_VARIABLE, "").split(",") if module.strip()]


def _is_needed(parameter: inspect.Parameter) -> bool:
    variable = parameter.kind in (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    return parameter.default is inspect.Parameter.empty and not variable


def _distribution(entry_point: EntryPoint) -> str:
    """The package that declares an entry point, with its version."""
    return f"{entry_point.dist.name} {entry_point.dist.version}" if entry_point.dist else entry_point.value
