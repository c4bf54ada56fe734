"""What ``view-attention`` looks at: accumulated objects, unexplained patches of surface, and what views show of them.

A patch stands for an object that no hypothesis speaks of: depth images show some of its surface, and no accumulated
object explains it. How much of each object and patch every view of the grid would show past the other objects comes
from :mod:`active6d_perception.visibility`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial.distance import cdist

from active6d_agent.policy import Observation
from active6d_core.object_model import ObjectModel
from active6d_perception.visibility import Tray, expected_visibility

#: Objects beyond these are left out, the best verified being kept.
MAX_OBJECTS = 64
#: Patches beyond these are left out, the largest being kept.
MAX_PATCHES = 8
# Points of surface within this fraction of the diameter are one patch, and so many are needed.
_PATCH_RADIUS = 0.45
_FEWEST_POINTS = 4
# More points than these are thinned out.
_MOST_POINTS = 240
# A patch of this many points has size one.
_POINTS_OF_SIZE_ONE = 50
# Where the middle of an object is guessed to be below the middle of its patch, in diameters.
_BELOW_SURFACE = 0.25


@dataclass(frozen=True, eq=False)
class SceneState:
    """n items, which are objects first and then patches, and the views about them.

    Attributes:
        pose: (n, 3, 4) in the world; a patch has the guessed middle of its object, and zeros for a rotation.
        scalars: (n, 6) verification, score, spread in metres, share of the views that support the object; 1 for a patch
            and its size.
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


def gather_patches(points: np.ndarray, diameter: float) -> tuple[np.ndarray, np.ndarray]:
    """The densest balls of unexplained points, one after the other.

    Args:
        points: (k, 3) metres.
        diameter: of an object.

    Returns:
        (m, 3) middles of the patches and (m,) their numbers of points.
    """
    thinning = max(1, -(-len(points) // _MOST_POINTS))
    points = points[::thinning]
    near = cdist(points, points) < _PATCH_RADIUS * diameter
    middles, sizes, free = [], [], np.ones(len(points), bool)
    while len(middles) < MAX_PATCHES and free.any():
        count = near @ free.astype(np.float32) * free
        members = near[count.argmax()] & free
        size = members.sum() * thinning
        if size < _FEWEST_POINTS:
            break
        middles.append(points[members].mean(axis=0))
        sizes.append(size)
        free &= ~members
    return np.reshape(middles, (-1, 3)), np.array(sizes, float)


def represent(observation: Observation, model: ObjectModel, tray: Tray | None = None) -> SceneState:
    """Everything that the network is told of an observation of objects in a tray, the usual one when None."""
    objects, t = observation.objects, len(observation.positions)
    best = best_verified(observation)
    patches, sizes = gather_patches(observation.unexplained, model.diameter)
    n, m = len(best), len(sizes)
    T_world_item = np.tile(np.eye(4), (n + m, 1, 1))
    T_world_item[:n] = objects.T_world_object[best]
    # Most of an object lies below the surface that shows. Which way it is turned is anybody's guess.
    T_world_item[n:, :3, 3] = patches - [0.0, 0.0, _BELOW_SURFACE * model.diameter]
    grid = observation.sphere.positions
    eyes = np.concatenate([grid, observation.positions])
    shares = expected_visibility(model).shares(T_world_item, eyes, tray or Tray.for_model(model), hiding=n)
    pose, scalars = T_world_item[:, :3].astype(np.float32), np.zeros((n + m, 6), np.float32)
    pose[n:, :, :3] = 0.0
    columns = objects.verification, objects.score, objects.spread, objects.support / t
    scalars[:n, :4] = np.column_stack(columns)[best]
    scalars[n:, 4], scalars[n:, 5] = 1.0, sizes / _POINTS_OF_SIZE_ONE
    return SceneState(
        pose,
        scalars,
        shares[:, : len(grid)].astype(np.float32),
        shares[:, len(grid) :].astype(np.float32),
        observation.positions.astype(np.float32),
        grid.astype(np.float32),
        observation.steps_left,
    )


def gather(states: Sequence[SceneState]) -> dict[str, torch.Tensor]:
    """Padded tensors of B states on one grid.

    Returns:
        ``pose`` (B, n, 3, 4), ``scalars`` (B, n, 6), ``shown`` (B, n, M), ``seen`` (B, n, t) whose last column repeats
        the current view, ``present`` (B, n), ``taken`` (B, t, 3) likewise, ``moves`` (B,) moves made, ``left`` (B,)
        moves left, ``views`` (M, 3).
    """
    count = max(1, *(len(each.pose) for each in states))
    longest = max(len(each.taken) for each in states)
    B, M = len(states), len(states[0].grid)
    arrays = {
        "pose": np.zeros((B, count, 3, 4), np.float32),
        "scalars": np.zeros((B, count, 6), np.float32),
        "shown": np.zeros((B, count, M), np.float32),
        "seen": np.zeros((B, count, longest), np.float32),
        "present": np.zeros((B, count), bool),
        "taken": np.zeros((B, longest, 3), np.float32),
    }
    for row, each in enumerate(states):
        n, t = each.seen.shape
        for name in ("pose", "scalars", "shown"):
            arrays[name][row, :n] = getattr(each, name)
        arrays["seen"][row, :n, :t], arrays["seen"][row, :n, t:] = each.seen, each.seen[:, -1:]
        arrays["present"][row, :n] = True
        arrays["taken"][row, :t], arrays["taken"][row, t:] = each.taken, each.taken[-1]
    arrays["moves"] = np.array([len(each.taken) - 1 for each in states], np.float32)
    arrays["left"] = np.array([each.left for each in states], np.float32)
    arrays["views"] = states[0].grid
    return {name: torch.from_numpy(values) for name, values in arrays.items()}
