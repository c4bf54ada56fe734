"""A policy that scores every view against the set of all objects: ``view-attention`` in the registry.

A Gaussian over two angles has one peak; good views may be on both sides of the bin. So every view of the grid is
valued separately. It attends to all accumulated objects and to the clusters of unexplained surface (cross-attention).
Features of each pair say how much of the object the view would show past the others and the bin's walls, from which
side, and how new that side is. The order and the number of objects do not matter.

The network predicts the gain of a view and the gain of the moves after it. Training is in
:mod:`active6d_agent.policies.view_attention.dagger`.
"""

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import nn

from active6d_agent.policies.policy_weights import load_weights, save_weights
from active6d_agent.policies.registry import Decision, DeterministicPolicy, Observation, register_policy, weights_path
from active6d_agent.policies.view_attention.features import (
    ITEM_FEATURES,
    PAIR_FEATURES,
    VIEW_FEATURES,
    SceneState,
    gather,
    go_for_items,
    represent,
)
from active6d_core.hypotheses import SceneObjects
from active6d_core.object_model import ObjectModel
from active6d_core.view_sphere import ViewSphere
from active6d_perception.scene.expected_visibility import Tray

#: A gain is the number of objects newly detected, and the fall of the summed ADD over 50 mm.
GAINS = 2


@dataclass(frozen=True)
class Weighing:
    """Weights of gains and travel in the worth of a view.

    Attributes:
        metres_weight: objects that one metre of travel costs.
        error_weight: of the fall of the summed ADD over 50 mm, in objects detected.
        lookahead: in [0, 1], weight of the gain of the moves after the next.

    Raises:
        ValueError: a weight is out of range.
    """

    metres_weight: float = 0.05
    error_weight: float = 0.5
    lookahead: float = 0.5

    def __post_init__(self) -> None:
        for name in ("metres_weight", "error_weight"):
            if not 0 <= getattr(self, name) < np.inf:
                raise ValueError(f"{name} is {getattr(self, name)}, must be finite and not negative")
        if not 0 <= self.lookahead <= 1:
            raise ValueError(f"lookahead is {self.lookahead}, must be in [0, 1]")


class _Seen(NamedTuple):
    """Activations of (M) views and (n) items."""

    pairs: torch.Tensor
    """(B, M, n, hidden), padding included"""
    whole: torch.Tensor
    """(B, M, 3 hidden + 8) the attended, the mean, and the features of the view"""
    mask: torch.Tensor
    """(B, n) 1 for an item, 0 for padding"""


class ViewAttention(nn.Module):
    """Values of all views.

    Args:
        hidden: width.
        weighing: with which it was validated.
    """

    def __init__(self, hidden: int = 32, weighing: Weighing = Weighing()) -> None:
        super().__init__()
        self.hidden, self.weighing = hidden, weighing
        self.of_object = nn.Sequential(nn.Linear(ITEM_FEATURES, hidden), nn.ReLU())
        self.in_context = nn.Sequential(nn.Linear(2 * hidden, hidden), nn.ReLU())
        self.of_pair = nn.Linear(PAIR_FEATURES, hidden)
        self.pair_from_object = nn.Linear(hidden, hidden, bias=False)
        self.pair_from_view = nn.Linear(VIEW_FEATURES, hidden, bias=False)
        self.mix = nn.Sequential(nn.Linear(hidden, hidden), nn.ReLU())
        self.attend = nn.Linear(hidden, 1)
        self.per_object = nn.Linear(hidden, 2 * GAINS)
        self.per_view = nn.Sequential(
            nn.Linear(3 * hidden + VIEW_FEATURES, hidden), nn.ReLU(), nn.Linear(hidden, 2 * GAINS)
        )

    def forward(self, state: dict[str, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
        """Value all views.

        Args:
            state: of :func:`~active6d_agent.policies.view_attention.features.gather`.

        Returns:
            Twice (B, M, n + 1, 2): gains of going there next, and of the moves after that, zero where none are left.
            They are the terms of each item, and last those of objects without an item; a view gains their sum.
        """
        seen = self._look(state)
        own = self.per_object(seen.pairs) * seen.mask[:, None, :, None]
        gains = torch.cat([own, self.per_view(seen.whole)[:, :, None]], dim=2)
        return gains[..., :GAINS], gains[..., GAINS:] * state["more"][:, None, None, None]

    def _look(self, state: dict[str, torch.Tensor]) -> "_Seen":
        views = state["outlooks"]
        h = self.of_object(state["items"])
        mask = state["present"].to(h.dtype)
        count = mask.sum(dim=1, keepdim=True).clamp(min=1)
        pooled = (h * mask[..., None]).sum(dim=1) / count
        h = self.in_context(torch.cat([h, pooled[:, None].expand_as(h)], dim=-1))
        # Passes over (B, M, n, hidden) dominate the time: sums are in place, and masks are in the weights of sums.
        e = self.of_pair(state["pairs"])
        e += self.pair_from_object(h)[:, None]
        e += self.pair_from_view(views)[:, :, None]
        e = e.relu_()
        e = e + self.mix(e)
        logits = self.attend(e)[..., 0].masked_fill_(mask[:, None] == 0, -1e9)
        attention = torch.softmax(logits, dim=-1) * mask[:, None]
        attended, total = (torch.stack([attention, mask[:, None].expand_as(attention)], dim=2) @ e).unbind(dim=2)
        whole = torch.cat([attended, total / count[..., None], pooled[:, None].expand_as(total), views], dim=-1)
        return _Seen(e, whole, mask)


def save_network(
    network: ViewAttention, path: Path, object_name: str, provenance: dict[str, Any] | None = None
) -> None:
    """Write ``path`` (.safetensors) and its configuration beside it (.json)."""
    config = {"object": object_name, "hidden": network.hidden, "weighing": asdict(network.weighing)}
    save_weights(network, path, "view-attention", config, provenance)


def load_network(path: Path, object_name: str) -> ViewAttention:
    """Read what :func:`save_network` wrote.

    Raises:
        ValueError: a file is missing, damaged, of another object or does not fit; the message names it.
    """

    def build(config: dict[str, Any]) -> ViewAttention:
        if config["object"] != object_name:
            raise ValueError(f"these are weights for '{config['object']}', not for '{object_name}'")
        return ViewAttention(config["hidden"], Weighing(**config["weighing"]))

    return load_weights(path, "view-attention", build)


@dataclass(frozen=True, eq=False)
class ViewValues:
    """Of B observations.

    Attributes:
        worth: (B, M) of going to each view next, ``-inf`` where it is not a candidate.
        gain: (B, M) expected of it and all later moves, ``-inf`` likewise.
        share: (B, M, n + 1) each item's share of what a view and the moves after it are worth, not negative and
            summing to one; last that of objects without an item. Zeros where a view is worth nothing.
    """

    worth: np.ndarray
    gain: np.ndarray
    share: np.ndarray


def value_views(
    network: nn.Module, observations: Sequence[Observation], states: Sequence[SceneState], weighing: Weighing
) -> ViewValues:
    """Value every view of every observation, given its features (:func:`.features.represent`)."""
    with torch.inference_mode():
        now, later = (values.double().numpy() for values in network(gather(states)))
    candidates = np.stack([each.candidates() for each in observations])
    arcs = np.stack([each.sphere.arc(each.sphere.positions, each.positions[-1]) for each in observations])
    weigh = np.array([1.0, weighing.error_weight])
    terms = (now + weighing.lookahead * later) @ weigh
    worth = terms.sum(axis=-1) - weighing.metres_weight * arcs
    # Views of equal value differ by rounding, which must not decide.
    worth = np.where(candidates, np.round(worth, 5), -np.inf)
    positive = np.maximum(terms, 0.0)
    total = positive.sum(axis=-1, keepdims=True)
    share = positive / np.where(total > 0, total, 1.0)
    return ViewValues(worth, np.where(candidates, ((now + later) @ weigh).sum(axis=-1), -np.inf), share)


def trace(network: ViewAttention, model: ObjectModel) -> nn.Module:
    """The same network without Python between its many small operations, for observations of any size."""
    sphere = ViewSphere()
    nothing = Observation(SceneObjects.empty(), sphere.positions[:1], sphere, np.ones(len(sphere), bool), 1)
    state = gather([represent(nothing, model)])
    with torch.inference_mode(), warnings.catch_warnings():
        # torch calls tracing deprecated, but what shall replace it needs a compiler on the robot.
        warnings.simplefilter("ignore", DeprecationWarning)
        traced = torch.jit.trace(network, (state,), strict=False, check_trace=False)
        # The first two calls optimise it, which no decision should wait for.
        for _ in range(2):
            traced(state)
    return traced


@lru_cache(maxsize=8)
def _deployed(path: Path, model: ObjectModel, written: int) -> tuple[nn.Module, Weighing]:
    """The traced network of a file as it was ``written`` (ns), and its weighing; an evaluation makes hundreds of
    policies, which share one."""
    network = load_network(path, model.name)
    return trace(network, model), network.weighing


@contextmanager
def _one_thread() -> Iterator[None]:
    """One observation is too little work to share: on a busy machine its threads wait for each other a hundred times
    as long as they work. What else the process computes keeps its threads."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@register_policy("view-attention")
class ViewAttentionPolicy(DeterministicPolicy):
    """Goes to the view of highest worth: its expected gain, plus that of the moves after it, less the travel.

    Args:
        model: names the shipped weights.
        weights: path of other weights, ``""`` for the shipped ones.
        metres_weight: see :class:`Weighing`; by default that of the weights, as for the next two.
        error_weight: likewise.
        lookahead: likewise.
        stop_below: stop when this and all later moves are expected to gain less than this many objects; 0 never does.
        bin_width: between the bin's inner walls along world x, metres; by default that of the object's usual bin.
        bin_depth: likewise along world y; by default as ``bin_width``.
        wall_height: of those walls above the floor, metres; 0 for an open table, by default that of the usual bin.

    Raises:
        ValueError: there are no usable weights, or a number is out of range.
    """

    def __init__(
        self,
        model: ObjectModel,
        weights: str = "",
        metres_weight: float | None = None,
        error_weight: float | None = None,
        lookahead: float | None = None,
        stop_below: float = 0.0,
        bin_width: float | None = None,
        bin_depth: float | None = None,
        wall_height: float | None = None,
    ) -> None:
        path = Path(weights) if weights else weights_path("view-attention", model.name)
        written = path.stat().st_mtime_ns if path.is_file() else 0
        self._network, weighing = _deployed(path, model, written)
        given = {"metres_weight": metres_weight, "error_weight": error_weight, "lookahead": lookahead}
        self._model, self._stop_below = model, stop_below
        self._weighing = replace(weighing, **{name: value for name, value in given.items() if value is not None})
        usual = Tray.for_model(model)
        width = usual.width if bin_width is None else bin_width
        depth, height = (
            width if bin_depth is None else bin_depth,
            usual.wall_height if wall_height is None else wall_height,
        )
        if not (0 < width < np.inf and 0 < depth < np.inf and 0 <= height < np.inf):
            raise ValueError(
                f"bin_width and bin_depth must be positive and wall_height not negative, got {width}, {depth}, {height}"
            )
        self._tray = Tray(width, depth, height)

    def decide(self, observation: Observation) -> Decision:
        """The view of highest worth. The attention is each object's share of it."""
        with _one_thread():
            state = represent(observation, self._model, self._tray)
            values = value_views(self._network, [observation], [state], self._weighing)
        most = values.gain[0].max()
        if most == -np.inf or (self._stop_below > 0 and most < self._stop_below):
            return Decision.stop_here(observation)
        view = int(values.worth[0].argmax())
        return go_for_items(observation, view, values.share[0, view])
