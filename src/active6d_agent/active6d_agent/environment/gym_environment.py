"""The paper's decision process as a Gymnasium environment on a scene bank ("Policy learning")."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from active6d_agent.bank.batched_fusion import BatchedFusion, FusedBatch
from active6d_agent.bank.scene_bank import SceneBank, load_bank
from active6d_core.metrics import DETECTION_FRACTION

ENVIRONMENT_ID = "Active6D-v0"
#: Fused objects beyond these are left out of the observation, the best verified being kept.
MAX_OBJECTS = 48


@dataclass(frozen=True)
class RewardParameters:
    """Equations 2 to 4, made dimensionless: errors over 10 % of the diameter, distances over the hemisphere's radius.

    Attributes:
        alpha: in [0, 1], weight of getting closer to the attended object.
        beta: in [0, 1], of closeness against the penalty on moving.
        error_scale: multiplies the first term.
        distance_scale: multiplies the second term.
        motion_scale: multiplies the penalty.
        as_printed: with the signs of equations 2 and 3 as printed (new minus old), which reward a growing error.

    Raises:
        ValueError: alpha or beta is outside [0, 1].
    """

    alpha: float = 0.3
    beta: float = 0.5
    error_scale: float = 1.0
    distance_scale: float = 0.1
    motion_scale: float = 0.02
    as_printed: bool = False

    def __post_init__(self) -> None:
        if not (0 <= self.alpha <= 1 and 0 <= self.beta <= 1):
            raise ValueError(f"reward: alpha and beta must be in [0, 1], got {self.alpha} and {self.beta}")

    def combine(self, error_drop: np.ndarray, approach: np.ndarray, motion: np.ndarray) -> np.ndarray:
        """Equation 4 from the falls of the error and of the distance to the object, and the L1 length of the move."""
        sign = -1.0 if self.as_printed else 1.0
        return (
            (1 - self.alpha) * self.error_scale * sign * error_drop
            + self.alpha * self.beta * self.distance_scale * sign * approach
            - (1 - self.alpha) * (1 - self.beta) * self.motion_scale * motion
        )


class Episodes:
    """E episodes side by side; what :class:`Active6DEnv` says of one holds for each.

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
        lookup: BatchedFusion,
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
        """Start (b,) episodes anew; scenes and first views are drawn where they are not given."""
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
        """Move, look and fuse: (E, 3) actions to (E,) rewards and (E,) whether the episodes are over."""
        each = np.arange(len(self.time))
        before, errors, last = self.fused, self._errors, self.current
        goal = self.sphere.position(np.pi * action[:, 0], np.pi / 4 * (action[:, 1] + 1.0))
        view = np.where(self.free, goal @ self._unit.T, -np.inf).argmax(axis=1)
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
        error_drop = (errors[each, target] - self._errors[each, target]) / self._error_unit
        attends = row >= 0
        reward = self.reward.combine(
            np.where(attends, error_drop, 0.0), np.where(attends, self._approach(row, last, view), 0.0), motion
        )
        return reward, self.time == self.steps

    def _approach(self, row: np.ndarray, last: np.ndarray, view: np.ndarray) -> np.ndarray:
        """Equation 3, falling; the attended object is now the accumulated one nearest to its place."""
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
        current, count = self.current, len(self.time)
        features = self.lookup.features(self.fused, self.scene, current)[:, :MAX_OBJECTS]
        width = features.shape[1]
        objects = np.zeros((count, MAX_OBJECTS, 6), np.float32)
        mask = np.zeros((count, MAX_OBJECTS), np.float32)
        objects[:, :width] = features
        mask[:, :width] = self.fused.objects[:, :width] >= 0
        past = np.arange(self.steps) < self.time[:, None]
        history = np.where(past[..., None], self._unit[self.views[:, :-1]], 0.0).astype(np.float32)
        return {"objects": objects, "mask": mask, "camera": self._unit[current].astype(np.float32), "history": history}

    def results(self) -> dict[str, np.ndarray]:
        """What the episodes have achieved: (E,) ``detection_rate``, ``e_add_mm`` and ``distance_m``."""
        scores = self.lookup.evaluate(self.fused, self.scene)
        positions = self.sphere.positions[self.views]
        arcs = np.where(self.views[:, 1:] >= 0, self.sphere.arc(positions[:, :-1], positions[:, 1:]), 0.0)
        return {
            "detection_rate": np.array([score.detection_rate for score in scores]),
            "e_add_mm": np.array([score.mean_e_add_mm for score in scores]),
            "distance_m": arcs.sum(axis=1),
        }


def make_spaces(steps: int) -> tuple[spaces.Dict, spaces.Box]:
    """Observation and action space of one episode of T moves."""
    observation = spaces.Dict(
        {
            "objects": spaces.Box(-1.0, 10.0, (MAX_OBJECTS, 6), np.float32),
            "mask": spaces.Box(0.0, 1.0, (MAX_OBJECTS,), np.float32),
            "camera": spaces.Box(-1.0, 1.0, (3,), np.float32),
            "history": spaces.Box(-1.0, 1.0, (steps, 3), np.float32),
        }
    )
    low, high = np.array([-1.0, -1.0, 0.0], np.float32), np.array([1.0, 1.0, MAX_OBJECTS - 1], np.float32)
    return observation, spaces.Box(low, high)


class Active6DEnv(gym.Env):
    """One episode is T moves in one scene; all that is seen and scored is looked up in a bank.

    Observation, a dict of float32: ``objects`` (MAX_OBJECTS, 6) the features B_t of the accumulated objects, padded
    with zeros; ``mask`` (MAX_OBJECTS,) 1 for an object; ``camera`` (3,) the camera's position over the radius;
    ``history`` (T, 3) the previous positions over the radius, zeros where there is none yet. The attention module
    belongs to the policy network, so o_t is made there.

    Action: three numbers, azimuth over 180 degrees in [-1, 1], elevation from the horizon (-1) to the zenith (1), and
    the index of the attended object, which the reward needs and the policy's attention decides. The angles are absolute
    and snap to the nearest view that has not been taken. An index beyond the objects attends to none.

    Reward: equation 4 with the signs of its text, see :class:`RewardParameters`. ``info`` at the end of an episode
    holds ``detection_rate``, ``e_add_mm`` and ``distance_m``; ``view`` always.

    ``reset(options={"scene": i, "view": j})`` fixes the scene and the first view, otherwise both are drawn.

    Args:
        bank: a bank, the path of one, or a look-up of one.
        settings: see :class:`Episodes`.
    """

    metadata = {"render_modes": []}  # noqa: RUF012  (Gymnasium's interface)

    def __init__(self, bank: BatchedFusion | SceneBank | str | Path, **settings: Any) -> None:
        self.episodes = Episodes(_open(bank), 1, **settings)
        self.observation_space, self.action_space = make_spaces(self.episodes.steps)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        """Begin an episode."""
        super().reset(seed=seed)
        options = options or {}
        self.episodes.begin(np.zeros(1, int), self.np_random, options.get("scene"), options.get("view"))
        return self._observe(), {"view": int(self.episodes.current[0])}

    def step(self, action: np.ndarray) -> tuple[dict, float, bool, bool, dict]:
        """Move, look, fuse."""
        reward, done = self.episodes.move(np.asarray(action, float)[None])
        info: dict[str, Any] = {"view": int(self.episodes.current[0])}
        if done[0]:
            info |= {name: float(value[0]) for name, value in self.episodes.results().items()}
        return self._observe(), float(reward[0]), bool(done[0]), False, info

    def _observe(self) -> dict[str, np.ndarray]:
        return {name: value[0] for name, value in self.episodes.observe().items()}


class Active6DVectorEnv(VectorEnv):
    """Many :class:`Active6DEnv` at once, much faster than one by one; episodes that end begin anew in the same step.

    ``info["final_obs"]`` and the results of :meth:`Episodes.results` are there in a step that ends episodes; all
    episodes have the same length, so they end together.

    Args:
        bank: as for :class:`Active6DEnv`.
        num_envs: how many.
        settings: see :class:`Episodes`.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012  (Gymnasium's interface)

    def __init__(self, bank: BatchedFusion | SceneBank | str | Path, num_envs: int = 1, **settings: Any) -> None:
        self.num_envs = num_envs
        self.episodes = Episodes(_open(bank), num_envs, **settings)
        self.single_observation_space, self.single_action_space = make_spaces(self.episodes.steps)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        """Begin all episodes; ``options`` may fix the (E,) ``scene`` and ``view``."""
        super().reset(seed=seed)
        options = options or {}
        self.episodes.begin(np.arange(self.num_envs), self.np_random, options.get("scene"), options.get("view"))
        return self.episodes.observe(), {}

    def step(self, actions: np.ndarray) -> tuple[dict, np.ndarray, np.ndarray, np.ndarray, dict]:
        """Move all cameras."""
        reward, done = self.episodes.move(np.asarray(actions, float))
        info: dict[str, Any] = {}
        if done.any():
            info = {"final_obs": self.episodes.observe(), **self.episodes.results()}
            self.episodes.begin(np.flatnonzero(done), self.np_random)
        return self.episodes.observe(), reward, done, np.zeros_like(done), info


def _open(bank: BatchedFusion | SceneBank | str | Path) -> BatchedFusion:
    if isinstance(bank, BatchedFusion):
        return bank
    return BatchedFusion(bank if isinstance(bank, SceneBank) else load_bank(Path(bank)))


def register_environment() -> None:
    """Make ``gymnasium.make("Active6D-v0", bank=...)`` and ``gymnasium.make_vec`` work."""
    if ENVIRONMENT_ID not in gym.registry:
        module = "active6d_agent.environment.gym_environment"
        gym.register(
            ENVIRONMENT_ID, entry_point=f"{module}:Active6DEnv", vector_entry_point=f"{module}:Active6DVectorEnv"
        )


register_environment()
