"""Fit the weights by which the dense estimator selects between the poses of an instance; the same for every object.

Example: python -m active6d_tools.studies.fit_pose_selection --views 8 --write

Candidates come from views of the nominal and the wild validation scenes of the shipped objects. A conditional logit is
fitted to the instances of which some candidates are right and some are not. Each object is also judged by weights that
were fitted without it, which shows what a new object can expect.
"""

import argparse
import json
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize
from scipy.special import log_softmax, logsumexp, softmax

from active6d_core.files import write_file
from active6d_core.metrics import DETECTION_FRACTION
from active6d_core.object_model import load_object
from active6d_core.se3 import invert
from active6d_core.view_sphere import ViewSphere
from active6d_perception.estimators.dense.dense_estimator import DenseEstimator
from active6d_perception.estimators.dense.trained_network import load_network
from active6d_perception.estimators.pose_selection import FEATURES, SELECTION_FILE
from active6d_perception.estimators.registry import weights_path
from active6d_perception.estimators.score_model import ScoreModel
from active6d_perception.model.ambiguity import ambiguity_of
from active6d_sim.scenes.scene_store import SPLITS, load_scene
from active6d_tools.benchmark.grid_views import GridViews
from active6d_tools.cli.terminal import console, progress_bar
from active6d_tools.training_data import VALIDATION_SPLITS

_OBJECTS = ("coffee_cup", "bunny", "mug")
_PENALTY = 3e-3  # of the squared weights of standardised features
_VISIBLE = 0.05  # least visible fraction of an object whose poses count


@dataclass(frozen=True, eq=False)
class Comparisons:
    """n instances with c candidates each.

    Attributes:
        features: (n, c, f) :data:`.FEATURES`.
        right: (n, c) bool, whether the body of a candidate is that of a visible object, within 10 % of the diameter.
    """

    features: np.ndarray
    right: np.ndarray

    def decided(self) -> "Comparisons":
        """The instances of which some candidates are right and some are not."""
        kept = self.right.any(axis=1) & ~self.right.all(axis=1)
        return Comparisons(self.features[kept], self.right[kept])

    def rate(self, weights: np.ndarray) -> float:
        """Of the instances with a right candidate, the share where the weights select one."""
        possible = self.right.any(axis=1)
        selected = (self.features @ weights).argmax(axis=1)
        return float(self.right[np.arange(len(selected)), selected][possible].mean())


def collect(name: str, views: int) -> Comparisons:
    """Candidates of one object in ``views`` views of every validation scene."""
    model = load_object(name)
    estimator = DenseEstimator(model, load_network(weights_path(name), model))
    distance, rng = ambiguity_of(model).body_distance, np.random.default_rng(0)
    features, right = [], []
    with progress_bar() as bar:
        task = bar.add_task(name, total=sum(SPLITS[split] for split in VALIDATION_SPLITS))
        for split in VALIDATION_SPLITS:
            scenes = [load_scene(name, split, index) for index in range(SPLITS[split])]
            grid = GridViews(model, scenes, seed=0)
            for index in range(len(scenes)):
                for number in rng.choice(len(ViewSphere()), views, replace=False):
                    labelled = grid.capture(index, int(number), 1.0)
                    true = invert(labelled.view.T_world_camera) @ labelled.T_world_object
                    true = true[labelled.visible_fraction >= _VISIBLE]
                    T, compared = estimator.compare(labelled.view)
                    apart = distance.between(T.reshape(-1, 4, 4), true)
                    features.append(compared)
                    right.append((apart < DETECTION_FRACTION * model.diameter).any(axis=1).reshape(T.shape[:2]))
                bar.advance(task)
    return Comparisons(np.concatenate(features), np.concatenate(right))


def fit(parts: list[Comparisons]) -> np.ndarray:
    """(f,) weights of the conditional logit: the likelihood that the selected candidate is a right one."""
    parts = [part.decided() for part in parts]
    together = np.concatenate([part.features.reshape(-1, len(FEATURES)) for part in parts])
    deviation = together.std(axis=0) + 1e-9

    def loss(weights: np.ndarray) -> tuple[float, np.ndarray]:
        total, gradient = _PENALTY * weights @ weights, 2 * _PENALTY * weights
        count = sum(len(part.right) for part in parts)
        for part in parts:
            scaled = part.features / deviation
            value = scaled @ weights
            among_right = np.where(part.right, value, -np.inf)
            total += -logsumexp(np.where(part.right, log_softmax(value, axis=1), -np.inf), axis=1).sum() / count
            pull = softmax(value, axis=1) - softmax(among_right, axis=1)
            gradient = gradient + np.einsum("nc,ncf->f", pull, scaled) / count
        return float(total), gradient

    found = minimize(loss, np.zeros(len(FEATURES)), jac=True, method="L-BFGS-B").x
    return np.asarray(found / deviation)


def main() -> None:
    """Collect candidates, fit, and print how often a right candidate is selected."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, default=8, help="number of views of every validation scene")
    parser.add_argument("--write", action="store_true", help="replace the weights in the package")
    arguments = parser.parse_args()
    parts = {name: collect(name, arguments.views) for name in _OBJECTS}
    weights = fit(list(parts.values()))
    for name, part in parts.items():
        others = fit([other for key, other in parts.items() if key != name])
        console.print(
            f"{name:11} {len(part.right):5} instances, network's own pose right {part.right[:, 0].mean():.3f}, "
            f"any candidate {part.right.any(axis=1).mean():.3f}; of these selected {part.rate(weights):.3f}, "
            f"by weights of the other objects {part.rate(others):.3f}",
            highlight=False,
        )
    text = json.dumps(ScoreModel(FEATURES, weights, 0.0).as_dict(), indent=1) + "\n"
    console.print(text, highlight=False)
    if arguments.write:
        write_file(SELECTION_FILE, text)


if __name__ == "__main__":
    main()
