"""Fits the weights of fusion from scenes whose true poses are known.

Rotations and bodies are scored so that, among all poses considered at a place, the right ones are probable (a
conditional logit). The probability of an object is a logistic regression on what is known of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import minimize
from scipy.special import expit
from torch import nn

from active6d_core.metrics import DETECTION_FRACTION, e_add
from active6d_core.object_model import ObjectModel
from active6d_core.se3 import transform_points
from active6d_perception.model.ambiguity import ambiguity_of
from active6d_perception.scene.belief_weights import Scorer
from active6d_perception.scene.scene_evidence import SceneEvidence

# Half of the loss is bounded: a place whose right pose looks impossible must not decide the weights.
_BOUNDED = 0.5
_UNITS = {"rotations": 32, "bodies": 16}
_EPOCHS, _BATCH = 16, 64  # a batch is of places
_RATE, _DECAY = 5e-3, 0.01
_PULL = 1e-3  # of the weights of the probability to 0, per squared unit


@dataclass(frozen=True, eq=False)
class LabelledPlaces:
    """Poses considered at the places of one episode of which some pose is right.

    Attributes:
        rotations: (K, r, columns) float32, see :meth:`.SceneEvidence.columns`.
        bodies: (K, columns) float32, see :meth:`.BodyEvidence.columns`.
        place: (K,) numbers, rising by one.
        right: (K, r) bool.
    """

    rotations: np.ndarray
    bodies: np.ndarray
    place: np.ndarray
    right: np.ndarray


def label_places(evidence: SceneEvidence, model: ObjectModel, T_world_object: np.ndarray) -> LabelledPlaces:
    """Keep the places with a right pose; (n, 4, 4) ``T_world_object`` are the true poses, metres."""
    ambiguity, candidates = ambiguity_of(model), evidence.candidates
    middles, true = (
        transform_points(T, ambiguity.middle[None])[:, 0] for T in (candidates.T_world_object, T_world_object)
    )
    nearest = np.linalg.norm(middles[:, None] - true, axis=-1).argmin(axis=1)
    limit = DETECTION_FRACTION * model.diameter
    errors = e_add(
        model, candidates.T_world_object[:, None] @ ambiguity.rotations, T_world_object[nearest][:, None], cutoff=limit
    )
    right = errors < limit
    solvable = np.isin(candidates.place, candidates.place[right.any(axis=1)])
    order = np.flatnonzero(solvable)[np.argsort(candidates.place[solvable], kind="stable")]
    place = np.unique(candidates.place[order], return_inverse=True)[1]
    return LabelledPlaces(evidence.columns()[order], evidence.bodies.columns()[order], place, right[order])


class _TrainedScorer(nn.Module):
    """:class:`.Scorer` for (n, c) columns whose statistics it takes."""

    mean: torch.Tensor
    scale: torch.Tensor

    def __init__(self, columns: torch.Tensor, units: int) -> None:
        super().__init__()
        flat = columns.reshape(-1, columns.shape[-1])
        self.register_buffer("mean", flat.mean(dim=0))
        # A column that hardly varies must not be blown up.
        self.register_buffer("scale", flat.std(dim=0) + 0.05)
        self.linear = nn.Linear(flat.shape[1], 1, bias=False)
        self.hidden, self.out = nn.Linear(flat.shape[1], units), nn.Linear(units, 1, bias=False)
        nn.init.zeros_(self.linear.weight)

    def forward(self, columns: torch.Tensor) -> torch.Tensor:
        standard = (columns - self.mean) / self.scale
        return (self.linear(standard) + self.out(torch.relu(self.hidden(standard))))[..., 0]

    def export(self) -> Scorer:
        tensors = self.linear.weight[0], self.hidden.weight.T, self.hidden.bias, self.out.weight[0]
        return Scorer(*(tensor.detach().numpy().copy() for tensor in (self.mean, self.scale, *tensors)))


def fit_belief(episodes: Sequence[LabelledPlaces], seed: int = 0) -> tuple[Scorer, Scorer]:
    """Fit the scorers of rotations and of bodies.

    Args:
        episodes: with at least one place among them.
        seed: of the first weights and of the order of places.

    Raises:
        ValueError: there is no place with a right pose.
    """
    if not any(len(episode.place) for episode in episodes):
        raise ValueError("no pose of any object is right: fusion cannot be fitted to this estimator")
    first = np.cumsum([0, *(episode.place.max(initial=-1) + 1 for episode in episodes)])
    place = np.concatenate([episode.place + start for episode, start in zip(episodes, first, strict=False)])
    # Objects differ in the number of rotations; repeating all of an object's changes none of its probabilities.
    common = np.lcm.reduce([episode.right.shape[1] for episode in episodes])
    repeated = [np.arange(common) % episode.right.shape[1] for episode in episodes]
    rotations, right = (
        torch.from_numpy(
            np.concatenate([getattr(each, name)[:, turn] for each, turn in zip(episodes, repeated, strict=True)])
        )
        for name in ("rotations", "right")
    )
    bodies = torch.from_numpy(np.concatenate([episode.bodies for episode in episodes]))
    starts = np.searchsorted(place, np.arange(first[-1] + 1))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        of_rotations = _TrainedScorer(rotations, _UNITS["rotations"])
        of_bodies = _TrainedScorer(bodies, _UNITS["bodies"])
    optimiser = torch.optim.AdamW([*of_rotations.parameters(), *of_bodies.parameters()], _RATE, weight_decay=_DECAY)
    batches = -(-int(first[-1]) // _BATCH)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, _EPOCHS * batches)
    rng = np.random.default_rng(seed)
    for _ in range(_EPOCHS):
        for batch in np.array_split(rng.permutation(first[-1]), batches):
            sizes = starts[batch + 1] - starts[batch]
            rows = torch.from_numpy(np.concatenate([np.arange(starts[p], starts[p + 1]) for p in batch]))
            group = torch.from_numpy(np.repeat(np.arange(len(batch)), sizes))
            odds = of_rotations(rotations[rows]) + of_bodies(bodies[rows])[:, None]
            loss = _loss(odds, right[rows], group, len(batch))
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
    return of_rotations.export(), of_bodies.export()


def _loss(odds: torch.Tensor, right: torch.Tensor, group: torch.Tensor, count: int) -> torch.Tensor:
    """Mean loss of the ``count`` groups whose rows (K, r) odds are; (K,) ``group`` numbers them."""

    def log_sum(values: torch.Tensor) -> torch.Tensor:
        highest = torch.full((count,), -torch.inf).scatter_reduce(0, group, values.max(dim=1).values, "amax").detach()
        total = torch.zeros(count).index_add(0, group, torch.exp(values - highest[group][:, None]).sum(dim=1))
        return highest + torch.log(total)

    log_p = log_sum(torch.where(right, odds, torch.tensor(-1e9))) - log_sum(odds)
    return (_BOUNDED * (1 - torch.exp(log_p)) - (1 - _BOUNDED) * log_p).mean()


def fit_probability(description: np.ndarray, right: np.ndarray) -> Scorer:
    """Fit the scorer of an object's probability.

    Args:
        description: (n, columns) see :func:`.describe_objects`, of scenes that the belief was not fitted to.
        right: (n,) bool, whether the object's pose is right.

    Raises:
        ValueError: there is no object.
    """
    if not len(right):
        raise ValueError("there is no object to fit the probability to")

    def loss(weights: np.ndarray) -> tuple[float, np.ndarray]:
        odds = description @ weights
        value = (np.logaddexp(0, odds) - right * odds).mean()
        gradient = (expit(odds) - right) @ description / len(right)
        return float(value + _PULL * (weights**2).sum()), gradient + 2 * _PULL * weights

    start = np.zeros(description.shape[1])
    return Scorer.of_weights(minimize(loss, start, jac=True, method="L-BFGS-B", options={"maxiter": 500}).x)
