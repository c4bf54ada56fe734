"""A policy that scores every view against the set of all objects: ``view-attention`` in the registry.

A Gaussian over two angles cannot say "either of these two gaps". Here every view of the grid is valued by itself:
it looks at all accumulated objects (cross-attention) through what a robot knows of each pair, which is geometry
between poses: how free the line of sight is past the other objects, from which side of the object it comes, how new
that side is after the views already taken. Everything is relative, so turning the world about the vertical axis turns
the answer with it; the order and the number of objects do not matter.

The network predicts what a view gains at once and what can still be gained after it. Training is in
:mod:`active6d_agent.imitation`.
"""

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import nn

from active6d_agent.policy import Decision, Observation, register_policy, weights_path
from active6d_agent.weights_file import load_weights, save_weights
from active6d_core.hypotheses import SceneObjects
from active6d_core.object_model import ObjectModel
from active6d_core.view_sphere import ViewSphere

#: Objects beyond these are left out, the best verified being kept.
MAX_OBJECTS = 64
#: Gains are told as objects newly detected, and as the fall of the summed e_ADD over 50 mm.
GAINS = 2
_OBJECT_FEATURES = 14
_PAIR_FEATURES = 12
_VIEW_FEATURES = 8
# A hypothesis closer than this fraction of the diameter is the same object, so it hides nothing.
_SAME_OBJECT = 0.25


@dataclass(frozen=True)
class Weighing:
    """What counts.

    Attributes:
        metres_weight: objects that must be gained for a metre on the way.
        error_weight: of the fall of the summed error over 50 mm, against one object detected.
        lookahead: in [0, 1], weight of what the moves after the next will gain.

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


def best_verified(observation: Observation) -> np.ndarray:
    """Indices of the objects that are looked at: all, or of many the best verified."""
    return np.argsort(-observation.objects.verification, kind="stable")[:MAX_OBJECTS]


def encode(observations: Sequence[Observation]) -> dict[str, torch.Tensor]:
    """Padded tensors of B observations on one grid.

    Returns:
        ``pose`` (B, n, 3, 4) objects in the world, ``scalars`` (B, n, 4) verification, score, spread in metres and
        share of the views that support the object, ``present`` (B, n), ``taken`` (B, t, 3) positions so far, at the end
        the current one, repeated, ``moves`` (B,) moves made, ``left`` (B,) moves left, ``views`` (M, 3).
    """
    count = max(1, max(min(len(each.objects), MAX_OBJECTS) for each in observations))
    longest = max(len(each.positions) for each in observations)
    B = len(observations)
    pose, scalars = np.zeros((B, count, 3, 4), np.float32), np.zeros((B, count, 4), np.float32)
    present, taken = np.zeros((B, count), bool), np.zeros((B, longest, 3), np.float32)
    for row, each in enumerate(observations):
        objects, t = each.objects, len(each.positions)
        n = min(len(objects), MAX_OBJECTS)
        best = best_verified(each)
        pose[row, :n] = objects.T_world_object[best, :3]
        columns = (objects.verification, objects.score, objects.spread, objects.support / t)
        scalars[row, :n] = np.column_stack(columns)[best]
        present[row, :n] = True
        taken[row, :t], taken[row, t:] = each.positions, each.positions[-1]
    arrays = {
        "pose": pose,
        "scalars": scalars,
        "present": present,
        "taken": taken,
        "moves": np.array([len(each.positions) - 1 for each in observations], np.float32),
        "left": np.array([each.steps_left for each in observations], np.float32),
        "views": observations[0].sphere.positions.astype(np.float32),
    }
    return {name: torch.from_numpy(values) for name, values in arrays.items()}


class _Seen(NamedTuple):
    """What (M) views make of (n) objects."""

    pairs: torch.Tensor
    """(B, M, n, hidden), also of objects that are padding"""
    total: torch.Tensor
    """(B, M, hidden) sum over the objects"""
    whole: torch.Tensor
    """(B, M, 3 hidden + 8) the attended, the mean, and what is known of the view"""
    attention: torch.Tensor
    """(B, M, n)"""
    mask: torch.Tensor
    """(B, n) 1 for an object, 0 for padding"""


class ViewAttention(nn.Module):
    """Values of all views.

    Args:
        diameter: of the object, metres.
        axis: (3,) unit axis of a continuous symmetry, None without one.
        hidden: width.
        weighing: what counted when it was validated.
    """

    def __init__(
        self, diameter: float, axis: Sequence[float] | None = None, hidden: int = 32, weighing: Weighing = Weighing()
    ) -> None:
        super().__init__()
        self.diameter, self.axis, self.hidden, self.weighing = diameter, axis, hidden, weighing
        self.register_buffer("_axis", None if axis is None else torch.tensor(axis), persistent=False)
        self.of_object = nn.Sequential(nn.Linear(_OBJECT_FEATURES, hidden), nn.ReLU())
        self.in_context = nn.Sequential(nn.Linear(2 * hidden, hidden), nn.ReLU())
        self.of_pair = nn.Linear(_PAIR_FEATURES, hidden)
        self.pair_from_object = nn.Linear(hidden, hidden, bias=False)
        self.pair_from_view = nn.Linear(_VIEW_FEATURES, hidden, bias=False)
        self.mix = nn.Sequential(nn.Linear(hidden, hidden), nn.ReLU())
        self.attend = nn.Linear(hidden, 1)
        self.per_object = nn.Linear(hidden, 2 * GAINS)
        self.per_view = nn.Sequential(
            nn.Linear(3 * hidden + _VIEW_FEATURES, hidden), nn.ReLU(), nn.Linear(hidden, 2 * GAINS)
        )

    def forward(self, state: dict[str, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Value all views.

        Args:
            state: of :func:`encode`.

        Returns:
            (B, M, 2) gains of going there next; (B, M, 2) gains of the moves after that, zero where none are left;
            (B, M, n) each view's attention to the objects.
        """
        seen = self._look(state)
        # Gains of different objects add up, each a linear function of its features, so they are had from the sum of
        # those. What nobody has seen yet is for the view as a whole to say.
        bias = (seen.mask.sum(dim=1, keepdim=True) * self.per_object.bias)[:, None]
        gains = seen.total @ self.per_object.weight.T + bias + self.per_view(seen.whole)
        more = (state["left"] > 1)[:, None, None]
        return gains[..., :GAINS], gains[..., GAINS:] * more, seen.attention

    def explain(self, state: dict[str, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
        """What :meth:`forward` adds up, to learn from: twice (B, M, n + 1, 2), gains of going there next and of the
        moves after that, of each object, and at the end of the view as a whole."""
        seen = self._look(state)
        own = self.per_object(seen.pairs) * seen.mask[:, None, :, None]
        gains = torch.cat([own, self.per_view(seen.whole)[:, :, None]], dim=2)
        return gains[..., :GAINS], gains[..., GAINS:] * (state["left"] > 1)[:, None, None, None]

    def _look(self, state: dict[str, torch.Tensor]) -> "_Seen":
        objects, pairs, views = self.describe(state)
        h = self.of_object(objects)
        mask = state["present"].to(h.dtype)
        count = mask.sum(dim=1, keepdim=True).clamp(min=1)
        pooled = (h * mask[..., None]).sum(dim=1) / count
        h = self.in_context(torch.cat([h, pooled[:, None].expand_as(h)], dim=-1))
        # Passes over (B, M, n, hidden) are what costs: sums are in place, and masks in the weights of sums.
        e = self.of_pair(pairs)
        e += self.pair_from_object(h)[:, None]
        e += self.pair_from_view(views)[:, :, None]
        e = e.relu_()
        e = e + self.mix(e)
        logits = self.attend(e)[..., 0].masked_fill_(mask[:, None] == 0, -1e9)
        attention = torch.softmax(logits, dim=-1) * mask[:, None]
        attended, total = (torch.stack([attention, mask[:, None].expand_as(attention)], dim=2) @ e).unbind(dim=2)
        whole = torch.cat([attended, total / count[..., None], pooled[:, None].expand_as(total), views], dim=-1)
        return _Seen(e, total, whole, attention, mask)

    def describe(self, state: dict[str, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """What is known of (B, n, 14) objects, (B, M, n, 12) pairs and (B, M, 8) views; none of it names a direction
        of the world but the vertical."""
        pose, present, taken, grid = state["pose"], state["present"], state["taken"], state["views"]
        rotation, centre = pose[..., :3], pose[..., 3]
        B, M = pose.shape[0], grid.shape[0]
        radius = torch.linalg.vector_norm(taken, dim=-1, keepdim=True)
        outlook, headings = grid / torch.linalg.vector_norm(grid, dim=-1, keepdim=True), taken / radius
        # Cameras last, (B, n, 3, K), so that everything between objects and cameras is one long row after another.
        cameras = torch.cat([grid.expand(B, M, 3), taken], dim=1).transpose(1, 2)
        rays = cameras[:, None] - centre[..., None]
        distance = torch.linalg.vector_norm(rays, dim=2)
        rays /= distance.clamp(min=1e-6)[:, :, None]
        apart = (centre[:, None] - centre[:, :, None]) / self.diameter
        square = (apart**2).sum(dim=-1)
        free, clear = self._sight(rays, apart, square, present)
        new, seen_then = rays[..., :M], free[..., M:]
        from_axis = torch.linalg.vector_norm(centre[..., :2], dim=-1)
        outward = centre[..., None, :2] / from_axis.clamp(min=1e-6)[..., None, None]
        turned = rays[..., M:].transpose(2, 3) @ new
        closest = turned.amax(dim=2).clamp_(-1.0, 1.0)
        columns = [
            free[..., :M],
            clear[..., :M],
            new[:, :, 2],
            torch.acos(closest * 0.999999) / np.pi,
            closest,
            (seen_then[..., None] * (1.0 + turned)).amax(dim=2) / 2,
            distance[..., :M] / radius[:, -1:] - 1.0,
            (outward @ new[:, :, :2])[:, :, 0],
            (new * outlook.T).sum(dim=2) - 0.95,
            *self._sides((rotation.transpose(2, 3) @ new).movedim(2, -1)).unbind(dim=-1),
        ]
        pairs = torch.stack(columns, dim=2).permute(0, 3, 1, 2).contiguous()
        sights = seen_then.amax(dim=2), clear[..., -1]
        objects = self._describe_objects(state, apart, square, from_axis, sights)
        return objects, pairs, self._describe_views(state, outlook, headings)

    def _sight(
        self, rays: torch.Tensor, apart: torch.Tensor, square: torch.Tensor, present: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """How free (B, n, 3, K) rays from objects to cameras are past the other objects: (B, n, K) twice, once for
        balls with the diameter and once for their cores."""
        hides = (square > _SAME_OBJECT**2) & present[:, None]
        # (B, n, n, K), the object whose sight it is first, then the one that may hide it.
        along = apart @ rays
        beside = torch.addcmul(torch.where(hides, square, np.inf)[..., None], along, along, value=-1.0)
        beside = torch.where(along > 0, beside, 1.0).clamp_(0.0, 1.0)
        # Roots are drawn of the products, which are fewer.
        return beside.prod(dim=2).sqrt_(), (4 * beside).clamp_(max=1.0).prod(dim=2).sqrt_()

    def _sides(self, directions: torch.Tensor) -> torch.Tensor:
        """(..., 3) directions in the object's frame; about a symmetry axis only the angle to it counts."""
        if self._axis is None:
            return directions
        axial = directions @ self._axis
        return torch.stack([axial, (1 - axial**2).clamp(min=0.0).sqrt(), torch.zeros_like(axial)], dim=-1)

    def _describe_objects(
        self,
        state: dict[str, torch.Tensor],
        apart: torch.Tensor,
        square: torch.Tensor,
        from_axis: torch.Tensor,
        sights: tuple[torch.Tensor, torch.Tensor],
    ) -> torch.Tensor:
        pose, present = state["pose"], state["present"]
        verification, score, spread, support = state["scalars"].unbind(dim=-1)
        near = torch.exp(-square) * present[:, None]
        columns = [
            verification,
            score,
            (spread / self.diameter).clamp_(max=1.0),
            support,
            pose[..., 2, 3] / self.diameter,
            from_axis / (2 * self.diameter),
            near.sum(dim=-1) / 3,
            (near * apart[..., 2].clamp(min=0.0)).sum(dim=-1),
            *sights,
            (state["moves"] / 5).clamp_(max=2.0)[:, None].expand_as(score),
            *self._sides(pose[..., 2, :3]).unbind(dim=-1),
        ]
        return torch.stack(columns, dim=-1)

    def _describe_views(
        self, state: dict[str, torch.Tensor], outlook: torch.Tensor, headings: torch.Tensor
    ) -> torch.Tensor:
        arcs = torch.acos((outlook @ headings.transpose(1, 2)).clamp_(-1, 1).mul_(0.999999)) / np.pi
        moves, left = (torch.stack([state["moves"], state["left"]]) / 5).clamp_(max=2.0).unbind()
        of_state = [headings[:, -1, 2], moves, left, state["present"].sum(dim=1) / 20.0, 1.0 / (1.0 + 5 * left)]
        level, *rest = torch.stack(of_state)[:, :, None].expand(-1, *arcs.shape[:2]).unbind()
        return torch.stack([outlook[:, 2].expand_as(level), level, arcs[..., -1], arcs.amin(dim=-1), *rest], dim=-1)


def save_network(network: ViewAttention, path: Path, object_name: str, provenance: dict | None = None) -> None:
    """Write ``path`` (.safetensors) and its configuration beside it (.json)."""
    axis = None if network.axis is None else [float(value) for value in network.axis]
    config = {
        "object": object_name,
        "diameter": float(network.diameter),
        "axis": axis,
        "hidden": network.hidden,
        "weighing": asdict(network.weighing),
    }
    save_weights(network, path, "view-attention", config, provenance)


def load_network(path: Path, object_name: str) -> ViewAttention:
    """Read what :func:`save_network` wrote.

    Raises:
        ValueError: a file is missing, damaged, of another object or does not fit; the message names it.
    """

    def build(config: dict) -> ViewAttention:
        if config["object"] != object_name:
            raise ValueError(f"these are weights for '{config['object']}', not for '{object_name}'")
        return ViewAttention(config["diameter"], config["axis"], config["hidden"], Weighing(**config["weighing"]))

    return load_weights(path, "view-attention", build)


def new_network(model: ObjectModel, hidden: int = 32) -> ViewAttention:
    """An untrained network for an object."""
    axis = model.symmetry.axis
    return ViewAttention(float(model.diameter), None if axis is None else axis.tolist(), hidden)


@dataclass(frozen=True, eq=False)
class ViewValues:
    """Of B observations.

    Attributes:
        worth: (B, M) of going to each view next, ``-inf`` where it is no candidate.
        gain: (B, M) expected of it and all later moves, ``-inf`` likewise.
        attention: (B, M, n) of each view to the objects that :func:`encode` keeps.
    """

    worth: np.ndarray
    gain: np.ndarray
    attention: np.ndarray


def value_views(network: nn.Module, observations: Sequence[Observation], weighing: Weighing) -> ViewValues:
    """Value every view of every observation."""
    with torch.inference_mode():
        now, later, attention = (values.double().numpy() for values in network(encode(observations)))
    candidates = np.stack([each.candidates() for each in observations])
    arcs = np.stack([each.sphere.arc(each.sphere.positions, each.positions[-1]) for each in observations])
    weigh = np.array([1.0, weighing.error_weight])
    worth = (now + weighing.lookahead * later) @ weigh - weighing.metres_weight * arcs
    # Views of equal value differ by rounding, which must not decide.
    worth = np.where(candidates, np.round(worth, 5), -np.inf)
    return ViewValues(worth, np.where(candidates, (now + later) @ weigh, -np.inf), attention)


def trace(network: ViewAttention) -> nn.Module:
    """The same network without Python between its many small operations, for observations of any size."""
    sphere = ViewSphere()
    nothing = Observation(SceneObjects.empty(), sphere.positions[:1], sphere, np.ones(len(sphere), bool), 1)
    state = encode([nothing])
    with torch.inference_mode(), warnings.catch_warnings():
        # torch calls tracing deprecated, but what shall replace it needs a compiler on the robot.
        warnings.simplefilter("ignore", DeprecationWarning)
        traced = torch.jit.trace(network, (state,), strict=False, check_trace=False)
        # The first two calls optimise it; no decision should wait for that.
        for _ in range(2):
            traced(state)
    return traced


@lru_cache(maxsize=8)
def _deployed(path: Path, object_name: str, written: int) -> tuple[nn.Module, Weighing]:
    """The traced network of a file as it was ``written`` (ns), and its weighing; an evaluation makes hundreds of
    policies, which share one."""
    network = load_network(path, object_name)
    return trace(network), network.weighing


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
class ViewAttentionPolicy:
    """Goes to the view that is worth most: what it gains at once, plus what the moves after it are expected to gain,
    less the way there.

    Args:
        model: names the shipped weights.
        weights: path of other weights, ``""`` for the shipped ones.
        metres_weight: see :class:`Weighing`; by default what the weights were validated with, as the next two.
        error_weight: likewise.
        lookahead: likewise.
        stop_below: stop when this and all later moves are expected to gain less than this many objects; 0 never does.

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
    ) -> None:
        path = Path(weights) if weights else weights_path("view-attention", model.name)
        written = path.stat().st_mtime_ns if path.is_file() else 0
        self._network, weighing = _deployed(path, model.name, written)
        given = {"metres_weight": metres_weight, "error_weight": error_weight, "lookahead": lookahead}
        given = {name: value for name, value in given.items() if value is not None}
        self._weighing = replace(weighing, **given)
        self._stop_below = stop_below

    def reset(self, rng: np.random.Generator) -> None:
        """Nothing is random here."""

    def decide(self, observation: Observation) -> Decision:
        """The view of most worth, and the object that it attends to."""
        with _one_thread():
            values = value_views(self._network, [observation], self._weighing)
        most = values.gain[0].max()
        if most == -np.inf or (self._stop_below > 0 and most < self._stop_below):
            return Decision.stop_here(observation)
        view = int(values.worth[0].argmax())
        n = len(observation.objects)
        if n == 0:
            return Decision.go_to(observation, view)
        attention = np.zeros(n)
        attention[best_verified(observation)] = values.attention[0, view]
        return Decision.go_to(observation, view, attention / attention.sum(), int(attention.argmax()))
