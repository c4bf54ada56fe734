#!/usr/bin/env python3
"""Compare ways to decode poses from one trained network, on views of the validation split.

The shards are the views that 'active6d train estimator' renders for validation. All weights and shards of the example
belong to the coffee cup.

Example: python -m active6d_tools.studies.compare_decodings coffee_cup
    src/active6d_perception/active6d_perception/estimators/dense/weights/coffee_cup.safetensors
    ~/.cache/active6d/training/coffee_cup/validation/*.npz
"""

from rich.console import Console
from rich.progress import track
from rich.table import Table

from active6d_perception.estimators.dense.decoding import DecodingParameters
from active6d_perception.estimators.dense.dense_estimator import DenseParameters
from active6d_perception.estimators.dense.training.validation import pose_rates
from active6d_tools.studies.arguments import read_arguments

DESIGNS = {
    "axes": DenseParameters(),
    "coordinates": DenseParameters(decoding=DecodingParameters(coordinates=True)),
    "axes, not refined": DenseParameters(refined=False),
}


def main() -> None:
    model, trained, samples = read_arguments(__doc__, every=1)
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
