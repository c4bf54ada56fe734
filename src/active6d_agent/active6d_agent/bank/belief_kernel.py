"""The belief of :class:`.AllViewsFusion` on tabulated evidence, compiled: one call fuses the views of one episode.

The columns are those of :mod:`active6d_perception.scene.scene_evidence` and
:mod:`active6d_perception.scene.object_probability`; a test compares them.
"""

from typing import NamedTuple

import numpy as np

from active6d_perception.compiled import compiled
from active6d_perception.scene.all_views_fusion import HOPELESS
from active6d_perception.scene.belief_weights import BeliefWeights, Scorer
from active6d_perception.scene.feasibility import FREE
from active6d_perception.scene.measured_cases import (
    CASES,
    FACING_ELSEWHERE,
    FITTING,
    HIDDEN,
    LOOKED_THROUGH,
    PER_PIXEL,
    WHOSE,
)
from active6d_perception.scene.object_probability import OBJECT_COLUMNS
from active6d_perception.scene.scene_evidence import (
    BODY_COLUMNS,
    DEEPEST_IN_CONTAINER,
    DEEPEST_IN_NEIGHBOUR,
    ROTATION_COLUMNS,
    TOUCHES_FLOOR,
    TOUCHES_NEIGHBOUR,
)

_ROOT = np.float32(0.3 / np.sqrt(PER_PIXEL))
_BODY, _ROTATION, _OBJECT = len(BODY_COLUMNS), len(ROTATION_COLUMNS), len(OBJECT_COLUMNS)


class FoldedScorer(NamedTuple):
    """A :class:`.Scorer` without its standardisation, so that columns of 0 cost nothing."""

    linear: np.ndarray
    """(c,)"""
    hidden: np.ndarray
    """(c, h)"""
    offset: np.ndarray
    """(h,)"""
    out: np.ndarray
    """(h,)"""
    constant: float
    """added to the result"""

    @classmethod
    def of(cls, scorer: Scorer) -> "FoldedScorer":
        """The same function."""
        linear, hidden = scorer.linear / scorer.scale, scorer.hidden / scorer.scale[:, None]
        offset = scorer.offset - scorer.mean @ hidden
        arrays = [np.ascontiguousarray(each, np.float32) for each in (linear, hidden, offset, scorer.out)]
        return cls(arrays[0], arrays[1], arrays[2], arrays[3], -float(scorer.mean @ linear))


class Belief(NamedTuple):
    """What the kernel needs beside the evidence."""

    rotation: FoldedScorer
    body: FoldedScorer
    probability: FoldedScorer
    similar: np.ndarray
    """(r, r) worth of a rotation if another one is right"""
    within: np.ndarray
    """(r, r) bool, rotations that are right if another one is"""
    diameter: float
    """of the object, metres divided by :attr:`.Ambiguity.scale`"""
    cut: float
    """hypotheses nearer than this to a body stand for it, metres"""
    exclusion: float
    """of two objects nearer than this only the more probable one is kept, metres"""
    least_probability: float

    @classmethod
    def of(cls, weights: BeliefWeights, *rest: object) -> "Belief":
        """Of weights and the other values in their order."""
        scorers = (FoldedScorer.of(each) for each in (weights.rotation, weights.body, weights.probability))
        return cls(*scorers, *rest)  # type: ignore[arg-type]


class SceneIndex(NamedTuple):
    """One scene's hypotheses (H rows by view) and candidates (K with R rotations)."""

    first_row: np.ndarray
    """(M + 1,) first row of each view"""
    candidate: np.ndarray
    """(H,) the candidate that each row is for, -1 for none"""
    of_view: np.ndarray
    """(H,) of each row"""
    confidence: np.ndarray
    """(H,)"""
    score: np.ndarray
    """(H,) of the estimator"""
    near: np.ndarray
    """(K, H) float32 distance between bodies, metres"""
    middles: np.ndarray
    """(K, H) float32 distance between the middles of bodies, metres"""
    twins: np.ndarray
    """(K, K) bool, which candidates are each other's twins"""
    place: np.ndarray
    """(K,)"""
    body: np.ndarray
    """(M, K, 1, CASES) uint8, see :class:`.EvidenceTables`"""
    twin: np.ndarray
    """(M, K, 1, CASES) uint8"""
    telling: np.ndarray
    """(M, K, R, CASES) uint8"""
    container: np.ndarray
    """(K, 5) of bodies, see :func:`.against_container`"""
    turned: np.ndarray
    """(K, R, 5) of the part that tells rotations apart"""
    first_pair: np.ndarray
    """(K + 1,) first pair of each candidate"""
    neighbour: np.ndarray
    """(P,) the other candidate of each pair"""
    pairs: np.ndarray
    """(P, 1, 2) of bodies, see :func:`.against_neighbour`"""
    turned_pairs: np.ndarray
    """(P, R, 2) of the part that tells rotations apart"""
    positions: np.ndarray
    """(K * R, 3) origins of the poses, world, metres"""


class FusedEpisode(NamedTuple):
    """n objects, most probable first."""

    pose: np.ndarray
    """(n,) number of the pose, candidate * R + rotation"""
    probability: np.ndarray
    """(n,)"""
    entropy: np.ndarray
    """(n,) nats"""
    best: np.ndarray
    """(n,) row of the hypothesis with the highest confidence"""
    seen: np.ndarray
    """(n,) the same of the current view, -1 without one"""
    support: np.ndarray
    """(n,) number of views with a hypothesis"""
    spread: np.ndarray
    """(n,) largest distance of a hypothesis, metres"""
    description: np.ndarray
    """(n, columns) see :func:`.describe_objects`"""


# Loops are inside of functions that are called once per candidate: a call that hands over arrays takes as long as what
# is done for one rotation.
@compiled
def _add_scores(columns: np.ndarray, scorer: FoldedScorer, odds: np.ndarray) -> None:
    """Add the log-odds of (n, c) columns to (n,) ``odds``."""
    units = np.empty(len(scorer.offset), np.float32)
    for row in range(len(columns)):
        units[:] = scorer.offset
        value = np.float32(scorer.constant)
        for c in range(columns.shape[1]):
            x = columns[row, c]
            if x != 0:
                value += x * scorer.linear[c]
                for h in range(len(units)):
                    units[h] += x * scorer.hidden[c, h]
        for h in range(len(units)):
            value += max(units[h], np.float32(0)) * scorer.out[h]
        odds[row] += value


@compiled
def _gather(scene: SceneIndex, views: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(m,) rows of the views, (K,) evidence, (K,) bool, which candidates are proposed, and which only by a twin."""
    count = 0
    for view in views:
        count += scene.first_row[view + 1] - scene.first_row[view]
    rows, evidence, m = np.empty(count, np.int64), np.zeros(len(scene.place)), 0
    for view in views:
        for row in range(scene.first_row[view], scene.first_row[view + 1]):
            rows[m] = row
            m += 1
            if scene.candidate[row] >= 0:
                evidence[scene.candidate[row]] += scene.confidence[row] ** 2
    proposed, alone = evidence > 0, np.zeros(len(evidence), np.bool_)
    for k in range(len(evidence)):
        if evidence[k] > 0:
            for other in range(len(evidence)):
                if scene.twins[k, other] and not evidence[other] > 0:
                    proposed[other] = alone[other] = True
    return rows, evidence, proposed, alone


@compiled
def _heads(scene: SceneIndex, evidence: np.ndarray, proposed: np.ndarray) -> np.ndarray:
    """(K,) bool, the proposed candidates with the most evidence at their place."""
    best = np.full(scene.place.max() + 1, -1)
    for k in range(len(proposed)):
        if proposed[k] and (best[scene.place[k]] < 0 or evidence[k] > evidence[best[scene.place[k]]]):
            best[scene.place[k]] = k
    heads = np.zeros(len(proposed), np.bool_)
    for k in best:
        if k >= 0:
            heads[k] = True
    return heads


@compiled
def _pairs_of(scene: SceneIndex, k: int, heads: np.ndarray) -> np.ndarray:
    """Pairs of a candidate with the heads of other places."""
    chosen, count = np.empty(scene.first_pair[k + 1] - scene.first_pair[k], np.int64), 0
    for pair in range(scene.first_pair[k], scene.first_pair[k + 1]):
        if heads[scene.neighbour[pair]]:
            chosen[count] = pair
            count += 1
    return chosen[:count]


@compiled
def _among(chosen: np.ndarray, pairs: np.ndarray, r: int) -> tuple[float, float]:
    """Share of a candidate in its neighbours, and the least distance to them; ``chosen`` of (P, R, 2) ``pairs``."""
    share, nearest = 0.0, FREE
    for pair in chosen:
        share = min(share + pairs[pair, r, 0], 1.0)
        nearest = min(nearest, pairs[pair, r, 1])
    return share, nearest


@compiled
def _sum_cases(table: np.ndarray, views: np.ndarray, k: int, r: int, cases: np.ndarray) -> None:
    """Set (CASES,) counts to the sum over views of the squares in (M, K, R, CASES) ``table``."""
    cases[:] = 0
    for view in views:
        for case in range(CASES):
            root = np.float32(table[view, k, r, case])
            cases[case] += root * root


@compiled
def _pixels(cases: np.ndarray, what: int) -> float:
    """Number of pixels of one kind."""
    total = 0.0
    for whose in range(WHOSE):
        total += cases[what * WHOSE + whose]
    return total / PER_PIXEL


@compiled
def _describe_body(
    scene: SceneIndex, k: int, cases: np.ndarray, twin: np.ndarray, evidence: float, alone: bool, near: np.ndarray
) -> np.ndarray:
    """(columns,) see :data:`.BODY_COLUMNS`; (2,) ``near`` is the overlap with neighbours."""
    columns = np.empty(_BODY, np.float32)
    for case in range(CASES):
        columns[case], columns[CASES + case] = _ROOT * np.sqrt(cases[case]), _ROOT * np.sqrt(twin[case])
    fitting, through = _pixels(cases, FITTING), _pixels(cases, LOOKED_THROUGH)
    elsewhere, hidden = _pixels(cases, FACING_ELSEWHERE), _pixels(cases, HIDDEN)
    seen = max(fitting + through + elsewhere, 1.0)
    c = 2 * CASES
    columns[c], columns[c + 1] = 10 * fitting / seen, 10 * through / seen
    columns[c + 2], columns[c + 3] = fitting / 300, through / 100
    columns[c + 4], columns[c + 5] = elsewhere / 300, hidden / 300
    columns[c + 6], columns[c + 7], columns[c + 8] = evidence, np.sqrt(evidence), alone
    columns[c + 9], columns[c + 10] = 10 * scene.container[k, 0], 10 * near[0]
    columns[c + 11] = min(max(-scene.container[k, 1], 0.0), DEEPEST_IN_CONTAINER) / 0.01
    columns[c + 12] = min(max(-near[1], 0.0), DEEPEST_IN_NEIGHBOUR) / 0.001
    return columns


@compiled
def _sum_rotations(scene: SceneIndex, views: np.ndarray, k: int, columns: np.ndarray) -> None:
    """Set the columns of cases of (R, columns), see :data:`.ROTATION_COLUMNS`."""
    columns[:, :CASES] = 0
    for view in views:
        for r in range(len(columns)):
            for case in range(CASES):
                root = np.float32(scene.telling[view, k, r, case])
                columns[r, case] += root * root
    for r in range(len(columns)):
        for case in range(CASES):
            columns[r, case] = _ROOT * np.sqrt(columns[r, case])


@compiled
def _describe_rotations(scene: SceneIndex, k: int, chosen: np.ndarray, diameter: float, columns: np.ndarray) -> None:
    """Set the other columns of (R, columns); ``chosen`` are the pairs with neighbours."""
    mean_height, c = scene.turned[k, :, 4].mean(), CASES
    for r in range(len(columns)):
        share, nearest = 0.0, FREE
        for pair in chosen:
            share = min(share + scene.turned_pairs[pair, r, 0], 1.0)
            nearest = min(nearest, scene.turned_pairs[pair, r, 1])
        row, lowest, beyond = columns[r], scene.turned[k, r, 1], scene.turned[k, r, 3]
        row[c], row[c + 1], row[c + 2] = 10 * scene.turned[k, r, 0], 10 * share, 10 * scene.turned[k, r, 2]
        row[c + 3] = min(max(-lowest, 0.0), DEEPEST_IN_CONTAINER) / 0.01
        row[c + 4] = min(max(-nearest, 0.0), DEEPEST_IN_NEIGHBOUR) / 0.001
        row[c + 5] = min(max(beyond, 0.0), DEEPEST_IN_CONTAINER) / 0.01
        row[c + 6], row[c + 7] = abs(lowest) < TOUCHES_FLOOR, abs(nearest) < TOUCHES_NEIGHBOUR
        row[c + 8] = (scene.turned[k, r, 4] - mean_height) / (0.4 * diameter)


@compiled
def _decide(odds: np.ndarray, members: np.ndarray, belief: Belief) -> tuple[int, int, float, float]:
    """The pose of one place: its candidate, its rotation, the probability of poses like it, and the entropy.

    Args:
        odds: (K, R) log-odds.
        members: (c,) candidates of the place.
        belief: with what is similar.
    """
    highest, total = -np.inf, 0.0
    for k in members:
        highest = max(highest, odds[k].max())
    p = np.empty((len(members), odds.shape[1]))
    for index in range(len(members)):
        p[index] = np.exp(odds[members[index]] - highest)
        total += p[index].sum()
    best, candidate, rotation, entropy = -1.0, 0, 0, 0.0
    for index in range(len(members)):
        for r in range(p.shape[1]):
            p[index, r] /= total
            entropy -= p[index, r] * np.log(max(p[index, r], 1e-12))
        for r in range(p.shape[1]):
            worth = 0.0
            for other in range(p.shape[1]):
                worth += p[index, other] * belief.similar[other, r]
            if worth > best:
                best, candidate, rotation = worth, index, r
    mass = 0.0
    for other in range(p.shape[1]):
        mass += belief.within[rotation, other] * p[candidate, other]
    return members[candidate], rotation, mass, entropy


@compiled
def _members(scene: SceneIndex, rows: np.ndarray, k: int, cut: float) -> np.ndarray:
    """Rows of the hypotheses that stand for a candidate, in the order of views; the nearest one if there is none."""
    count, nearest = 0, 0
    for m in range(len(rows)):
        count += scene.near[k, rows[m]] < cut
        if scene.middles[k, rows[m]] < scene.middles[k, rows[nearest]]:
            nearest = m
    if count == 0:
        return rows[nearest : nearest + 1].copy()
    chosen, count = np.empty(count, np.int64), 0
    for row in rows:
        if scene.near[k, row] < cut:
            chosen[count] = row
            count += 1
    return chosen


@compiled
def _describe_object(
    scene: SceneIndex,
    k: int,
    r: int,
    sums: tuple[np.ndarray, np.ndarray],
    near: np.ndarray,
    evidence: float,
    decided: tuple[float, float],
    scores: tuple[float, float],
    views: tuple[int, int],
    columns: np.ndarray,
) -> None:
    """Set (columns,), see :data:`.OBJECT_COLUMNS`.

    Args:
        scene: of the object.
        k: its candidate.
        r: its rotation.
        sums: (CASES,) of the body and of the part that tells rotations apart.
        near: (2,) overlap of the body with neighbours.
        evidence: of the candidate.
        decided: probability of poses like it, and entropy.
        scores: largest and mean score of its hypotheses.
        views: number of views with a hypothesis of it, and of views with any.
        columns: to set.
    """
    body, telling = sums
    mass = min(max(decided[0], 1e-3), 1 - 1e-3)
    fitting, through = _pixels(body, FITTING), _pixels(body, LOOKED_THROUGH)
    seen = max(fitting + through + _pixels(body, FACING_ELSEWHERE), 1.0)
    columns[0], columns[1], columns[2] = 1.0, np.log(mass / (1 - mass)), decided[1]
    columns[3], columns[4], columns[5] = scores[0], scores[1], np.sqrt(evidence)
    columns[6], columns[7] = np.log1p(views[0]), views[0] / max(views[1], 1)
    columns[8], columns[9] = fitting / seen, through / seen
    columns[10] = body[FITTING * WHOSE + 1] / PER_PIXEL / max(fitting, 1.0)
    columns[11], columns[12] = np.log1p(fitting), np.log1p(_pixels(body, HIDDEN))
    columns[13], columns[14] = near[0], scene.container[k, 0]
    columns[15] = 0.3 * np.sqrt(_pixels(telling, FITTING))
    columns[16] = 0.3 * np.sqrt(_pixels(telling, LOOKED_THROUGH))


@compiled
def _suppress(pose: np.ndarray, probability: np.ndarray, positions: np.ndarray, belief: Belief) -> np.ndarray:
    """Indices of the (n,) poses that are kept, most probable first."""
    order = np.argsort(-probability, kind="mergesort")
    kept, count = np.empty(len(order), np.int64), 0
    for index in order:
        free = probability[index] >= belief.least_probability
        for other in kept[:count]:
            square = 0.0
            for axis in range(3):
                square += (positions[pose[index], axis] - positions[pose[other], axis]) ** 2
            free &= square >= belief.exclusion**2
        if free:
            kept[count] = index
            count += 1
    return kept[:count].copy()


@compiled
def _body_odds(
    scene: SceneIndex, views: np.ndarray, belief: Belief, bodies: np.ndarray, near: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(m,) rows of the views, (K,) evidence, (K,) bool heads of places, and (K,) log-odds of the bodies.

    The log-odds of bodies that have no chance are negative infinity. (K, CASES) ``bodies`` and (K, 2) ``near`` are set.
    """
    rows, evidence, proposed, alone = _gather(scene, views)
    heads = _heads(scene, evidence, proposed)
    odds, best = np.full(len(proposed), -np.inf), np.full(scene.place.max() + 1, -np.inf)
    twin = np.empty(CASES, np.float32)
    for k in range(len(proposed)):
        if proposed[k]:
            _sum_cases(scene.body, views, k, 0, bodies[k])
            _sum_cases(scene.twin, views, k, 0, twin)
            near[k, 0], near[k, 1] = _among(_pairs_of(scene, k, heads), scene.pairs, 0)
            columns = _describe_body(scene, k, bodies[k], twin, evidence[k], alone[k], near[k])
            odds[k] = 0.0
            _add_scores(columns.reshape(1, -1), belief.body, odds[k : k + 1])
            best[scene.place[k]] = max(best[scene.place[k]], odds[k])
    for k in range(len(odds)):
        if odds[k] <= best[scene.place[k]] - HOPELESS:
            odds[k] = -np.inf
    return rows, evidence, heads, odds


@compiled
def fuse_episode(scene: SceneIndex, views: np.ndarray, current: int, belief: Belief) -> FusedEpisode:
    """Fuse (v,) views, -1 and repetitions of which are ignored; ``current`` is where the camera is."""
    views = np.unique(views[views >= 0])
    K, R = len(scene.place), scene.telling.shape[2]
    if K == 0:
        none, nothing = np.empty(0, np.int64), np.empty(0)
        return FusedEpisode(none, nothing, nothing, none, none, none, nothing, np.empty((0, _OBJECT)))
    places = scene.place.max() + 1
    bodies, near = np.empty((K, CASES), np.float32), np.empty((K, 2))
    rows, evidence, heads, body_odds = _body_odds(scene, views, belief, bodies, near)
    odds, rotations, with_rows = np.empty((K, R)), np.empty((R, _ROTATION), np.float32), 0
    for k in range(K):
        if body_odds[k] > -np.inf:
            odds[k] = body_odds[k]
            _sum_rotations(scene, views, k, rotations)
            _describe_rotations(scene, k, _pairs_of(scene, k, heads), belief.diameter, rotations)
            _add_scores(rotations, belief.rotation, odds[k])
    for view in views:
        with_rows += scene.first_row[view + 1] > scene.first_row[view]
    pose, entropy = np.empty(places, np.int64), np.empty(places)
    best, seen, support, spread = pose.copy(), pose.copy(), pose.copy(), entropy.copy()
    description, telling, n = np.empty((places, _OBJECT)), np.empty(CASES, np.float32), 0
    for place in range(places):
        own = np.flatnonzero((scene.place == place) & (body_odds > -np.inf))
        if not len(own):
            continue
        k, r, mass, entropy[n] = _decide(odds, own, belief)
        pose[n], spread[n], support[n], seen[n] = k * R + r, 0.0, 0, -1
        members, total, last = _members(scene, rows, k, belief.cut), 0.0, -1
        best[n], highest = members[0], 0.0
        for row in members:
            total, highest = total + scene.score[row], max(highest, scene.score[row])
            spread[n] = max(spread[n], scene.near[k, row])
            support[n] += scene.of_view[row] != last
            last = scene.of_view[row]
            if scene.confidence[row] > scene.confidence[best[n]]:
                best[n] = row
            if last == current and (seen[n] < 0 or scene.confidence[row] > scene.confidence[seen[n]]):
                seen[n] = row
        _sum_cases(scene.telling, views, k, r, telling)
        scores, counts = (highest, total / len(members)), (support[n], with_rows)
        _describe_object(
            scene, k, r, (bodies[k], telling), near[k], evidence[k], (mass, entropy[n]), scores, counts, description[n]
        )
        n += 1
    probability = np.zeros(n)
    _add_scores(description[:n].astype(np.float32), belief.probability, probability)
    probability = 1 / (1 + np.exp(-probability))
    kept = _suppress(pose[:n], probability, scene.positions, belief)
    return FusedEpisode(
        pose[kept],
        probability[kept],
        entropy[kept],
        best[kept],
        seen[kept],
        support[kept],
        spread[kept],
        description[kept],
    )
