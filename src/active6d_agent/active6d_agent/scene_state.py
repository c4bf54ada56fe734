"""What ``view-attention`` looks at: accumulated objects, unexplained patches of surface, and what views show of them.

A patch stands for an object that no hypothesis speaks of: depth images show some of its surface, and no accumulated
object explains it. How much of each object and patch every view of the grid would show past the other objects comes
from :mod:`active6d_perception.visibility`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from scipy.spatial.distance import cdist

from active6d_agent.policy import Observation
from active6d_core.object_model import ObjectModel
from active6d_perception.compiled import compiled
from active6d_perception.model_views import model_views
from active6d_perception.visibility import Tray, expected_visibility

#: Objects beyond these are left out, the best verified being kept.
MAX_OBJECTS = 64
#: Patches beyond these are left out, the largest being kept.
MAX_PATCHES = 8
#: What is known of an object and a view, see :func:`gather`.
PAIR_FEATURES = 12
# Points of surface within this fraction of the diameter are one patch, and so many are needed.
_PATCH_RADIUS = 0.45
_FEWEST_POINTS = 4
# More points than these are thinned out.
_MOST_POINTS = 240
# Unexplained surface is counted within these distances of an item's middle, in diameters, and so many points are one.
_NEAR_MIDDLE = (0.35, 0.65)
_POINTS_OF_ONE = 50
# Where the middle of an object is looked for about the middle of its patch, in diameters: most of it is below.
_PLACES = np.stack(np.meshgrid(*[np.linspace(-0.4, 0.4, 5)] * 2, np.linspace(-0.5, 0.1, 4)), axis=-1).reshape(-1, 3)
# Surface within this distance has a vote in that, in diameters, but no more points than these.
_VOTERS_WITHIN = 0.7
_MOST_VOTERS = 60
# Standard deviation of the surface's distance from the middle that votes allow for, in diameters.
_SHELL = 0.12
# A twentieth of all votes more makes a place e times as likely.
_SHARPNESS = 20.0


@dataclass(frozen=True, eq=False)
class SceneState:
    """n items, which are objects first and then patches, and the views about them.

    Attributes:
        pose: (n, 3, 4) in the world; a patch has the guessed middle of its object, and zeros for a rotation.
        scalars: (n, 7) verification, score, spread in metres, share of the views that support the object; 1 for a
            patch; unexplained surface near the middle and farther about it, of which right poses leave little.
        shown: (n, M) share that each view of the grid would show past the objects in between.
        seen: (n, t) the same of the views taken.
        taken: (t, 3) positions of the camera, the current one last.
        grid: (M, 3) positions of the views.
        left: moves left.
    """

    pose: np.ndarray
    scalars: np.ndarray
    shown: np.ndarray
    seen: np.ndarray
    taken: np.ndarray
    grid: np.ndarray
    left: int

    @property
    def patches(self) -> np.ndarray:
        """(m, 3) where the middles of the patches' objects are guessed to be."""
        return self.pose[self.scalars[:, 4] > 0, :, 3]


def best_verified(observation: Observation) -> np.ndarray:
    """Indices of the objects that are looked at: all, or of many the best verified."""
    return np.argsort(-observation.objects.verification, kind="stable")[:MAX_OBJECTS]


def gather_patches(points: np.ndarray, diameter: float) -> np.ndarray:
    """The densest balls of unexplained points, one after the other.

    Args:
        points: (k, 3) metres.
        diameter: of an object.

    Returns:
        (m, 3) middles of the patches.
    """
    thinning = max(1, -(-len(points) // _MOST_POINTS))
    points = points[::thinning]
    near = cdist(points, points) < _PATCH_RADIUS * diameter
    middles, free = [], np.ones(len(points), bool)
    while len(middles) < MAX_PATCHES and free.any():
        count = near @ free.astype(np.float32) * free
        members = near[count.argmax()] & free
        if members.sum() * thinning < _FEWEST_POINTS:
            break
        middles.append(points[members].mean(axis=0))
        free &= ~members
    return np.reshape(middles, (-1, 3))


def guess_middle(points: np.ndarray, patch: np.ndarray, model: ObjectModel) -> np.ndarray:
    """Where the middle of an object is likely to be, given surface of it.

    Every point about the patch votes for the places that are as far from it as an object's surface mostly is from its
    middle; the answer is the mean of all places, weighted by how many agree on them (a Hough transform, softened).

    Args:
        points: (k, 3) unexplained surface, metres.
        patch: (3,) middle of some of it.
        model: of the object.
    """
    near = points[np.linalg.norm(points - patch, axis=1) < _VOTERS_WITHIN * model.diameter]
    near = near[:: max(1, -(-len(near) // _MOST_VOTERS))]
    places = patch + _PLACES * model.diameter
    off_surface = (cdist(places, near) - _middle_radius(model)) / (_SHELL * model.diameter)
    votes = np.exp(-0.5 * off_surface**2).mean(axis=1)
    weight = np.exp(_SHARPNESS * (votes - votes.max()))
    return weight @ places / weight.sum()


@lru_cache(maxsize=16)
def _middle_radius(model: ObjectModel) -> float:
    """How far half of an object's surface is from its origin, metres."""
    return float(np.median(np.linalg.norm(model_views(model).points, axis=1)))


def represent(observation: Observation, model: ObjectModel, tray: Tray | None = None) -> SceneState:
    """Everything that the network is told of an observation of objects in a tray, the usual one when None."""
    objects, t = observation.objects, len(observation.positions)
    best = best_verified(observation)
    unexplained = observation.unexplained
    patches = gather_patches(unexplained, model.diameter)
    n, m = len(best), len(patches)
    T_world_item = np.tile(np.eye(4), (n + m, 1, 1))
    T_world_item[:n] = objects.T_world_object[best]
    T_world_item[n:, :3, 3] = np.reshape([guess_middle(unexplained, patch, model) for patch in patches], (m, 3))
    grid = observation.sphere.positions
    eyes = np.concatenate([grid, observation.positions])
    shares = expected_visibility(model).shares(T_world_item, eyes, tray or Tray.for_model(model), hiding=n)
    pose, scalars = T_world_item[:, :3].astype(np.float32), np.zeros((n + m, 7), np.float32)
    pose[n:, :, :3] = 0.0
    columns = objects.verification, objects.score, objects.spread, objects.support / t
    scalars[:n, :4] = np.column_stack(columns)[best]
    scalars[n:, 4] = 1.0
    apart = cdist(T_world_item[:, :3, 3], unexplained)
    for column, within in enumerate(_NEAR_MIDDLE, start=5):
        scalars[:, column] = (apart < within * model.diameter).sum(axis=1) / _POINTS_OF_ONE
    return SceneState(
        pose,
        scalars,
        shares[:, : len(grid)].astype(np.float32),
        shares[:, len(grid) :].astype(np.float32),
        observation.positions.astype(np.float32),
        grid.astype(np.float32),
        observation.steps_left,
    )


def gather(states: Sequence[SceneState], views: np.ndarray | None = None) -> dict[str, torch.Tensor]:
    """Padded tensors of B states on one grid.

    Args:
        states: of any numbers of items and of views taken.
        views: (M,) those in question, all of the grid when None.

    Returns:
        ``pose`` (B, n, 3, 4), ``scalars`` (B, n, 7), ``shown`` (B, n, M), ``seen`` (B, n, t) whose last column repeats
        the current view, ``present`` (B, n), ``taken`` (B, t, 3) likewise, ``moves`` (B,) moves made, ``left`` (B,)
        moves left, ``views`` (M, 3), ``pairs`` (B, M, n, 12) what is known of each object and each view: the share that
        the view would show, how much that is above what was seen, how steeply the view looks down on the object, the
        angle to the nearest view taken, its cosine, how much the views taken have seen from that side, how far away the
        object is, whether the view is on the object's side of the bin, how far off the image's centre the object is,
        and the direction to the view in the object's frame.
    """
    count = max(1, *(len(each.pose) for each in states))
    longest = max(len(each.taken) for each in states)
    some = slice(None) if views is None else views
    grid = np.ascontiguousarray(states[0].grid[some], np.float32)
    B, M = len(states), len(grid)
    arrays = {
        "pose": np.zeros((B, count, 3, 4), np.float32),
        "scalars": np.zeros((B, count, 7), np.float32),
        "shown": np.zeros((B, count, M), np.float32),
        "seen": np.zeros((B, count, longest), np.float32),
        "present": np.zeros((B, count), bool),
        "taken": np.zeros((B, longest, 3), np.float32),
    }
    for row, each in enumerate(states):
        n, t = each.seen.shape
        arrays["pose"][row, :n], arrays["scalars"][row, :n] = each.pose, each.scalars
        arrays["shown"][row, :n] = each.shown[:, some]
        arrays["seen"][row, :n, :t], arrays["seen"][row, :n, t:] = each.seen, each.seen[:, -1:]
        arrays["present"][row, :n] = True
        arrays["taken"][row, :t], arrays["taken"][row, t:] = each.taken, each.taken[-1]
    arrays["moves"] = np.array([len(each.taken) - 1 for each in states], np.float32)
    arrays["left"] = np.array([each.left for each in states], np.float32)
    arrays["views"] = grid
    arrays["pairs"] = np.zeros((B, M, count, PAIR_FEATURES), np.float32)
    _pair(*(arrays[name] for name in ("pose", "shown", "seen", "present", "taken", "views", "pairs")))
    return {name: torch.from_numpy(values) for name, values in arrays.items()}


@compiled
def _pair(
    pose: np.ndarray,
    shown: np.ndarray,
    seen: np.ndarray,
    present: np.ndarray,
    taken: np.ndarray,
    views: np.ndarray,
    pairs: np.ndarray,
) -> None:
    """Fill ``pairs`` of :func:`gather` where objects are present; compiled, since it is a dozen numbers each."""
    to_taken = np.empty(taken.shape[1:], np.float32)
    for row, item in np.ndindex(present.shape):
        if not present[row, item]:
            continue
        x0, y0, z0 = pose[row, item, 0, 3], pose[row, item, 1, 3], pose[row, item, 2, 3]
        for index in range(len(to_taken)):
            x, y, z = taken[row, index, 0] - x0, taken[row, index, 1] - y0, taken[row, index, 2] - z0
            length = _length(x, y, z)
            to_taken[index, 0], to_taken[index, 1], to_taken[index, 2] = x / length, y / length, z / length
        radius = _length(taken[row, -1, 0], taken[row, -1, 1], taken[row, -1, 2])
        from_axis, most = _length(x0, y0, np.float32(0)), seen[row, item].max()
        for view in range(len(views)):
            x, y, z = views[view, 0] - x0, views[view, 1] - y0, views[view, 2] - z0
            length = _length(x, y, z)
            distance = length / radius
            x, y, z = x / length, y / length, z / length
            closest, known = np.float32(-1), np.float32(0)
            for index in range(len(to_taken)):
                cosine = x * to_taken[index, 0] + y * to_taken[index, 1] + z * to_taken[index, 2]
                closest = max(closest, cosine)
                known = max(known, seen[row, item, index] * (np.float32(1) + cosine))
            closest = min(closest, np.float32(1))
            off_axis = x * views[view, 0] + y * views[view, 1] + z * views[view, 2]
            off_axis /= _length(views[view, 0], views[view, 1], views[view, 2])
            pairs[row, view, item, 0] = shown[row, item, view]
            pairs[row, view, item, 1] = shown[row, item, view] - most
            pairs[row, view, item, 2] = z
            # Just off the ends, where the angle has no derivative.
            pairs[row, view, item, 3] = np.arccos(closest * np.float32(0.999999)) / np.float32(np.pi)
            pairs[row, view, item, 4] = closest
            pairs[row, view, item, 5] = known / np.float32(2)
            pairs[row, view, item, 6] = distance - np.float32(1)
            pairs[row, view, item, 7] = (x0 * x + y0 * y) / from_axis
            pairs[row, view, item, 8] = off_axis - np.float32(0.95)
            for axis in range(3):
                along = x * pose[row, item, 0, axis] + y * pose[row, item, 1, axis] + z * pose[row, item, 2, axis]
                pairs[row, view, item, 9 + axis] = along


@compiled
def _length(x: np.float32, y: np.float32, z: np.float32) -> np.float32:
    """Of a vector in metres, a micrometre at the least: nothing has the direction of a zero."""
    return max(np.sqrt(x * x + y * y + z * z), np.float32(1e-6))
