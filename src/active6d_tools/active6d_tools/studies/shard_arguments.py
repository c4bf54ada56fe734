"""The arguments OBJECT WEIGHTS SHARD.npz ... [--every N] that scripts about one trained network share."""

import argparse
from pathlib import Path

from active6d_core.object_model import ObjectModel, load_object
from active6d_core.training_view import TrainingView
from active6d_perception.estimators.dense.trained_network import TrainedNetwork, load_network
from active6d_perception.estimators.dense.training.samples import read_shard


def read_arguments(description: str, every: int) -> tuple[ObjectModel, TrainedNetwork, list[TrainingView]]:
    """The object, its network, and every N-th view of the shards; ``every`` is the default of N."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("object")
    parser.add_argument("weights", type=Path)
    parser.add_argument("shards", type=Path, nargs="+")
    parser.add_argument("--every", type=int, default=every, help="take every N-th view")
    arguments = parser.parse_args()
    model = load_object(arguments.object)
    samples = [sample for path in arguments.shards for sample in read_shard(path)][:: arguments.every]
    return model, load_network(arguments.weights, model), samples
