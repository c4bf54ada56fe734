"""From the state of an episode to the inputs of the paper's network, and from its outputs to a view.

The environment, the training and the deployed policy all use these two functions.
"""

import numpy as np

from active6d_agent.policies.registry import MAX_OBJECTS
from active6d_core.view_sphere import ViewSphere

#: Numbers for each object: box (4), depth, verification score.
FEATURES = 6


def encode(
    features: np.ndarray, present: np.ndarray, positions: np.ndarray, moves: np.ndarray, steps: int
) -> dict[str, np.ndarray]:
    """Network inputs of E episodes, float32 and of fixed size.

    Of more than ``MAX_OBJECTS`` objects the first ones are kept, in the order in which fusion ranks them.

    Args:
        features: (E, n, 6) of the objects in the current camera, the objects of each episode first, then padding.
        present: (E, n) bool, false for padding.
        positions: (E, v, 3) camera positions over the sphere's radius, in order; what follows the current is unused.
        moves: (E,) moves made, so that ``positions[e, moves[e]]`` is where the camera is.
        steps: horizon T of the network; of a longer history the last T positions are kept.

    Returns:
        ``objects`` (E, MAX_OBJECTS, 6), ``mask`` (E, MAX_OBJECTS), ``camera`` (E, 3) and ``history`` (E, T, 3).
    """
    each, width = np.arange(len(moves)), min(features.shape[1], MAX_OBJECTS)
    objects = np.zeros((len(moves), MAX_OBJECTS, FEATURES), np.float32)
    mask = np.zeros((len(moves), MAX_OBJECTS), np.float32)
    objects[:, :width], mask[:, :width] = features[:, :width], present[:, :width]
    past = np.maximum(moves - steps, 0)[:, None] + np.arange(steps)
    known = past < moves[:, None]
    history = np.where(known[..., None], positions[each[:, None], np.where(known, past, 0)], 0.0).astype(np.float32)
    return {
        "objects": objects,
        "mask": mask,
        "camera": positions[each, moves].astype(np.float32),
        "history": history,
    }


def decode(angles: np.ndarray, sphere: ViewSphere, candidates: np.ndarray) -> np.ndarray:
    """(E,) the candidate view nearest to each goal.

    Args:
        angles: (E, 2) azimuth over 180 degrees in [-1, 1], and elevation from the horizon (-1) to the zenith (1).
        sphere: the grid of M views.
        candidates: (E, M) bool.
    """
    goal = sphere.position(np.pi * angles[:, 0], np.pi / 4 * (angles[:, 1] + 1.0))
    return np.where(candidates, goal @ (sphere.positions / sphere.radius).T, -np.inf).argmax(axis=1)
