#!/usr/bin/env python3
"""Count the moves for which the paper's reward has an error term (equation 2), with both kinds of fusion.

The cameras go to random views and attend to random objects, in the test scenes that ship. A policy that is hardly ever
paid for an error learns from the penalty on motion only.

Example: python -m active6d_tools.studies.count_paid_moves coffee_cup
"""

import numpy as np

from active6d_agent.bank.all_views_lookup import AllViewsLookup
from active6d_agent.bank.best_view_lookup import BestViewLookup
from active6d_agent.bank.scene_bank import find_bank, load_bank
from active6d_agent.bank.scene_lookup import SceneLookup
from active6d_agent.environment.episodes import Episodes
from active6d_tools.studies.arguments import study_parser


def random_terms(lookup: SceneLookup, count: int, steps: int, rng: np.random.Generator) -> np.ndarray:
    """(3, count * steps) error, distance and motion terms of random moves in ``count`` episodes."""
    episodes, terms = Episodes(lookup, count, steps), []
    episodes.begin(np.arange(count), rng)
    for _ in range(steps):
        objects = (episodes.fused.objects >= 0).sum(axis=1)
        attended = rng.integers(np.maximum(objects, 1))
        episodes.move(np.column_stack([rng.uniform(-1.0, 1.0, (count, 2)), attended]))
        terms.append(episodes.terms)
    return np.concatenate(terms, axis=1)


def main() -> None:
    parser = study_parser(__doc__)
    parser.add_argument("--episodes", type=int, default=1000, help="number of episodes (default: %(default)s)")
    parser.add_argument("--steps", type=int, default=5, help="moves of each (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of scenes, views and objects (default: %(default)s)")
    arguments = parser.parse_args()
    bank = load_bank(find_bank(arguments.object, "test"))
    for name, make in (("all-views", AllViewsLookup), ("best-view", BestViewLookup)):
        rng = np.random.default_rng(arguments.seed)
        error, _, motion = random_terms(make(bank), arguments.episodes, arguments.steps, rng)
        print(
            f"{name}: {(error != 0).mean():.3f} of the moves have an error term; "
            f"mean error term {error.mean():+.4f}, motion {motion.mean():+.4f}"
        )


if __name__ == "__main__":
    main()
