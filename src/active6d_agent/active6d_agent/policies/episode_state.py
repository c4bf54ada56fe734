"""The state of one episode of a policy: views taken, budget left, and the views that the camera did not go to."""

from dataclasses import dataclass, replace

import numpy as np

from active6d_agent.policies.registry import Decision, Observation, Policy
from active6d_core.episode_views import views_from
from active6d_core.hypotheses import SceneObjects
from active6d_core.view_sphere import ViewSphere

#: Goals in a row that the camera does not reach in time before the episode counts it as out of order.
MOST_MISSED = 5


@dataclass(frozen=True)
class Limits:
    """What an episode may use.

    Attributes:
        sphere: the grid of views.
        allowed: (M,) bool, views of the grid that the camera can reach.
        steps: budget of moves T.
        metres: travel budget along the hemisphere in metres, 0 for none.
        seconds: budget of time from the first view on, 0 for none.
        goal_timeout: seconds that the camera has to reach a goal, 0 for no limit.
    """

    sphere: ViewSphere
    allowed: np.ndarray
    steps: int
    metres: float = 0.0
    seconds: float = 0.0
    goal_timeout: float = 0.0


class EpisodeState:
    """Asks a policy for goals, and strikes a view from those in reach when the camera refuses it or does not arrive.

    A struck view stays struck until the episode ends.

    Args:
        start: stamp of the episode's first view in nanoseconds.
        limits: what the episode may use.
    """

    def __init__(self, start: int, limits: Limits) -> None:
        self.start = start
        self.ended = False
        self._limits = limits
        self._positions: dict[int, np.ndarray] = {}
        self._struck = np.zeros(len(limits.sphere), bool)
        self._refused: list[str] = []
        self._timeouts = self._missed_in_a_row = 0
        self._goal: np.ndarray | None = None
        self._waited = 0.0

    @property
    def positions(self) -> np.ndarray:
        """(t + 1, 3) camera positions in the world so far, metres."""
        return np.stack(list(self._positions.values()))

    @property
    def moves(self) -> int:
        """Moves made so far."""
        return len(self._positions) - 1

    @property
    def travelled(self) -> float:
        """Metres of arc travelled so far."""
        return self._limits.sphere.path_length(self.positions)

    @property
    def elapsed(self) -> float:
        """Seconds from the first view to the last, by their stamps."""
        stamps = list(self._positions)
        return (stamps[-1] - stamps[0]) * 1e-9

    @property
    def waiting(self) -> bool:
        """Whether the camera has still to reach a goal."""
        return self._goal is not None

    def add_view(self, stamp: int, position: np.ndarray) -> None:
        """The camera has taken the view of this stamp (ns) at (3,) ``position`` in the world."""
        self._positions[stamp] = position
        self.reached()

    def views_from(self, stamp: int) -> dict[int, np.ndarray]:
        """Stamp (ns) to position of the view of ``stamp`` and of those taken after it; empty without that view."""
        return views_from(self._positions, stamp)

    def decide(self, policy: Policy, objects: SceneObjects, unexplained: np.ndarray) -> tuple[Decision | None, str]:
        """The policy's decision on the last view, and why the episode ends: empty text when the decision is a goal.

        There is no decision when the episode ends before the policy is asked.
        """
        limits, self._goal = self._limits, None
        if self.moves >= limits.steps:
            return None, f"budget of {limits.steps} moves spent"
        if self._missed_in_a_row >= MOST_MISSED:
            missed = f"the last {MOST_MISSED} goals within {limits.goal_timeout:g} s each"
            return None, f"the camera reached none of {missed}; check that it is running"
        if 0 < limits.seconds <= self.elapsed:
            return None, f"budget of {limits.seconds:g} s spent"
        allowed, steps_left = limits.allowed & ~self._struck, limits.steps - self.moves
        observation = Observation(
            objects, self.positions, limits.sphere, allowed, steps_left, self._metres_left(), unexplained=unexplained
        )
        decision = self._avoid_struck(observation, policy.decide(observation))
        if decision.stop:
            if observation.candidates().any():
                return decision, "the policy stopped: no view is worth the move"
            return decision, f"{self._describe_end(observation)}{self._describe_struck()}"
        self._goal, self._waited = decision.position, 0.0
        return decision, ""

    def _metres_left(self) -> float:
        """Arc left in metres: of the travel budget, and of what the seconds left allow at the pace so far."""
        limits, left = self._limits, np.inf
        if limits.metres > 0:
            left = limits.metres - self.travelled
        if limits.seconds > 0 and self.travelled > 0:
            left = min(left, (limits.seconds - self.elapsed) * self.travelled / self.elapsed)
        return left

    def refused(self, reason: str) -> bool:
        """The camera refuses the goal. True if another one must be chosen; false if it has reached this one before."""
        if not self.waiting:
            return False
        self._missed_in_a_row = 0
        self._refused.append(reason)
        self._strike()
        return True

    def reached(self) -> None:
        """The camera is at the goal; its view may still be under way."""
        self._goal = None
        self._missed_in_a_row = 0

    def wait(self, seconds: float) -> bool:
        """Count seconds towards the limit of the goal. True if it has passed and another goal must be chosen."""
        self._waited += seconds
        if not self.waiting or not 0 < self._limits.goal_timeout <= self._waited + 1e-9:
            return False
        self._timeouts += 1
        self._missed_in_a_row += 1
        self._strike()
        return True

    def _strike(self) -> None:
        assert self._goal is not None, "only a goal on its way can be missed"
        self._struck[self._limits.sphere.nearest(self._goal)] = True
        self._goal = None

    def _avoid_struck(self, observation: Observation, decision: Decision) -> Decision:
        """The decision, or the view nearest to it if the grid's view there is struck: for goals beside the grid."""
        sphere, position = observation.sphere, decision.position
        if decision.stop or not self._struck[sphere.nearest(position)]:
            return decision
        candidates = observation.candidates()
        if not candidates.any():
            return Decision.stop_here(observation)
        view = int(np.where(candidates, sphere.arc(sphere.positions, position), np.inf).argmin())
        return Decision.go_to(observation, view, decision.attention, decision.attended)

    def _describe_end(self, observation: Observation) -> str:
        """Why no view can be next: the budget's rest is too short, or there is none."""
        limits, left = self._limits, observation.metres_left
        if not replace(observation, metres_left=np.inf).candidates().any():
            return "no reachable view is left"
        if limits.metres > 0 and left == limits.metres - self.travelled:
            return f"no view within the {max(left, 0.0):.2f} m left of the budget of {limits.metres:.2f} m"
        seconds = limits.seconds - self.elapsed
        return f"no view within the {seconds:.1f} s left of the budget of {limits.seconds:g} s"

    def _describe_struck(self) -> str:
        parts = []
        if self._refused:
            parts.append(f"{len(self._refused)} refused by the camera, the last because: {self._refused[-1]}")
        if self._timeouts:
            parts.append(f"{self._timeouts} not reached within {self._limits.goal_timeout:g} s")
        return f" ({'; '.join(parts)})" if parts else ""
