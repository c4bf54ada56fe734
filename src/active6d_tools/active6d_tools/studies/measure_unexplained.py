#!/usr/bin/env python3
"""Measure how often unexplained surface shows a missed object, on the bank of the validation scenes.

Example: python -m active6d_tools.studies.measure_unexplained mug --within 0.05
"""

import numpy as np

from active6d_agent.bank.all_views_lookup import make_lookup
from active6d_agent.bank.scene_bank import find_bank, load_bank
from active6d_core.metrics import DETECTION_FRACTION
from active6d_perception.scene.fusion_parameters import FusionParameters
from active6d_perception.scene.observed_surface import explainer
from active6d_sim.scenes.scene_store import find_scene
from active6d_tools.studies.arguments import study_parser

VIEWS = (2, 3, 4, 6)
CHOICES = 15
# Unexplained surface shows a missed object with this many cells on it. Objects count from this visible fraction on.
LEAST_CELLS, LEAST_VISIBLE = 3, 0.1


def main() -> None:
    parser = study_parser(__doc__)
    within = FusionParameters.explained_within
    text = "an object explains surface within this distance, in diameters (default: %(default)s)"
    parser.add_argument("--within", type=float, default=within, help=text)
    arguments = parser.parse_args()
    name = arguments.object
    lookup = make_lookup(load_bank(find_bank(name, "val")), FusionParameters(explained_within=arguments.within))
    near = explainer(lookup.model, within)
    limit, rng = DETECTION_FRACTION * lookup.model.diameter, np.random.default_rng(0)
    shown, without, cells = [], [], []
    for index, bank_scene in enumerate(lookup.bank.scenes):
        scene = find_scene(name, bank_scene.name, 0)
        truth = scene.T_world_object
        for count in np.repeat(VIEWS, CHOICES):
            views = rng.choice(len(lookup.sphere), (1, count), replace=False)
            fused = lookup.fuse(np.array([index]), views, views[:, -1])
            points = lookup.unexplained(fused, np.array([index]), views)[0]
            missed = lookup.object_errors(fused)[0, : len(truth)] >= limit
            seen = missed & (scene.visible_fraction[views[0]].max(axis=0) >= LEAST_VISIBLE)
            found = lookup.positions[fused.objects[0]]
            apart = np.linalg.norm(truth[:, None, :3, 3] - found, axis=-1).min(axis=1, initial=np.inf)
            on = near.explains(points, truth)
            shown.extend(on[seen].sum(axis=1) >= LEAST_CELLS)
            without.extend(on[seen & (apart > 0.3 * lookup.model.diameter)].sum(axis=1) >= LEAST_CELLS)
            rest = ~(on[missed].any(axis=0) | near.explains(points, scene.T_world_hidden).any(axis=0))
            cells.append((len(points), (rest & on.any(axis=0)).sum(), (rest & ~on.any(axis=0)).sum()))
    print(f"{name}: of {len(shown)} missed objects that a view shows {LEAST_VISIBLE:.0%} of, {np.mean(shown):.3f} have")
    print(f"  {LEAST_CELLS} unexplained cells; of {len(without)} without a hypothesis near them {np.mean(without):.3f}")
    every, of_found, of_nothing = np.mean(cells, axis=0)
    print(f"  {every:.1f} cells on average, {of_found:.2f} of them of found objects and {of_nothing:.3f} of no object")


if __name__ == "__main__":
    main()
