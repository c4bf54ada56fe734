"""Pose errors by BOP's names and formulas, and the paper's score of a scene.

The leading dimensions of ``T_est`` and ``T_gt`` broadcast: ``e_add(model, T_est[:, None], T_gt)`` is the (k, n) table
of all pairs. Both poses are in one frame, in metres. An error is the least one over the object's symmetry group. For a
continuous axis the minimum is searched for and not sampled, see :func:`_least_over_symmetries`.

Formulas: Hodan et al., "BOP: Benchmark for 6D Object Pose Estimation", and Hinterstoisser et al. for ADD. Conventions
are those of the paper, "Evaluation metrics" and supplement D. The paper writes e_ADD for ADD with symmetries.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from active6d_core.camera import PinholeCamera, project
from active6d_core.object_model import ObjectModel, Symmetry
from active6d_core.se3 import invert, make_transform, transform_points

#: Error in metres of an object without a matched hypothesis, and the largest of any object (paper, supplement D).
MISSED_E_ADD = 0.05
#: An object is detected if its ADD is below this fraction of the diameter (paper, "Evaluation metrics").
DETECTION_FRACTION = 0.1

_METRE_TOLERANCE = 5e-5
_PIXEL_TOLERANCE = 0.05
_COARSE_STEP = np.radians(10.0)
_CHUNK = 1_000_000


def e_add(model: ObjectModel, T_est: np.ndarray, T_gt: np.ndarray, *, cutoff: float = np.inf) -> np.ndarray:
    """ADD with symmetries: min over S of mean over x of ``||T_est x - T_gt S x||``.

    Args:
        model: the object; x are its ``error_points``, S its symmetries.
        T_est: (..., 4, 4) estimated poses.
        T_gt: (..., 4, 4) true poses, broadcast against ``T_est``.
        cutoff: metres; larger errors may be returned as ``inf``, which saves most of the work on a table.

    Returns:
        (...,) metres, at most 0.05 mm too large for a continuous symmetry, otherwise exact.

    Raises:
        ValueError: a pose is not finite.
    """
    return _point_error(model, T_est, T_gt, np.mean, cutoff)


def mssd(model: ObjectModel, T_est: np.ndarray, T_gt: np.ndarray, *, cutoff: float = np.inf) -> np.ndarray:
    """Maximum symmetry-aware surface distance (BOP): min over S of max over x of ``||T_est x - T_gt S x||``.

    Arguments, result and precision as for :func:`e_add`.
    """
    return _point_error(model, T_est, T_gt, np.max, cutoff)


def mspd(model: ObjectModel, T_est: np.ndarray, T_gt: np.ndarray, camera: PinholeCamera) -> np.ndarray:
    """Maximum symmetry-aware projection distance (BOP): min over S of max over x of the distance in the image.

    Args:
        model: the object; x are its ``error_points``, S its symmetries.
        T_est: (..., 4, 4) estimated poses in the optical frame.
        T_gt: (..., 4, 4) true poses in the optical frame, broadcast against ``T_est``.
        camera: intrinsics.

    Returns:
        (...,) pixels, at most 0.05 px too large for a continuous symmetry; ``inf`` where either pose reaches behind
        the camera.
    """
    leading, T_est, T_gt = _flatten(T_est, T_gt)
    geometry = _geometry(model)
    reach = np.linalg.norm(geometry.points, axis=1).max()
    in_front = np.minimum(T_est[:, 2, 3], T_gt[:, 2, 3]) > reach
    errors = np.full(len(T_est), np.inf)
    T_est, T_gt = T_est[in_front], T_gt[in_front]
    nearest = T_gt[:, 2, 3] - reach
    slant = (np.linalg.norm(T_gt[:, :2, 3], axis=1) + reach) / nearest
    # A point moves by at most its distance from the axis times the angle. Its image moves by that over the depth, and
    # by more away from the principal point.
    lipschitz = max(camera.fx, camera.fy) * geometry.axis_distance.max() / nearest * np.hypot(1.0, slant)

    def evaluate(pair: np.ndarray, S: np.ndarray) -> np.ndarray:
        worst = np.empty(len(pair))
        for part in _chunks(len(pair), len(geometry.points)):
            T = T_gt[pair[part]]
            seen = project(transform_points(T_est[pair[part]], geometry.points), camera)
            true = project(
                transform_points(make_transform(T[:, :3, :3] @ S[part], T[:, :3, 3]), geometry.points), camera
            )
            worst[part] = np.linalg.norm(seen - true, axis=-1).max(axis=1)
        return worst

    errors[in_front] = _least_over_symmetries(model.symmetry, evaluate, lipschitz, _PIXEL_TOLERANCE, np.inf)
    return errors.reshape(leading)


def add_s(model: ObjectModel, T_est: np.ndarray, T_gt: np.ndarray, *, cutoff: float = np.inf) -> np.ndarray:
    """ADD-S (ADI in BOP): mean over points at the true pose of the distance to the nearest point at the estimate.

    Arguments and errors as for :func:`e_add`; the model's symmetries are not used.

    Returns:
        (...,) metres.
    """
    leading, T_est, T_gt = _flatten(T_est, T_gt)
    geometry = _geometry(model)
    errors = np.full(len(T_est), np.inf)
    # The mean distance is at least the distance of the true centroid from the convex hull at the estimate.
    centroid = (
        transform_points(T_gt, geometry.centroid[None])[:, 0] - transform_points(T_est, geometry.centroid[None])[:, 0]
    )
    reach = np.linalg.norm(geometry.points - geometry.centroid, axis=1).max()
    for i in np.flatnonzero(np.linalg.norm(centroid, axis=1) - reach <= cutoff):
        errors[i] = geometry.tree.query(transform_points(invert(T_est[i]) @ T_gt[i], geometry.points))[0].mean()
    return errors.reshape(leading)


def match(errors: np.ndarray, missed: float = MISSED_E_ADD) -> np.ndarray:
    """Find the one-to-one assignment of hypotheses to objects with the least total error.

    Args:
        errors: (k, n) error of each hypothesis against each object; ``inf`` is allowed.
        missed: error of an object without a hypothesis; pairs match only if their error is below this.

    Returns:
        (n,) index of each object's hypothesis, -1 without a match.

    Raises:
        ValueError: an error is NaN.
    """
    if np.isnan(errors).any():
        raise ValueError("match: errors contain NaN")
    matched = np.full(errors.shape[1], -1)
    # With costs clipped at `missed`, a pair at that cost is the same as no match, so a full assignment is optimal.
    rows, columns = linear_sum_assignment(np.minimum(errors, missed))
    good = errors[rows, columns] < missed
    matched[columns[good]] = rows[good]
    return matched


@dataclass(frozen=True, eq=False)
class SceneScore:
    """The paper's scores of n true objects.

    Attributes:
        e_add_mm: (n,) ADD in millimetres, at most 50, which is the value of an object without a hypothesis.
        matched: (n,) index of each object's hypothesis, -1 without a match.
        detected: (n,) bool, whether ADD is below 10 % of the diameter.
    """

    e_add_mm: np.ndarray
    matched: np.ndarray
    detected: np.ndarray

    @property
    def detection_rate(self) -> float:
        """Fraction of the objects that are detected."""
        return float(self.detected.mean())

    @property
    def mean_e_add_mm(self) -> float:
        """Mean error over the objects, millimetres."""
        return float(self.e_add_mm.mean())


def score_errors(errors: np.ndarray, diameter: float, missed: float = MISSED_E_ADD) -> SceneScore:
    """As :func:`evaluate_scene`, from a table of errors.

    Args:
        errors: (k, n) ADD in metres; entries from ``missed`` on may be ``inf``.
        diameter: the object's, metres.
        missed: error of an object without a hypothesis, metres.

    Raises:
        ValueError: the table has no object, or contains NaN.
    """
    if errors.shape[1] == 0:
        raise ValueError("a scene without objects has no score")
    matched = match(errors, missed)
    charged = np.full(len(matched), missed)
    found = matched >= 0
    charged[found] = errors[matched[found], np.flatnonzero(found)]
    return SceneScore(1e3 * charged, matched, found & (charged < DETECTION_FRACTION * diameter))


def score_confirmed(errors: np.ndarray, confirmed: np.ndarray, diameter: float) -> tuple[float, int, int]:
    """What counts if only the confirmed ones of k reported objects do.

    Args:
        errors: (k, n) ADD in metres, as for :func:`score_errors`.
        confirmed: (k,) bool.
        diameter: the object's, metres.

    Returns:
        The fraction of the true objects that confirmed objects detect, the number of confirmed objects, and how many
        of these detect no object. A second object at the same place is not counted as wrong.
    """
    own = errors[confirmed]
    rate = score_errors(own, diameter).detection_rate
    return rate, len(own), int((~(own < DETECTION_FRACTION * diameter).any(axis=1)).sum())


def evaluate_scene(
    model: ObjectModel, T_est: np.ndarray, T_gt: np.ndarray, *, missed: float = MISSED_E_ADD
) -> SceneScore:
    """Score estimated poses against the true ones: ADD after one-to-one matching.

    Args:
        model: the object.
        T_est: (k, 4, 4) estimated poses in any frame.
        T_gt: (n, 4, 4) true poses in that frame, n > 0.
        missed: error of an object without a hypothesis, metres.

    Raises:
        ValueError: there is no true object, or a pose is not finite.
    """
    return score_errors(e_add(model, T_est[:, None], T_gt[None], cutoff=missed), model.diameter, missed)


@dataclass(frozen=True, eq=False)
class _Geometry:
    """Precomputed quantities of a model's n error points.

    ``monomials`` (10, n) are the products of x, y, z, 1. With them squared distances are one matrix product, because
    ``||A x + t||^2`` is a quadratic form in (x, 1).
    """

    points: np.ndarray
    monomials: np.ndarray
    centroid: np.ndarray
    axis_distance: np.ndarray
    centroid_play: float
    tree: cKDTree


_UPPER = np.triu_indices(4)
_DOUBLED = np.where(_UPPER[0] == _UPPER[1], 1.0, 2.0)


@lru_cache(maxsize=16)
def _geometry(model: ObjectModel) -> _Geometry:
    points = model.error_points
    homogeneous = np.c_[points, np.ones(len(points))]
    centroid = points.mean(axis=0)
    axis = model.symmetry.axis
    off_axis = np.zeros_like(points) if axis is None else points - np.outer(points @ axis, axis)
    centroid_off_axis = 0.0 if axis is None else np.linalg.norm(centroid - (centroid @ axis) * axis)
    return _Geometry(
        points=points,
        monomials=(homogeneous[:, _UPPER[0]] * homogeneous[:, _UPPER[1]]).T.copy(),
        centroid=centroid,
        axis_distance=np.linalg.norm(off_axis, axis=1),
        centroid_play=np.linalg.norm(model.symmetry.discrete @ centroid - centroid, axis=1).max()
        + 2 * centroid_off_axis,
        tree=cKDTree(points),
    )


def _flatten(T_est: np.ndarray, T_gt: np.ndarray) -> tuple[tuple[int, ...], np.ndarray, np.ndarray]:
    """Broadcast both to one list of m pairs; returns the leading shape and two (m, 4, 4) arrays."""
    T_est, T_gt = np.broadcast_arrays(T_est, T_gt)
    if not (np.isfinite(T_est).all() and np.isfinite(T_gt).all()):
        raise ValueError("pose errors need finite poses")
    return T_est.shape[:-2], T_est.reshape(-1, 4, 4), T_gt.reshape(-1, 4, 4)


def _chunks(count: int, width: int) -> list[slice]:
    """Slices of ``range(count)`` small enough that a (slice, width) table is about as large as the cache."""
    size = max(1, _CHUNK // width)
    return [slice(start, start + size) for start in range(0, count, size)]


def _point_error(
    model: ObjectModel, T_est: np.ndarray, T_gt: np.ndarray, reduce: Callable[..., np.ndarray], cutoff: float
) -> np.ndarray:
    """Min over S of ``reduce`` (mean or max) over x of ``||T_est x - T_gt S x||``."""
    leading, T_est, T_gt = _flatten(T_est, T_gt)
    geometry = _geometry(model)
    relative = invert(T_gt) @ T_est
    # Mean and maximum are at least the distance of the centroids, which S changes by at most centroid_play.
    shift = np.linalg.norm(transform_points(relative, geometry.centroid[None])[:, 0] - geometry.centroid, axis=1)
    near = shift - geometry.centroid_play <= cutoff
    relative = relative[near, :3]

    def evaluate(pair: np.ndarray, S: np.ndarray) -> np.ndarray:
        error = np.empty(len(pair))
        for part in _chunks(len(pair), len(geometry.points)):
            residual = relative[pair[part]]
            residual[:, :, :3] -= S[part]
            form = np.swapaxes(residual, 1, 2) @ residual
            squared = (form[:, _UPPER[0], _UPPER[1]] * _DOUBLED) @ geometry.monomials
            error[part] = reduce(np.sqrt(np.maximum(squared, 0.0, out=squared), out=squared), axis=1)
        return error

    lipschitz = np.full(len(relative), reduce(geometry.axis_distance))
    errors = np.full(len(T_est), np.inf)
    errors[near] = _least_over_symmetries(model.symmetry, evaluate, lipschitz, _METRE_TOLERANCE, cutoff)
    return errors.reshape(leading)


def _least_over_symmetries(
    symmetry: Symmetry,
    evaluate: Callable[[np.ndarray, np.ndarray], np.ndarray],
    lipschitz: np.ndarray,
    tolerance: float,
    cutoff: float,
) -> np.ndarray:
    """Minimum of an error over the symmetry group, for m pairs at once.

    For a continuous axis this is branch and bound. An error changes by at most ``lipschitz`` per radian, so an interval
    of angles whose middle has a large error cannot contain the minimum. The other intervals are cut in four, until none
    can improve the best value by more than ``tolerance``. Sampling with the same guarantee needs steps of 0.2 degrees
    for a cup, which takes a hundred times as long.

    Args:
        symmetry: the group.
        evaluate: (q,) indices of pairs and (q, 3, 3) rotations to (q,) errors.
        lipschitz: (m,) largest change of a pair's error per radian about the axis.
        tolerance: of the result, in the unit of the error.
        cutoff: larger errors need not be exact.

    Returns:
        (m,) errors.
    """
    m, s = len(lipschitz), len(symmetry.discrete)
    if symmetry.axis is None:
        pair, which = np.repeat(np.arange(m), s), np.tile(np.arange(s), m)
        return evaluate(pair, symmetry.discrete[which]).reshape(m, s).min(axis=1)
    coarse = np.arange(0.0, 2 * np.pi, _COARSE_STEP)
    pair, which, angle = (grid.ravel() for grid in np.meshgrid(np.arange(m), np.arange(s), coarse, indexing="ij"))
    half = _COARSE_STEP / 2
    best = np.full(m, np.inf)
    while len(pair):
        about_axis = Rotation.from_rotvec(angle[:, None] * symmetry.axis).as_matrix()
        errors = evaluate(pair, about_axis @ symmetry.discrete[which])
        np.minimum.at(best, pair, errors)
        bound = errors - lipschitz[pair] * half
        open_ = (bound < best[pair] - tolerance) & (bound <= cutoff)
        half /= 4
        pair, which = np.repeat(pair[open_], 4), np.repeat(which[open_], 4)
        angle = (angle[open_, None] + half * np.array([-3.0, -1.0, 1.0, 3.0])).ravel()
    return best
