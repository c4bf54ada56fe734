"""Batches of inputs and targets from files of training views, without end."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from active6d_core.camera import View
from active6d_core.training_view import TrainingView
from active6d_perception.estimators.dense.canonical_frame import CanonicalFrame
from active6d_perception.estimators.dense.network_input import network_input, pad
from active6d_perception.estimators.dense.training.augmentation import augment, crop
from active6d_perception.estimators.dense.training.samples import read_shard
from active6d_perception.estimators.dense.training.targets import Targets, make_targets

#: Number of files read at a time; their views are shuffled together.
_SHARDS_TOGETHER = 24
#: Height and width in pixels of the window cut from each view; objects seldom cover more.
_WINDOW = (160, 208)


class TrainingViews(IterableDataset[Any]):
    """Augmented pairs of input and targets in random order, without end."""

    def __init__(
        self, shards: list[Path], canonical_frame: CanonicalFrame, diameter: float, seed: tuple[int, ...]
    ) -> None:
        """
        Args:
            shards: files of training views.
            canonical_frame: the object's.
            diameter: the object's, metres.
            seed: seed of order and augmentation; a resumed training uses another one.

        Raises:
            ValueError: ``shards`` is empty.
        """
        if not shards:
            raise ValueError("there are no training views; render them with 'active6d train estimator --heaps N'")
        self._shards, self._canonical_frame, self._diameter, self._seed = shards, canonical_frame, diameter, seed

    def __iter__(self) -> Iterator[tuple[Tensor, Targets]]:
        worker = get_worker_info()
        rng = np.random.default_rng([*self._seed, worker.id if worker else 0])
        while True:
            order = rng.permutation(len(self._shards))
            for start in range(0, len(order), _SHARDS_TOGETHER):
                chosen = order[start : start + _SHARDS_TOGETHER]
                samples = [sample for index in chosen for sample in read_shard(self._shards[index])]
                for index in rng.permutation(len(samples)):
                    yield self._prepare(samples[index], rng)

    def _prepare(self, sample: TrainingView, rng: np.random.Generator) -> tuple[Tensor, Targets]:
        sample = crop(sample, *_WINDOW, rng)
        view = augment(sample.view, rng)
        return input_tensor(view, self._diameter), make_targets(sample, self._canonical_frame, self._diameter)


def input_tensor(view: View, diameter: float) -> Tensor:
    """The padded (channels, h, w) input of one view at the network's resolution."""
    return torch.from_numpy(pad(network_input(view, diameter)))


def batches(views: TrainingViews, size: int, workers: int) -> Iterator[tuple[Tensor, list[Targets]]]:
    """Batches of ``size`` views without end; ``workers`` processes prepare them, or this process when 0."""
    return iter(
        DataLoader(views, batch_size=size, num_workers=workers, collate_fn=_collate, persistent_workers=workers > 0)
    )


def _collate(items: list[tuple[Tensor, Targets]]) -> tuple[Tensor, list[Targets]]:
    return torch.stack([tensor for tensor, _ in items]), [targets for _, targets in items]
