"""ROS parameter files: the shipped one, what a file says of a node, and what in it is wrong."""

import re
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from ament_index_python.packages import PackageNotFoundError, get_package_share_directory

from active6d_core.nearest_name import did_you_mean
from active6d_core.ros.graph_nodes import NODES
from active6d_core.structured_text import read_yaml

#: The names of nodes that a file gives, with wildcards as in ROS, each with its parameters; in the file's order.
Sections = list[tuple[str, dict[str, Any]]]
#: Names this much alike are the same but for a letter or two.
_TYPO = 0.9


def default_params_file() -> Path | None:
    """The parameters that ship with this package: in the source tree, else in its installed share folder."""
    source = Path(__file__).parents[2] / "config" / "active6d.yaml"
    if source.is_file():
        return source
    try:
        installed = Path(get_package_share_directory("active6d_bringup")) / "config" / "active6d.yaml"
    except PackageNotFoundError:
        return None
    return installed if installed.is_file() else None


def read_params_file(path: Path) -> Sections:
    """What a file gives the nodes, checked by :func:`check_parameters`.

    Raises:
        ValueError: no such file, no parameter file, or a wrong parameter; the message names the file.
    """
    if not path.is_file():
        raise ValueError(f"params file {path} does not exist")
    try:
        sections = _sections(path)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        expected = "it must hold NODE: {ros__parameters: {NAME: VALUE}}"
        raise ValueError(f"params file {path}: {expected} ({type(error).__name__}: {error})") from error
    for name, parameters in sections:
        try:
            _refuse_typo(_last(name))
            check_parameters({_last(name): parameters})
        except ValueError as error:
            raise ValueError(f"params file {path}: {error}") from error
    return sections


def parameters_of(sections: Sections, node: str, namespace: str = "") -> dict[str, Any]:
    """What ROS gives a node of a file: of all sections whose name matches the node's, the last one counts."""
    name = _full_name(node, namespace)
    return {key: value for pattern, own in sections if _matches(pattern, name) for key, value in own.items()}


def unused_sections(sections: Sections, nodes: Iterable[str], namespace: str = "") -> list[str]:
    """A sentence on each section that is for none of these nodes, nor for another node of active6d."""
    names = {node: _full_name(node, namespace) for node in nodes}
    sentences = []
    for pattern, _ in sections:
        last = _last(pattern)
        if "*" in last or (last in NODES and last not in names):
            continue
        if last not in NODES:
            sentences.append(f"active6d has no node '{last}'{did_you_mean(last, NODES)}; its parameters are not used")
        elif not _matches(pattern, names[last]):
            sentences.append(f"the parameters of '{pattern}' are not used: the node is /{names[last]}")
    return sentences


def check_parameters(parameters: Mapping[str, Mapping[str, Any]]) -> None:
    """Check that nodes have the parameters that were set; ROS would ignore a mistyped name.

    Args:
        parameters: node name to parameters by name.

    Raises:
        ValueError: a node has no such parameter, or a value is of another type; the message has the nearest name.
    """
    known = _default_parameters()
    for node in parameters.keys() & known.keys():
        for name, value in parameters[node].items():
            if name == "use_sim_time" or name.startswith("qos_overrides"):
                continue
            if name not in known[node]:
                raise ValueError(f"{node} has no parameter '{name}'{did_you_mean(name, known[node])}")
            expected = known[node][name]
            if type(value) is not type(expected):
                kind = type(expected).__name__
                raise ValueError(f"{node}: parameter '{name}' must be a {kind} such as {expected!r}, got {value!r}")


@cache
def _default_parameters() -> dict[str, dict[str, Any]]:
    """Node name to the default values of its parameters, from the shipped file; empty without it."""
    path = default_params_file()
    return {} if path is None else {_last(name): parameters for name, parameters in _sections(path)}


def _sections(path: Path) -> Sections:
    return [(str(node), dict(section["ros__parameters"])) for node, section in read_yaml(path).items()]


def _last(name: str) -> str:
    """The last part of a node's name: the name without namespaces."""
    return name.rpartition("/")[2]


def _full_name(node: str, namespace: str) -> str:
    """The node's name with its namespace, without the first slash."""
    return "/".join(part for part in (*namespace.split("/"), node) if part)


def _refuse_typo(node: str) -> None:
    """Other programs' nodes may share the file, so only what is nearly the name of a node is refused."""
    if node not in NODES and (hint := did_you_mean(node, NODES, _TYPO)):
        raise ValueError(f"there is no node '{node}'{hint}")


def _matches(pattern: str, name: str) -> bool:
    """Whether a section is for the node of this full name without the first slash; ``**`` is any number of parts."""
    parts = {"**": "(?:/[^/]+)*", "*": "/[^/]+"}
    expression = "".join(parts.get(part, "/" + re.escape(part)) for part in pattern.strip("/").split("/"))
    return re.fullmatch(expression, f"/{name}") is not None
