"""Camera poses of images of one heap from the objects found in them, where a recording has none."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from active6d_core.object_model import ObjectModel
from active6d_core.se3 import invert, make_transform, transform_points
from active6d_perception.model.symmetric_distance import SymmetricDistance

#: Objects of two images are the same if their centres then are this near, as a fraction of the diameter. On real
#: images the estimator's centres, intrinsics and meshes are each off by millimetres.
_NEAR = 0.12
#: Two such poses agree if they are at most this far apart, as a fraction of the diameter.
_AGREES = 0.3
#: Objects that two images must share.
FEWEST_SHARED = 5
#: Their least share of those of the smaller image.
_SHARE = 0.5
#: A second placement that fits as well as this share of the best makes the pair ambiguous.
_AMBIGUOUS = 0.75
#: Three points whose longest side is this share of the circumference are nearly on a line, and fix no rotation.
_FLATTEST = 0.49
_TRIPLES = 150
_ROUNDS = 10


def register_views(
    poses: Sequence[np.ndarray], model: ObjectModel, seed: int = 0
) -> tuple[dict[int, np.ndarray], dict[int, str]]:
    """Poses of cameras in the frame of the first, from the objects that each of m images shows.

    Each image is placed among the objects of all images placed before it. Positions decide where it can be, and of
    several such places the one where most rotations agree, too. So some wrong rotations do no harm.

    Args:
        poses: m times (k, 4, 4) ``T_camera_object`` in the optical frame, metres.
        model: of the object.
        seed: of the search.

    Returns:
        (4, 4) ``T_first_camera`` of the images that can be placed, by rising index, and why the others cannot: they
        share too few objects with the others, or fit in two ways. The search begins with the image of most objects.
    """
    rng, placing = np.random.default_rng(seed), _Placing(model)
    first = max(range(len(poses)), key=lambda index: len(poses[index]))
    placed, scene = {first: np.eye(4)}, poses[first]
    waiting = {index: "" for index in range(len(poses)) if index != first}
    # How many objects were known when an image was tried last: it fits no better before there are more.
    tried = dict.fromkeys(waiting, -1)
    while stale := [index for index in waiting if tried[index] < len(scene)]:
        index = min(stale, key=tried.__getitem__)
        tried[index] = len(scene)
        T, waiting[index] = placing.place(scene, poses[index], rng)
        if T is None:
            continue
        placed[index] = T
        del waiting[index]
        seen = T @ poses[index]
        apart = np.linalg.norm(seen[:, None, :3, 3] - scene[None, :, :3, 3], axis=2)
        scene = np.concatenate([scene, seen[apart.min(axis=1, initial=np.inf) > 2 * placing.near]])
    order = sorted(placed)
    centres = [poses[index][:, :3, 3] for index in order]
    refined = _refine(np.array([placed[index] for index in order]), centres, scene[:, :3, 3], placing.near)
    return dict(zip(order, refined, strict=True)), waiting


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


class _Placing:
    """Places one image among objects.

    Attributes:
        near: centres of one object are at most this far apart, metres.
    """

    def __init__(self, model: ObjectModel) -> None:
        self.near, self._agrees = _NEAR * model.diameter, _AGREES * model.diameter
        self._distance = SymmetricDistance(model).between

    def place(self, a: np.ndarray, b: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray | None, str]:
        """``T_a_b`` (4, 4) that brings most poses (k, 4, 4) of b onto those of a, or None and why."""
        needed = max(FEWEST_SHARED, int(np.ceil(_SHARE * min(len(a), len(b)))))
        if min(len(a), len(b)) < needed:
            return None, f"it shows {min(len(a), len(b))} objects, and {needed} must be shared"
        points = a[:, :3, 3], b[:, :3, 3]
        candidates = [_fit(*points, T, self.near) for T in _guesses(*points, self.near, rng)]
        most = max((len(pairs) for _, pairs in candidates), default=0)
        if most < needed:
            return None, f"at most {most} objects agree with the other images, {needed} must"
        # Only a placement of nearly as many objects can be as good, since each of them counts twice at most.
        rated = [
            (len(pairs) + self._count_agreeing(a, b, T, pairs), len(pairs), T)
            for T, pairs in candidates
            if len(pairs) >= 0.5 * _AMBIGUOUS * most
        ]
        worth, count, best = max(rated, key=lambda each: each[:2])
        if count < needed:
            return None, f"at most {count} objects agree with the other images, {needed} must"
        for other, shared, T in rated:
            if other >= _AMBIGUOUS * worth and np.linalg.norm(T - best, axis=(0, 1)) > 0.2:
                return None, f"two placements fit, with {count} and {shared} objects"
        return best, ""

    def _count_agreeing(self, a: np.ndarray, b: np.ndarray, T: np.ndarray, pairs: np.ndarray) -> int:
        """How many of (m, 2) pairs have nearly the same pose, and not only the same centre."""
        apart = self._distance(a[pairs[:, 0]], T @ b[pairs[:, 1]])
        return int(np.count_nonzero(np.diagonal(apart) < self._agrees))


def _guesses(a: np.ndarray, b: np.ndarray, near: float, rng: np.random.Generator) -> list[np.ndarray]:
    """Placements of b that bring some triangle of its points onto an equal one of a."""
    sides = np.linalg.norm(a[:, None] - a[None], axis=2)
    found = []
    for _ in range(_TRIPLES):
        i, j, k = rng.choice(len(b), 3, replace=False)
        lengths = np.linalg.norm(b[[i, j, k]] - b[[j, k, i]], axis=1)
        if lengths.min() < 4 * near or lengths.max() > _FLATTEST * lengths.sum():
            continue
        first, second = np.nonzero(np.abs(sides - lengths[0]) < near)
        for p, q in zip(first, second, strict=True):
            fits = (np.abs(sides[q] - lengths[1]) < near) & (np.abs(sides[p] - lengths[2]) < near)
            found += [_align(a[[p, q, r]], b[[i, j, k]]) for r in np.flatnonzero(fits)]
    return found


def _fit(a: np.ndarray, b: np.ndarray, T: np.ndarray, near: float) -> tuple[np.ndarray, np.ndarray]:
    """The placement improved by all points that agree, and (m, 2) indices of these in a and b."""
    pairs = np.zeros((0, 2), int)
    for _ in range(3):
        apart = np.linalg.norm(a[:, None] - transform_points(T, b)[None], axis=2)
        mutual = (apart == apart.min(axis=0)) & (apart == apart.min(axis=1, keepdims=True)) & (apart < near)
        pairs = np.argwhere(mutual)
        if len(pairs) < 3:
            break
        T = _align(a[pairs[:, 0]], b[pairs[:, 1]])
    return T, pairs


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
