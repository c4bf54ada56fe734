"""Fit the score of the training-free estimator, which is the same for every object.

Example: python -m active6d_tools.studies.fit_geometric_score --views 3 --write

Candidates come from views of the validation scenes of the shipped objects. In the wild ones, what is no object is seen
as well.
"""

import argparse
import json

import numpy as np

from active6d_core.files import write_file
from active6d_core.object_model import load_object
from active6d_perception.estimators.geometric.foreground import measure_surface
from active6d_perception.estimators.geometric.geometric_estimator import (
    AGAINST,
    FEATURES,
    SCORE_FILE,
    GeometricEstimator,
)
from active6d_perception.estimators.score_model import ScoreModel
from active6d_tools.cli.terminal import console, progress_bar
from active6d_tools.score_fitting import JudgedPoses, judge_validation_views, summarise_score

_OBJECTS = ("coffee_cup", "bunny", "mug")


def collect(name: str, views: int) -> JudgedPoses:
    """Candidates of one object in ``views`` views of every validation scene."""
    estimator = GeometricEstimator(load_object(name))
    with progress_bar() as bar:
        task = bar.add_task(name)
        return judge_validation_views(
            estimator.model,
            lambda view: estimator.candidates(measure_surface(view.depth, view.camera, estimator.model.diameter))[::2],
            views,
            np.random.default_rng(0),
            lambda done, total: bar.update(task, completed=done, total=total),
        )


def main() -> None:
    """Collect candidates, fit, and print the quality of the scores."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, default=3, help="number of views of every validation scene")
    parser.add_argument("--write", action="store_true", help="replace the weights in the package")
    arguments = parser.parse_args()
    parts = [collect(name, arguments.views) for name in _OBJECTS]
    features, right, weight = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("features", "right", "weight")
    )
    model = ScoreModel.fit(FEATURES, features, right, weight, against=AGAINST)
    for name, part in zip(_OBJECTS, parts, strict=True):
        for key, value in summarise_score(model, part).items():
            console.print(f"{name:11} {key:30} {value:.3f}", highlight=False)
    text = json.dumps(model.as_dict(), indent=1) + "\n"
    console.print(text, highlight=False)
    if arguments.write:
        write_file(SCORE_FILE, text)


if __name__ == "__main__":
    main()
