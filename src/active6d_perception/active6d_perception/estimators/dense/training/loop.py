"""The training loop: resumable, with averaged weights, of which those best on the validation split are exported."""

import json
import math
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.optim.lr_scheduler import LambdaLR
from torch.optim.swa_utils import AveragedModel

from active6d_core.files import Checkpoints, atomic_file, make_folder, write_file
from active6d_core.object_model import ObjectModel
from active6d_core.training_view import TrainingView
from active6d_perception.estimators.dense.canonical_frame import canonical_frame_of
from active6d_perception.estimators.dense.network import (
    DenseNetwork,
    NetworkSize,
    has_fast_bfloat16,
)
from active6d_perception.estimators.dense.trained_network import TrainedNetwork, load_network, save_network
from active6d_perception.estimators.dense.training.batches import TrainingViews, batches
from active6d_perception.estimators.dense.training.curves import draw_curves
from active6d_perception.estimators.dense.training.losses import LossWeights, loss_terms, total
from active6d_perception.estimators.dense.training.targets import Targets
from active6d_perception.estimators.dense.training.validation import validate

_CLIP = 1.0  # norm of the gradient


@dataclass(frozen=True)
class TrainingOptions:
    """Options of a training.

    Attributes:
        steps: total number of optimiser steps, over which the learning rate falls to zero.
        batch: views per step.
        learning_rate: the highest learning rate, after the warm-up.
        warmup: number of steps over which the learning rate rises.
        weight_decay: of AdamW.
        averaging: factor per step of the exponential moving average of the weights.
        checkpoint_every: steps between checkpoints; an interruption loses at most so many, or some 20 s.
        validate_every: steps between validations, a multiple of ``checkpoint_every``.
        workers: number of processes that prepare batches.
        seed: seed of initial weights, order and augmentation.
        start: path of trained weights to start from instead of random ones; empty for random ones.
        loss: weights of the terms of the loss.
        size: channels of the network's layers.

    Raises:
        ValueError: a number is out of range.
    """

    steps: int = 5_500
    batch: int = 8
    learning_rate: float = 2e-3
    warmup: int = 300
    weight_decay: float = 1e-4
    averaging: float = 0.998
    checkpoint_every: int = 200
    validate_every: int = 1000
    workers: int = 1
    seed: int = 0
    start: str = ""
    loss: LossWeights = field(default_factory=LossWeights)
    size: NetworkSize = field(default_factory=NetworkSize)

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "checkpoint_every", "validate_every"):
            if getattr(self, name) < 1:
                raise ValueError(f"training: {name} must be at least 1, got {getattr(self, name)}")
        if self.validate_every % self.checkpoint_every:
            raise ValueError("training: validate_every must be a multiple of checkpoint_every")


@dataclass(frozen=True)
class Report:
    """Progress that :func:`train` reports after each step.

    Attributes:
        step: number of steps done.
        loss: of this step's batch, the weighted sum of ``terms``.
        terms: of the loss.
        validation: rates of the latest validation, empty before the first one.
    """

    step: int
    loss: float
    terms: dict[str, float]
    validation: dict[str, float]


def train(
    model: ObjectModel,
    shards: Sequence[Path],
    validation: Sequence[TrainingView],
    folder: Path,
    options: TrainingOptions,
    device: str = "cpu",
    on_step: Callable[[Report], None] = lambda report: None,
) -> Path:
    """Train a network, or resume the training in ``folder``.

    Args:
        model: the object.
        shards: files of training views.
        validation: views by which the best weights are chosen, at the network's resolution.
        folder: for ``state.*`` (to resume), ``curves.json``, ``curves.png`` and ``best.*`` (the result).
        options: how to train.
        device: torch device, ``cpu`` or ``cuda``.
        on_step: called after every step.

    Returns:
        path of the best weights so far.

    Raises:
        ValueError: there are no training views, or the state in the folder is damaged or belongs to other options.
    """
    make_folder(folder)
    canonical_frame = canonical_frame_of(model)
    run = _Run(model, folder, options, device)
    feed = batches(
        TrainingViews(list(shards), canonical_frame, model.diameter, (options.seed, run.step)),
        options.batch,
        options.workers,
    )
    best = folder / "best.safetensors"
    running: list[dict[str, float]] = []
    checkpoints = Checkpoints()
    while run.step < options.steps:
        inputs, targets = next(feed)
        terms = run.advance(inputs, targets)
        running.append(terms)
        if run.step % options.validate_every == 0 or run.step == options.steps:
            mean = {f"training_{name}": sum(item[name] for item in running) / len(running) for name in running[0]}
            running.clear()
            averaged = TrainedNetwork(run.averaged_on_cpu(), canonical_frame, model.name, model.diameter, options.size)
            run.history.append({"step": run.step, **mean, **validate(model, averaged, validation)})
            if max(run.history, key=worth)["step"] == run.step:
                # Of the starting weights only the name is published, not the path.
                named = {**asdict(options), "start": Path(options.start).name}
                training = {"options": named, "heaps": len(shards), "validation": run.history[-1]}
                save_network(best, replace(averaged, training=training))
            write_file(folder / "curves.json", json.dumps(run.history, indent=1) + "\n")
            draw_curves(run.history, folder / "curves.png", title=f"{model.name}: training of the dense estimator")
        if run.step % options.checkpoint_every == 0 or run.step == options.steps or checkpoints.due():
            run.save()
        on_step(Report(run.step, run.loss, terms, run.history[-1] if run.history else {}))
    return best


def worth(validation: dict[str, float]) -> float:
    """Criterion for the best weights: high detection rates for well and barely visible objects, and high precision."""
    return validation["add_half"] + validation["add_tenth"] + validation["adds_tenth"] + 0.5 * validation["precision"]


class _Run:
    """State of a training: network, averaged network, optimiser and history, with the file that holds them."""

    def __init__(self, model: ObjectModel, folder: Path, options: TrainingOptions, device: str) -> None:
        torch.manual_seed(options.seed)
        self._options, self._device = options, torch.device(device)
        network: Any = DenseNetwork(options.size)
        if options.start:
            _start_from(network, load_network(Path(options.start), model).network)
        self._network: DenseNetwork = network.to(self._device, memory_format=torch.channels_last).train()
        self._averaged = AveragedModel(self._network, avg_fn=partial(_average, options.averaging), use_buffers=True)
        # The scheduler reads the initial rate from here when it goes on with a training.
        groups = [{"params": list(self._network.parameters()), "initial_lr": options.learning_rate}]
        self._optimizer = torch.optim.AdamW(groups, options.learning_rate, weight_decay=options.weight_decay)
        self._state_file = folder / "state.safetensors"
        self.step = 0
        self.loss = math.nan
        self.history: list[dict[str, float]] = []
        if self._state_file.is_file():
            self._load()
        self._schedule = LambdaLR(self._optimizer, partial(_learning_rate_share, options), last_epoch=self.step - 1)

    def advance(self, inputs: Tensor, targets: list[Targets]) -> dict[str, float]:
        """Do one step of the optimiser; returns the terms of the loss."""
        inputs = inputs.to(self._device, memory_format=torch.channels_last)
        with torch.autocast(self._device.type, torch.bfloat16, enabled=has_fast_bfloat16(self._device.type)):
            answer = self._network(inputs)
        terms = loss_terms(answer, targets)
        loss = total(terms, self._options.loss)
        self._optimizer.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(self._network.parameters(), _CLIP)
        self._optimizer.step()
        self._schedule.step()
        self._averaged.update_parameters(self._network)
        self.step += 1
        self.loss = loss.item()
        return {name: value.item() for name, value in terms.items()}

    def averaged_on_cpu(self) -> DenseNetwork:
        """A copy of the averaged network."""
        return cast(DenseNetwork, deepcopy(self._averaged.module).cpu().eval())

    def save(self) -> None:
        """Write tensors and history; the previous state stays if the writing is interrupted."""
        tensors = {f"network.{name}": tensor for name, tensor in self._network.state_dict().items()}
        tensors |= {f"averaged.{name}": tensor for name, tensor in self._averaged.module.state_dict().items()}
        for index, state in self._optimizer.state_dict()["state"].items():
            tensors |= {f"optimizer.{index}.{name}": value for name, value in state.items()}
        progress = {"step": self.step, "options": asdict(self._options), "history": self.history}
        # One file holds tensors and progress, so that they cannot disagree.
        contiguous = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
        with atomic_file(self._state_file) as unfinished:
            save_file(contiguous, unfinished, metadata={"progress": json.dumps(progress)})

    def _load(self) -> None:
        try:
            with safe_open(self._state_file, "pt") as file:
                progress = json.loads(file.metadata()["progress"])
            if progress["options"] != json.loads(json.dumps(asdict(self._options))):
                raise ValueError("it was started with other options")
            tensors = load_file(self._state_file, device=str(self._device))
            self._network.load_state_dict(_under(tensors, "network."))
            self._averaged.module.load_state_dict(_under(tensors, "averaged."))
            self._averaged.n_averaged.fill_(progress["step"])
            state: dict[int, dict[str, Tensor]] = {}
            for name, tensor in _under(tensors, "optimizer.").items():
                index, key = name.split(".")
                state.setdefault(int(index), {})[key] = tensor
            self._optimizer.load_state_dict({**self._optimizer.state_dict(), "state": state})
            self.step, self.history = progress["step"], progress["history"]
        except (OSError, SafetensorError, RuntimeError, KeyError, ValueError, TypeError) as error:
            reason = str(error).splitlines()[0]
            raise ValueError(
                f"{self._state_file}: cannot resume this training ({reason}); give another folder or delete it"
            ) from error


def _start_from(network: DenseNetwork, trained: DenseNetwork) -> None:
    """Copy weights.

    Raises:
        ValueError: the networks have layers of other sizes.
    """
    try:
        network.load_state_dict(trained.state_dict())
    except RuntimeError as error:
        raise ValueError(f"cannot start from these weights: {str(error).splitlines()[-1].strip()}") from error


def _under(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}


def _average(factor: float, averaged: Tensor, current: Tensor, count: Tensor) -> Tensor:
    """Exponential moving average after ``count`` updates; the first updates count more. Integers are copied."""
    if not averaged.is_floating_point():
        return current
    return torch.lerp(averaged, current, 1 - ((count + 1) / (count + 11)).clamp(max=factor))


def _learning_rate_share(options: TrainingOptions, step: int) -> float:
    """Share of the highest learning rate: a linear warm-up, then half a cosine to zero."""
    warm = min(1.0, (step + 1) / options.warmup)
    return warm * 0.5 * (1 + math.cos(math.pi * step / options.steps))
