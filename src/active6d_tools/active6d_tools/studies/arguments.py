"""Command lines of the studies."""

import argparse
from pathlib import Path

from active6d_core.object_model import ObjectModel, load_object
from active6d_core.training_view import TrainingView
from active6d_perception.estimators.dense.trained_network import TrainedNetwork, load_network
from active6d_perception.estimators.dense.training.samples import read_shard


def study_parser(doc: str | None) -> argparse.ArgumentParser:
    """A parser for a study of one object, whose help is the docstring of its module."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("object", help="name of the object, see 'active6d object list'")
    return parser


def read_arguments(doc: str | None, every: int) -> tuple[ObjectModel, TrainedNetwork, list[TrainingView]]:
    """The object, its network and every N-th view of the shards, for studies of one trained network.

    Args:
        doc: docstring of the study.
        every: default of N.
    """
    parser = study_parser(doc)
    parser.add_argument("weights", type=Path, help="weights of the dense estimator")
    parser.add_argument("shards", type=Path, nargs="+", help="files of views, from 'active6d train estimator'")
    parser.add_argument("--every", type=int, default=every, help="take every N-th view (default: %(default)s)")
    arguments = parser.parse_args()
    model = load_object(arguments.object)
    samples = [sample for path in arguments.shards for sample in read_shard(path)][:: arguments.every]
    return model, load_network(arguments.weights, model), samples
