"""Refines poses jointly over the depth images of several views, by visible-surface ICP in the world.

Each step takes the equations of every view at the pose rounded to a lattice (:mod:`.pose_lattice`). So the equations of
a view depend on the rounded pose alone, and their sum is cached: a new view adds only its own equations, and the result
does not depend on the order of views.
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from active6d_core.se3 import make_transform
from active6d_perception.compiled import compiled
from active6d_perception.model.visible_samples import VisibleSamples, direction_of
from active6d_perception.scene.measured_view import NORMAL, MeasuredView
from active6d_perception.scene.memo import ViewSums
from active6d_perception.scene.pose_lattice import round_poses

_ALIKE = 0.5  # cosine between normals of a pair
_LEAST_PAIRS = 6
_DAMPING = 1e-4  # of the mean diagonal entry
_LARGEST_TURN = 0.4  # radians in one step
_SIZE = 6
_UPPER = np.triu_indices(_SIZE)
_COLUMNS = len(_UPPER[0]) + _SIZE + 1


class BodyRefinement:
    """Point-to-plane ICP of poses against the measured points of all views at once.

    A sample that a camera sees is paired with a measured point that is within the gate and has a similar normal. What
    other objects hide is farther than the gate behind them and has no pair. The planes are the model's, which have no
    noise.

    Args:
        samples: of the part of the surface to align.
        gates: largest distance of a pair in each step, metres.
        lattice: step of the lattice, metres; a finer one gives finer poses, a coarser one remembers more.
        search: whether the nearest point is searched for around a sample's pixel. That point is found even where the
            pose is off; without a search the sample's own pixel is taken, in a third of the time.
    """

    def __init__(
        self, samples: VisibleSamples, gates: tuple[float, ...], lattice: float, *, search: bool = True
    ) -> None:
        self._samples, self._gates, self._lattice, self._search = samples, gates, lattice, search

    def refine(self, T_world_object: np.ndarray, sums: ViewSums) -> np.ndarray:
        """Refine (k, 4, 4) poses, metres, over the views of ``sums``.

        Returns:
            (k, 4, 4) poses; one with fewer than 6 pairs stays as it was.
        """
        T = np.array(T_world_object, float)
        for gate in self._gates:
            rounded, keys = round_poses(T, T_world_object, self._lattice)
            T = _step(T, rounded, self._equations(rounded, keys, sums, gate))
        return T

    def _equations(self, rounded: np.ndarray, keys: list[bytes], sums: ViewSums, gate: float) -> np.ndarray:
        def compute(missing: np.ndarray, view: MeasuredView) -> np.ndarray:
            return normal_equations(rounded[missing], self._samples, view, gate, self._search)

        return sums.sums([(gate, id(self._samples), key) for key in keys], compute, np.zeros(_COLUMNS))


def refine_poses(
    T_world_object: np.ndarray,
    samples: VisibleSamples,
    views: Sequence[MeasuredView],
    gates: tuple[float, ...],
    *,
    search: bool,
) -> np.ndarray:
    """:meth:`BodyRefinement.refine` without rounding and without remembering anything."""
    T = np.array(T_world_object, float)
    for gate in gates:
        total = np.zeros((len(T), _COLUMNS))
        for view in views:
            total += normal_equations(T, samples, view, gate, search)
        T = _step(T, T, total)
    return T


def _step(T: np.ndarray, rounded: np.ndarray, equations: np.ndarray) -> np.ndarray:
    """Gauss-Newton step from (k, 4, 4) rounded poses by (k, columns) equations; ``T`` where there are too few pairs."""
    A = np.zeros((len(T), _SIZE, _SIZE))
    A[:, _UPPER[0], _UPPER[1]] = equations[:, : len(_UPPER[0])]
    A[:, _UPPER[1], _UPPER[0]] = equations[:, : len(_UPPER[0])]
    # Damping keeps the pose from moving where the points leave it free, as about the axis of a cup.
    A += np.eye(_SIZE) * (_DAMPING * np.trace(A, axis1=1, axis2=2)[:, None, None] / _SIZE + 1e-12)
    step = np.linalg.solve(A, equations[:, len(_UPPER[0]) : -1, None])[..., 0]
    angle = np.linalg.norm(step[:, :3], axis=1, keepdims=True)
    step[:, :3] *= np.minimum(1.0, _LARGEST_TURN / np.maximum(angle, 1e-12))
    moved = make_transform(
        Rotation.from_rotvec(step[:, :3]).as_matrix() @ rounded[:, :3, :3], rounded[:, :3, 3] + step[:, 3:]
    )
    return np.where((equations[:, -1] >= _LEAST_PAIRS)[:, None, None], moved, T)


@compiled
def normal_equations(
    T_world_object: np.ndarray, samples: VisibleSamples, view: MeasuredView, gate: float, search: bool
) -> np.ndarray:
    """The normal equations of one view's pairs, for a rotation about each pose's origin and a shift, in world axes.

    Args:
        T_world_object: (k, 4, 4) metres.
        samples: of the surface to align.
        view: what was measured.
        gate: largest distance of a pair, metres.
        search: see :class:`BodyRefinement`.

    Returns:
        (k, 28): the upper half of the matrix by rows, the right side, and the number of pairs.
    """
    result = np.zeros((len(T_world_object), _COLUMNS))
    # Loops are in functions of their own that are called once per pose: a call that hands over arrays takes as long
    # as a pair.
    rows, measured = np.empty((samples.chosen.shape[1], 6)), np.empty((samples.chosen.shape[1], 3))
    for k in range(len(T_world_object)):
        P = view.T_camera_world @ T_world_object[k]
        count = _place(P, direction_of(P, samples.nearest), samples, rows)
        _pair(rows, P[:3, 3], count, view, gate, search, measured)
        _add_pairs(rows, P[:3, 3], count, view.T_camera_world, measured, result[k])
    return result


@compiled
def _place(P: np.ndarray, direction: int, samples: VisibleSamples, rows: np.ndarray) -> int:
    """Set the first (n, 6) ``rows`` to the samples' offsets from a (4, 4) pose and normals, optical frame; n."""
    count = samples.number[direction]
    for place in range(count):
        s = samples.chosen[direction, place]
        a, b, c = samples.points[s, 0], samples.points[s, 1], samples.points[s, 2]
        d, e, f = samples.normals[s, 0], samples.normals[s, 1], samples.normals[s, 2]
        for axis in range(3):
            rows[place, axis] = P[axis, 0] * a + P[axis, 1] * b + P[axis, 2] * c
            rows[place, 3 + axis] = P[axis, 0] * d + P[axis, 1] * e + P[axis, 2] * f
    return count


@compiled
def _pair(
    rows: np.ndarray, t: np.ndarray, count: int, view: MeasuredView, gate: float, search: bool, measured: np.ndarray
) -> None:
    """Set (n, 3) ``measured`` to the points that n ``rows`` at (3,) ``t`` are paired with, NaN without one."""
    height, width = view.depth.shape
    for place in range(count):
        measured[place, 0] = np.nan
        x, y, z = rows[place, 0] + t[0], rows[place, 1] + t[1], rows[place, 2] + t[2]
        if z < 1e-3:
            continue
        u, v = int(np.rint(x / z * view.fx + view.cx)), int(np.rint(y / z * view.fy + view.cy))
        row, column, least, reach = -1, -1, gate * gate, 1 if search else 0
        # The nearest point of the first pixels bounds how far away a nearer one can be.
        for _ in range(2):
            for i in range(max(v - reach, 0), min(v + reach + 1, height)):
                for j in range(max(u - reach, 0), min(u + reach + 1, width)):
                    depth = view.depth[i, j]
                    dx, dy = (j - view.cx) / view.fx * depth - x, (i - view.cy) / view.fy * depth - y
                    square = dx * dx + dy * dy + (depth - z) ** 2
                    if square < least:
                        row, column, least = i, j, square
            reach = int(np.sqrt(least) * view.fx / z + 0.5)
            if not search or reach <= 1:
                break
        if row >= 0:
            normal, nx, ny, nz = view.normals[row, column], rows[place, 3], rows[place, 4], rows[place, 5]
            if normal[0] * nx + normal[1] * ny + normal[2] * nz > _ALIKE * NORMAL:
                depth = view.depth[row, column]
                measured[place, 0] = (column - view.cx) / view.fx * depth
                measured[place, 1], measured[place, 2] = (row - view.cy) / view.fy * depth, depth


@compiled
def _add_pairs(
    rows: np.ndarray, t: np.ndarray, count: int, W: np.ndarray, measured: np.ndarray, equations: np.ndarray
) -> None:
    """Add n pairs to (28,) ``equations`` in world axes; (4, 4) ``W`` maps the world to the optical frame."""
    J = np.empty(_SIZE)
    for place in range(count):
        qx = measured[place, 0]
        if np.isnan(qx):
            continue
        ax, ay, az, nx, ny, nz = rows[place]
        residual = (qx - ax - t[0]) * nx + (measured[place, 1] - ay - t[1]) * ny + (measured[place, 2] - az - t[2]) * nz
        tx, ty, tz = ay * nz - az * ny, az * nx - ax * nz, ax * ny - ay * nx
        for i in range(3):
            J[i] = W[0, i] * tx + W[1, i] * ty + W[2, i] * tz
            J[3 + i] = W[0, i] * nx + W[1, i] * ny + W[2, i] * nz
        column = 0
        for i in range(_SIZE):
            equations[21 + i] += J[i] * residual
            for j in range(i, _SIZE):
                equations[column] += J[i] * J[j]
                column += 1
        equations[27] += 1
