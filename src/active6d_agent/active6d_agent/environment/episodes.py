"""Episodes of the paper's decision process on a scene bank, many side by side ("Policy learning").

Needs NumPy only; :mod:`active6d_agent.environment.gym_environment` makes Gymnasium environments of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from active6d_agent.bank.scene_lookup import FusedBatch, SceneLookup
from active6d_agent.environment.rollout import score_fused
from active6d_agent.policies.attention.encoding import decode, encode
from active6d_core.metrics import DETECTION_FRACTION


@dataclass(frozen=True)
class RewardParameters:
    """Equations 2 to 4, dimensionless: errors over 10 % of the diameter, distances over the hemisphere's radius.

    Attributes:
        alpha: in [0, 1], weight of getting closer to the attended object.
        beta: in [0, 1], of closeness against the penalty on moving.
        error_scale: multiplies the first term.
        distance_scale: multiplies the second term.
        motion_scale: multiplies the penalty.
        as_printed: with the signs of equations 2 and 3 as printed (new minus old), which reward a growing error.
        every_object: equation 2 is of the sum over all objects; in the paper, of the attended object.

    Raises:
        ValueError: alpha or beta is outside [0, 1].
    """

    alpha: float = 0.3
    beta: float = 0.5
    error_scale: float = 1.0
    distance_scale: float = 0.1
    motion_scale: float = 0.02
    as_printed: bool = False
    every_object: bool = False

    def __post_init__(self) -> None:
        if not (0 <= self.alpha <= 1 and 0 <= self.beta <= 1):
            raise ValueError(f"reward: alpha and beta must be in [0, 1], got {self.alpha} and {self.beta}")

    def terms(self, error_drop: np.ndarray, approach: np.ndarray, motion: np.ndarray) -> np.ndarray:
        """(3, E) summands of equation 4, in the order of the arguments.

        Args:
            error_drop: (E,) decrease of the error.
            approach: (E,) decrease of the distance to the object.
            motion: (E,) L1 length of the move.
        """
        sign = -1.0 if self.as_printed else 1.0
        return np.stack(
            [
                (1 - self.alpha) * self.error_scale * sign * error_drop,
                self.alpha * self.beta * self.distance_scale * sign * approach,
                -(1 - self.alpha) * (1 - self.beta) * self.motion_scale * motion,
            ]
        )


class Episodes:
    """E episodes side by side, each as :class:`~active6d_agent.environment.gym_environment.Active6DEnv` describes it.

    Args:
        lookup: of the bank.
        count: E.
        steps: the horizon T.
        reward: weights and scales.
        scenes: indices of the scenes to draw from, all when None.
        allowed: (M,) bool, views in reach, all when None.

    Raises:
        ValueError: the horizon does not fit the views in reach.
    """

    def __init__(
        self,
        lookup: SceneLookup,
        count: int,
        steps: int = 5,
        reward: RewardParameters | None = None,
        scenes: Sequence[int] | None = None,
        allowed: np.ndarray | None = None,
    ) -> None:
        self.lookup, self.sphere, self.steps = lookup, lookup.sphere, steps
        self.reward = reward or RewardParameters()
        self._scenes = np.arange(len(lookup.bank.scenes)) if scenes is None else np.asarray(scenes)
        self._allowed = np.ones(len(self.sphere), bool) if allowed is None else np.asarray(allowed, bool)
        if not 1 <= steps < self._allowed.sum():
            most = self._allowed.sum() - 1
            raise ValueError(f"steps is {steps}, must be between 1 and {most}, one less than the views in reach")
        self._unit = self.sphere.positions / self.sphere.radius
        self._error_unit = DETECTION_FRACTION * lookup.model.diameter
        self.scene = np.zeros(count, int)
        self.time = np.zeros(count, int)
        self.views = np.full((count, steps + 1), -1)
        self.free = np.tile(self._allowed, (count, 1))
        #: (3, E) summands of the last move's rewards: error, distance and motion.
        self.terms = np.zeros((3, count))
        self.fused: FusedBatch = lookup.fuse(self.scene, self.views, self.scene)

    @property
    def current(self) -> np.ndarray:
        """(E,) the views that the cameras are at."""
        return self.views[np.arange(len(self.time)), self.time]

    def begin(
        self,
        which: np.ndarray,
        rng: np.random.Generator,
        scene: np.ndarray | None = None,
        view: np.ndarray | None = None,
    ) -> None:
        """Start (b,) new episodes; scenes and first views are drawn where they are not given."""
        self.scene[which] = rng.choice(self._scenes, len(which)) if scene is None else scene
        self.views[which] = -1
        self.views[which, 0] = rng.integers(len(self.sphere), size=len(which)) if view is None else view
        self.free[which] = self._allowed
        self.free[which, self.views[which, 0]] = False
        self.time[which] = 0
        self._fuse()

    def _fuse(self) -> None:
        self.fused = self.lookup.fuse(self.scene, self.views, self.current)
        self._errors = self.lookup.object_errors(self.fused)

    def move(self, action: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Take the next views: (E, 3) actions to (E,) rewards and (E,) whether the episodes are over."""
        each = np.arange(len(self.time))
        before, errors, last = self.fused, self._errors, self.current
        view = decode(action[:, :2], self.sphere, self.free)
        self.time += 1
        self.views[each, self.time] = view
        self.free[each, view] = False
        self._fuse()
        motion = np.abs(self._unit[view] - self._unit[last]).sum(axis=1)
        index = (action[:, 2] + 0.5).astype(int)
        row = np.full(len(each), -1)
        within = index < before.objects.shape[1]
        row[within] = before.objects[each[within], index[within]]
        target = self.lookup.nearest_object[row]
        falls, attends = (errors - self._errors) / self._error_unit, row >= 0
        error_drop = np.where(attends, falls[each, target], 0.0)
        if self.reward.every_object:
            error_drop = falls.sum(axis=1)
        approach = np.where(attends, self._approach(row, last, view), 0.0)
        self.terms = self.reward.terms(error_drop, approach, motion)
        return self.terms.sum(axis=0), self.time == self.steps

    def _approach(self, row: np.ndarray, last: np.ndarray, view: np.ndarray) -> np.ndarray:
        """Decrease of equation 3's distance; the attended object is now the one nearest to its old position."""
        if not self.fused.objects.size:
            return np.zeros(len(row))
        centre = self.lookup.positions[row]
        now = self.lookup.positions[self.fused.objects]
        apart = np.where(self.fused.objects >= 0, ((now - centre[:, None]) ** 2).sum(axis=-1), np.inf)
        nearest = now[np.arange(len(row)), apart.argmin(axis=1)]
        before = np.linalg.norm(centre - self.sphere.positions[last], axis=1)
        return (before - np.linalg.norm(nearest - self.sphere.positions[view], axis=1)) / self.sphere.radius

    def observe(self) -> dict[str, np.ndarray]:
        """Observations of all episodes, stacked."""
        features = self.lookup.features(self.fused, self.scene, self.current)
        return encode(features, self.fused.objects >= 0, self._unit[self.views], self.time, self.steps)

    def results(self) -> dict[str, np.ndarray]:
        """(E,) ``detection_rate``, ``e_add_mm`` and ``distance_m`` of the views so far."""
        return score_fused(self.lookup, self.fused, self.scene, self.views).measures
