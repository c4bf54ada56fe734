#!/usr/bin/env python3
"""Compare settings of pose refinement on views of the validation split, starting near the true poses.

The network segments the objects. Every object that is at least a tenth visible starts 6 degrees and 4 mm off its true
pose. The shards are the validation views that 'active6d train estimator' renders.

Example: python -m active6d_tools.studies.compare_refinements mug
    src/active6d_perception/active6d_perception/estimators/dense/weights/mug.safetensors
    ~/.cache/active6d/training/mug/val/*.npz
"""

from time import process_time
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy.spatial.transform import Rotation

from active6d_core.camera import pool_depth
from active6d_core.metrics import e_add
from active6d_core.se3 import make_transform
from active6d_perception.estimators.dense.decoding import decode
from active6d_perception.estimators.dense.dense_estimator import DenseEstimator
from active6d_perception.estimators.dense.measured_surface import MeasuredSurface
from active6d_perception.estimators.dense.network_input import OUTPUT_STRIDE, output_camera
from active6d_perception.estimators.image_registration import register
from active6d_perception.model.model_views import model_views
from active6d_perception.model.visible_samples import visible_samples
from active6d_tools.studies.arguments import read_arguments

DEPLOYED: dict[str, Any] = {"gates": (0.008, 0.004), "iterations": 3, "samples": 192}
VARIANTS: dict[str, dict[str, Any]] = {
    "not refined": {"gates": ()},
    "as deployed": {},
    "5 steps a gate": {"iterations": 5},
    "96 points": {"samples": 96},
    "384 points": {"samples": 384},
    "one gate, 8 mm": {"gates": (0.008,)},
    "one gate, 4 mm": {"gates": (0.004,)},
}
ANGLE, DISTANCE = np.radians(6.0), 0.004  # radians, metres


def directions(count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, 3) unit vectors."""
    vectors = rng.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def main() -> None:
    model, trained, samples = read_arguments(__doc__, every=2)
    estimator, views, rng = DenseEstimator(model, trained), model_views(model), np.random.default_rng(0)
    everything, counts = np.ones(len(views.points), bool), {how.get("samples", 192) for how in VARIANTS.values()}
    samples_of = {count: visible_samples(views, everything, count, model.mesh.area) for count in counts}
    errors: dict[str, list[np.ndarray]] = {name: [] for name in VARIANTS}
    seconds = dict.fromkeys(VARIANTS, 0.0)
    for sample in track(samples):
        depth, camera = pool_depth(sample.view.depth, OUTPUT_STRIDE), output_camera(sample.view.camera)
        instances = decode(estimator.ask(sample.view), depth, camera, trained.canonical_frame, model.diameter)
        measured = MeasuredSurface.of(sample.view, instances).of_instances
        true = sample.T_camera_object[sample.visible_fraction >= 0.1]
        if not len(instances) or not len(true):
            continue
        turn = Rotation.from_rotvec(ANGLE * directions(len(true), rng)).as_matrix()
        start = make_transform(true[:, :3, :3] @ turn, true[:, :3, 3] + DISTANCE * directions(len(true), rng))
        for name, own in VARIANTS.items():
            begun = process_time()
            how = {**DEPLOYED, **own}
            T = register(start, samples_of[how["samples"]], measured, np.array(how["gates"]), how["iterations"])
            seconds[name] += process_time() - begun
            errors[name].append(e_add(model, T, true))
    table = Table("", "found at 10 %", "and at 5 %", "median ADD, mm", "ms per view")
    for name, found in errors.items():
        error = np.concatenate(found)
        rates = [f"{(error < share * model.diameter).mean():.3f}" for share in (0.1, 0.05)]
        table.add_row(name, *rates, f"{1e3 * np.median(error):.2f}", f"{1e3 * seconds[name] / len(found):.1f}")
    Console().print(table)


if __name__ == "__main__":
    main()
