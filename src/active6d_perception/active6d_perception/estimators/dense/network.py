"""The network of the dense estimator: a small U-Net whose output has half the resolution of its input."""

from copy import deepcopy
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.utils import fuse_conv_bn_eval

from active6d_perception.estimators.dense.network_input import CHANNELS

#: Number of bins on the sphere over which the network predicts the direction of the axis frame's x.
DIRECTION_BINS = 64
#: Name and number of channels of each part of the network's output, in their order.
HEADS = {
    "mask": 1,  # logit: an object or not
    "centre": 3,  # from the surface point to the axis frame's origin, in the frame of the pixel's ray, diameters
    "centre_scale": 1,  # logarithm of the Laplace scale of its error
    "axis": 3,  # the axis frame's z in the frame of the ray through its origin; not normalised
    "axis_line": 6,  # products xx, yy, zz, xy, yz, zx of the axis: the axis without its sign, which is learned sooner
    "direction": DIRECTION_BINS,  # logits: the axis frame's x, in the frame of the ray through its origin
}
_CHANNELS_OUT = sum(HEADS.values())
_WIDEST = 1024


@dataclass(frozen=True)
class NetworkSize:
    """Channels of the four resolutions, from half of the input down to a sixteenth, and of the last shared layer."""

    widths: tuple[int, int, int, int] = (32, 64, 96, 160)
    last: int = 64

    def __post_init__(self) -> None:
        if len(self.widths) != 4 or not all(1 <= width <= _WIDEST for width in (*self.widths, self.last)):
            raise ValueError(
                f"a network needs four widths and a last width from 1 to {_WIDEST}, got {self.widths}, {self.last}"
            )


class DenseNetwork(nn.Module):
    """(n, CHANNELS, h, w) input, both sides multiples of 16, to (n, channels of all :data:`HEADS`, h / 2, w / 2)."""

    def __init__(self, size: NetworkSize = NetworkSize()) -> None:
        super().__init__()
        fine, middle, coarse, coarsest = size.widths
        self.down0 = nn.Sequential(_convolution(CHANNELS, fine, stride=2), _convolution(fine, fine))
        self.down1 = nn.Sequential(_convolution(fine, middle, stride=2), Residual(middle))
        self.down2 = nn.Sequential(_convolution(middle, coarse, stride=2), Residual(coarse))
        self.down3 = nn.Sequential(_convolution(coarse, coarsest, stride=2), Residual(coarsest), Residual(coarsest))
        self.up2, self.up1, self.up0 = Merge(coarsest, coarse), Merge(coarse, middle), Merge(middle, fine)
        self.answer = nn.Sequential(_convolution(fine, size.last), nn.Conv2d(size.last, _CHANNELS_OUT, 1))

    def forward(self, x: Tensor) -> Tensor:
        x0 = self.down0(x)
        x1 = self.down1(x0)
        x2 = self.down2(x1)
        x3 = self.down3(x2)
        return self.answer(self.up0(self.up1(self.up2(x3, x2), x1), x0))


class Residual(nn.Module):
    """Two convolutions, added to their input."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = _convolution(channels, channels)
        self.second = nn.Sequential(nn.Conv2d(channels, channels, 3, padding=1, bias=False), nn.BatchNorm2d(channels))

    def forward(self, x: Tensor) -> Tensor:
        return torch.relu(x + self.second(self.first(x)))


class Merge(nn.Module):
    """Enlarges coarse features, adds them to finer ones and smooths the sum."""

    def __init__(self, coarse: int, fine: int) -> None:
        super().__init__()
        self.reduce = nn.Conv2d(coarse, fine, 1)
        self.enlarge = nn.Upsample(scale_factor=2, mode="nearest")
        self.smooth = _convolution(fine, fine)

    def forward(self, coarse: Tensor, fine: Tensor) -> Tensor:
        return self.smooth(fine + self.enlarge(self.reduce(coarse)))


def _convolution(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride, padding=1, bias=False), nn.BatchNorm2d(outputs), nn.ReLU(inplace=True)
    )


def fused(network: DenseNetwork) -> DenseNetwork:
    """A copy for inference with each batch normalisation merged into the convolution before it."""
    network = deepcopy(network).eval()
    for module in list(network.modules()):
        if isinstance(module, nn.Sequential):
            match list(module):
                case [nn.Conv2d() as convolution, nn.BatchNorm2d() as normalisation, *_]:
                    module[0], module[1] = fuse_conv_bn_eval(convolution, normalisation), nn.Identity()
    return network


def has_fast_bfloat16(device: str = "cpu") -> bool:
    """Whether bfloat16 is faster than float32: on GPUs, and on processors that have instructions for it."""
    if device == "cuda":
        return True
    capabilities = torch.cpu.get_capabilities()
    return bool(capabilities.get("avx512_bf16") or capabilities.get("amx_bf16"))


def split(answer: Any, axis: int = 1) -> dict[str, Any]:
    """The network's output by head: views of a torch tensor or NumPy array, cut along ``axis``.

    Raises:
        ValueError: the number of channels is not that of :data:`HEADS`.
    """
    if answer.shape[axis] != _CHANNELS_OUT:
        raise ValueError(f"the output of the network has {answer.shape[axis]} channels; its heads have {_CHANNELS_OUT}")
    parts, start = {}, 0
    for name, channels in HEADS.items():
        parts[name] = answer[(slice(None),) * axis + (slice(start, start + channels),)]
        start += channels
    return parts
