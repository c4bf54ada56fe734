"""Trained policies on disk: tensors in safetensors, their configuration as JSON beside them. Nothing is executed."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from safetensors.torch import load_file, save_file
from torch import nn

from active6d_core.files import atomic_file, write_file

_Module = TypeVar("_Module", bound=nn.Module)


def save_weights(
    module: nn.Module, path: Path, policy: str, config: dict[str, Any], provenance: dict[str, Any] | None = None
) -> None:
    """Write ``path`` (.safetensors) and the configuration that :func:`load_weights` builds from beside it (.json)."""
    with atomic_file(path) as unfinished:
        save_file({name: value.detach().cpu().clone() for name, value in module.state_dict().items()}, unfinished)
    document = {"policy": policy, **config, "provenance": provenance or {}}
    write_file(path.with_suffix(".json"), json.dumps(document, indent=2) + "\n")


def load_weights(path: Path, policy: str, build: Callable[[dict[str, Any]], _Module], remedy: str = "") -> _Module:
    """Read what :func:`save_weights` wrote.

    Args:
        path: of the ``.safetensors``.
        policy: whose weights they must be.
        build: configuration to a module of that shape; may raise any exception.
        remedy: how such weights are made; by default the command that trains the policy.

    Raises:
        ValueError: a file is missing, damaged or does not fit; one line that names the file and what to do.
    """
    remedy = remedy or f"train them with: active6d train policy --object NAME --policy {policy} --export DIR"
    if not path.is_file():
        raise ValueError(f"{path}: no weights of the {policy} policy here; {remedy}")
    try:
        config = json.loads(path.with_suffix(".json").read_text())
        if config["policy"] != policy:
            raise ValueError(f"these are weights of policy '{config['policy']}'")
        module = build(config)
        module.load_state_dict(load_file(path))
    except Exception as error:  # safetensors and torch raise their own kinds
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(f"{path}: no weights of the {policy} policy ({reason}); {remedy}") from error
    return module.eval()
