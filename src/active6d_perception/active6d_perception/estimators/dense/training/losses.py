"""The loss of the network's output."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from active6d_perception.estimators.dense.network import split
from active6d_perception.estimators.dense.training.targets import Targets

#: Range of the logarithm of Laplace scales: 0.3 % to 150 % of the diameter.
SCALE_RANGE = (-5.8, 0.4)


@dataclass(frozen=True)
class LossWeights:
    """Weight of each term of the loss; 0 leaves a head untrained."""

    mask: float = 1.0
    centre: float = 2.0
    scale: float = 0.1
    axis: float = 2.0
    axis_line: float = 2.0
    direction: float = 1.0


def loss_terms(answer: Tensor, targets: Sequence[Targets]) -> dict[str, Tensor]:
    """Compute the terms of the loss, by the names of :class:`LossWeights`.

    ``centre`` and ``axis`` are mean distances ``e``, the first in diameters. ``scale`` is the negative log-likelihood
    ``e / b + 3 log b`` of an isotropic Laplace distribution in space. The network predicts its scale b, and so learns
    where the error of the centre is large.

    The likelihood trains b only: ``e`` is held fixed in it. Otherwise the head would be weighted by 1 / b, and the
    centre, which is learned early, would outweigh the axis, which is difficult.

    Args:
        answer: (n, channels, h, w) output of the network, at least as large as the targets.
        targets: targets of each view, all of one size.
    """
    height, width = targets[0].mask.shape
    answer = answer[:, :, :height, :width].float()
    mask = torch.stack([torch.from_numpy(target.mask) for target in targets]).to(answer.device)
    terms = {"mask": F.binary_cross_entropy_with_logits(answer[:, 0], mask)}
    pixel = torch.cat([torch.from_numpy(target.pixel + i * height * width) for i, target in enumerate(targets)])
    parts = split(answer.movedim(1, -1).reshape(-1, answer.shape[1])[pixel.to(answer.device)], axis=1)
    wanted = {name: _gather(targets, name, answer) for name in ("weight", "centre", "axis", "direction")}
    weight = wanted["weight"] / wanted["weight"].sum().clamp(min=1.0)
    log_scale = parts["centre_scale"][:, 0].clamp(*SCALE_RANGE)
    error = (parts["centre"] - wanted["centre"]).norm(dim=1)
    terms["scale"] = (weight * (error.detach() * torch.exp(-log_scale) + 3 * log_scale)).sum()
    terms["centre"] = (weight * error).sum()
    terms["axis"] = (weight * (parts["axis"] - wanted["axis"]).norm(dim=1)).sum()
    terms["axis_line"] = (weight * (parts["axis_line"] - _line(wanted["axis"])).norm(dim=1)).sum()
    cross_entropy = -(wanted["direction"] * F.log_softmax(parts["direction"], dim=1)).sum(dim=1)
    terms["direction"] = (weight * cross_entropy).sum()
    return terms


def total(terms: dict[str, Tensor], weights: LossWeights) -> Tensor:
    """The weighted sum of the terms."""
    return sum(getattr(weights, name) * value for name, value in terms.items())


def _line(axis: Tensor) -> Tensor:
    """(p, 6) products xx, yy, zz, xy, yz, zx of (p, 3) vectors; an axis and its opposite have the same."""
    return torch.cat([axis * axis, axis * axis.roll(-1, dims=1)], dim=1)


def _gather(targets: Sequence[Targets], name: str, like: Tensor) -> Tensor:
    return torch.cat([torch.from_numpy(getattr(target, name)) for target in targets]).to(like.device)
