"""A model of Stable-Baselines3, trained on ``Active6D-v0``, as a policy: ``sb3`` in the registry.

Stable-Baselines3's own ``.zip`` files contain pickled objects, which execute code when they are loaded. So a model is
exported where it was trained, with :func:`export_model`: tensors in ``.safetensors`` and the configuration as JSON
beside them. Loading them executes nothing. Stable-Baselines3 must be installed where the policy runs.
"""

from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3 import A2C, PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from torch import nn

from active6d_agent.environment.gym_environment import horizon, make_spaces
from active6d_agent.policies.attention.encoding import decode
from active6d_agent.policies.attention.network import encode_observations
from active6d_agent.policies.policy_weights import load_weights, save_weights
from active6d_agent.policies.registry import Decision, DeterministicPolicy, Observation, register_policy
from active6d_core.object_model import ObjectModel

_ALGORITHMS = {algorithm.__name__: algorithm for algorithm in (A2C, PPO, SAC, TD3)}
_ACTIVATIONS = {activation.__name__: activation for activation in (nn.ELU, nn.LeakyReLU, nn.ReLU, nn.Tanh)}
_MOST_LAYERS, _WIDEST = 8, 4096
_REMEDY = "write them with active6d_agent.policies.sb3.export_model"


def export_model(model: BaseAlgorithm, path: Path) -> None:
    """Write a trained model to ``path`` (.safetensors) and its configuration beside it (.json).

    Args:
        model: A2C, PPO, SAC or TD3 with "MultiInputPolicy"; of ``policy_kwargs`` only ``net_arch`` and
            ``activation_fn`` may be set.
        path: of the weights.

    Raises:
        ValueError: a model of another kind.
    """
    config = {
        "algorithm": type(model).__name__,
        "steps": horizon(model.observation_space),
        "net_arch": model.policy.net_arch,
        "activation": getattr(model.policy.activation_fn, "__name__", ""),
    }
    try:
        shapes = {name: value.shape for name, value in _build(config).state_dict().items()}
    except KeyError as error:
        raise ValueError(f"sb3: {error} cannot be exported; known: {[*_ALGORITHMS, *_ACTIVATIONS]}") from error
    if {name: value.shape for name, value in model.policy.state_dict().items()} != shapes:
        raise ValueError("sb3: the model has policy_kwargs other than net_arch and activation_fn, or another policy")
    save_weights(model.policy, path, "sb3", config)


def _build(config: dict[str, Any]) -> BasePolicy:
    architecture = config["net_arch"] or []
    for layers in architecture.values() if isinstance(architecture, dict) else [architecture]:
        if len(layers) > _MOST_LAYERS or not all(1 <= width <= _WIDEST for width in layers):
            raise ValueError(f"net_arch needs at most {_MOST_LAYERS} layers of 1 to {_WIDEST}")
    return _ALGORITHMS[config["algorithm"]].policy_aliases["MultiInputPolicy"](
        *make_spaces(config["steps"]),
        lambda _: 0.0,
        net_arch=config["net_arch"],
        activation_fn=_ACTIVATIONS[config["activation"]],
    )


@register_policy("sb3")
class Sb3Policy(DeterministicPolicy):
    """The exported model, deterministic; goes to the candidate nearest to its goal.

    Args:
        model: unused.
        weights: path of the export.

    Raises:
        ValueError: there are no usable weights.
    """

    def __init__(self, model: ObjectModel, weights: str) -> None:
        self._policy = load_weights(Path(weights), "sb3", _build, _REMEDY, dry_run=False)
        self._steps = horizon(self._policy.observation_space)

    def decide(self, observation: Observation) -> Decision:
        """Attend to the object that the action names, if there is one, and go to the goal's nearest candidate."""
        candidates = observation.candidates()
        if not candidates.any():
            return Decision.stop_here(observation)
        encoded = encode_observations([observation], self._steps)
        action, _ = self._policy.predict({name: value.numpy() for name, value in encoded.items()}, deterministic=True)
        view = decode(action[:, :2].astype(float), observation.sphere, candidates[None])[0]
        attended = int(action[0, 2] + 0.5)
        if attended >= len(observation.objects):
            return Decision.go_to(observation, view)
        return Decision.go_to(observation, view, np.eye(len(observation.objects))[attended], attended)
