"""The paper's policy as Stable-Baselines3 trains it: Algorithm 1 extracts the state, a Gaussian chooses two angles."""

from typing import Any, cast

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import Schedule
from torch import nn

from active6d_agent.environment.gym_environment import horizon
from active6d_agent.policies.attention.encoding import FEATURES
from active6d_agent.policies.attention.network import AttentionNetwork, ObjectAttention


class AttentionExtractor(BaseFeaturesExtractor):
    """The state s_t; remembers what the attention chose last, which is part of the action.

    Args:
        observation_space: of the environment.
        rule: of :class:`~active6d_agent.policies.attention.network.ObjectAttention`.
        mean: (6,) of the objects' features, subtracted; zeros when None.
        deviation: (6,) of the features, which divides them; ones when None.

    Attributes:
        attended: (B,) index of the attended object.
        weight: (B, N) the attention's weights.
    """

    def __init__(
        self,
        observation_space: spaces.Dict,
        rule: str = "learned",
        mean: np.ndarray | None = None,
        deviation: np.ndarray | None = None,
    ) -> None:
        self.steps = horizon(observation_space)
        super().__init__(observation_space, 15 + 3 * self.steps)
        self.attention = ObjectAttention(rule)
        self.register_buffer("mean", torch.zeros(FEATURES) if mean is None else torch.from_numpy(mean).float())
        unit = torch.ones(FEATURES) if deviation is None else torch.from_numpy(deviation).float()
        self.register_buffer("deviation", unit)
        self.attended = torch.zeros(0, dtype=torch.long)
        self.weight = torch.zeros(0, 0)

    mean: torch.Tensor
    deviation: torch.Tensor

    def forward(self, observation: dict[str, torch.Tensor], index: torch.Tensor | None = None) -> torch.Tensor:
        """(B, 15 + 3 T); ``index`` (B,) is attended in place of the object with the largest weight."""
        objects, mask = (observation["objects"] - self.mean) / self.deviation, observation["mask"]
        attended, self.weight, self.attended = self.attention(objects, mask, index)
        # Without objects, the features are zeros before they are standardised.
        nothing = torch.cat([torch.zeros_like(self.mean), -self.mean / self.deviation])
        attended = torch.where(mask.any(dim=1, keepdim=True), attended, nothing)
        return torch.cat([attended, observation["camera"], observation["history"].flatten(1)], dim=1)

    def fold(self, weight: torch.Tensor, bias: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Weights and bias for raw features, of a layer whose inputs are (6,) standardised ones."""
        scaled = weight / self.deviation
        return scaled, bias - scaled @ self.mean


class PaperPolicy(ActorCriticPolicy):
    """128 ReLU units, a Gaussian over the two angles; the third component of an action is the attended index.

    In the paper, the index follows from the state, so it has no probability of its own: the attention learns through
    o_t, whose gradient flows from the policy through the weight (Algorithm 1). With ``credit`` it is drawn from the
    weights. The value is always that of the state in which the largest weight attends: a value that knew the drawn
    index would take the credit from it.
    """

    def __init__(
        self,
        observation_space: spaces.Dict,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        credit: bool = False,
        **keywords: Any,
    ) -> None:
        angles = spaces.Box(action_space.low[:2], action_space.high[:2])
        settings = {
            "features_extractor_class": AttentionExtractor,
            "net_arch": [128],
            "activation_fn": nn.ReLU,
        }
        super().__init__(observation_space, angles, lr_schedule, **{**settings, **keywords})
        self.action_space, self.credit = action_space, credit

    features_extractor: AttentionExtractor

    def forward(self, obs: Any, deterministic: bool = False) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Actions (B, 3), values (B, 1) and log probabilities (B,)."""
        extractor = self.features_extractor
        state = extractor(obs)
        values = self.value_net(self.mlp_extractor.forward_critic(state))
        index = extractor.attended
        choice = self._choice(obs)
        if choice and not deterministic:
            index = choice.sample()
            state = extractor(obs, index)
        distribution = self._get_action_dist_from_latent(self.mlp_extractor.forward_actor(state))
        angles = distribution.get_actions(deterministic=deterministic)
        log_probability = distribution.log_prob(angles)
        if choice:
            log_probability = log_probability + choice.log_prob(index)
        return torch.cat([angles, index[:, None].to(angles.dtype)], dim=1), values, log_probability

    def evaluate_actions(
        self, obs: Any, actions: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor | None]:
        """Values, log probabilities and entropies of (B, 3) actions; the index counts with ``credit`` only."""
        state = self.features_extractor(obs)
        values = self.value_net(self.mlp_extractor.forward_critic(state))
        choice, index = self._choice(obs), actions[:, 2].round().long()
        if choice:
            state = self.features_extractor(obs, index)
        distribution = self._get_action_dist_from_latent(self.mlp_extractor.forward_actor(state))
        log_probability, entropy = distribution.log_prob(actions[:, :2]), distribution.entropy()
        if choice and entropy is not None:
            log_probability, entropy = log_probability + choice.log_prob(index), entropy + choice.entropy()
        return values, log_probability, entropy

    def _predict(self, observation: Any, deterministic: bool = False) -> torch.Tensor:
        return self(observation, deterministic)[0]

    def _choice(self, obs: dict[str, torch.Tensor]) -> torch.distributions.Categorical | None:
        """The distribution that the attended index is drawn from, after the extractor ran; None if it is not drawn."""
        if not self.credit:
            return None
        # Without objects, the last index is certain, as in the attention.
        weight, none = self.features_extractor.weight, ~(obs["mask"] > 0).any(dim=1)
        last = nn.functional.one_hot(torch.tensor(weight.shape[1] - 1), weight.shape[1]).to(weight)
        return torch.distributions.Categorical(torch.where(none[:, None], last, weight))

    def network(self) -> AttentionNetwork:
        """The deployable part, a copy; it takes raw features."""
        extractor = self.features_extractor
        network = AttentionNetwork(extractor.steps, rule=extractor.attention.rule)
        network.attention.load_state_dict(extractor.attention.state_dict())
        network.policy.load_state_dict(self.mlp_extractor.policy_net.state_dict())
        with torch.no_grad():
            fc, first = cast(nn.Linear, network.attention.fc[0]), cast(nn.Linear, network.policy[0])
            fc.weight[:], fc.bias[:] = extractor.fold(fc.weight, fc.bias)
            raw = slice(FEATURES, 2 * FEATURES)
            first.weight[:, raw], first.bias[:] = extractor.fold(first.weight[:, raw], first.bias)
        network.mean.load_state_dict(self.action_net.state_dict())
        network.log_std.data.copy_(self.log_std.data)
        return network.eval()
