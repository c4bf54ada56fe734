"""Episodes on a scene bank, many side by side: observations of a policy, its moves, and their scores.

Evaluation and training share these functions; the Gymnasium environment shares the scoring.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from active6d_agent.bank.scene_lookup import FusedBatch, SceneLookup
from active6d_agent.policies.registry import Observation
from active6d_core.metrics import score_confirmed

MEASURES = ("detection_rate", "e_add_mm", "distance_m")
#: Measures of the objects that are confirmed by their probability.
CONFIRMED = ("confirmed_rate", "confirmed", "wrong")
#: From (b,) indices of the running episodes and their observations to (b,) next views, -1 to stop.
Choose = Callable[[np.ndarray, list[Observation]], np.ndarray]


@dataclass(frozen=True, eq=False)
class EpisodeResults:
    """Final results of E episodes of one policy.

    Attributes:
        scene: (E,) indices.
        detection_rate: (E,) fraction of the objects.
        e_add_mm: (E,) mean over the objects, 50 mm for the missed.
        distance_m: (E,) along the hemisphere.
        views: (E, T + 1) views taken, -1 after an early stop.
        confirmed_rate: (E,) fraction of the objects that a confirmed object finds; None if there is no probability.
        confirmed: (E,) number of confirmed objects; None likewise.
        wrong: (E,) number of confirmed objects that find none; None likewise.
    """

    scene: np.ndarray
    detection_rate: np.ndarray
    e_add_mm: np.ndarray
    distance_m: np.ndarray
    views: np.ndarray
    confirmed_rate: np.ndarray | None = None
    confirmed: np.ndarray | None = None
    wrong: np.ndarray | None = None

    @property
    def measures(self) -> dict[str, np.ndarray]:
        """The paper's three measures and those of confirmed objects that are known, by name, (E,) each."""
        values = {name: getattr(self, name) for name in (*MEASURES, *CONFIRMED)}
        return {name: value for name, value in values.items() if value is not None}

    @classmethod
    def join(cls, parts: "Sequence[EpisodeResults]") -> "EpisodeResults":
        """The episodes of all parts, one after the other."""
        columns = zip(*(vars(part).values() for part in parts), strict=True)
        joined: list[Any] = [None if column[0] is None else np.concatenate(column) for column in columns]
        return cls(*joined)

    @property
    def means(self) -> tuple[float, float, float]:
        """Mean detection rate, mean ADD (mm) and mean distance (m)."""
        return float(self.detection_rate.mean()), float(self.e_add_mm.mean()), float(self.distance_m.mean())


def roll_out(
    lookup: SceneLookup,
    choose: Choose,
    scene: np.ndarray,
    start: np.ndarray,
    moves: np.ndarray,
    *,
    allowed: np.ndarray | None = None,
    metres: float = np.inf,
) -> np.ndarray:
    """Run E episodes to their ends.

    Args:
        lookup: of the bank.
        choose: makes all moves of one step.
        scene: (E,) indices.
        start: (E,) first views.
        moves: (E,) budget of each episode.
        allowed: (M,) bool, views in reach, all when None.
        metres: travel budget of each episode.

    Returns:
        (E, most moves + 1) views taken in order, -1 where an episode had ended.
    """
    views = np.full((len(scene), moves.max(initial=0) + 1), -1)
    views[:, 0] = start
    running, step = np.flatnonzero(moves > 0), 0
    while len(running):
        left = moves[running] - step
        observations = observe(lookup, scene[running], views[running], left, allowed=allowed, metres=metres)
        step += 1
        views[running, step] = choose(running, observations)
        running = running[(views[running, step] >= 0) & (moves[running] > step)]
    return views


def observe(
    lookup: SceneLookup,
    scene: np.ndarray,
    views: np.ndarray,
    left: np.ndarray,
    *,
    allowed: np.ndarray | None = None,
    metres: float = np.inf,
) -> list[Observation]:
    """Observations of a policy after (E, v) views, -1 padding at the end, with (E,) moves left.

    Args:
        lookup: of the bank.
        scene: (E,) indices.
        views: taken so far, at least one.
        left: of the budget.
        allowed: (M,) bool, views in reach, all when None.
        metres: travel budget of each episode from its beginning.
    """
    allowed = np.ones(len(lookup.sphere), bool) if allowed is None else allowed
    count = (views >= 0).sum(axis=1)
    current = views[np.arange(len(views)), count - 1]
    fused = lookup.fuse(scene, views, current)
    described = zip(lookup.describe(fused, scene, current), lookup.unexplained(fused, scene, views), strict=True)
    observations = []
    for (objects, unexplained), taken, number, moves in zip(described, views, count, left, strict=True):
        positions = lookup.sphere.positions[taken[:number]]
        metres_left = metres - lookup.sphere.path_length(positions)
        observation = Observation(
            objects, positions, lookup.sphere, allowed, int(moves), metres_left, unexplained=unexplained
        )
        observations.append(observation)
    return observations


def measure(lookup: SceneLookup, scene: np.ndarray, views: np.ndarray) -> EpisodeResults:
    """Score (E, v) views, -1 padding, taken in order."""
    last = np.take_along_axis(views, (views >= 0).sum(axis=1, keepdims=True) - 1, axis=1)[:, 0]
    return score_fused(lookup, lookup.fuse(scene, views, last), scene, views)


def score_fused(lookup: SceneLookup, fused: FusedBatch, scene: np.ndarray, views: np.ndarray) -> EpisodeResults:
    """Score what fusion made of (E, v) views, -1 padding, taken in order."""
    scores = lookup.evaluate(fused, scene)
    positions = lookup.sphere.positions[views]
    arcs = np.where(views[:, 1:] >= 0, lookup.sphere.arc(positions[:, :-1], positions[:, 1:]), 0.0)
    rate, confirmed, wrong = _score_confirmed(lookup, fused, scene)
    return EpisodeResults(
        confirmed_rate=rate,
        confirmed=confirmed,
        wrong=wrong,
        scene=scene,
        detection_rate=np.array([score.detection_rate for score in scores]),
        e_add_mm=np.array([score.mean_e_add_mm for score in scores]),
        distance_m=arcs.sum(axis=1),
        views=views,
    )


def _score_confirmed(
    lookup: SceneLookup, fused: FusedBatch, scene: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(E,) fraction of the objects that confirmed ones find, number of these, and how many of them find none."""
    sure = (fused.objects >= 0) & (fused.probability >= lookup.parameters.confirmed)
    rows = []
    for objects, own, count in zip(fused.objects, sure, lookup.object_count[scene], strict=True):
        errors = lookup.errors[objects[own], :count]
        rows.append(score_confirmed(errors, np.ones(len(errors), bool), lookup.model.diameter))
    rate, confirmed, wrong = np.array(rows, float).reshape(-1, 3).T
    return rate, confirmed, wrong
