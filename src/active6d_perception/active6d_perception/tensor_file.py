"""Weights from strangers: shapes are compared with the header of a file before anything is allocated."""

from collections.abc import Callable, Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from safetensors import safe_open
from safetensors.numpy import load_file
from torch import nn

from active6d_core.files import refuse_special

#: Bytes of a file of weights.
MOST_BYTES = 2**28
_MOST_HEADER_BYTES = 2**20
_Module = TypeVar("_Module", bound=nn.Module)


def load_module(path: Path, build: Callable[[], _Module], *, dry_run: bool = True) -> _Module:
    """A module with the weights of a ``.safetensors`` file. Nothing in the file is executed.

    Args:
        path: of the file.
        build: makes the module; called first without memory for its weights, then with it.
        dry_run: False for modules that cannot be made without memory; then ``build`` must bound their size.

    Raises:
        ValueError: the module is not of the file's shapes, or the file is damaged, too large or has weights that are
            not finite. The message does not name the file.
        OSError: the file cannot be read.
    """
    with torch.device("meta") if dry_run else nullcontext():
        shapes = {name: tuple(value.shape) for name, value in build().state_dict().items()}
    tensors = read_tensors(path, shapes)
    module = build()
    module.load_state_dict({name: torch.from_numpy(value) for name, value in tensors.items()})
    return module


def read_tensors(path: Path, shapes: Mapping[str, tuple[int, ...]] | None = None) -> dict[str, np.ndarray]:
    """The tensors of a ``.safetensors`` file.

    Args:
        path: of the file.
        shapes: of all tensors by name; None for any.

    Raises:
        ValueError: as :func:`load_module`.
        OSError: the file cannot be read.
    """
    refuse_special(path)
    size = path.stat().st_size
    with path.open("rb") as file:
        header = int.from_bytes(file.read(8), "little")
    if size > MOST_BYTES or header > _MOST_HEADER_BYTES:
        raise ValueError(f"has {size} bytes, {header} of them header; at most {MOST_BYTES} and {_MOST_HEADER_BYTES}")
    try:
        if shapes is not None:
            _check_shapes(path, shapes)
        tensors: dict[str, np.ndarray] = load_file(path)
    except OSError:
        raise
    # The library has errors of its own, also for types that NumPy does not have.
    except Exception as error:
        raise ValueError(str(error).splitlines()[0] if str(error) else type(error).__name__) from error
    for name, value in tensors.items():
        if not np.isfinite(value).all():
            raise ValueError(f"'{name}' has weights that are not finite")
    return tensors


def _check_shapes(path: Path, shapes: Mapping[str, tuple[int, ...]]) -> None:
    with safe_open(path, "numpy") as file:
        found = {name: tuple(file.get_slice(name).get_shape()) for name in file.keys()}  # noqa: SIM118  no mapping
    differing = sorted(name for name in found.keys() | shapes.keys() if found.get(name) != shapes.get(name))
    if differing:
        name = differing[0]
        raise ValueError(f"'{name}' has shape {found.get(name)}, expected {shapes.get(name)}")
