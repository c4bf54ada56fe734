#!/usr/bin/env python3
"""Compare expected visibility with the rendered visible fractions of the validation scenes.

First with the true poses, then for the objects that are missed after a few random views, with what the policy knows.

Example: python -m active6d_tools.studies.compare_visibility mug
"""

import numpy as np

from active6d_agent.bank.all_views_lookup import make_lookup
from active6d_agent.bank.scene_bank import find_bank, load_bank
from active6d_agent.environment.rollout import observe
from active6d_agent.evaluation.oracle import known
from active6d_agent.policies.view_attention.dagger import stand_for
from active6d_agent.policies.view_attention.features import represent
from active6d_core.object_model import ObjectModel, load_object
from active6d_core.view_sphere import ViewSphere
from active6d_perception.scene.expected_visibility import Tray, expected_visibility
from active6d_sim.scenes.scene_store import SPLITS, load_scene
from active6d_tools.studies.arguments import study_parser

VIEWS = (2, 3, 4)
CHOICES = 15


def compare_true_poses(model: ObjectModel) -> None:
    """All objects of the stored scenes, those that no view shows among them."""
    eyes, visibility = ViewSphere().positions, expected_visibility(model)
    scenes = [load_scene(model.name, "val", index) for index in range(SPLITS["val"])]
    rendered = np.concatenate([scene.visible_fraction.T.ravel() for scene in scenes])
    for what, tray in (("with walls", Tray.for_model(model)), ("without walls", None)):
        expected = []
        for scene in scenes:
            everything = np.concatenate([scene.T_world_object, scene.T_world_hidden])
            expected.append(visibility.shares(everything, eyes, tray)[: len(scene.T_world_object)].ravel())
        found = np.concatenate(expected)
        off, correlation = np.abs(found - rendered).mean(), np.corrcoef(found, rendered)[0, 1]
        print(f"{model.name} {what:14} mean difference {off:.3f}, correlation {correlation:.3f}")


def compare_missed(model: ObjectModel) -> None:
    """Over the grid's views, of each missed object, what the item shows that stands for it: the mean correlation."""
    lookup, rng = make_lookup(load_bank(find_bank(model.name, "val"))), np.random.default_rng(0)
    correlations: dict[str, list[float]] = {"a hypothesis": [], "a cluster": []}
    for index in range(SPLITS["val"]):
        rendered = load_scene(model.name, "val", index).visible_fraction
        for count in np.repeat(VIEWS, CHOICES):
            views = rng.choice(len(lookup.sphere), (1, count), replace=False)
            scene = np.array([index])
            state = represent(observe(lookup, scene, views, np.array([1]))[0], model)
            fused = lookup.fuse(scene, views, views[:, -1])
            missed = known(lookup, scene, views)[0, :, 0] == 0
            for item, true in zip(*stand_for(lookup, index, fused, state.clusters), strict=True):
                if missed[true] and np.ptp(state.shown[item]) > 0:
                    correlation = np.corrcoef(state.shown[item], rendered[:, true])[0, 1]
                    correlations["a cluster" if state.scalars[item, 4] else "a hypothesis"].append(correlation)
    for what, values in correlations.items():
        print(f"{model.name} missed, {what} stands for it: {len(values)}, correlation {np.mean(values):.3f}")


def main() -> None:
    parser = study_parser(__doc__)
    model = load_object(parser.parse_args().object)
    compare_true_poses(model)
    compare_missed(model)


if __name__ == "__main__":
    main()
