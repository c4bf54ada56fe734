"""Weights from strangers: shapes from the header first, and no weights that are not finite."""

import json
import struct

import numpy as np
import pytest
import torch
from safetensors.numpy import save_file
from torch import nn

from active6d_perception.estimators.dense.network import NetworkSize
from active6d_perception.tensor_file import load_module, read_tensors


def weights(**changes):
    return {"weight": np.ones((2, 3), np.float32), "bias": np.zeros(2, np.float32), **changes}


def test_weights_that_fit_are_read(tmp_path):
    save_file(weights(weight=np.full((2, 3), 0.5, np.float16)), tmp_path / "a.safetensors")
    module = load_module(tmp_path / "a.safetensors", lambda: nn.Linear(3, 2))
    assert module.weight.dtype == torch.float32
    assert (module.weight == 0.5).all()


def test_shapes_are_compared_before_memory_is_taken(tmp_path):
    save_file(weights(), tmp_path / "a.safetensors")
    made = []

    def build():
        # 4 TB, were it not for a device without memory.
        made.append(nn.Linear(10**6, 10**6))
        return made[-1]

    with pytest.raises(ValueError, match=r"'bias' has shape \(2,\), expected \(1000000,\)"):
        load_module(tmp_path / "a.safetensors", build)
    assert [module.weight.device.type for module in made] == ["meta"]


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_weights_that_are_not_finite_are_refused(tmp_path, value):
    save_file(weights(bias=np.array([0, value], np.float32)), tmp_path / "a.safetensors")
    with pytest.raises(ValueError, match="'bias' has weights that are not finite"):
        read_tensors(tmp_path / "a.safetensors")


def test_a_header_that_is_too_long_or_lies_is_refused(tmp_path):
    path = tmp_path / "a.safetensors"
    path.write_bytes(struct.pack("<Q", 2**40) + b"{}")
    with pytest.raises(ValueError, match="header"):
        read_tensors(path)
    text = json.dumps({"a": {"dtype": "F32", "shape": [10**9], "data_offsets": [0, 4 * 10**9]}}).encode()
    path.write_bytes(struct.pack("<Q", len(text)) + text + bytes(16))
    with pytest.raises(ValueError, match=r"."):
        read_tensors(path)


def test_the_width_of_a_network_is_limited():
    with pytest.raises(ValueError, match="widths"):
        NetworkSize((32, 64, 96, 10**6), 64)
