"""YAML and JSON from strangers: read within limits, so that no small text becomes a large structure."""

import json
import re
from pathlib import Path
from typing import Any

import yaml

from active6d_core.files import refuse_special

#: Bytes of a YAML text, and of a JSON file; memory is up to 30 times that.
MOST_YAML_BYTES, MOST_JSON_BYTES = 2**20, 2**25
_MOST_NODES = 100_000
_MOST_DEPTH = 32


# The compiled parser, where PyYAML has it, is ten times faster.
class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """Reads 1e-4 as a number, as YAML 1.2 does; PyYAML follows YAML 1.1, in which it is a text."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)[eE][-+]?[0-9]+$"), list("-+.0123456789")
)


def parse_yaml(text: str) -> Any:
    """The content of a YAML text of plain values, without anchors and aliases.

    Raises:
        ValueError: not YAML, too long, too deep, or with aliases, which can multiply what they name.
    """
    if len(text) > MOST_YAML_BYTES:
        raise ValueError(f"has {len(text)} characters, at most {MOST_YAML_BYTES} are read")
    try:
        depth = nodes = 0
        for event in yaml.parse(text, Loader=_Loader):
            nodes += isinstance(event, yaml.NodeEvent)
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if isinstance(event, yaml.AliasEvent):
                line = event.start_mark.line + 1 if event.start_mark else 0
                raise ValueError(f"has an alias in line {line}; write the value out")
            if nodes > _MOST_NODES or depth > _MOST_DEPTH:
                raise ValueError(f"has more than {_MOST_NODES} values, or more than {_MOST_DEPTH} inside one another")
        return yaml.load(text, Loader=_Loader)  # noqa: S506  a safe loader
    except yaml.YAMLError as error:
        raise ValueError(f"not YAML: {' '.join(str(error).split())}") from error
    # Constructors of numbers and dates raise many kinds of errors.
    except (ArithmeticError, AttributeError, LookupError, RecursionError, TypeError) as error:
        raise ValueError(f"not YAML: {type(error).__name__} {error}") from error


def read_yaml(path: Path) -> Any:
    """The content of a YAML file, as :func:`parse_yaml`.

    Raises:
        ValueError: as :func:`parse_yaml`, or no UTF-8; the message does not name the file.
        OSError: the file cannot be read.
    """
    return parse_yaml(_read_text(path, MOST_YAML_BYTES))


def read_json(path: Path) -> Any:
    """The content of a JSON file.

    Raises:
        ValueError: not JSON, not UTF-8, too long or too deep; the message does not name the file.
        OSError: the file cannot be read.
    """
    return parse_json(_read_text(path, MOST_JSON_BYTES))


def parse_json(text: str) -> Any:
    """The content of a JSON text.

    Raises:
        ValueError: not JSON, or too deep.
    """
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("not JSON: too many values inside one another") from error


def _read_text(path: Path, most: int) -> str:
    refuse_special(path)
    with path.open("rb") as file:
        content = file.read(most + 1)
    if len(content) > most:
        raise ValueError(f"has more than {most} bytes")
    return content.decode()
