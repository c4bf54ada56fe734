"""Trained policies on disk: tensors in safetensors, their configuration as JSON beside them. Nothing is executed."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from safetensors.torch import save_file
from torch import nn

from active6d_core.files import atomic_file, write_file
from active6d_core.structured_text import read_json
from active6d_perception.tensor_file import load_module

_Module = TypeVar("_Module", bound=nn.Module)


def save_weights(
    module: nn.Module, path: Path, policy: str, config: dict[str, Any], provenance: dict[str, Any] | None = None
) -> None:
    """Write ``path`` (.safetensors) and the configuration that :func:`load_weights` builds from beside it (.json)."""
    with atomic_file(path) as unfinished:
        save_file({name: value.detach().cpu().clone() for name, value in module.state_dict().items()}, unfinished)
    document = {"policy": policy, **config, "provenance": provenance or {}}
    write_file(path.with_suffix(".json"), json.dumps(document, indent=2) + "\n")


def load_weights(
    path: Path, policy: str, build: Callable[[dict[str, Any]], _Module], remedy: str = "", *, dry_run: bool = True
) -> _Module:
    """Read what :func:`save_weights` wrote.

    Args:
        path: of the ``.safetensors``.
        policy: whose weights they must be.
        build: configuration to a module of that shape; may raise any exception.
        dry_run: whether the module can be made without memory, to compare shapes first; else ``build`` bounds its size.
        remedy: how such weights are made; by default the command that trains the policy.

    Raises:
        ValueError: a file is missing, damaged or does not fit; one line that names the file and what to do.
    """
    remedy = remedy or f"train them with: active6d train policy --object NAME --policy {policy} --export DIR"
    if not path.is_file():
        raise ValueError(f"{path}: no weights of the {policy} policy here; {remedy}")
    try:
        config = read_json(path.with_suffix(".json"))
        if config["policy"] != policy:
            raise ValueError(f"these are weights of policy '{config['policy']}'")
        module = load_module(path, lambda: build(config), dry_run=dry_run)
    except Exception as error:  # a wrong configuration fails in whichever library meets it first
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(f"{path}: no weights of the {policy} policy ({reason}); {remedy}") from error
    return module.eval()
