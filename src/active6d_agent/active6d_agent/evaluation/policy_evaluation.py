"""The paper's Table 1 on a bank: every policy and the bounds from the same starts, with paired intervals."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from scipy.stats import norm, t

from active6d_agent.bank.scene_lookup import SceneLookup
from active6d_agent.environment.rollout import EpisodeResults, measure, roll_out
from active6d_agent.evaluation.oracle import search_views
from active6d_agent.policies.registry import Observation, Policy, create_policy

BOUNDS = ("oracle", "all-views")
_RESAMPLES = 2000
# Episodes between two reports of progress.
_TOGETHER = 100

#: Name of a measure of an episode to (E,) values, one per episode.
Measures = dict[str, np.ndarray]


def all_starts(lookup: SceneLookup, sample: int | None = None, seed: int = 0) -> np.ndarray:
    """(E, 2) scenes and first views: every pair, or ``sample`` of them drawn without replacement."""
    scenes, views = len(lookup.bank.scenes), len(lookup.sphere)
    pairs = np.stack(np.unravel_index(np.arange(scenes * views), (scenes, views)), axis=1)
    if sample is None or sample >= len(pairs):
        return pairs
    return pairs[np.sort(np.random.default_rng(seed).choice(len(pairs), sample, replace=False))]


def run_policy(
    lookup: SceneLookup,
    make_policy: Callable[[int], Policy],
    starts: np.ndarray,
    steps: int,
    *,
    seed: int = 0,
    allowed: np.ndarray | None = None,
    metres: float = np.inf,
) -> EpisodeResults:
    """Run a policy from every start, all episodes side by side.

    Args:
        lookup: of the bank.
        make_policy: index of a scene to the policy for it.
        starts: (E, 2) scenes and first views.
        steps: moves T.
        seed: each episode's randomness follows from it and its start.
        allowed: (M,) bool, views in reach, all when None.
        metres: travel budget of each episode.
    """
    scene = starts[:, 0]
    policies = [make_policy(index) for index in scene]
    for policy, start in zip(policies, starts.tolist(), strict=True):
        policy.reset(np.random.default_rng([seed, *start]))

    def choose(running: np.ndarray, observations: list[Observation]) -> np.ndarray:
        decisions = [policies[index].decide(each) for index, each in zip(running, observations, strict=True)]
        return np.array([-1 if decision.stop else decision.view for decision in decisions])

    moves = np.full(len(starts), steps)
    views = roll_out(lookup, choose, scene, starts[:, 1], moves, allowed=allowed, metres=metres)
    return measure(lookup, scene, views)


def run_named(
    lookup: SceneLookup,
    name: str,
    starts: np.ndarray,
    steps: int,
    *,
    seed: int = 0,
    parameters: dict[str, Any] | None = None,
) -> EpisodeResults:
    """Run a policy or a bound by name.

    Args:
        lookup: of the bank.
        name: of a policy, or one of ``BOUNDS``: the greedy ``oracle`` knows the truth, ``all-views`` takes all.
        starts: (E, 2) scenes and first views.
        steps: moves T.
        seed: of the policy's randomness.
        parameters: of the policy.

    Raises:
        ValueError: no such policy.
    """
    scene = starts[:, 0]
    if name == "oracle":
        found = [search_views(lookup, int(index), int(view), steps) for index, view in starts]
        return measure(lookup, scene, np.stack(found))
    if name == "all-views":
        return _all_views(lookup, starts)

    def make(index: int) -> Policy:
        own = {"entropy": lookup.bank.scenes[index].entropy} if name == "entropy" else {}
        return create_policy(name, lookup.model, **{**own, **(parameters or {})})

    return run_policy(lookup, make, starts, steps, seed=seed)


def _all_views(lookup: SceneLookup, starts: np.ndarray) -> EpisodeResults:
    """Every view of the grid in its order from the first on; fused once for each scene, as order does not matter."""
    grid = np.arange(len(lookup.sphere))
    scenes, inverse = np.unique(starts[:, 0], return_inverse=True)
    once = measure(lookup, scenes, np.tile(grid, (len(scenes), 1)))
    views = (grid + starts[:, 1:]) % len(grid)
    steps = lookup.sphere.positions[views]
    metres = lookup.sphere.arc(steps[:, :-1], steps[:, 1:]).sum(axis=1)
    shared = {name: values[inverse] for name, values in once.measures.items()}
    return EpisodeResults(**{**shared, "scene": starts[:, 0], "distance_m": metres, "views": views})


class Intervals:
    """95 % bootstrap intervals of means over E episodes, by resampling in two ways.

    ``ci95`` draws episodes: the range over other starts in the same scenes. ``ci95_scenes`` draws whole scenes with all
    their starts (a cluster bootstrap): the range over other scenes. The starts of a scene share one heap, so they are
    not independent. A claim about unseen scenes needs the second, wider interval. A bootstrap of few scenes is too
    narrow: it is widened as Student's distribution and the factor for the sample's variance say (Hesterberg, "What
    teachers should know about the bootstrap", 2015), by 22 % with ten scenes, and stays within the values. One scene
    says nothing of others: ``ci95_scenes`` is None.

    To compare two policies from the same starts, give the differences, which pairs the episodes.

    Args:
        scene: (E,) indices of the episodes' scenes.
        seed: of the resampling.
        resamples: drawn of each kind.
    """

    def __init__(self, scene: np.ndarray, seed: int = 0, resamples: int = _RESAMPLES) -> None:
        clusters = {"ci95": np.arange(len(scene)), "ci95_scenes": np.unique(scene, return_inverse=True)[1]}
        self._weights: dict[str, np.ndarray] = {}
        self._factor = dict.fromkeys(clusters, 1.0)
        for kind, cluster in clusters.items():
            count = cluster.max() + 1
            if kind == "ci95_scenes" and count == 1:
                continue
            rng = np.random.default_rng(seed)
            weight = rng.multinomial(count, np.full(count, 1.0 / count), size=resamples)[:, cluster]
            self._weights[kind] = weight / weight.sum(axis=1, keepdims=True)
            if kind == "ci95_scenes":
                narrow = norm.ppf(0.975) * np.sqrt((count - 1) / count)
                self._factor[kind] = float(t.ppf(0.975, count - 1) / narrow)

    def of(self, values: np.ndarray) -> dict[str, list[float] | None]:
        """Both intervals of the mean of (E,) values, by name; ``ci95_scenes`` is None with one scene."""
        table: dict[str, list[float] | None] = dict.fromkeys(self._factor)
        for kind, weight in self._weights.items():
            table[kind] = self._interval(kind, weight @ values, values.mean(), values)
        return table

    def _interval(self, kind: str, resampled: np.ndarray, centre: float, values: np.ndarray) -> list[float]:
        ends = np.quantile(resampled, [0.025, 0.975])
        return np.clip(centre + self._factor[kind] * (ends - centre), values.min(), values.max()).tolist()

    def of_ratio(self, part: np.ndarray, whole: np.ndarray) -> dict[str, list[float] | None]:
        """Both intervals of the mean of (E,) ``part`` over that of (E,) ``whole``; ``ci95_scenes`` as in :meth:`of`.

        Some of ``whole`` must be positive; resamples without any are left out.
        """
        table: dict[str, list[float] | None] = dict.fromkeys(self._factor)
        for kind, weight in self._weights.items():
            wholes = weight @ whole
            some = wholes > 0
            ratios = part[whole > 0] / whole[whole > 0]
            table[kind] = self._interval(kind, (weight @ part)[some] / wholes[some], part.mean() / whole.mean(), ratios)
        return table


def evaluate(
    lookup: SceneLookup,
    names: Sequence[str],
    steps: int,
    starts: np.ndarray,
    *,
    seed: int = 0,
    parameters: dict[str, dict[str, Any]] | None = None,
    on_progress: Callable[[str, int], None] = lambda name, episodes: None,
) -> Iterator[tuple[str, EpisodeResults]]:
    """Run every policy from the same starts; yields each as it is done.

    Args:
        lookup: of the bank.
        names: of policies and of bounds.
        steps: moves T.
        starts: (E, 2) scenes and first views.
        seed: of the policies' randomness.
        parameters: name to parameters.
        on_progress: called with the name and how many more of its episodes are done.
    """
    for name in names:
        parts = []
        for some in np.array_split(starts, -(-len(starts) // _TOGETHER)):
            parts.append(run_named(lookup, name, some, steps, seed=seed, parameters=(parameters or {}).get(name)))
            on_progress(name, len(some))
        yield name, EpisodeResults.join(parts)


def describe(measures: Measures, intervals: Intervals, first: Measures | None = None) -> dict[str, Any]:
    """The mean of each measure (E,) as ``name``, with ``name_ci95`` and ``name_ci95_scenes`` (:class:`Intervals`).

    ``wrong`` is a share of the confirmed objects of all episodes, None without any. A mean over episodes of their
    shares would count an object in a scene with few of them many times. With ``first``, also ``against_first``: the
    paired differences to those measures (:func:`compare`).
    """
    row: dict[str, Any] = {}
    for name, values in measures.items():
        if name == "wrong":
            row |= describe_ratio(name, values, measures["confirmed"], intervals)
            continue
        row[name] = float(values.mean())
        row |= {f"{name}_{kind}": interval for kind, interval in intervals.of(values).items()}
    return row if first is None else {**row, "against_first": compare(measures, first, intervals)}


def describe_ratio(name: str, part: np.ndarray, whole: np.ndarray, intervals: Intervals) -> dict[str, Any]:
    """The mean of (E,) ``part`` over that of (E,) ``whole``, and its intervals (:func:`describe`); None without any."""
    if not whole.any():
        return {name: None}
    both = {f"{name}_{kind}": interval for kind, interval in intervals.of_ratio(part, whole).items()}
    return {name: float(part.mean() / whole.mean()), **both}


def compare(own: Measures, other: Measures, intervals: Intervals) -> dict[str, dict[str, Any]]:
    """Paired differences of each measure (E,), positive where ``own`` is higher.

    They are ``mean``, both intervals, and whether these exclude zero (``excludes_zero``, ``excludes_zero_scenes``).
    An interval that does not exist, over scenes where there is one, excludes nothing.
    """
    table = {}
    for name, values in own.items():
        difference = values - other[name]
        both = intervals.of(difference)
        sure = {
            f"excludes_zero{kind.removeprefix('ci95')}": ends is not None and (ends[0] > 0 or ends[1] < 0)
            for kind, ends in both.items()
        }
        table[name] = {"mean": float(difference.mean()), **both, **sure}
    return table


def summarise(results: dict[str, EpisodeResults], object_name: str, steps: int, seed: int = 0) -> dict[str, Any]:
    """The table: means with 95 % intervals, paired differences to every other policy, and the share of the gap closed.

    Args:
        results: of every policy, all from the same starts.
        object_name: of the object.
        steps: moves T.
        seed: of the resampling.

    Returns:
        ``{"object", "steps", "episodes", "scenes", "policies": {name: {...}}}``; a policy's row is that of
        :func:`describe`, with ``gap_closed``, None unless ``random`` and ``oracle`` are among the results, and
        ``against``: every other policy's name to :func:`compare`.
    """
    scene = next(iter(results.values())).scene
    intervals = Intervals(scene, seed)
    table = {}
    for name, own in results.items():
        against = {
            other: compare(own.measures, theirs.measures, intervals)
            for other, theirs in results.items()
            if other != name
        }
        table[name] = {
            **describe(own.measures, intervals),
            "gap_closed": _gap_closed(results, own),
            "against": against,
        }
    scenes = len(np.unique(scene))
    return {"object": object_name, "steps": steps, "episodes": len(scene), "scenes": scenes, "policies": table}


def _gap_closed(results: dict[str, EpisodeResults], own: EpisodeResults) -> float | None:
    """Share of the way from Random's detection rate to the greedy oracle's."""
    if not {"random", "oracle"} <= results.keys():
        return None
    low, high = (results[name].detection_rate.mean() for name in ("random", "oracle"))
    return float((own.detection_rate.mean() - low) / (high - low)) if high > low else None
