#!/usr/bin/env python3
"""Expected visibility against the rendered shares stored with the validation scenes, true poses given.

Usage: scripts/compare_visibility.py OBJECT
"""

import argparse

import numpy as np

from active6d_core.object_model import load_object
from active6d_core.view_sphere import ViewSphere
from active6d_perception.visibility import Tray, expected_visibility
from active6d_sim.scene_store import SPLITS, load_scene


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("object")
    model = load_object(parser.parse_args().object)
    eyes, visibility = ViewSphere().positions, expected_visibility(model)
    scenes = [load_scene(model.name, "val", index) for index in range(SPLITS["val"])]
    rendered = np.concatenate([scene.visible_fraction.T.ravel() for scene in scenes])
    for what, tray in (("with walls", Tray.for_model(model)), ("without walls", None)):
        told = []
        for scene in scenes:
            everything = np.concatenate([scene.T_world_object, scene.T_world_hidden])
            told.append(visibility.shares(everything, eyes, tray)[: len(scene.T_world_object)].ravel())
        told = np.concatenate(told)
        off, correlation = np.abs(told - rendered).mean(), np.corrcoef(told, rendered)[0, 1]
        print(f"{model.name} {what:14} mean difference {off:.3f}, correlation {correlation:.3f}")


if __name__ == "__main__":
    main()
