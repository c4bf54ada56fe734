#!/usr/bin/env python3
"""Compare trainings with and without the coordinates heads: whether they help what deployment decodes.

Two networks are trained from random weights, on the same views, with the same seed. Both decode poses from votes for
centre and axis. The network with the heads also decodes them from its coordinates. The views are those that
'active6d train estimator --render-only' renders. An interrupted study continues where it stopped.

Example: python -m active6d_tools.studies.compare_coordinates_heads coffee_cup --data training/coffee_cup --steps 3500
    --threads 1
"""

from pathlib import Path

import torch
from rich.progress import track

from active6d_core.files import cache_folder
from active6d_core.object_model import ObjectModel, load_object
from active6d_core.training_view import TrainingView
from active6d_perception.estimators.dense.decoding import DecodingParameters
from active6d_perception.estimators.dense.dense_estimator import DenseParameters
from active6d_perception.estimators.dense.trained_network import load_network
from active6d_perception.estimators.dense.training.loop import TrainingOptions, train
from active6d_perception.estimators.dense.training.losses import LossWeights
from active6d_perception.estimators.dense.training.samples import read_shard
from active6d_perception.estimators.dense.training.validation import pose_rates
from active6d_tools.cli.terminal import messages, print_table, progress_bar
from active6d_tools.studies.arguments import study_parser
from active6d_tools.training_data import VALIDATION_SPLITS

AXES, NOT_REFINED = DenseParameters(), DenseParameters(refined=False)
COORDINATES = DenseParameters(decoding=DecodingParameters(coordinates=True))
#: Name of a training: weight of the coordinates in its loss, and how its network's poses are decoded.
TRAININGS = {
    "without-coordinates": (0.0, {"axes": AXES, "axes, not refined": NOT_REFINED}),
    "with-coordinates": (LossWeights.coordinates, {"axes": AXES, "coordinates": COORDINATES}),
}


def main() -> None:
    parser = study_parser(__doc__)
    parser.add_argument("--data", type=Path, help="folder of the views, as of 'active6d train estimator'")
    parser.add_argument(
        "--steps", type=int, default=TrainingOptions.steps, help="optimiser steps (default: %(default)s)"
    )
    parser.add_argument("--every", type=int, default=1, help="validate on every N-th view (default: %(default)s)")
    parser.add_argument("--threads", type=int, default=0, help="number of cores to use, 0 for all")
    parser.add_argument("--seed", type=int, default=0, help="seed of both trainings (default: %(default)s)")
    arguments = parser.parse_args()
    model = load_object(arguments.object)
    folder = arguments.data or cache_folder("training") / model.name
    shards = sorted(folder.glob("training-*/*.npz"))
    validation = {split: _read(folder / split)[:: arguments.every] for split in VALIDATION_SPLITS}
    if not all((shards, *validation.values())):
        parser.error(f"{folder}: no views; render them with 'active6d train estimator --render-only --data {folder}'")
    if arguments.threads:
        torch.set_num_threads(arguments.threads)
    together = [view for views in validation.values() for view in views]
    rows = []
    for name, (weight, designs) in TRAININGS.items():
        options = TrainingOptions(steps=arguments.steps, seed=arguments.seed, loss=LossWeights(coordinates=weight))
        network = load_network(_train(model, shards, together, folder / name, options), model)
        cases = [(split, design) for split in validation for design in designs]
        for split, design in track(cases, f"{name}: validating", console=messages):
            rates = pose_rates(model, network, validation[split], designs[design])
            rows.append([name, split, design, *(f"{rate:.3f}" for rate in rates.values())])
    print_table(["network", "views", "decoded by", *rates], rows, title=model.name, left=3)


def _train(
    model: ObjectModel, shards: list[Path], validation: list[TrainingView], folder: Path, options: TrainingOptions
) -> Path:
    """Path of the best weights."""
    with progress_bar() as bar:
        task = bar.add_task(f"{folder.name}: training", total=options.steps)
        device = "cuda" if torch.cuda.is_available() else "cpu"
        done = lambda report: bar.update(task, completed=report.step)
        return train(model, shards, validation, folder, options, device, done)


def _read(folder: Path) -> list[TrainingView]:
    return [view for path in sorted(folder.glob("*.npz")) for view in read_shard(path)]


if __name__ == "__main__":
    main()
