"""Example of a policy: looks from above at the object that the fewest views have confirmed."""

import numpy as np

from active6d_agent.policies.registry import Decision, Observation
from active6d_core.object_model import ObjectModel


class LeastSupported:
    """Goes to the candidate view that looks at the least supported object most steeply.

    Args:
        model: the object that fills the bin; unused.
        steepness: weight of looking down against the length of the move.

    Raises:
        ValueError: steepness is negative.
    """

    def __init__(self, model: ObjectModel, steepness: float = 1.0) -> None:
        if steepness < 0:
            raise ValueError(f"steepness is {steepness}, must not be negative")
        self._steepness = steepness

    def reset(self, rng: np.random.Generator) -> None:
        """Begin an episode. Random choices would use ``rng`` and nothing else."""

    def decide(self, observation: Observation) -> Decision:
        """Choose the next view, or stop where no candidate is left."""
        candidates = observation.candidates()
        if not candidates.any():
            return Decision.stop_here(observation)
        objects, sphere = observation.objects, observation.sphere
        move = sphere.arc(sphere.positions, observation.positions[-1]) / sphere.radius
        if not len(objects):
            return Decision.go_to(observation, int(np.where(candidates, move, -np.inf).argmax()))
        attended = int(objects.support.argmin())
        rays = sphere.positions - objects.T_world_object[attended, :3, 3]
        down = rays[:, 2] / np.linalg.norm(rays, axis=1)
        worth = np.where(candidates, self._steepness * down - 0.1 * move, -np.inf)
        attention = np.eye(len(objects))[attended]
        return Decision.go_to(observation, int(worth.argmax()), attention, attended)
