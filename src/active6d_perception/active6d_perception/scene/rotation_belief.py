"""Selects the body and the rotation at each place in a scene, with their probability."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class PlaceBeliefs:
    """The most probable pose at each of n places.

    Attributes:
        candidate: (n,) index of the body.
        weight: (n, r) weights of the rotations that make up the pose: the most probable one and those like it.
        rotation: (n,) index of the most probable rotation.
        mass: (n,) probability of all poses of the body that are within the tolerance of the pose.
        entropy: (n,) of the posterior over all poses at the place, nats.
    """

    candidate: np.ndarray
    weight: np.ndarray
    rotation: np.ndarray
    mass: np.ndarray
    entropy: np.ndarray


def posterior(log_odds: np.ndarray, place: np.ndarray) -> np.ndarray:
    """(K, r) probabilities that sum to 1 over the candidates and rotations of each place.

    Args:
        log_odds: (K, r) of each pose.
        place: (K,) place of each candidate, from 0.
    """
    count = place.max(initial=-1) + 1
    highest = np.full(count, -np.inf)
    np.maximum.at(highest, place, log_odds.max(axis=1, initial=-np.inf))
    odds = np.exp(log_odds - highest[place, None])
    return odds / np.bincount(place, odds.sum(axis=1), count)[place, None]


def decide(probability: np.ndarray, place: np.ndarray, errors: np.ndarray, tolerance: float) -> PlaceBeliefs:
    """Choose the pose at each place that is most probably right.

    A pose counts as right if its ADD is within the tolerance, so the probabilities of similar rotations add up; those
    near the limit count less, since poses have other errors too.

    Args:
        probability: (K, r) see :func:`posterior`.
        place: (K,) of each candidate.
        errors: (r, r) ADD between the rotations, metres.
        tolerance: metres.
    """
    similar = np.maximum(0.0, 1.0 - (errors / tolerance) ** 2)
    worth = probability @ similar
    rotation = worth.argmax(axis=1)
    best = worth[np.arange(len(worth)), rotation]
    # The first of equal candidates is kept: they come by falling evidence.
    order = np.lexsort([np.arange(len(place)), -best, place])
    candidate = order[np.unique(place[order], return_index=True)[1]]
    rotation = rotation[candidate]
    weight = probability[candidate] * similar[rotation]
    within = (errors[rotation] < tolerance) * probability[candidate]
    terms = -probability * np.log(np.maximum(probability, 1e-12))
    entropy = np.bincount(place, terms.sum(axis=1), place.max(initial=-1) + 1)
    return PlaceBeliefs(candidate, weight, rotation, within.sum(axis=1), entropy)
