"""Refines poses jointly over the depth images of several views, by visible-surface ICP in the world.

Each step takes the equations of every view at the pose rounded to a lattice (:mod:`.pose_lattice`). So the equations of
a view depend on the rounded pose alone and are remembered: another view costs its own equations, and results do not
depend on the order in which views came.
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from active6d_core.se3 import make_transform
from active6d_perception.compiled import compiled
from active6d_perception.model.visible_samples import VisibleSamples, direction_of
from active6d_perception.scene.measured_view import MeasuredView
from active6d_perception.scene.memo import Memo
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

    def refine(self, T_world_object: np.ndarray, views: Sequence[tuple[MeasuredView, Memo]]) -> np.ndarray:
        """Refine (k, 4, 4) poses, metres, over views with what is remembered of each.

        Returns:
            (k, 4, 4) poses; one with fewer than 6 pairs stays as it was.
        """
        T = np.array(T_world_object, float)
        for gate in self._gates:
            rounded, keys = round_poses(T, self._lattice)
            total = np.zeros((len(T), _COLUMNS))
            for view, memo in views:
                total += self._equations(rounded, keys, view, memo, gate)
            T = _step(T, rounded, total)
        return T

    def _equations(
        self, rounded: np.ndarray, keys: list[bytes], view: MeasuredView, memo: Memo, gate: float
    ) -> np.ndarray:
        def compute(missing: np.ndarray) -> np.ndarray:
            return normal_equations(rounded[missing], self._samples, view, gate, self._search)

        return memo.rows([(gate, id(self._samples), key) for key in keys], compute)


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
    W, J = view.T_camera_world, np.empty(_SIZE)
    for k in range(len(T_world_object)):
        P, row = W @ T_world_object[k], result[k]
        direction = direction_of(P, samples.nearest)
        for place in range(samples.number[direction]):
            s = samples.chosen[direction, place]
            a, b, c = samples.points[s, 0], samples.points[s, 1], samples.points[s, 2]
            ax = P[0, 0] * a + P[0, 1] * b + P[0, 2] * c
            ay = P[1, 0] * a + P[1, 1] * b + P[1, 2] * c
            az = P[2, 0] * a + P[2, 1] * b + P[2, 2] * c
            x, y, z = ax + P[0, 3], ay + P[1, 3], az + P[2, 3]
            if z < 1e-3:
                continue
            v, u = _nearest_pixel(x, y, z, view, gate, search)
            if v < 0:
                continue
            d, e, f = samples.normals[s, 0], samples.normals[s, 1], samples.normals[s, 2]
            nx = P[0, 0] * d + P[0, 1] * e + P[0, 2] * f
            ny = P[1, 0] * d + P[1, 1] * e + P[1, 2] * f
            nz = P[2, 0] * d + P[2, 1] * e + P[2, 2] * f
            if not (view.normals[v, u, 0] * nx + view.normals[v, u, 1] * ny + view.normals[v, u, 2] * nz > _ALIKE):
                continue
            qx, qy, qz = view.points[v, u, 0] - x, view.points[v, u, 1] - y, view.points[v, u, 2] - z
            tx, ty, tz = ay * nz - az * ny, az * nx - ax * nz, ax * ny - ay * nx
            for i in range(3):
                J[i] = W[0, i] * tx + W[1, i] * ty + W[2, i] * tz
                J[3 + i] = W[0, i] * nx + W[1, i] * ny + W[2, i] * nz
            _add(J, qx * nx + qy * ny + qz * nz, row)
    return result


@compiled
def _add(J: np.ndarray, residual: float, row: np.ndarray) -> None:
    """Add a pair with (6,) Jacobian to (28,) equations."""
    column = 0
    for i in range(6):
        row[21 + i] += J[i] * residual
        for j in range(i, 6):
            row[column] += J[i] * J[j]
            column += 1
    row[27] += 1


@compiled
def _nearest_pixel(x: float, y: float, z: float, view: MeasuredView, gate: float, search: bool) -> tuple[int, int]:
    """Row and column of the measured point nearest to a point in the optical frame; -1 without one within ``gate``."""
    u, v = x / z * view.fx + view.cx, y / z * view.fy + view.cy
    if not search:
        row, column, _ = _nearest_within(x, y, z, np.rint(u), np.rint(v), 0.0, view, gate * gate)
        return row, column
    row, column, least = _nearest_within(x, y, z, u, v, 1.0, view, gate * gate)
    # The nearest point of the first pixels bounds how far away a nearer one can be.
    reach = np.sqrt(least) * view.fx / z
    if reach > 1.0:
        further = _nearest_within(x, y, z, u, v, reach, view, least)
        if further[0] >= 0:
            row, column = further[0], further[1]
    return row, column


@compiled
def _nearest_within(
    x: float, y: float, z: float, u: float, v: float, reach: float, view: MeasuredView, least: float
) -> tuple[int, int, float]:
    """As :func:`_nearest_pixel`, within ``reach`` pixels of (u, v) and the squared distance ``least``; and that one."""
    height, width = view.instance.shape
    row, column = -1, -1
    for i in range(max(int(np.ceil(v - reach)), 0), min(int(np.floor(v + reach)) + 1, height)):
        for j in range(max(int(np.ceil(u - reach)), 0), min(int(np.floor(u + reach)) + 1, width)):
            dx, dy, dz = view.points[i, j, 0] - x, view.points[i, j, 1] - y, view.points[i, j, 2] - z
            square = dx * dx + dy * dy + dz * dz
            if square < least:
                row, column, least = i, j, square
    return row, column, least
