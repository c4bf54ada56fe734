"""Pose errors by BOP's names and formulas, and the paper's score of a scene.

Every error takes ``T_est`` and ``T_gt`` whose leading dimensions broadcast: ``e_add(model, T_est[:, None], T_gt)`` is
the (k, n) table of all pairs. Both poses are in one frame, metres. Symmetries come from the model: an error is the
least one over the object's symmetry group, and a continuous axis is searched, not sampled: see
:func:`_least_over_symmetries`. Formulas: Hodan et al., "BOP: Benchmark for 6D Object Pose Estimation", and
Hinterstoisser et al. for ADD; conventions as in the paper's "Evaluation metrics" and supplement D.
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

#: Metres charged for an object without a matched hypothesis, and the most that any object is (paper, supplement D).
MISSED_E_ADD = 0.05
#: An object is detected when its e_ADD is below this fraction of the diameter (paper, "Evaluation metrics").
DETECTION_FRACTION = 0.1

_METRE_TOLERANCE = 5e-5
_PIXEL_TOLERANCE = 0.05
_COARSE_STEP = np.radians(10.0)
_CHUNK = 1_000_000


def e_add(model: ObjectModel, T_est: np.ndarray, T_gt: np.ndarray, *, cutoff: float = np.inf) -> np.ndarray:
    """Average distance of model points: min over S of mean over x of ``||T_est x - T_gt S x||``.

    Args:
        model: its ``error_points`` are averaged over.
        T_est: (..., 4, 4) estimated poses.
        T_gt: (..., 4, 4) true poses, broadcast against ``T_est``.
        cutoff: metres; an error known to be above it may come back as ``inf`` instead, which saves most of a table.

    Returns:
        (...,) metres, at most 0.05 mm too large for a continuous symmetry, otherwise exact.
    """
    return _point_error(model, T_est, T_gt, np.mean, cutoff)


def mssd(model: ObjectModel, T_est: np.ndarray, T_gt: np.ndarray, *, cutoff: float = np.inf) -> np.ndarray:
    """Maximum symmetry-aware surface distance (BOP): min over S of max over x of ``||T_est x - T_gt S x||``.

    Arguments, result and precision as for :func:`e_add`.
    """
    return _point_error(model, T_est, T_gt, np.max, cutoff)


def mspd(model: ObjectModel, T_est: np.ndarray, T_gt: np.ndarray, camera: PinholeCamera) -> np.ndarray:
    """Maximum symmetry-aware projection distance (BOP): min over S of max over x of the distance of both projections.

    Args:
        model: its ``error_points`` are projected.
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
    # A point moves by at most its axis distance times the angle; its image by that over depth, more off the axis.
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
    """ADD-S (BOP's ADI): mean over points x at the true pose of the distance to the nearest point at the estimate.

    Arguments as for :func:`e_add`; the model's symmetries play no part.

    Returns:
        (...,) metres.
    """
    leading, T_est, T_gt = _flatten(T_est, T_gt)
    geometry = _geometry(model)
    errors = np.full(len(T_est), np.inf)
    # The nearest points' mean distance is no shorter than the way from the true centroid to the estimate's hull.
    centroid = (
        transform_points(T_gt, geometry.centroid[None])[:, 0] - transform_points(T_est, geometry.centroid[None])[:, 0]
    )
    reach = np.linalg.norm(geometry.points - geometry.centroid, axis=1).max()
    for i in np.flatnonzero(np.linalg.norm(centroid, axis=1) - reach <= cutoff):
        errors[i] = geometry.tree.query(transform_points(invert(T_est[i]) @ T_gt[i], geometry.points))[0].mean()
    return errors.reshape(leading)


def match(errors: np.ndarray, missed: float = MISSED_E_ADD) -> np.ndarray:
    """One-to-one assignment of hypotheses to objects with the least total error.

    Args:
        errors: (k, n) error of each hypothesis against each object; ``inf`` is allowed.
        missed: what an object without a hypothesis costs; a pair at or above it is no match.

    Returns:
        (n,) index of each object's hypothesis, -1 without one.

    Raises:
        ValueError: an error is NaN.
    """
    if np.isnan(errors).any():
        raise ValueError("match: errors contain NaN")
    matched = np.full(errors.shape[1], -1)
    # Every hypothesis spared costs `missed`, so with the costs clipped there a full assignment is also the best one.
    rows, columns = linear_sum_assignment(np.minimum(errors, missed))
    good = errors[rows, columns] < missed
    matched[columns[good]] = rows[good]
    return matched


@dataclass(frozen=True, eq=False)
class SceneScore:
    """The paper's measures of n true objects.

    Attributes:
        e_add_mm: (n,) millimetres; 50 for an object without a hypothesis, and never more.
        matched: (n,) index of each object's hypothesis, -1 without one.
        detected: (n,) bool, e_ADD below 10 % of the diameter.
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
    """:func:`evaluate_scene` from a (k, n) table of e_ADD in metres; entries from ``missed`` on may be ``inf``.

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


def evaluate_scene(
    model: ObjectModel, T_est: np.ndarray, T_gt: np.ndarray, *, missed: float = MISSED_E_ADD
) -> SceneScore:
    """Score estimates against the truth: e_ADD, one-to-one, an object without a match charged ``missed``.

    Args:
        model: the object.
        T_est: (k, 4, 4) estimated poses in any frame.
        T_gt: (n, 4, 4) true poses in that frame, n > 0.
        missed: metres.

    Raises:
        ValueError: there is no true object, or a pose is not finite.
    """
    return score_errors(e_add(model, T_est[:, None], T_gt[None], cutoff=missed), model.diameter, missed)


@dataclass(frozen=True, eq=False)
class _Geometry:
    """What the errors need of a model's n error points.

    ``monomials`` (10, n) are the products of x, y, z, 1: with them a squared distance is one matrix product, because
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
    """Broadcast both to one list of pairs; returns the leading shape and two (m, 4, 4)."""
    T_est, T_gt = np.broadcast_arrays(T_est, T_gt)
    if not (np.isfinite(T_est).all() and np.isfinite(T_gt).all()):
        raise ValueError("pose errors need finite poses")
    return T_est.shape[:-2], T_est.reshape(-1, 4, 4), T_gt.reshape(-1, 4, 4)


def _chunks(count: int, width: int) -> list[slice]:
    """Slices of ``range(count)`` small enough that a (slice, width) table stays in the cache's neighbourhood."""
    size = max(1, _CHUNK // width)
    return [slice(start, start + size) for start in range(0, count, size)]


def _point_error(
    model: ObjectModel, T_est: np.ndarray, T_gt: np.ndarray, reduce: Callable[..., np.ndarray], cutoff: float
) -> np.ndarray:
    """Min over S of ``reduce`` (mean or max) over x of ``||T_est x - T_gt S x||``."""
    leading, T_est, T_gt = _flatten(T_est, T_gt)
    geometry = _geometry(model)
    relative = invert(T_gt) @ T_est
    # Mean and maximum are both no less than the distance of the centroids, which S moves by at most centroid_play.
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

    About a continuous axis this is branch and bound: an error changes by at most ``lipschitz`` per radian, so an
    interval of angles whose middle lies too high cannot hold the minimum; the others are cut in four until no interval
    can improve the best value by more than ``tolerance``. That is a guarantee, which sampling gives only at steps so
    fine (0.2 degrees for a cup) that it costs a hundred times as much.

    Args:
        symmetry: the group.
        evaluate: (q,) indices of pairs and (q, 3, 3) rotations to (q,) errors.
        lipschitz: (m,) most that a pair's error changes per radian about the axis.
        tolerance: of the result, in the error's unit.
        cutoff: errors above it need not be exact.

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
