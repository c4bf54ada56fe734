"""Training the paper's policy with PPO ("Policy learning", supplement E): Stable-Baselines3 on a scene bank."""

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from safetensors.torch import load_file, save_file
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from active6d_agent.bank.scene_lookup import SceneLookup
from active6d_agent.environment.episodes import RewardParameters
from active6d_agent.environment.gym_environment import Active6DVectorEnv
from active6d_agent.environment.rollout import measure, roll_out
from active6d_agent.evaluation.policy_evaluation import all_starts
from active6d_agent.policies.attention.encoding import FEATURES, decode
from active6d_agent.policies.attention.network import (
    ATTENTION_RULES,
    AttentionNetwork,
    encode_observations,
    save_network,
)
from active6d_agent.policies.attention.ppo_policy import PaperPolicy
from active6d_agent.policies.registry import Observation
from active6d_agent.policies.training_folder import begin_training
from active6d_core.files import Checkpoints, append_line, atomic_file, write_file

#: The paper's length of the training and its learning rate (supplement E); batch and discount are the usual ones here.
AS_IN_THE_PAPER = {"total": 10_000_000, "learning_rate": 1e-4, "evaluate_every": 200_000}


@dataclass(frozen=True)
class PpoParameters:
    """How to train; the paper's hyper-parameters where it gives them.

    Attributes:
        steps: horizon T.
        total: environment steps (the paper: 1e7).
        environments: episodes side by side.
        rollout: steps of each environment between updates, a multiple of ``steps``.
        gamma: discount (paper).
        learning_rate: of Adam; the paper's 1e-4 goes with its 1e7 steps.
        batch: minibatch (paper: "number of batches 128").
        epochs: passes over each rollout.
        entropy: weight of the entropy bonus.
        seed: of the weights, the episodes and the batches.
        evaluate_every: environment steps between evaluations on the validation scenes.
        attend: rule for the attended object, see :class:`~active6d_agent.policies.attention.network.ObjectAttention`.
        credit: draw the attended object from the attention's weights during training, so that the choice has a
            probability and is rewarded; the paper's has none.
        normalise: standardise the objects' features and divide rewards by the deviation of returns.
        log_deviation: natural logarithm of the Gaussian's deviation at the beginning.

    Raises:
        ValueError: a value is out of range.
    """

    steps: int = 5
    total: int = 1_000_000
    environments: int = 128
    rollout: int = 20
    gamma: float = 0.995
    learning_rate: float = 5e-4
    batch: int = 128
    epochs: int = 4
    entropy: float = 0.0
    seed: int = 0
    evaluate_every: int = 50_000
    attend: str = "learned"
    credit: bool = False
    normalise: bool = False
    log_deviation: float = -0.5

    def __post_init__(self) -> None:
        for name in ("steps", "total", "environments", "rollout", "batch", "epochs", "evaluate_every"):
            if getattr(self, name) < 1:
                raise ValueError(f"training: {name} must be at least 1, got {getattr(self, name)}")
        if self.rollout % self.steps:
            raise ValueError(f"training: rollout {self.rollout} must be a multiple of steps {self.steps}")
        if self.attend not in ATTENTION_RULES:
            raise ValueError(f"training: attend must be one of {', '.join(ATTENTION_RULES)}, got {self.attend}")


class BankVecEnv(VecEnv):
    """:class:`Active6DVectorEnv` as Stable-Baselines3 wants it."""

    def __init__(self, environment: Active6DVectorEnv) -> None:
        self.environment = environment
        self._actions = np.zeros((environment.num_envs, 3))
        self._returns = np.zeros(environment.num_envs)
        self.render_mode = None
        super().__init__(environment.num_envs, environment.single_observation_space, environment.single_action_space)

    def reset(self) -> dict[str, np.ndarray]:
        """Begin all episodes; the first time with the seed given to :meth:`seed`."""
        seed, self._seeds[0] = self._seeds[0], None
        return self.environment.reset(seed=seed)[0]

    def step_async(self, actions: np.ndarray) -> None:
        """Remember the actions."""
        self._actions = actions

    def step_wait(self) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Move all cameras."""
        observation, reward, done, _, info = self.environment.step(self._actions)
        self._returns += reward
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for index in np.flatnonzero(done):
            last = {name: values[index] for name, values in info["final_obs"].items()}
            episode = {"r": self._returns[index], "l": self.environment.episodes.steps, "t": 0.0}
            infos[index] = {"terminal_observation": last, "episode": episode}
        self._returns[done] = 0.0
        return observation, reward.astype(np.float32), done, infos

    def close(self) -> None:
        """Nothing to release."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute, which all episodes share."""
        return [getattr(self, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute, which all episodes share."""
        setattr(self, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """There are no single environments to call.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError(f"episodes side by side have no method {method_name} of their own")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """No wrappers."""
        return [False] * len(list(self._get_indices(indices)))


@dataclass(frozen=True)
class Progress:
    """One line of the learning curve.

    Attributes:
        steps: environment steps so far.
        seconds: of training so far.
        detection_rate: on the validation scenes.
        e_add_mm: there.
        distance_m: there.
        mean_return: of the latest training episodes.
    """

    steps: int
    seconds: float
    detection_rate: float
    e_add_mm: float
    distance_m: float
    mean_return: float


def train_ppo(
    train: SceneLookup,
    validation: SceneLookup,
    folder: Path,
    parameters: PpoParameters | None = None,
    reward: RewardParameters | None = None,
    *,
    resume: bool = False,
    again: bool = False,
) -> Iterator[Progress]:
    """Train, evaluate on the validation scenes, keep the best; yields the curve as it grows.

    ``folder`` receives ``curve.jsonl``, ``best.safetensors`` with its JSON (highest validation detection rate, lower
    ADD of equals), and ``latest.safetensors`` with ``latest.json`` to continue from.

    Args:
        train: scenes to train on.
        validation: scenes to choose the best on.
        folder: of the results.
        parameters: how to train.
        reward: weights and scales of the reward.
        resume: continue from ``latest``; all parameters but ``total`` must be the same as before.
        again: replace the training that is in the folder.

    Raises:
        ValueError: there is nothing to resume from, or with other parameters, or a training that is neither to go on
            nor to be replaced.
    """
    parameters, reward = parameters or PpoParameters(), reward or RewardParameters()
    begin_training(folder, resume=resume, again=again)
    ppo = _make_ppo(train, parameters, reward)
    identity = {"parameters": asdict(parameters) | {"total": 0}, "reward": asdict(reward)}
    curve, best, begun = folder / "curve.jsonl", (-1.0, 0.0), time.perf_counter()
    evaluated = 0
    if resume:
        best, seconds, evaluated = _restore(ppo, folder, identity)
        begun -= seconds

    def keep() -> None:
        state = {"best": best, "seconds": time.perf_counter() - begun, "evaluated": evaluated}
        _checkpoint(ppo, folder, {**identity, **state})

    while evaluated < parameters.total:
        _learn(ppo, min(evaluated + parameters.evaluate_every, parameters.total), keep)
        evaluated = ppo.num_timesteps
        network = cast(PaperPolicy, ppo.policy).network()
        measured = validate(network, validation, parameters.steps)
        returns = [episode["r"] for episode in ppo.ep_info_buffer or []]
        mean_return = float(np.mean(returns)) if returns else float("nan")
        progress = Progress(ppo.num_timesteps, time.perf_counter() - begun, *measured, mean_return)
        append_line(curve, json.dumps(asdict(progress)))
        if (progress.detection_rate, -progress.e_add_mm) > best:
            best = (progress.detection_rate, -progress.e_add_mm)
            save_network(network, folder / "best.safetensors", {**identity, "validation": asdict(progress)})
        keep()
        yield progress


def _learn(ppo: PPO, until: int, keep: Callable[[], None]) -> None:
    """Learn until so many environment steps are done, and call ``keep`` every some seconds."""
    checkpoints = Checkpoints()

    def keep_when_due(*_: Any) -> bool:
        if checkpoints.due():
            keep()
        return True

    if until > ppo.num_timesteps:
        ppo.learn(until - ppo.num_timesteps, reset_num_timesteps=False, progress_bar=False, callback=keep_when_due)


def _make_ppo(lookup: SceneLookup, parameters: PpoParameters, reward: RewardParameters) -> PPO:
    environment: VecEnv = BankVecEnv(
        Active6DVectorEnv(lookup, parameters.environments, steps=parameters.steps, reward=reward)
    )
    extractor: dict[str, Any] = {"rule": parameters.attend}
    if parameters.normalise:
        extractor["mean"], extractor["deviation"] = _feature_statistics(environment, parameters.seed)
        environment = VecNormalize(environment, norm_obs=False, gamma=parameters.gamma)
    return PPO(
        PaperPolicy,
        environment,
        policy_kwargs={
            "features_extractor_kwargs": extractor,
            "credit": parameters.credit,
            "log_std_init": parameters.log_deviation,
        },
        learning_rate=parameters.learning_rate,
        n_steps=parameters.rollout,
        batch_size=parameters.batch,
        n_epochs=parameters.epochs,
        gamma=parameters.gamma,
        ent_coef=parameters.entropy,
        seed=parameters.seed,
    )


def _feature_statistics(environment: VecEnv, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """(6,) mean and (6,) deviation of the objects' features in the first views of episodes."""
    environment.seed(seed)
    observation = cast(dict[str, np.ndarray], environment.reset())
    present = observation["objects"][observation["mask"] > 0].astype(float)
    if not len(present):
        return np.zeros(FEATURES), np.ones(FEATURES)
    return present.mean(axis=0), np.maximum(present.std(axis=0), 1e-3)


def validate(network: AttentionNetwork, lookup: SceneLookup, steps: int) -> tuple[float, float, float]:
    """Detection rate, ADD (mm) and metres of the network's mean actions over all scenes and starting views."""
    starts = all_starts(lookup)

    def choose(_: np.ndarray, observations: list[Observation]) -> np.ndarray:
        with torch.inference_mode():
            mean = network(encode_observations(observations, network.steps))[0]
        candidates = np.stack([observation.candidates() for observation in observations])
        return decode(mean.double().clamp(-1.0, 1.0).numpy(), lookup.sphere, candidates)

    views = roll_out(lookup, choose, starts[:, 0], starts[:, 1], np.full(len(starts), steps))
    return measure(lookup, starts[:, 0], views).means


def _checkpoint(ppo: PPO, folder: Path, state: dict[str, Any]) -> None:
    """Weights and Adam's moments as tensors, the rest as JSON: nothing pickled."""
    tensors = {f"policy.{name}": value for name, value in ppo.policy.state_dict().items()}
    for index, moments in ppo.policy.optimizer.state_dict()["state"].items():
        tensors |= {f"adam.{index}.{name}": value for name, value in moments.items()}
    # Cloned, because the policy names its extractor three times and safetensors refuses shared memory.
    cloned = {name: value.detach().cpu().clone() for name, value in tensors.items()}
    with atomic_file(folder / "latest.safetensors") as unfinished:
        save_file(cloned, unfinished)
    environment = ppo.env
    if isinstance(environment, VecNormalize):
        returns = environment.ret_rms
        state = {**state, "returns": [float(returns.mean), float(returns.var), float(returns.count)]}
    write_file(folder / "latest.json", json.dumps({**state, "steps": ppo.num_timesteps}, indent=2) + "\n")


def _restore(ppo: PPO, folder: Path, identity: dict[str, Any]) -> tuple[tuple[float, float], float, int]:
    """Load a checkpoint into ``ppo``; the best so far, the seconds spent, and the steps at the last evaluation."""
    path = folder / "latest.safetensors"
    try:
        state, tensors = json.loads(path.with_suffix(".json").read_text()), load_file(path)
    except Exception as error:  # safetensors raises its own kinds
        raise ValueError(f"{path}: nothing to resume from ({error})") from error
    # Parameters that did not exist when it was written had what is now their default.
    defaults = {"parameters": asdict(PpoParameters()), "reward": asdict(RewardParameters())}
    if any({**defaults[key], **state.get(key, {})} != value for key, value in identity.items()):
        raise ValueError(f"{path}: was trained with other parameters; give these, or replace it with --again")
    ppo.policy.load_state_dict({k.removeprefix("policy."): v for k, v in tensors.items() if k.startswith("policy.")})
    adam: dict[int, dict[str, torch.Tensor]] = {}
    for key, value in tensors.items():
        if key.startswith("adam."):
            _, index, name = key.split(".")
            adam.setdefault(int(index), {})[name] = value
    ppo.policy.optimizer.load_state_dict({**ppo.policy.optimizer.state_dict(), "state": adam})
    if isinstance(ppo.env, VecNormalize):
        returns = ppo.env.ret_rms
        mean, variance, returns.count = state["returns"]
        returns.mean, returns.var = np.array(mean), np.array(variance)
    ppo.num_timesteps = int(state["steps"])
    # The seed alone would draw the same scenes again.
    ppo.set_random_seed((ppo.seed or 0) + ppo.num_timesteps)
    return tuple(state["best"]), float(state["seconds"]), int(state.get("evaluated", state["steps"]))
