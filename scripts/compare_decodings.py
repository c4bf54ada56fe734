#!/usr/bin/env python3
"""Compare ways to decode poses from one trained network, on views of the validation split.

Usage: scripts/compare_decodings.py OBJECT WEIGHTS SHARD.npz ... [--every N]

The shards are those that 'active6d train estimator' renders for validation
(~/.cache/active6d/training/OBJECT/validation/*.npz).
"""

import argparse
from pathlib import Path

from rich.console import Console
from rich.progress import track
from rich.table import Table

from active6d_core.object_model import load_object
from active6d_perception.dense.decoding import DecodingParameters
from active6d_perception.dense.estimator import DenseParameters
from active6d_perception.dense.weights_file import load_network
from active6d_perception.training.samples import read_shard
from active6d_perception.training.validation import pose_rates

DESIGNS = {
    "axes": DenseParameters(),
    "coordinates": DenseParameters(decoding=DecodingParameters(coordinates=True)),
    "axes, not refined": DenseParameters(refined=False),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("object")
    parser.add_argument("weights", type=Path)
    parser.add_argument("shards", type=Path, nargs="+")
    parser.add_argument("--every", type=int, default=1, help="take every N-th view")
    arguments = parser.parse_args()
    model = load_object(arguments.object)
    trained = load_network(arguments.weights, model)
    samples = [sample for path in arguments.shards for sample in read_shard(path)][:: arguments.every]
    rates = {
        name: pose_rates(model, trained, samples, parameters)
        for name, parameters in track(DESIGNS.items(), description=f"{len(samples)} views")
    }
    table = Table("", *next(iter(rates.values())))
    for name, found in rates.items():
        table.add_row(name, *(f"{rate:.3f}" for rate in found.values()))
    Console().print(table)


if __name__ == "__main__":
    main()
