#!/usr/bin/env python3
"""Compare the scores that fusion can rank hypotheses by, on random walks through the validation scenes.

Example: python -m active6d_tools.studies.compare_rankings mug --views 6 --walks 2
"""

from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from active6d_core.camera import DEFAULT_CAMERA
from active6d_core.metrics import evaluate_scene
from active6d_core.object_model import load_object
from active6d_core.view_sphere import ViewSphere
from active6d_perception.estimators.registry import create_estimator
from active6d_perception.scene.best_view_fusion import BestViewFusion
from active6d_perception.scene.fusion_parameters import RANKINGS, FusionParameters
from active6d_perception.scene.verification import Verifier
from active6d_sim.rendering.simulator import Simulator
from active6d_sim.scenes.scene_store import SPLITS, load_scene
from active6d_tools.studies.arguments import study_parser


def main() -> None:
    parser = study_parser(__doc__)
    parser.add_argument("--views", type=int, default=6, help="views fused in each walk")
    parser.add_argument("--walks", type=int, default=2, help="walks in each scene, which have no view in common")
    arguments = parser.parse_args()
    model, sphere = load_object(arguments.object), ViewSphere()
    estimator, verifier = create_estimator("auto", model), Verifier(model)
    results: dict[str, list[Any]] = {ranking: [] for ranking in RANKINGS}
    for index in track(range(SPLITS["val"])):
        scene = load_scene(model.name, "val", index)
        simulator, rng = Simulator(scene, seed=index), np.random.default_rng(index)
        chosen = rng.choice(len(sphere), arguments.views * arguments.walks, replace=False)
        seen = []
        for stamp, view in enumerate(chosen, start=1):
            T_world_camera = sphere.pose(sphere.positions[view])
            captured = simulator.capture(T_world_camera, stamp)
            found = estimator.estimate(captured)
            seen.append((stamp, T_world_camera, found, verifier.score(captured.depth, captured.camera, found)))
        for walk in (seen[start : start + arguments.views] for start in range(0, len(seen), arguments.views)):
            for ranking in RANKINGS:
                fusion = BestViewFusion(model, FusionParameters(rank_by=ranking))
                for taken in walk:
                    fusion.add_view(*taken)
                objects = fusion.objects(*walk[-1][:2], DEFAULT_CAMERA)
                score = evaluate_scene(model, objects.T_world_object, scene.T_world_object)
                results[ranking].append((score.detection_rate, score.mean_e_add_mm))
    table = Table("rank_by", "detection rate", "ADD, mm", title=f"{model.name}, {len(results[RANKINGS[0]])} walks")
    for ranking, values in results.items():
        detection, error = np.mean(values, axis=0)
        table.add_row(ranking, f"{detection:.3f}", f"{error:.2f}")
    Console().print(table)


if __name__ == "__main__":
    main()
