#!/usr/bin/env python3
"""Compare ways to decode poses from one trained network, on views of the validation split.

Usage: python -m active6d_tools.studies.compare_decodings OBJECT WEIGHTS SHARD.npz ... [--every N]

The shards are those that 'active6d train estimator' renders for validation
(~/.cache/active6d/training/OBJECT/validation/*.npz).
"""

from rich.console import Console
from rich.progress import track
from rich.table import Table

from active6d_perception.estimators.dense.decoding import DecodingParameters
from active6d_perception.estimators.dense.dense_estimator import DenseParameters
from active6d_perception.estimators.dense.training.validation import pose_rates
from active6d_tools.studies.shard_arguments import read_arguments

DESIGNS = {
    "axes": DenseParameters(),
    "coordinates": DenseParameters(decoding=DecodingParameters(coordinates=True)),
    "axes, not refined": DenseParameters(refined=False),
}


def main() -> None:
    model, trained, samples = read_arguments(__doc__.splitlines()[0], every=1)
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
