"""Training ``view-attention`` on a scene bank by imitation (DAgger).

The ground truth gives the gain of every candidate view, and the gain of the moves after it under a fixed rule: views
far from all taken ones (:func:`spread`). So one visited state labels a hundred views. The states are those that the
learner visits itself, with some random moves and with budgets of every length.
"""

import json
import time
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np
import torch
from torch.optim.lr_scheduler import CosineAnnealingLR
from torch.optim.swa_utils import AveragedModel

from active6d_agent.bank.scene_lookup import FusedBatch, SceneLookup
from active6d_agent.environment.rollout import MEASURES, Choose, measure, roll_out
from active6d_agent.evaluation.oracle import known
from active6d_agent.evaluation.policy_evaluation import all_starts, run_named
from active6d_agent.policies.registry import MAX_OBJECTS, Observation
from active6d_agent.policies.training_folder import begin_training
from active6d_agent.policies.view_attention.features import BELIEF, INFORMATION, SceneState, gather, represent
from active6d_agent.policies.view_attention.network import (
    GAINS,
    ViewAttention,
    Weighing,
    load_network,
    save_network,
    value_views,
)
from active6d_core.files import Checkpoints, append_line
from active6d_core.object_model import ObjectModel
from active6d_core.view_sphere import ViewSphere

# Episodes that the network values together: more are no faster and need memory.
_TOGETHER = 32
# The averaged weights are a mean over about as many steps as four rounds have.
_MEAN_DECAY = 0.995
# The learning rate at the end, over that at the beginning.
_LOWEST_RATE = 0.02
# Values that are tried for the weighing.
_LOOKAHEADS = (0.0, 0.25, 0.5, 1.0)
_METRES_WEIGHTS = (0.0, 0.02, 0.05, 0.1, 0.2, 0.4, 0.7, 1.0)
# A cluster of unexplained surface belongs to a true object within this fraction of the diameter of its likely centre.
_CLUSTER_REACH = 0.75
# Weight of the loss of all gains to the end, against that of the next view's.
_LATER_WEIGHT = 0.1
# Variance over a state's views, in objects squared, below which all states count the same.
_VARIANCE_FLOOR = 0.1

#: Columns of the network's inputs that are not used, by the value of ``inputs``.
IGNORED: dict[str, dict[str, slice | int]] = {
    "all": {},
    "belief": {"pairs": INFORMATION},
    "information": {"items": BELIEF},
    "poses": {"items": BELIEF, "pairs": INFORMATION},
}


@dataclass(frozen=True)
class DaggerParameters:
    """How to train.

    Attributes:
        steps: horizon T of validation.
        longest: training episodes have 1 to this many moves.
        rounds: of collecting states and learning from all of them.
        episodes: of each round.
        updates: steps of the optimiser each round.
        batch: states per step.
        views: of each state that one step learns from.
        learning_rate: of Adam at first; falls to 2 % of it along a cosine.
        explore: share of random moves, in [0, 1].
        capacity: states kept, the latest.
        starts: validation episodes.
        evaluate_every: rounds between validations.
        object_weight: of the loss of single objects, against that of a view's sum.
        certainty: share of a detection's gain that counts only with the pose's probability, in [0, 1]. Whether a pose
            is detected changes by chance; its probability rises with every view that tells something.
        inputs: ``all``, or without what fusion knows of its certainty, to measure what that is worth: ``poses``
            (neither probability, entropy nor expected information), ``belief`` (no expected information) or
            ``information`` (neither probability nor entropy).
        hidden: width of the network.
        seed: of the weights, the episodes and the batches.

    Raises:
        ValueError: a value is out of range.
    """

    steps: int = 5
    longest: int = 8
    rounds: int = 30
    episodes: int = 32
    updates: int = 100
    batch: int = 96
    views: int = 32
    learning_rate: float = 2e-3
    explore: float = 0.2
    capacity: int = 12_000
    starts: int = 300
    evaluate_every: int = 5
    object_weight: float = 1.0
    certainty: float = 0.5
    inputs: str = "all"
    hidden: int = 32
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("explore", "certainty"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"training: {name} must be in [0, 1], got {getattr(self, name)}")
        if self.inputs not in IGNORED:
            raise ValueError(f"training: inputs must be one of {', '.join(IGNORED)}, got '{self.inputs}'")
        for name in asdict(self).keys() - {"certainty", "explore", "learning_rate", "object_weight", "inputs", "seed"}:
            if getattr(self, name) < 1:
                raise ValueError(f"training: {name} must be at least 1, got {getattr(self, name)}")
        if not self.learning_rate > 0:
            raise ValueError(f"training: learning_rate must be positive, got {self.learning_rate}")


@dataclass(frozen=True)
class DaggerProgress:
    """One line of the curve.

    Attributes:
        round: rounds done.
        seconds: of training so far.
        states: labelled so far.
        loss: mean of the round.
        detection_rate: on the validation scenes.
        e_add_mm: there.
        distance_m: there.
    """

    round: int
    seconds: float
    states: int
    loss: float
    detection_rate: float
    e_add_mm: float
    distance_m: float


@dataclass(frozen=True, eq=False)
class Example:
    """One state and the gains of its views.

    Attributes:
        state: the network's input.
        now: (M, n + 1, 2) :func:`candidate_gains`.
        later: (M, n + 1, 2) likewise.
    """

    state: SceneState
    now: np.ndarray
    later: np.ndarray


def train_dagger(
    train: SceneLookup,
    validation: SceneLookup,
    folder: Path,
    parameters: DaggerParameters | None = None,
    weighing: Weighing | None = None,
    *,
    resume: bool = False,
    again: bool = False,
) -> Iterator[DaggerProgress]:
    """Train, evaluate on the validation scenes, keep the best; yields the curve as it grows.

    ``folder`` receives ``curve.jsonl``, ``best.safetensors`` (highest validation detection rate, lower ADD of equals)
    and ``latest.safetensors``, each with its JSON. At the end the best gets its weighing by :func:`choose_weighing`.

    Args:
        train: scenes to train on.
        validation: scenes to choose the best on.
        folder: of the results.
        parameters: how to train.
        weighing: of gains and travel, for the learner's moves.
        resume: go on from ``latest``, which is at most one round or some 20 s old, with newly collected states.
        again: replace the training that is in the folder.

    Raises:
        ValueError: there is nothing to resume from, or a training that is neither to go on nor to be replaced.
    """
    parameters, weighing = parameters or DaggerParameters(), weighing or Weighing()
    begin_training(folder, resume=resume, again=again)
    learner = _Learner(train, parameters, weighing)
    curve, latest, best, begun = folder / "curve.jsonl", folder / "latest.safetensors", (-1.0, 0.0), time.perf_counter()
    if resume:
        best, seconds = learner.restore(latest)
        begun -= seconds
    starts = all_starts(validation, parameters.starts)  # the same for every seed, whose networks are compared
    common = {"parameters": asdict(parameters), "bank": train.bank.provenance}
    checkpoints = Checkpoints()
    while learner.round < parameters.rounds:
        loss = learner.advance()
        seconds = time.perf_counter() - begun
        if learner.round % parameters.evaluate_every and learner.round < parameters.rounds:
            if checkpoints.due():
                done = {"round": learner.round, "seconds": seconds, "states": learner.states}
                save_network(learner.network, latest, train.model.name, {**common, "progress": done, "best": best})
            continue
        measured = validate(learner.network, validation, starts, parameters.steps)
        progress = DaggerProgress(learner.round, seconds, learner.states, loss, *measured)
        append_line(curve, json.dumps(asdict(progress)))
        made = {**common, "progress": asdict(progress)}
        if (progress.detection_rate, -progress.e_add_mm) > best:
            best = (progress.detection_rate, -progress.e_add_mm)
            save_network(learner.network, folder / "best.safetensors", train.model.name, made)
        save_network(learner.network, latest, train.model.name, {**made, "best": best})
        yield progress
    settle(folder / "best.safetensors", validation, starts, parameters.steps)


def settle(path: Path, validation: SceneLookup, starts: np.ndarray, steps: int) -> None:
    """Give stored weights the weighing of :func:`choose_weighing`; for its arguments see there."""
    network = load_network(path, validation.model.name)
    provenance = json.loads(path.with_suffix(".json").read_text())["provenance"]
    network.weighing = choose_weighing(network, validation, starts, steps)
    settled = dict(zip(MEASURES, validate(network, validation, starts, steps), strict=True))
    save_network(network, path, validation.model.name, {**provenance, "settled": settled})


def choose_weighing(network: ViewAttention, validation: SceneLookup, starts: np.ndarray, steps: int) -> Weighing:
    """The lookahead with the highest detection rate on the validation scenes, then likewise the weight of metres.

    Weights of metres count only if the network travels no farther than the random policy.

    Args:
        network: whose weighing is the start; it is not changed.
        validation: scenes to choose on.
        starts: (E, 2) scenes and first views.
        steps: moves T.
    """
    most_metres = run_named(validation, "random", starts, steps).distance_m.mean()
    given, weighing = network.weighing, network.weighing
    for name, values in (("lookahead", _LOOKAHEADS), ("metres_weight", _METRES_WEIGHTS)):
        results = []
        for value in values:
            network.weighing = replace(weighing, **{name: value})
            rate, error, metres = validate(network, validation, starts, steps)
            fits = name == "lookahead" or metres <= most_metres
            results.append((fits, rate if fits else -metres, -error, network.weighing))
        weighing = max(results, key=lambda result: result[:3])[-1]
    network.weighing = given
    return weighing


def validate(network: ViewAttention, lookup: SceneLookup, starts: np.ndarray, steps: int) -> tuple[float, float, float]:
    """Detection rate, ADD (mm) and metres of the network's moves from (E, 2) starts."""
    moves = np.full(len(starts), steps)
    views = roll_out(lookup, greedy(network, lookup.model), starts[:, 0], starts[:, 1], moves)
    return measure(lookup, starts[:, 0], views).means


def greedy(network: ViewAttention, model: ObjectModel) -> Choose:
    """Always the view of highest worth."""

    def choose(_: np.ndarray, observations: list[Observation]) -> np.ndarray:
        states = [represent(each, model) for each in observations]
        return _worths(network, observations, states).argmax(axis=1)

    return choose


def _worths(network: ViewAttention, observations: list[Observation], states: list[SceneState]) -> np.ndarray:
    """(B, M) worth of every view by the network's weighing."""
    parts = [slice(start, start + _TOGETHER) for start in range(0, len(observations), _TOGETHER)]
    values = [value_views(network, observations[part], states[part], network.weighing) for part in parts]
    return np.concatenate([each.worth for each in values])


def spread(sphere: ViewSphere, paths: np.ndarray, moves: int) -> np.ndarray:
    """(E, v) views to (E, v + moves): each next one is the view at 60 degrees farthest from all taken ones, the nearest
    of equals. The rule needs geometry only."""
    arcs = sphere.arc(sphere.positions[:, None], sphere.positions)
    elevation = np.arcsin(sphere.positions[:, 2] / sphere.radius)
    ring = np.flatnonzero(np.isclose(elevation, elevation[np.abs(elevation - np.pi / 3).argmin()]))
    for _ in range(moves):
        farness = arcs[paths][:, :, ring].min(axis=1) - 1e-3 * arcs[paths[:, -1]][:, ring]
        paths = np.column_stack([paths, ring[farness.argmax(axis=1)]])
    return paths


def candidate_gains(
    lookup: SceneLookup, scene: int, views: np.ndarray, left: int, clusters: np.ndarray, certainty: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """The gain of each view after the (v,) views taken, and that of :func:`spread` in the moves left after it.

    An item is an accumulated object, in the order of :func:`.features.best_verified`, or one of the (m, 3) likely
    centres ``clusters``. Of several items for one true object the first has the gain.

    Returns:
        Twice (M, n + 1, 2), NaN for views taken: gains (:func:`.oracle.known`) of the true objects that the n items
        stand for; last, the sum over the true objects that no item stands for.
    """
    free = np.setdiff1d(np.arange(len(lookup.sphere)), views)
    paths = np.column_stack([np.tile(views, (len(free), 1)), free])
    before = known(lookup, np.array([scene]), views[None], certainty)
    scenes, longer = np.full(len(free), scene), spread(lookup.sphere, paths, left - 1)
    after, ended = (known(lookup, scenes, each, certainty) for each in (paths, longer))
    fused = lookup.fuse(np.array([scene]), views[None], views[-1:])
    column, stands_for = stand_for(lookup, scene, fused, clusters)
    count = min(fused.objects.shape[1], MAX_OBJECTS) + len(clusters)
    gains = np.full((2, len(lookup.sphere), count + 1, GAINS), np.nan)
    gains[:, free] = 0.0
    for part, added in zip(gains, (after - before, ended - after), strict=True):
        part[free[:, None], column] = added[:, stands_for]
        part[free, -1] = added.sum(axis=1) - added[:, stands_for].sum(axis=1)
    return gains[0], gains[1]


def stand_for(
    lookup: SceneLookup, scene: int, fused: FusedBatch, clusters: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Items that stand for true objects, and those objects.

    An accumulated object of ``fused``, of one episode, stands for the true object that it is nearest to in ADD. A
    cluster of unexplained surface stands for the nearest true object without an accumulated one.
    """
    rows = fused.objects[0]
    order = np.argsort(-lookup.verification[fused.best[0]], kind="stable")
    stands_for, best = np.unique(lookup.nearest_object[rows], return_index=True)
    column = np.argsort(order)[best]
    given = column < MAX_OBJECTS
    stands_for, column = stands_for[given], column[given]
    true = lookup.bank.scenes[scene].T_world_object[:, :3, 3]
    apart = np.linalg.norm(clusters[:, None] - true, axis=-1)
    apart[:, stands_for] = np.inf
    for cluster, distances in enumerate(apart):
        nearest = int(distances.argmin())
        if distances[nearest] < _CLUSTER_REACH * lookup.model.diameter:
            stands_for = np.append(stands_for, nearest)
            column = np.append(column, min(len(rows), MAX_OBJECTS) + cluster)
            apart[:, nearest] = np.inf
    return column, stands_for


class _Learner:
    """The network, its optimiser and the labelled states."""

    def __init__(self, lookup: SceneLookup, parameters: DaggerParameters, weighing: Weighing) -> None:
        torch.manual_seed(parameters.seed)
        self.lookup, self.parameters, self._weighing = lookup, parameters, weighing
        self._trained = ViewAttention(parameters.hidden)
        _ignore(self._trained, IGNORED[parameters.inputs])
        self.optimizer = torch.optim.Adam(self._trained.parameters(), parameters.learning_rate, weight_decay=1e-5)
        lowest = _LOWEST_RATE * parameters.learning_rate
        self._schedule = CosineAnnealingLR(self.optimizer, parameters.rounds, lowest)
        # The running mean of the weights makes the moves and is stored: it does better on other scenes than the latest.
        self._average = AveragedModel(self._trained, avg_fn=_running_mean).eval()
        self.network = cast(ViewAttention, self._average.module)
        self.network.weighing = weighing
        self.rng = np.random.default_rng(parameters.seed)
        self.memory: deque[Example] = deque(maxlen=parameters.capacity)
        self.round, self.states = 0, 0

    def restore(self, path: Path) -> tuple[tuple[float, float], float]:
        """Take the weights of an earlier training; the best so far and the seconds spent."""
        stored = load_network(path, self.lookup.model.name)
        for network in (self._trained, self.network):
            network.load_state_dict(stored.state_dict())
        self.network.weighing = stored.weighing
        provenance = json.loads(path.with_suffix(".json").read_text())["provenance"]
        progress = provenance["progress"]
        self.round, self.states = progress["round"], progress["states"]
        self.optimizer.step()  # without gradients it does nothing; the schedule expects it first
        for _ in range(self.round):
            self._schedule.step()
        # The seed alone would draw the same scenes again.
        self.rng = np.random.default_rng([self.parameters.seed, self.round])
        return tuple(provenance["best"]), progress["seconds"]

    def advance(self) -> float:
        """Run one round and return its mean loss."""
        self._collect()
        loss = float(np.mean([self._update() for _ in range(self.parameters.updates)]))
        self._schedule.step()
        self.round += 1
        return loss

    def _collect(self) -> None:
        """Run episodes with the current network and label every state."""
        lookup, rng, count = self.lookup, self.rng, self.parameters.episodes
        scene = rng.integers(len(lookup.bank.scenes), size=count)
        moves = rng.integers(1, self.parameters.longest + 1, size=count)
        start = rng.integers(len(lookup.sphere), size=count)
        paths = [[view] for view in start]
        # The oracle chooses most views in the first fifth of the training.
        by_oracle = max(0.0, 1.0 - 5.0 * self.round / self.parameters.rounds)

        def choose(running: np.ndarray, observations: list[Observation]) -> np.ndarray:
            states = [represent(each, lookup.model) for each in observations]
            values = _worths(self.network, observations, states)
            gains = [
                candidate_gains(
                    lookup,
                    scene[index],
                    np.array(paths[index]),
                    each.steps_left,
                    state.clusters,
                    self.parameters.certainty,
                )
                for index, each, state in zip(running, observations, states, strict=True)
            ]
            self.memory.extend(Example(state, *both) for state, both in zip(states, gains, strict=True))
            self.states += len(observations)
            truths = [(now + later).sum(axis=1) @ [1.0, self._weighing.error_weight] for now, later in gains]
            best = [self._best(truth, worth, by_oracle) for truth, worth in zip(truths, values, strict=True)]
            for index, view in zip(running, best, strict=True):
                paths[index].append(view)
            return np.array(best)

        roll_out(lookup, choose, scene, start, moves)

    def _best(self, truth: np.ndarray, worth: np.ndarray, by_oracle: float) -> int:
        """The next view of a training episode."""
        if self.rng.random() < self.parameters.explore:
            return int(self.rng.choice(np.flatnonzero(np.isfinite(worth))))
        return int(np.nanargmax(truth) if self.rng.random() < by_oracle else worth.argmax())

    def _update(self) -> float:
        drawn = [self.memory[i] for i in self.rng.integers(len(self.memory), size=self.parameters.batch)]
        some = self.rng.permutation(len(self.lookup.sphere))[: self.parameters.views]
        state = gather([example.state for example in drawn], some)
        nows, laters = self._trained(state)
        now = _labels([example.now for example in drawn], some, nows.shape[2])
        later = _labels([example.later for example in drawn], some, nows.shape[2])
        # The next view's gain decides more than later gains, and is less noisy.
        weight = self.parameters.object_weight
        loss = _loss(nows, now, weight) + _LATER_WEIGHT * _loss(nows + laters, now + later, weight)
        self.optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self._trained.parameters(), 1.0)
        self.optimizer.step()
        self._average.update_parameters(self._trained)
        return float(loss.detach())


def _ignore(network: ViewAttention, inputs: Mapping[str, slice | int]) -> None:
    """Set the weights of some inputs to zero and keep them there."""
    layers = {"items": network.of_object[0], "pairs": network.of_pair}
    for name, columns in inputs.items():
        weight = cast(torch.Tensor, layers[name].weight)
        kept = torch.ones_like(weight)
        kept[:, columns] = 0.0
        weight.data.mul_(kept)
        weight.register_hook(kept.mul)


def _running_mean(mean: torch.Tensor, value: torch.Tensor, count: torch.Tensor | int) -> torch.Tensor:
    """Exponential moving average; at first over fewer steps, so that the initial weights do not count."""
    return torch.lerp(value, mean, torch.as_tensor((1 + count) / (10 + count)).clamp(max=_MEAN_DECAY))


def _labels(gains: list[np.ndarray], views: np.ndarray, count: int) -> np.ndarray:
    """(B, M', count, 2) gains of (M',) views; padding is before the last row, the gain without an item."""
    padded = np.zeros((len(gains), len(views), count, GAINS), np.float32)
    for row, own in zip(padded, gains, strict=True):
        row[:, : own.shape[1] - 1], row[:, -1] = own[views, :-1], own[views, -1]
    return padded


def _loss(predicted: torch.Tensor, truth: np.ndarray, object_weight: float) -> torch.Tensor:
    """Square error of (B, M, n + 1, 2) gains where they are labelled: of their sums over the items, and of each item.

    Of the sums, differences between the views of a state count most.
    """
    target = torch.from_numpy(truth)
    labelled = torch.isfinite(target[:, :, -1:, :1])
    off = torch.where(labelled, predicted - torch.nan_to_num(target), 0.0)
    count = labelled.sum(dim=1, keepdim=True).clamp(min=1)
    weight = _weigh_states(truth)[:, None, None]
    total = off.sum(dim=2, keepdim=True)
    level = total.sum(dim=1, keepdim=True) / count
    about = torch.where(labelled, total - level, 0.0) ** 2 / count * weight[..., None]
    own = off**2 / count * weight[..., None]
    return (about.sum() + object_weight * own.sum()) / len(truth) + 0.25 * (level[:, 0, 0] ** 2 * weight[:, 0]).mean()


def _weigh_states(truth: np.ndarray) -> torch.Tensor:
    """(B,) weights that sum to B: the less the gains of a state's views differ, the more each counts.

    The first moves find many objects and the last ones few. A plain square error would ignore the last ones, which
    make the difference between policies.
    """
    weight = 1.0 / (np.nanvar(truth[..., 0].sum(axis=2), axis=1) + _VARIANCE_FLOOR)
    return torch.from_numpy((weight / weight.mean()).astype(np.float32))
