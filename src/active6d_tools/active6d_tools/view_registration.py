"""Camera poses of images of one heap from the objects found in them, where a recording has none."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from active6d_core.se3 import invert, make_transform, transform_points

#: Objects of two images are the same if their centres then are this near, as a fraction of the diameter.
_NEAR = 0.08
#: Objects that two images must share, and their least share of those of the smaller image.
_FEWEST, _SHARE = 5, 0.5
#: A second placement that fits as well as this share of the best makes the pair ambiguous.
_AMBIGUOUS = 0.75
_TRIPLES = 150
_ROUNDS = 10


def register_views(centres: Sequence[np.ndarray], diameter: float, seed: int = 0) -> np.ndarray:
    """Poses of m cameras in the frame of the first, from the centres of the objects that each of them sees.

    Each image is placed among the objects of all images placed before it. Only centres are used, so that symmetric
    objects and wrong rotations do no harm.

    Args:
        centres: m times (k, 3) in the optical frame, metres.
        diameter: of the object, metres.
        seed: of the search.

    Returns:
        (m, 4, 4) ``T_first_camera``.

    Raises:
        ValueError: an image shares too few objects with the others, or fits in two ways; the message has its number.
    """
    rng, near = np.random.default_rng(seed), _NEAR * diameter
    known = [np.asarray(points, float).reshape(-1, 3) for points in centres]
    poses, scene = {0: np.eye(4)}, known[0]
    waiting = dict.fromkeys(range(1, len(known)), "")
    while waiting:
        for index in waiting:
            T, waiting[index] = _place(scene, known[index], near, rng)
            if T is not None:
                break
        else:
            index, reason = next(iter(waiting.items()))
            raise ValueError(f"image {index} has no camera pose and cannot be placed by its objects: {reason}")
        poses[index] = T
        del waiting[index]
        points = transform_points(T, known[index])
        apart = np.linalg.norm(points[:, None] - scene[None], axis=2)
        scene = np.concatenate([scene, points[apart.min(axis=1) > 2 * near]])
    return _refine(np.array([poses[index] for index in range(len(known))]), known, scene, near)


def _refine(poses: np.ndarray, known: list[np.ndarray], scene: np.ndarray, near: float) -> np.ndarray:
    """Alternate between the objects' mean centres over all images and the poses that fit them best."""
    for _ in range(_ROUNDS):
        placed = [transform_points(T, points) for T, points in zip(poses, known, strict=True)]
        every = np.concatenate(placed)
        nearest = np.linalg.norm(every[:, None] - scene[None], axis=2)
        label = np.where(nearest.min(axis=1) < 2 * near, nearest.argmin(axis=1), -1)
        scene = np.array([every[label == index].mean(axis=0) for index in np.unique(label[label >= 0])])
        poses = np.array([_fit(scene, points, T, near)[0] for T, points in zip(poses, known, strict=True)])
    return invert(poses[0]) @ poses


def _place(a: np.ndarray, b: np.ndarray, near: float, rng: np.random.Generator) -> tuple[np.ndarray | None, str]:
    """``T_a_b`` (4, 4) that brings most points (k, 3) of b onto those of a, or None and why."""
    needed = max(_FEWEST, int(np.ceil(_SHARE * min(len(a), len(b)))))
    if min(len(a), len(b)) < needed:
        return None, f"it shows {len(b)} objects, and {needed} must be shared"
    candidates = [_fit(a, b, T, near) for T in _guesses(a, b, near, rng)]
    candidates.sort(key=lambda found: -found[1])
    if not candidates or candidates[0][1] < needed:
        return (
            None,
            f"at most {candidates[0][1] if candidates else 0} objects agree with the other images, {needed} must",
        )
    best, count = candidates[0]
    for T, other in candidates[1:]:
        if other >= _AMBIGUOUS * count and np.linalg.norm(T - best, axis=(0, 1)) > 0.2:
            return None, f"two placements fit, with {count} and {other} objects"
    return best, ""


def _guesses(a: np.ndarray, b: np.ndarray, near: float, rng: np.random.Generator) -> list[np.ndarray]:
    """Placements of b that bring some triangle of its points onto an equal one of a."""
    sides = np.linalg.norm(a[:, None] - a[None], axis=2)
    found = []
    for _ in range(_TRIPLES):
        i, j, k = rng.choice(len(b), 3, replace=False)
        lengths = np.linalg.norm(b[[i, j, k]] - b[[j, k, i]], axis=1)
        if lengths.min() < 4 * near:
            continue
        first, second = np.nonzero(np.abs(sides - lengths[0]) < near)
        for p, q in zip(first, second, strict=True):
            fits = (np.abs(sides[q] - lengths[1]) < near) & (np.abs(sides[p] - lengths[2]) < near)
            found += [_align(a[[p, q, r]], b[[i, j, k]]) for r in np.flatnonzero(fits)]
    return found


def _fit(a: np.ndarray, b: np.ndarray, T: np.ndarray, near: float) -> tuple[np.ndarray, int]:
    """The placement improved by all points that agree, and their number."""
    pairs: tuple[np.ndarray, ...] = (np.zeros(0, int),)
    for _ in range(3):
        apart = np.linalg.norm(a[:, None] - transform_points(T, b)[None], axis=2)
        mutual = (apart == apart.min(axis=0)) & (apart == apart.min(axis=1, keepdims=True)) & (apart < near)
        pairs = np.nonzero(mutual)
        if len(pairs[0]) < 3:
            break
        T = _align(a[pairs[0]], b[pairs[1]])
    return T, len(pairs[0])


def _align(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """``T_a_b`` (4, 4) of least squares between corresponding points (k, 3)."""
    middle_a, middle_b = a.mean(axis=0), b.mean(axis=0)
    R = Rotation.align_vectors(a - middle_a, b - middle_b)[0].as_matrix()
    return make_transform(R, middle_a - R @ middle_b)


def upright(T_first_camera: np.ndarray, normal: np.ndarray, point: np.ndarray) -> np.ndarray:
    """(m, 4, 4) poses in a frame with z along (3,) ``normal`` and origin (3,) ``point``, both in the first camera."""
    z = normal / np.linalg.norm(normal)
    x = np.cross((0.0, 1.0, 0.0), z)
    x = x / np.linalg.norm(x) if np.linalg.norm(x) > 1e-6 else np.array([1.0, 0.0, 0.0])
    return invert(make_transform(np.stack([x, np.cross(z, x), z], axis=1), point)) @ T_first_camera
