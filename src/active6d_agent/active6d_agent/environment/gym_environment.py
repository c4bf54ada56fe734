"""The paper's decision process as a Gymnasium environment on a scene bank ("Policy learning")."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from active6d_agent.bank.all_views_lookup import make_lookup
from active6d_agent.bank.scene_bank import SceneBank, load_bank
from active6d_agent.bank.scene_lookup import SceneLookup
from active6d_agent.environment.episodes import Episodes
from active6d_agent.policies.attention.encoding import FEATURES
from active6d_agent.policies.registry import MAX_OBJECTS


def make_spaces(steps: int) -> tuple[spaces.Dict, spaces.Box]:
    """Observation and action space of one episode of T moves."""
    observation = spaces.Dict(
        {
            "objects": spaces.Box(-1.0, 10.0, (MAX_OBJECTS, FEATURES), np.float32),
            "mask": spaces.Box(0.0, 1.0, (MAX_OBJECTS,), np.float32),
            "camera": spaces.Box(-1.0, 1.0, (3,), np.float32),
            "history": spaces.Box(-1.0, 1.0, (steps, 3), np.float32),
        }
    )
    low, high = np.array([-1.0, -1.0, 0.0], np.float32), np.array([1.0, 1.0, MAX_OBJECTS - 1], np.float32)
    return observation, spaces.Box(low, high)


def horizon(observations: spaces.Space[Any]) -> int:
    """T of an observation space of :func:`make_spaces`.

    Raises:
        ValueError: it is another space.
    """
    history = observations["history"] if isinstance(observations, spaces.Dict) else None
    if history is None or not history.shape:
        raise ValueError("this is not an observation space of Active6D-v0")
    return history.shape[0]


class Active6DEnv(gym.Env):
    """One episode is T moves in one scene; observations and scores are looked up in a bank.

    Observation, a dict of float32: ``objects`` (MAX_OBJECTS, 6) the features B_t of the accumulated objects, padded
    with zeros, and ``mask`` (MAX_OBJECTS,) 1 for an object. ``camera`` (3,) is the camera's position over the radius,
    ``history`` (T, 3) the previous ones, zeros where there is none yet. The attention module belongs to the policy
    network, which computes o_t.

    Action: three numbers, azimuth over 180 degrees in [-1, 1], elevation from the horizon (-1) to the zenith (1), and
    the index of the attended object, which the reward needs and the policy's attention decides. The angles are absolute
    and snap to the nearest view that has not been taken. An index beyond the objects attends to none.

    Reward: equation 4 with the signs of its text, see :class:`RewardParameters`. ``info`` at the end of an episode
    holds ``detection_rate``, ``e_add_mm`` and ``distance_m``; ``view`` always.

    ``reset(options={"scene": i, "view": j})`` fixes the scene and the first view, otherwise both are drawn.

    Args:
        bank: a bank, the path of one, or a look-up of one.
        settings: see :class:`~active6d_agent.environment.episodes.Episodes`.
    """

    metadata = {"render_modes": []}  # noqa: RUF012  (Gymnasium's interface)

    def __init__(self, bank: SceneLookup | SceneBank | str | Path, **settings: Any) -> None:
        self.episodes = Episodes(_open(bank), 1, **settings)
        self.observation_space, self.action_space = make_spaces(self.episodes.steps)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin an episode."""
        super().reset(seed=seed)
        options = options or {}
        self.episodes.begin(np.zeros(1, int), self.np_random, options.get("scene"), options.get("view"))
        return self._observe(), {"view": int(self.episodes.current[0])}

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Take the next view."""
        reward, done = self.episodes.move(np.asarray(action, float)[None])
        info: dict[str, Any] = {"view": int(self.episodes.current[0])}
        if done[0]:
            info |= {name: float(value[0]) for name, value in self.episodes.results().items()}
        return self._observe(), float(reward[0]), bool(done[0]), False, info

    def _observe(self) -> dict[str, np.ndarray]:
        return {name: value[0] for name, value in self.episodes.observe().items()}


class Active6DVectorEnv(VectorEnv):
    """Many :class:`Active6DEnv` at once, much faster than one by one.

    An episode that ends is followed by a new one in the same step.

    ``info["final_obs"]`` and the results of :meth:`Episodes.results` are there in a step that ends episodes; all
    episodes have the same length, so they end together.

    Args:
        bank: as for :class:`Active6DEnv`.
        num_envs: how many.
        settings: see :class:`~active6d_agent.environment.episodes.Episodes`.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012  (Gymnasium's interface)

    def __init__(self, bank: SceneLookup | SceneBank | str | Path, num_envs: int = 1, **settings: Any) -> None:
        self.num_envs = num_envs
        self.episodes = Episodes(_open(bank), num_envs, **settings)
        self.single_observation_space, self.single_action_space = make_spaces(self.episodes.steps)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin all episodes; ``options`` may fix the (E,) ``scene`` and ``view``."""
        super().reset(seed=seed)
        options = options or {}
        self.episodes.begin(np.arange(self.num_envs), self.np_random, options.get("scene"), options.get("view"))
        return self.episodes.observe(), {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Move all cameras."""
        reward, done = self.episodes.move(np.asarray(actions, float))
        info: dict[str, Any] = {}
        if done.any():
            info = {"final_obs": self.episodes.observe(), **self.episodes.results()}
            self.episodes.begin(np.flatnonzero(done), self.np_random)
        return self.episodes.observe(), reward, done, np.zeros_like(done), info


def _open(bank: SceneLookup | SceneBank | str | Path) -> SceneLookup:
    if isinstance(bank, SceneLookup):
        return bank
    return make_lookup(bank if isinstance(bank, SceneBank) else load_bank(Path(bank)))
