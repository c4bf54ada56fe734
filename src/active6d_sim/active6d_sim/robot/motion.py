"""Motions of joints: a way without collision between two configurations, and how long it takes."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np

#: Configurations are checked at least this close together along a way, radians in the largest joint.
SPACING = 0.03
_STEP = 0.6
_MOST_NODES = 400


def seconds_of(way: np.ndarray, speeds: np.ndarray, accelerations: np.ndarray) -> float:
    """Duration of a motion that stops at every configuration of (k, n) ``way`` (radians), all joints in step.

    Args:
        way: configurations in order.
        speeds: (n,) largest speed of each joint, radians per second.
        accelerations: (n,) largest acceleration of each joint, radians per second squared.
    """
    total = 0.0
    for turn in np.abs(np.diff(way, axis=0)):
        if not turn.any():
            continue
        # The slowest joint sets the pace: speed and acceleration of the share of the motion that is done.
        moving = turn > 0
        speed, acceleration = (float((most[moving] / turn[moving]).min()) for most in (speeds, accelerations))
        cruises = speed**2 < acceleration
        total += 1 / speed + speed / acceleration if cruises else 2 / np.sqrt(acceleration)
    return total


def sample_way(way: np.ndarray, spacing: float = SPACING) -> np.ndarray:
    """(m, n) configurations along the straight lines between those of (k, n) ``way``, ends included."""
    parts = [way[:1]]
    for start, end in pairwise(way):
        count = max(1, int(np.ceil(np.abs(end - start).max() / spacing)))
        parts.append(start + np.linspace(0, 1, count + 1)[1:, None] * (end - start))
    return np.concatenate(parts)


def find_way(
    start: np.ndarray,
    end: np.ndarray,
    limits: np.ndarray,
    is_free: Callable[[np.ndarray], bool],
    rng: np.random.Generator,
) -> np.ndarray | None:
    """(k, n) configurations whose straight connections are free, from start to end; None if none was found.

    The straight line is tried first, then two trees grow towards each other (RRT-Connect, Kuffner and LaValle 2000),
    and corners that are not needed are cut.

    Args:
        start: (n,) radians, free.
        end: (n,) radians, free.
        limits: (n, 2) lowest and highest angle.
        is_free: whether a configuration is without collision.
        rng: of the trees.
    """

    def connects(a: np.ndarray, b: np.ndarray) -> bool:
        line = sample_way(np.stack([a, b]))[1:]
        # The middle first: most lines that are not free fail there.
        order = np.argsort(np.abs(np.arange(len(line)) - len(line) / 2), kind="stable")
        return all(is_free(line[i]) for i in order)

    if connects(start, end):
        return np.stack([start, end])
    trees: list[tuple[list[np.ndarray], list[int]]] = [([start], [-1]), ([end], [-1])]
    for count in range(_MOST_NODES):
        (nodes, parents), (others, other_parents) = trees[count % 2], trees[1 - count % 2]
        grown = _grow(nodes, parents, rng.uniform(*limits.T), connects, once=True)
        if not grown:
            continue
        target = nodes[-1]
        _grow(others, other_parents, target, connects, once=False)
        if np.array_equal(others[-1], target):
            ends = [_to_root(*tree) for tree in trees]
            return _cut_corners([*ends[0][::-1], *ends[1][1:]], connects)
    return None


def _grow(
    nodes: list[np.ndarray],
    parents: list[int],
    target: np.ndarray,
    connects: Callable[[np.ndarray, np.ndarray], bool],
    once: bool,
) -> bool:
    """Extend a tree towards a configuration, by one step or as far as it is free. Whether it has grown."""
    nearest = int(np.abs(np.array(nodes) - target).max(axis=1).argmin())
    grown = False
    while True:
        way = target - nodes[nearest]
        length = np.abs(way).max()
        new = target if length <= _STEP else nodes[nearest] + way * (_STEP / length)
        if not connects(nodes[nearest], new):
            return grown
        nodes.append(new)
        parents.append(nearest)
        nearest, grown = len(nodes) - 1, True
        if once or new is target:
            return True


def _to_root(nodes: list[np.ndarray], parents: list[int]) -> list[np.ndarray]:
    index, way = len(nodes) - 1, []
    while index >= 0:
        way.append(nodes[index])
        index = parents[index]
    return way


def _cut_corners(way: list[np.ndarray], connects: Callable[[np.ndarray, np.ndarray], bool]) -> np.ndarray:
    """Leave out every configuration that a free straight line passes by."""
    kept, at = [way[0]], 0
    while at < len(way) - 1:
        at = next(next_ for next_ in range(len(way) - 1, at, -1) if next_ == at + 1 or connects(way[at], way[next_]))
        kept.append(way[at])
    return np.array(kept)
