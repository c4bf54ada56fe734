"""Input features of ``view-attention``: of objects, of clusters of unexplained surface, and of views.

A cluster of unexplained surface stands for an object without a hypothesis. Depth images show some of its surface, and
no accumulated object explains that. An item is an accumulated object or such a cluster. How much of each item a view
would show past the other objects comes from :mod:`active6d_perception.scene.expected_visibility`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import scipy.stats
import torch
from scipy.spatial.distance import cdist

from active6d_agent.policies.registry import MAX_OBJECTS, Decision, Observation
from active6d_core.object_model import ObjectModel
from active6d_perception.compiled import compiled
from active6d_perception.model.model_views import model_views
from active6d_perception.scene.expected_visibility import Tray, expected_visibility

#: Clusters of unexplained surface beyond these are left out, the largest being kept.
MAX_CLUSTERS = 8
#: Number of features of an item, of an item and a view, and of a view, see :class:`SceneState` and :func:`gather`.
ITEM_FEATURES, PAIR_FEATURES, VIEW_FEATURES = 20, 13, 8
#: Columns of the probability and the entropy among an item's features, and of the expected information among a pair's.
BELIEF, INFORMATION = slice(18, 20), 12
# Points within this fraction of the diameter are one cluster, and so many are needed.
_CLUSTER_RADIUS = 0.45
_FEWEST_POINTS = 4
# More points than these are subsampled.
_MOST_POINTS = 240
# Unexplained points are counted within these distances of an item's centre, in diameters, in units of so many.
_NEAR_CENTRE = (0.35, 0.65)
_POINTS_OF_ONE = 50
# Candidates for an object's centre around the middle of its cluster, in diameters: most of the object is below.
_CENTRES = np.stack(np.meshgrid(*[np.linspace(-0.4, 0.4, 5)] * 2, np.linspace(-0.5, 0.1, 4)), axis=-1).reshape(-1, 3)
# Points within this distance vote for the centre, in diameters, but no more than these.
_VOTERS_WITHIN = 0.7
_MOST_VOTERS = 60
# Standard deviation of the surface's distance from the centre that votes allow for, in diameters.
_SHELL = 0.12
# A candidate with 5 % more of all votes counts e times as much.
_SHARPNESS = 20.0


@dataclass(frozen=True, eq=False)
class SceneState:
    """n items, first the objects and then the clusters of unexplained surface, and the views around them.

    Attributes:
        pose: (n, 3, 4) in the world; a cluster has the likely centre of its object, and zeros for a rotation.
        scalars: (n, 9) verification score, estimator's score, spread in metres, share of the views that support the
            object; 1 for a cluster; unexplained surface near the centre and in a wider ball. Correct poses leave
            little of it. Then the probability that the pose is right, and the entropy of the belief there in nats.
        shown: (n, M) share of the item's surface that each view of the grid would show past the objects in between.
        seen: (n, t) the same for the views taken.
        taken: (t, 3) positions of the camera, the current one last.
        grid: (M, 3) positions of the views.
        left: moves left.
        diameter: of an object.
        axis: (3,) of its continuous symmetry, object frame, zeros without one.
    """

    pose: np.ndarray
    scalars: np.ndarray
    shown: np.ndarray
    seen: np.ndarray
    taken: np.ndarray
    grid: np.ndarray
    left: int
    diameter: float
    axis: np.ndarray

    @property
    def clusters(self) -> np.ndarray:
        """(m, 3) likely centres of the objects that the clusters of unexplained surface belong to."""
        return self.pose[self.scalars[:, 4] > 0, :, 3]

    @cached_property
    def items(self) -> np.ndarray:
        """(n, 20) float32, features of each item; of the world's directions only the vertical counts."""
        verification, score, spread, *rest, probability, entropy = self.scalars.T
        centre, upright = self.pose[:, :, 3], self.pose[:, 2, :3]
        apart = (centre - centre[:, None]) / self.diameter
        near = np.exp(-(apart**2).sum(axis=-1))
        moves = np.full(len(centre), self._few(len(self.taken) - 1))
        columns = [
            verification,
            score,
            np.minimum(spread / self.diameter, 1.0),
            *rest,
            centre[:, 2] / self.diameter,
            np.linalg.norm(centre[:, :2], axis=1) / (2 * self.diameter),
            near.sum(axis=1) / 3,
            (near * np.maximum(apart[..., 2], 0.0)).sum(axis=1),
            self.seen.max(axis=1),
            self.seen[:, -1],
            self.seen.sum(axis=1) / 3,
            moves,
            *_sides(upright, self.axis).T,
            probability,
            entropy,
        ]
        return np.stack(columns, axis=1).astype(np.float32)

    @cached_property
    def uncertainty(self) -> np.ndarray:
        """(n,) float32, entropy in nats of what is not known of each item.

        Of an object it is the entropy of "right or wrong" and of the belief over the poses at its place. Of a cluster
        of unexplained surface it is that of a toss: an object is there or not.
        """
        probability, entropy = self.scalars[:, 7], self.scalars[:, 8]
        right = scipy.stats.entropy(np.stack([probability, 1 - probability]))
        return np.where(self.scalars[:, 4] > 0, np.log(2), right + entropy).astype(np.float32)

    @cached_property
    def outlooks(self) -> np.ndarray:
        """(M, 8) float32, features of each view.

        They are its height and the camera's, the arcs to it from the camera and from the nearest view taken, moves
        made and left, the number of items, and 1 / (1 + moves left).
        """
        outlook, heading = (each / np.linalg.norm(each, axis=1, keepdims=True) for each in (self.grid, self.taken))
        # Not quite 1 and -1, where the arc cosine has no derivative.
        arcs = np.arccos((outlook @ heading.T).clip(-1.0, 1.0) * np.float32(0.999999)) / np.float32(np.pi)
        moves, left = self._few(len(self.taken) - 1), self._few(self.left)
        known = np.empty((len(outlook), VIEW_FEATURES), np.float32)
        known[:, 0], known[:, 1] = outlook[:, 2], heading[-1, 2]
        known[:, 2], known[:, 3] = arcs[:, -1], arcs.min(axis=1)
        known[:, 4:] = moves, left, len(self.pose) / 20, 1 / (1 + 5 * left)
        return known

    @staticmethod
    def _few(moves: int) -> float:
        """A number of moves over five, at most 2."""
        return min(moves / 5, 2.0)


def best_verified(observation: Observation) -> np.ndarray:
    """Indices of the objects that count, the best verified first, at most ``MAX_OBJECTS``."""
    return np.argsort(-observation.objects.verification, kind="stable")[:MAX_OBJECTS]


def go_for_items(observation: Observation, view: int, share: np.ndarray) -> Decision:
    """Move to a view of the grid whose worth is due to several items; the attention is each object's share of it.

    Args:
        observation: of the items.
        view: index in the grid.
        share: of the objects in the order of :func:`best_verified`, then of what has no pose yet; not negative. A move
            that is mostly for such an item attends to no object.
    """
    best, attention = best_verified(observation), np.zeros(len(observation.objects))
    attention[best] = share[: len(best)]
    largest = int(share.argmax()) if share.any() else len(best)
    return Decision.go_to(observation, view, attention, int(best[largest]) if largest < len(best) else None)


def cluster_unexplained(points: np.ndarray, diameter: float) -> np.ndarray:
    """Clusters of unexplained surface: the densest balls of points, one after the other, without those of earlier ones.

    Args:
        points: (k, 3) metres.
        diameter: of an object.

    Returns:
        (m, 3) means of the clusters' points, metres.
    """
    thinning = max(1, -(-len(points) // _MOST_POINTS))
    points = points[::thinning]
    near = cdist(points, points) < _CLUSTER_RADIUS * diameter
    middles: list[np.ndarray] = []
    free = np.ones(len(points), bool)
    while len(middles) < MAX_CLUSTERS and free.any():
        count = near @ free.astype(np.float32) * free
        members = near[count.argmax()] & free
        if members.sum() * thinning < _FEWEST_POINTS:
            break
        middles.append(points[members].mean(axis=0))
        free &= ~members
    return np.reshape(middles, (-1, 3))


def likely_centre(points: np.ndarray, cluster: np.ndarray, model: ObjectModel) -> np.ndarray:
    """(3,) likely centre of the object that a cluster of unexplained surface belongs to (a soft Hough transform).

    Every point near the cluster votes for candidates at the median distance of the object's surface from its centre.
    The result is the mean of all candidates, weighted by their votes.

    Args:
        points: (k, 3) unexplained surface, metres.
        cluster: (3,) mean of the cluster, metres.
        model: of the object.
    """
    near = points[np.linalg.norm(points - cluster, axis=1) < _VOTERS_WITHIN * model.diameter]
    near = near[:: max(1, -(-len(near) // _MOST_VOTERS))]
    centres = cluster + _CENTRES * model.diameter
    off_surface = (cdist(centres, near) - _surface_radius(model)) / (_SHELL * model.diameter)
    votes = np.exp(-0.5 * off_surface**2).mean(axis=1)
    weight = np.exp(_SHARPNESS * (votes - votes.max()))
    return weight @ centres / weight.sum()


@lru_cache(maxsize=16)
def _surface_radius(model: ObjectModel) -> float:
    """Median distance of an object's surface from its origin, metres."""
    return float(np.median(np.linalg.norm(model_views(model).points, axis=1)))


def represent(observation: Observation, model: ObjectModel, tray: Tray | None = None) -> SceneState:
    """Network input features of an observation; ``tray`` is the bin, the object's usual one when None."""
    objects, t = observation.objects, len(observation.positions)
    best = best_verified(observation)
    unexplained = observation.unexplained
    clusters = cluster_unexplained(unexplained, model.diameter)
    n, m = len(best), len(clusters)
    T_world_item = np.tile(np.eye(4), (n + m, 1, 1))
    T_world_item[:n] = objects.T_world_object[best]
    T_world_item[n:, :3, 3] = np.reshape([likely_centre(unexplained, cluster, model) for cluster in clusters], (m, 3))
    grid = observation.sphere.positions
    eyes = np.concatenate([grid, observation.positions])
    shares = expected_visibility(model).shares(T_world_item, eyes, tray or Tray.for_model(model), hiding=n)
    pose, scalars = T_world_item[:, :3].astype(np.float32), np.zeros((n + m, 9), np.float32)
    pose[n:, :, :3] = 0.0
    axis = np.zeros(3) if model.symmetry.axis is None else model.symmetry.axis
    columns = objects.verification, objects.score, objects.spread, objects.support / t
    scalars[:n, :4] = np.column_stack(columns)[best]
    scalars[n:, 4] = 1.0
    scalars[:n, 7:] = np.column_stack([objects.probability, objects.entropy])[best]
    apart = cdist(T_world_item[:, :3, 3], unexplained)
    for column, within in enumerate(_NEAR_CENTRE, start=5):
        scalars[:, column] = (apart < within * model.diameter).sum(axis=1) / _POINTS_OF_ONE
    return SceneState(
        pose,
        scalars,
        shares[:, : len(grid)].astype(np.float32),
        shares[:, len(grid) :].astype(np.float32),
        observation.positions.astype(np.float32),
        grid.astype(np.float32),
        observation.steps_left,
        float(model.diameter),
        np.asarray(axis, np.float32),
    )


def gather(states: Sequence[SceneState], views: np.ndarray | None = None) -> dict[str, torch.Tensor]:
    """Padded tensors of B states of one object and one grid.

    Args:
        states: with any numbers of items and of views taken.
        views: (M,) indices of the views to describe, all of the grid when None.

    Returns:
        ``items`` (B, n, 20) and ``outlooks`` (B, M, 8) of the states. ``present`` (B, n), which items are no padding.
        ``more`` (B,), whether moves are left after the next. ``pairs`` (B, M, n, 13), features of each item and view.

        These 13 are the share of the item that the view would show, and how much more that is than the views taken have
        shown. Then how steeply the view looks down, the angle to the nearest view taken, seen from the item, and its
        cosine. Then how much the views taken have seen from that side, the distance, and whether the view is on the
        item's side of the bin. Then how far the item is from the image's centre, and the direction to the view in the
        object's frame (3). Last, how much the view is expected to tell of the item, in nats: its uncertainty, times the
        share that the view would show, times the share that the views taken have not seen from that side.
    """
    count = max(1, *(len(each.pose) for each in states))
    some = slice(None) if views is None else views
    grid = np.ascontiguousarray(states[0].grid[some], np.float32)
    B, M = len(states), len(grid)
    arrays = {
        "items": np.zeros((B, count, ITEM_FEATURES), np.float32),
        "outlooks": np.stack([each.outlooks[some] for each in states]),
        "present": np.zeros((B, count), bool),
        "more": np.array([each.left > 1 for each in states]),
        "pairs": np.zeros((B, M, count, PAIR_FEATURES), np.float32),
    }
    for row, each in enumerate(states):
        n = len(each.pose)
        arrays["items"][row, :n], arrays["present"][row, :n] = each.items, True
        shown = np.ascontiguousarray(each.shown[:, some])
        _pair(each.pose, shown, each.seen, each.taken, grid, arrays["pairs"][row])
        arrays["pairs"][row, :, :n, INFORMATION] = each.uncertainty * shown.T * (1 - arrays["pairs"][row, :, :n, 5])
    arrays["pairs"][..., 9:12] = _sides(arrays["pairs"][..., 9:12], states[0].axis)
    return {name: torch.from_numpy(values) for name, values in arrays.items()}


def _sides(directions: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """(..., 3) directions in the object's frame; about a symmetry axis only the angle to it counts."""
    if not axis.any():
        return directions
    axial = directions @ axis
    return np.stack([axial, np.sqrt(np.maximum(1 - axial**2, 0.0)), np.zeros_like(axial)], axis=-1)


@compiled
def _pair(
    pose: np.ndarray, shown: np.ndarray, seen: np.ndarray, taken: np.ndarray, views: np.ndarray, pairs: np.ndarray
) -> None:
    """Fill one state's ``pairs`` of :func:`gather`; compiled, because it loops over all items and views."""
    to_taken = np.empty(taken.shape, np.float32)
    radius = _length(taken[-1, 0], taken[-1, 1], taken[-1, 2])
    for item in range(len(pose)):
        x0, y0, z0 = pose[item, 0, 3], pose[item, 1, 3], pose[item, 2, 3]
        for index in range(len(to_taken)):
            x, y, z = taken[index, 0] - x0, taken[index, 1] - y0, taken[index, 2] - z0
            length = _length(x, y, z)
            to_taken[index, 0], to_taken[index, 1], to_taken[index, 2] = x / length, y / length, z / length
        from_axis, most = _length(x0, y0, np.float32(0)), seen[item].max()
        for view in range(len(views)):
            x, y, z = views[view, 0] - x0, views[view, 1] - y0, views[view, 2] - z0
            length = _length(x, y, z)
            distance = length / radius
            x, y, z = x / length, y / length, z / length
            closest, known = np.float32(-1), np.float32(0)
            for index in range(len(to_taken)):
                cosine = x * to_taken[index, 0] + y * to_taken[index, 1] + z * to_taken[index, 2]
                closest = max(closest, cosine)
                known = max(known, seen[item, index] * (np.float32(1) + cosine))
            closest = min(closest, np.float32(1))
            off_axis = x * views[view, 0] + y * views[view, 1] + z * views[view, 2]
            off_axis /= _length(views[view, 0], views[view, 1], views[view, 2])
            pair = pairs[view, item]
            pair[0], pair[1], pair[2] = shown[item, view], shown[item, view] - most, z
            # Not quite 1 and -1, where the arc cosine has no derivative.
            pair[3] = np.arccos(closest * np.float32(0.999999)) / np.float32(np.pi)
            pair[4], pair[5], pair[6] = closest, known / np.float32(2), distance - np.float32(1)
            pair[7], pair[8] = (x0 * x + y0 * y) / from_axis, off_axis - np.float32(0.95)
            for axis in range(3):
                pair[9 + axis] = x * pose[item, 0, axis] + y * pose[item, 1, axis] + z * pose[item, 2, axis]


@compiled
def _length(x: np.float32, y: np.float32, z: np.float32) -> np.float32:
    """Length of a vector in metres, at least a micrometre, so that one can divide by it."""
    return max(np.sqrt(x * x + y * y + z * z), np.float32(1e-6))
