"""The paper's baselines ("Baseline policies", supplement B) and one heuristic.

All of them choose among :meth:`Observation.candidates`: views in reach, not visited, within the budget. Without a
candidate they stop.
"""

import numpy as np
from scipy.special import softmax

from active6d_agent.policies.registry import Decision, DeterministicPolicy, Observation, register_policy
from active6d_core.object_model import ObjectModel

#: A hypothesis within this fraction of the diameter of the attended one is the same object, so it hides nothing.
_SAME_OBJECT = 0.25
_ATTENTION_TEMPERATURE = 0.1


@register_policy("random")
class RandomPolicy:
    """Azimuth and elevation from a fixed Gaussian, snapped to the nearest candidate.

    The default deviations reach the whole hemisphere: half a turn makes the wrapped azimuth uniform to 2 %, and 30
    degrees about 45 spread the snapped elevations evenly over 15 to 75. Five moves then measure 4.2 m; the paper's two
    objects have 4.97 m and 3.97 m.

    Args:
        model: unused.
        azimuth_mean_degrees: of the Gaussian, from world +x.
        azimuth_std_degrees: of the Gaussian.
        elevation_mean_degrees: of the Gaussian, above the horizon.
        elevation_std_degrees: of the Gaussian.

    Raises:
        ValueError: a deviation is negative, or a number is not finite.
    """

    def __init__(
        self,
        model: ObjectModel,
        azimuth_mean_degrees: float = 0.0,
        azimuth_std_degrees: float = 180.0,
        elevation_mean_degrees: float = 45.0,
        elevation_std_degrees: float = 30.0,
    ) -> None:
        self._mean = np.radians([azimuth_mean_degrees, elevation_mean_degrees])
        self._std = np.radians([azimuth_std_degrees, elevation_std_degrees])
        if not (np.isfinite(self._mean).all() and np.isfinite(self._std).all() and (self._std >= 0).all()):
            raise ValueError("means and deviations must be finite, deviations not negative")

    def reset(self, rng: np.random.Generator) -> None:
        """Begin an episode."""
        self._rng = rng

    def decide(self, observation: Observation) -> Decision:
        """Draw the next view."""
        azimuth, elevation = self._rng.normal(self._mean, self._std)
        # The Gaussian's tail beyond the zenith must not come down on the other side.
        goal = observation.sphere.position(azimuth, np.clip(elevation, 0.0, np.pi / 2))
        return _nearest_candidate(observation, goal)


@register_policy("unidirectional")
class UnidirectionalPolicy(DeterministicPolicy):
    """One revolution at a fixed elevation: T + 1 views 360 / (T + 1) degrees apart, counter-clockwise.

    The first view is the camera's start, at any elevation; the others lie on the ring. On the ring from the
    start, T = 5 measures 2.89 m (the paper prints 2.88).

    Args:
        model: unused.
        elevation_degrees: of the ring; 45 "provides a balanced view between occlusion and variability".

    Raises:
        ValueError: the elevation is not between 0 and 90.
    """

    def __init__(self, model: ObjectModel, elevation_degrees: float = 45.0) -> None:
        if not 0 <= elevation_degrees <= 90:
            raise ValueError(f"elevation_degrees is {elevation_degrees}, must be between 0 and 90")
        self._elevation = np.radians(elevation_degrees)

    def decide(self, observation: Observation) -> Decision:
        """The next view of the ring."""
        start, _ = observation.sphere.angles(observation.positions[0])
        turned = 2 * np.pi * len(observation.positions) / (observation.steps + 1)
        return _nearest_candidate(observation, observation.sphere.position(start + turned, self._elevation))


@register_policy("max-distance")
class MaxDistancePolicy(DeterministicPolicy):
    """The candidate farthest from all previous views: the largest arc to the nearest of them.

    "The longest distance from previous viewpoints" may also mean the last view (to and fro, 9.9 m in 5 moves) or the
    sum over all (9.1 m). The largest minimum gives 7.0 m, next to the paper's 7.66 m. It spreads views as the paper's
    figure does.
    """

    def decide(self, observation: Observation) -> Decision:
        """The farthest view."""
        sphere = observation.sphere
        arcs = sphere.arc(sphere.positions[:, None], observation.positions[None]).min(axis=1)
        return _best_candidate(observation, arcs)


@register_policy("lowest-score")
class LowestScorePolicy(DeterministicPolicy):
    """Attends to the object with the lowest verification score and moves to the view that should show it best.

    The worth of a view has four terms. The first is the sine of its elevation seen from the object, because walls and
    unknown objects hide things from the side. Novelty is the angle to the nearest earlier direction, at most a quarter
    turn. Sight is how free the line of sight is past the other objects, each modelled as a ball. The length of the
    move is subtracted. Without any object the policy does as ``max-distance``.

    Args:
        model: its diameter is the size of the balls.
        novelty_weight: of the new direction.
        sight_weight: of the free line of sight.
        motion_weight: of the arc to the view over half the sphere's circumference.

    Raises:
        ValueError: a weight is negative or not finite.
    """

    def __init__(
        self,
        model: ObjectModel,
        novelty_weight: float = 1.0,
        sight_weight: float = 0.5,
        motion_weight: float = 0.5,
    ) -> None:
        self._weights = (novelty_weight, sight_weight, motion_weight)
        if not all(0 <= weight < np.inf for weight in self._weights):
            raise ValueError(f"weights must be finite and not negative, got {self._weights}")
        self._diameter = model.diameter
        self._explore = MaxDistancePolicy(model)

    def decide(self, observation: Observation) -> Decision:
        """The view of highest worth for the least certain object."""
        objects, sphere = observation.objects, observation.sphere
        if not len(objects):
            return self._explore.decide(observation)
        attended = int(np.argmin(objects.verification))
        centres = objects.T_world_object[:, :3, 3]
        rays = _directions(centres[attended], sphere.positions)
        turned = np.arccos(np.clip(rays @ _directions(centres[attended], observation.positions).T, -1.0, 1.0))
        novelty = np.minimum(turned.min(axis=1) / (np.pi / 2), 1.0)
        sight = line_of_sight(centres, attended, sphere.positions, self._diameter)
        motion = sphere.arc(sphere.positions, observation.positions[-1]) / (np.pi * sphere.radius)
        for_novelty, for_sight, for_motion = self._weights
        value = rays[:, 2] + for_novelty * novelty + for_sight * sight - for_motion * motion
        attention = softmax((1.0 - objects.verification) / _ATTENTION_TEMPERATURE)
        return _best_candidate(observation, value, attention, attended)


@register_policy("single-view")
class SingleViewPolicy(DeterministicPolicy):
    """Never moves, so that only the first view counts (T = 0)."""

    def decide(self, observation: Observation) -> Decision:
        """Stop."""
        return Decision.stop_here(observation)


@register_policy("entropy")
class EntropyPolicy(DeterministicPolicy):
    """The candidate with the largest view entropy, computed beforehand for every view of this scene.

    A robot does not know the entropy of views that it has not taken. So this is a baseline for scenes in a bank (paper,
    "Entropy-based").

    Args:
        model: unused.
        entropy: (M,) entropy of each view of the grid.

    Raises:
        ValueError: entropy is not a row of finite numbers.
    """

    def __init__(self, model: ObjectModel, entropy: np.ndarray) -> None:
        self._entropy = np.asarray(entropy, float)
        if self._entropy.ndim != 1 or not np.isfinite(self._entropy).all():
            raise ValueError("entropy must be one finite number per view")

    def decide(self, observation: Observation) -> Decision:
        """The view with the largest entropy."""
        return _best_candidate(observation, self._entropy)


def line_of_sight(centres: np.ndarray, index: int, views: np.ndarray, diameter: float) -> np.ndarray:
    """How free (M,) views see one of n objects past the others: 1 free, 0 hidden.

    Another object in front of this one hides linearly less of it with its distance from the ray, nothing from one
    ``diameter`` on. Several objects multiply.

    Args:
        centres: (n, 3) object centres, world, metres.
        index: of the observed object.
        views: (M, 3) camera positions.
        diameter: of an object.
    """
    rays = _directions(centres[index], views)
    others = centres - centres[index]
    others = others[np.linalg.norm(others, axis=1) > _SAME_OBJECT * diameter]
    along = rays @ others.T
    beside = np.sqrt(np.maximum((others**2).sum(axis=1) - along**2, 0.0))
    hidden = np.where(along > 0, np.clip(1.0 - beside / diameter, 0.0, 1.0), 0.0)
    return np.prod(1.0 - hidden, axis=1)


def _directions(origin: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """(m, 3) unit vectors from (3,) ``origin`` to (m, 3) ``targets``."""
    rays = targets - origin
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _nearest_candidate(observation: Observation, goal: np.ndarray) -> Decision:
    return _best_candidate(observation, -observation.sphere.arc(observation.sphere.positions, goal))


def _best_candidate(
    observation: Observation, value: np.ndarray, attention: np.ndarray | None = None, attended: int | None = None
) -> Decision:
    """Move to the candidate with the largest ``value`` (M,), the lowest index of equals; stop without candidates."""
    candidates = observation.candidates()
    if not candidates.any():
        return Decision.stop_here(observation)
    # Views of equal value differ by rounding, which must not decide.
    rounded = np.round(np.where(candidates, value, -np.inf), 9)
    return Decision.go_to(observation, int(np.argmax(rounded)), attention, attended)
