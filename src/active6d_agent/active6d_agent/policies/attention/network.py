"""The paper's policy: object attention (Algorithm 1) and a Gaussian over azimuth and elevation.

Registered as ``attention``. :mod:`active6d_agent.policies.attention.ppo` trains it and writes a ``.safetensors`` file
with a JSON file of the configuration beside it; loading them executes no code.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from active6d_agent.policies.attention.encoding import FEATURES, decode, encode
from active6d_agent.policies.policy_weights import load_weights, save_weights
from active6d_agent.policies.registry import Decision, DeterministicPolicy, Observation, register_policy, weights_path
from active6d_core.object_model import ObjectModel

#: Numbers of a state without the history: o_t (12) and the camera's position (3).
_STATE = 15
#: How the attended object is chosen.
ATTENTION_RULES = ("learned", "lowest-score")


class ObjectAttention(nn.Module):
    """Algorithm 1: attends to one object.

    g^i = FC(b^i, d^i, c^i); w^i = Selector(g^i, mean g); the object with the highest softmax weight m is attended, and
    o_t = (g^m times its weight, b^m, d^m, c^m). The choice is hard; gradients reach FC and Selector through g^m and
    through the weight.

    Args:
        rule: "learned"; or "lowest-score" for the ablation, where the object with the lowest verification score is
            attended and has all the weight.

    Raises:
        ValueError: no such rule.
    """

    def __init__(self, rule: str = "learned") -> None:
        super().__init__()
        if rule not in ATTENTION_RULES:
            raise ValueError(f"attention: no rule '{rule}', there are {', '.join(ATTENTION_RULES)}")
        self.rule = rule
        self.fc = nn.Sequential(nn.Linear(FEATURES, FEATURES), nn.ReLU())
        self.selector = nn.Linear(2 * FEATURES, 1)

    def forward(
        self, objects: torch.Tensor, mask: torch.Tensor, index: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Attend to one object of each scene.

        Args:
            objects: (B, N, 6) features, padded.
            mask: (B, N) 1 for an object, 0 for padding.
            index: (B,) the object that is attended instead of the one with the largest weight.

        Returns:
            (B, 12) o_t, zeros without objects; (B, N) weights, zero for padding; (B,) index m, N - 1 without objects.
        """
        present = mask > 0
        g = self.fc(objects)
        count = present.sum(dim=1, keepdim=True).clamp(min=1)
        pooled = (g * present[..., None]).sum(dim=1) / count
        together = torch.cat([g, pooled[:, None].expand_as(g)], dim=-1)
        score = self.selector(together)[..., 0].masked_fill(~present, -1e9)
        weight = torch.softmax(score, dim=1) * present
        if self.rule == "lowest-score":
            lowest = objects[..., -1].masked_fill(~present, torch.inf).argmin(dim=1)
            weight = nn.functional.one_hot(lowest, objects.shape[1]).to(objects.dtype) * present
        index = weight.argmax(dim=1) if index is None else index
        rows = torch.arange(len(objects), device=objects.device)
        some = present.any(dim=1)
        attended = torch.cat([g[rows, index] * weight[rows, index, None], objects[rows, index]], dim=1)
        last = torch.full_like(index, objects.shape[1] - 1)
        return attended * some[:, None], weight, torch.where(some, index, last)


class AttentionNetwork(nn.Module):
    """State (o_t, camera, history) to the mean of the Gaussian: one hidden layer of 128 units (supplement, E).

    Args:
        steps: horizon T that the history has room for.
        hidden: units of the hidden layer.
        rule: of :class:`ObjectAttention`.
    """

    def __init__(self, steps: int = 5, hidden: int = 128, rule: str = "learned") -> None:
        super().__init__()
        self.steps, self.hidden = steps, hidden
        self.attention = ObjectAttention(rule)
        self.policy = nn.Sequential(nn.Linear(_STATE + 3 * steps, hidden), nn.ReLU())
        self.mean = nn.Linear(hidden, 2)
        self.log_std = nn.Parameter(torch.full((2,), -0.5))

    def state(self, observation: dict[str, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """(B, 15 + 3 T) state s_t, (B, N) attention weights and (B,) attended index."""
        attended, weight, index = self.attention(observation["objects"], observation["mask"])
        state = torch.cat([attended, observation["camera"], observation["history"].flatten(1)], dim=1)
        return state, weight, index

    def forward(self, observation: dict[str, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """(B, 2) mean azimuth and elevation in [-1, 1] units, attention weights, attended index."""
        state, weight, index = self.state(observation)
        return self.mean(self.policy(state)), weight, index


def save_network(network: AttentionNetwork, path: Path, provenance: dict[str, Any] | None = None) -> None:
    """Write ``path`` (.safetensors) and its configuration beside it (.json)."""
    config = {"steps": network.steps, "hidden": network.hidden, "rule": network.attention.rule}
    save_weights(network, path, "attention", config, provenance)


def load_network(path: Path) -> AttentionNetwork:
    """Read what :func:`save_network` wrote.

    Raises:
        ValueError: a file is missing, damaged or does not fit; the message names it.
    """
    return load_weights(
        path, "attention", lambda config: AttentionNetwork(config["steps"], config["hidden"], config["rule"])
    )


@register_policy("attention")
class AttentionPolicy(DeterministicPolicy):
    """The trained network; always takes the mean of its Gaussian.

    Args:
        model: names the shipped weights.
        weights: path of other weights, ``""`` for the shipped ones.

    Raises:
        ValueError: there are no usable weights.
    """

    name = "attention"

    def __init__(self, model: ObjectModel, weights: str = "") -> None:
        self.network = load_network(Path(weights) if weights else weights_path(self.name, model.name))

    def decide(self, observation: Observation) -> Decision:
        """Attend to one object and go to the candidate nearest to the mean."""
        candidates = observation.candidates()
        if not candidates.any():
            return Decision.stop_here(observation)
        with torch.inference_mode():
            mean, weight, index = self.network(encode_observations([observation], self.network.steps))
        count = len(observation.objects)
        weight = weight[0, :count].double().numpy()
        # Objects beyond those that the network looks at have none.
        attention = np.zeros(count)
        attention[: len(weight)] = weight
        view = decode(mean.double().clamp(-1.0, 1.0).numpy(), observation.sphere, candidates[None])[0]
        attended = int(index[0]) if count else None
        return Decision.go_to(observation, view, attention / max(attention.sum(), 1e-12), attended)


@register_policy("attention-paper")
class PaperAttentionPolicy(AttentionPolicy):
    """The same with weights that were trained as the paper says, to the letter: see :data:`.ppo.AS_IN_THE_PAPER`."""

    name = "attention-paper"


def encode_observations(observations: Sequence[Observation], steps: int) -> dict[str, torch.Tensor]:
    """Network inputs of B observations.

    Args:
        observations: of a policy.
        steps: horizon T of the network.
    """
    encoded = []
    for observation in observations:
        features = observation.objects.features()[None]
        positions = observation.positions[None] / observation.sphere.radius
        moves = np.array([len(observation.positions) - 1])
        encoded.append(encode(features, np.ones(features.shape[:2], bool), positions, moves, steps))
    return {name: torch.from_numpy(np.concatenate([each[name] for each in encoded])) for name in encoded[0]}
