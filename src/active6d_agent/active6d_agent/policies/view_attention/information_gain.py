"""A computed policy: go where the most is expected to be learned about what is uncertain.

It needs no training, so it serves objects without a trained policy, and shows what training adds to it.
"""

import numpy as np

from active6d_agent.policies.registry import Decision, DeterministicPolicy, Observation, register_policy
from active6d_agent.policies.view_attention.features import INFORMATION, gather, go_for_items, represent
from active6d_core.object_model import ObjectModel


@register_policy("information-gain")
class InformationGainPolicy(DeterministicPolicy):
    """Goes to the view with the largest expected information, less the travel.

    The information of a view is a sum over the accumulated objects and the clusters of unexplained surface. Each adds
    its entropy (is the pose right, and which of the similar poses is it), times the share of it that the view would
    show past the other objects and the walls, times how new that side is.

    Args:
        model: of the object.
        metres_weight: nats that one metre of travel costs.
        stop_below: stop when no view is expected to give this many nats; 0 never does.

    Raises:
        ValueError: a number is negative or not finite.
    """

    def __init__(self, model: ObjectModel, metres_weight: float = 0.1, stop_below: float = 0.0) -> None:
        for name, value in (("metres_weight", metres_weight), ("stop_below", stop_below)):
            if not 0 <= value < np.inf:
                raise ValueError(f"{name} is {value}, must be finite and not negative")
        self._model, self._metres_weight, self._stop_below = model, metres_weight, stop_below

    def decide(self, observation: Observation) -> Decision:
        """The view of most information. The attention is each object's share of it."""
        candidates = observation.candidates()
        told = gather([represent(observation, self._model)])["pairs"][0, ..., INFORMATION].double().numpy()
        information = np.where(candidates, told.sum(axis=1), -np.inf)
        if not candidates.any() or information.max() < self._stop_below:
            return Decision.stop_here(observation)
        sphere = observation.sphere
        worth = information - self._metres_weight * sphere.arc(sphere.positions, observation.positions[-1])
        # Views of equal value differ by rounding, which must not decide.
        view = int(np.round(worth, 5).argmax())
        return go_for_items(observation, view, told[view] / max(told[view].sum(), np.finfo(float).tiny))
