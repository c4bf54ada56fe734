"""The interface of policies: their observation, their decision, and their registry by name.

A policy uses only what a robot knows: the fused objects, the unexplained surface, the camera's positions, the views in
reach, and the budget left (paper, "Problem definition"). Node, training and evaluation use policies through this
module.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

from active6d_core.hypotheses import SceneObjects
from active6d_core.object_model import ObjectModel, find_beside
from active6d_core.registry import Registry
from active6d_core.view_sphere import ViewSphere

#: Weights of the trained policies that this package contains.
SHIPPED_WEIGHTS = Path(__file__).parent / "weights"
#: Learned policies look at this many objects at most.
MAX_OBJECTS = 64
#: A view of the grid counts as visited when the camera was this close to it, metres of arc, and to no other one closer.
#: A robot's camera may stop some two centimetres from its goal.
VISITED_WITHIN = 0.03


@dataclass(frozen=True, eq=False)
class Observation:
    """What is known after t moves.

    Attributes:
        objects: the n accumulated objects, their boxes and depths in the current camera.
        positions: (t + 1, 3) camera positions in the world so far, the current one last, metres.
        sphere: the grid of views.
        allowed: (M,) bool, views of the grid that the camera can reach.
        steps_left: moves left, at least 1.
        metres_left: arc left on the sphere, ``inf`` without a travel budget.
        unexplained: (k, 3) points of unexplained surface, which depth images have shown and no accumulated object
            explains; metres in the world.
    """

    objects: SceneObjects
    positions: np.ndarray
    sphere: ViewSphere
    allowed: np.ndarray
    steps_left: int
    metres_left: float = np.inf
    unexplained: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def steps(self) -> int:
        """The budget T of the episode in moves."""
        return len(self.positions) - 1 + self.steps_left

    def visited(self) -> np.ndarray:
        """(M,) bool, views of the grid that the camera has taken."""
        grid, taken = self.sphere.positions / self.sphere.radius, self.positions
        taken = taken / np.linalg.norm(taken, axis=1, keepdims=True)
        cosine, visited = grid @ taken.T, np.zeros(len(grid), bool)
        near = cosine.max(axis=0) > np.cos(VISITED_WITHIN / self.sphere.radius)
        visited[cosine.argmax(axis=0)[near]] = True
        return visited

    def candidates(self) -> np.ndarray:
        """(M,) bool, views that may be next: reachable, not visited, within the metres left."""
        candidates = self.allowed & ~self.visited()
        if self.metres_left < np.inf:
            candidates &= self.sphere.arc(self.sphere.positions, self.positions[-1]) <= self.metres_left
        return candidates


@dataclass(frozen=True, eq=False)
class Decision:
    """The next view, and the object that it is for.

    Attributes:
        position: (3,) goal on the sphere in the world, metres; the current position when stopping.
        view: index of the goal in the grid, None when it lies off the grid or the episode stops.
        attention: (n,) weight of each object. They sum to at most one; what is missing is the weight of objects that
            have no hypothesis yet.
        attended: index of the object that the move is for, None when it is for no single object of these.
        stop: end the episode here instead of moving.
    """

    position: np.ndarray
    view: int | None
    attention: np.ndarray
    attended: int | None = None
    stop: bool = False

    @classmethod
    def go_to(
        cls, observation: Observation, view: int, attention: np.ndarray | None = None, attended: int | None = None
    ) -> "Decision":
        """Move to a view of the grid; without ``attention`` all objects weigh the same."""
        if attention is None:
            attention = uniform_attention(len(observation.objects))
        return cls(observation.sphere.positions[view], int(view), attention, attended)

    @classmethod
    def stop_here(cls, observation: Observation) -> "Decision":
        """End the episode at the current view."""
        return cls(observation.positions[-1], None, uniform_attention(len(observation.objects)), stop=True)


class Policy(Protocol):
    """Chooses the next view."""

    def reset(self, rng: np.random.Generator) -> None:
        """Begin an episode; ``rng`` is the only source of randomness until the next one."""

    def decide(self, observation: Observation) -> Decision:
        """The next move; a policy stops when the observation leaves it no candidate."""


class DeterministicPolicy:
    """Base of policies without randomness; those without parameters use its ``__init__``, too.

    Args:
        model: unused.
    """

    def __init__(self, model: ObjectModel) -> None:
        pass

    def reset(self, rng: np.random.Generator) -> None:
        """Nothing is random here."""


def weights_path(policy: str, object_name: str) -> Path:
    """Path of a policy's weights for an object: beside the object's description, or among the shipped ones."""
    return find_beside(f"{policy}_{object_name}.safetensors", SHIPPED_WEIGHTS)


def choose_policy(object_name: str) -> str:
    """What ``auto`` stands for: the learned policy where there are weights, else the best baseline."""
    return "view-attention" if weights_path("view-attention", object_name).is_file() else "unidirectional"


_BASELINES = "random", "unidirectional", "max-distance", "lowest-score", "single-view", "entropy"
_registry: Registry[Policy] = Registry(
    "policy",
    choose_policy,
    {
        **dict.fromkeys(_BASELINES, "active6d_agent.policies.baselines"),
        **dict.fromkeys(("attention", "attention-paper"), "active6d_agent.policies.attention.network"),
        "information-gain": "active6d_agent.policies.view_attention.information_gain",
        "view-attention": "active6d_agent.policies.view_attention.network",
        "sb3": "active6d_agent.policies.sb3",
    },
    "active6d.policies",
)
#: Decorates a factory ``(model, **parameters) -> Policy``.
register_policy = _registry.register
#: All names, without ``auto``; and the same with where each comes from.
list_policies, policy_origins = _registry.names, _registry.origins
#: Makes one by name; see :meth:`active6d_core.registry.Registry.create`.
create_policy = _registry.create


def uniform_attention(count: int) -> np.ndarray:
    """(n,) equal weights that sum to one."""
    return np.full(count, 1.0 / max(count, 1))
