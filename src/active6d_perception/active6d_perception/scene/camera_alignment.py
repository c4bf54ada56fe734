"""Corrects the poses of cameras against each other, by their depth images (point-to-plane ICP).

A robot knows the pose of its camera to some millimetres and tenths of a degree. The depth image of a new view is
aligned with those of the nearest views before it. Instances look alike, so the surfaces are compared and not the
objects: what is beside and below them tells as much. Poses that are right to a millimetre are left as they are.

The first view keeps its pose, so all corrected poses are in a frame that is off by the error of the first view. A view
that shows nothing of what the views before it show keeps its pose as well, and later views are aligned with both. The
errors of several views cancel: the mean of all corrections estimates that of the first view, see
:attr:`CameraAlignment.T_world_anchor`.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation

from active6d_core.episode_views import views_from
from active6d_core.se3 import invert, make_transform, transform_points
from active6d_perception.compiled import compiled
from active6d_perception.scene.measured_view import NORMAL, MeasuredView, move_view

# Points of a new view that are compared, at most, out of every so many rows and columns.
_POINTS, _STRIDE = 1500, 2
# Views that a new one is aligned with.
_NEAREST = 3
# Largest distance of a pair, metres: of the step that shows whether a pose is right, and of those that correct it.
_FIRST_GATE = 0.02
_GATES = (0.05, 0.05, 0.035, 0.025, 0.02, 0.015, 0.012) + 8 * (0.01,)
# Steps of the finest gate end when one moves the scene less than this, metres.
_STILL = 0.0002
# Where a correction is large or its pairs are few, these shifts along the table are tried as well, metres.
_STARTS = 0.015 * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
_LARGE, _FEW = 0.008, 0.7
# Another correction, or none, is only given up for one with this much more of the pairs.
_BETTER = 0.04
# A pose with less of the pairs is not confirmed: right ones have .36 or more, or none where views share no surface.
_LEAST_SHARE = 0.25
# Surfaces are sampled evenly over the directions of their normals: those of the faces, edges and corners of a cube.
_DIRECTIONS = np.array([each for each in product((-1.0, 0.0, 1.0), repeat=3) if any(each)])
_DIRECTIONS /= np.linalg.norm(_DIRECTIONS, axis=1, keepdims=True)
# A pose is right if a step moves the scene less than this, metres.
_RIGHT = 0.001
# Cosine between the normals of a pair, at least.
_ALIKE = 0.6
# Directions of motion with less than this share of the pairs' weight are not moved along: nothing holds them.
_LEAST_HELD = 0.02
_LEAST_PAIRS = 100
# A correction must not be larger, metres at the scene and radians.
_LARGEST_SHIFT, _LARGEST_TURN = 0.08, np.radians(6.0)
_SIZE = 6


@dataclass(frozen=True, eq=False)
class Alignment:
    """How a view was aligned.

    Attributes:
        correction: (4, 4) maps the measured surface from where the given pose has it to where it is, in the frame of
            the first view's pose, metres; the identity if the given pose was right.
        shift: root mean square by which that moves the surface, metres.
        aligned: false if the view could not be aligned and keeps its given pose.
    """

    correction: np.ndarray
    shift: float = 0.0
    aligned: bool = True


@dataclass(frozen=True, eq=False)
class _AlignedView:
    measured: MeasuredView
    """with the corrected pose"""
    alignment: Alignment
    middle: np.ndarray
    """(3,) of what was measured, metres"""
    is_reference: bool
    """whether later views are aligned with it"""


_AS_GIVEN = Alignment(np.eye(4))


class CameraAlignment:
    """Aligns views one after the other, and keeps what it needs of them."""

    def __init__(self) -> None:
        # Compile now, so that no view has to wait.
        nothing, blank = np.zeros((0, 3)), np.zeros((1, 1, 3), np.int8)
        view = MeasuredView(
            blank[..., 0].astype(np.float32),
            blank,
            blank[..., 0].astype(np.int16),
            nothing,
            np.eye(4),
            1.0,
            1.0,
            0.0,
            0.0,
        )
        _step(np.zeros((1, 3)), np.zeros((1, 3)), [view], _FIRST_GATE)
        self.reset()

    def reset(self) -> None:
        """Forget all views."""
        self._views: dict[int, _AlignedView] = {}

    def forget_before(self, stamp: int) -> None:
        """Forget the views that were added before the one of ``stamp`` (nanoseconds); all without that one."""
        self._views = views_from(self._views, stamp)

    def add_view(self, stamp: int, measured: MeasuredView) -> MeasuredView:
        """Align a view with those added before.

        Args:
            stamp: of the view, nanoseconds.
            measured: with the given pose of its camera.

        Returns:
            The view with the corrected pose.
        """
        points, normals = _surface(measured)
        enough = len(points) >= _LEAST_PAIRS
        near = self._nearest(measured.T_camera_world, points) if enough else []
        is_first = enough and not any(view.is_reference for view in self._views.values())
        found = _align(points, normals, near) if near else Alignment(np.eye(4), aligned=is_first)
        moved = measured
        if found.shift:  # a pose that is not corrected stays the same to the last bit
            moved = move_view(measured, found.correction @ invert(measured.T_camera_world))
        middle = transform_points(found.correction, points).mean(axis=0) if len(points) else np.zeros(3)
        # One that disagrees with the views before it is wrong; one that shows something else need not be.
        self._views[stamp] = _AlignedView(moved, found, middle, found.aligned or (enough and not near))
        return moved

    def alignment(self, stamp: int) -> Alignment:
        """How the view of a stamp was aligned; as it was given if it was not added."""
        return self._views[stamp].alignment if stamp in self._views else _AS_GIVEN

    @property
    def T_world_anchor(self) -> np.ndarray:
        """(4, 4) from the frame of the corrected poses to the world: undoes the mean of all corrections, metres.

        The identity if no view was corrected.
        """
        aligned = [view for view in self._views.values() if view.alignment.aligned]
        if not any(view.alignment.shift for view in aligned):
            return np.eye(4)
        corrections = np.stack([view.alignment.correction for view in aligned])
        middle = np.mean([view.middle for view in aligned], axis=0)
        rotation = Rotation.from_matrix(corrections[:, :3, :3]).mean().as_matrix()
        shifted = transform_points(corrections, middle[None])[:, 0].mean(axis=0)
        return invert(make_transform(rotation, shifted - rotation @ middle))

    def T_world_cameras(self) -> np.ndarray:
        """(t, 4, 4) corrected poses of the cameras in the world, in the order in which views were added, metres."""
        T_anchor_camera = [invert(view.measured.T_camera_world) for view in self._views.values()]
        return self.T_world_anchor @ np.reshape(T_anchor_camera, (-1, 4, 4))

    def _nearest(self, T_camera_world: np.ndarray, points: np.ndarray) -> list[MeasuredView]:
        """The references that show some of (n, 3) points and whose cameras look in the most similar directions."""
        some, references = points[:: len(points) // _LEAST_PAIRS], []
        for view in self._views.values():
            if view.is_reference and _shows(view.measured, some):
                references.append(view.measured)
        alike = np.array([view.T_camera_world[2, :3] @ T_camera_world[2, :3] for view in references])
        return [references[index] for index in np.argsort(-alike, kind="stable")[:_NEAREST]]


def _shows(view: MeasuredView, points: np.ndarray) -> bool:
    """Whether a view measured something near one of (n, 3) points in the world."""
    x, y, z = transform_points(view.T_camera_world, points).T
    z = np.maximum(z, 1e-3)
    u, v = np.rint(x / z * view.fx + view.cx), np.rint(y / z * view.fy + view.cy)
    height, width = view.depth.shape
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    depth = view.depth[v[inside].astype(int), u[inside].astype(int)]
    return bool((np.abs(depth - z[inside]) < _LARGEST_SHIFT).any())


def _surface(view: MeasuredView) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) points and (n, 3) unit normals of some pixels of a view, in the frame of its pose.

    Every direction of the normals has about as many points (normal-space sampling, Rusinkiewicz and Levoy 2001):
    otherwise the table, which says nothing of shifts along it, outweighs the rest.
    """
    T = invert(view.T_camera_world)
    rows, columns = np.nonzero(
        view.normals[::_STRIDE, ::_STRIDE].any(axis=-1) & np.isfinite(view.depth[::_STRIDE, ::_STRIDE])
    )
    rows, columns = _STRIDE * rows, _STRIDE * columns
    normals = view.normals[rows, columns] / NORMAL @ T[:3, :3].T
    direction = (normals @ _DIRECTIONS.T).argmax(axis=1)
    parts = [np.flatnonzero(direction == each) for each in np.unique(direction)]
    most = _POINTS // max(1, len(parts))
    some = np.concatenate([np.zeros(0, int), *(part[:: max(1, len(part) // most)] for part in parts)])
    rows, columns, normals = rows[some], columns[some], normals[some]
    z = view.depth[rows, columns].astype(float)
    points = np.stack([(columns - view.cx) / view.fx * z, (rows - view.cy) / view.fy * z, z], axis=1)
    return transform_points(T, points), normals


def _align(points: np.ndarray, normals: np.ndarray, near: list[MeasuredView]) -> Alignment:
    """Align (n, 3) points and normals of a view, by its given pose, with views that have been aligned."""
    first = _step(points, normals, near, _FIRST_GATE)
    # Points of the table alone pair anywhere, and say nothing of a shift along it.
    if first is not None and first[1] > _LEAST_SHARE and _moved(points, first[0]) < _RIGHT:
        return _AS_GIVEN
    correction, share = _descend(points, normals, near, np.eye(4))
    if share < _FEW or _moved(points, correction) > _LARGE:
        starts = [make_transform(np.eye(3), shift) @ correction for shift in _STARTS]
        others = [_descend(points, normals, near, start) for start in starts]
        other, more = max(others, key=lambda found: found[1])
        if more > share + _BETTER:
            correction, share = other, more
    before = _step(points, normals, near, _GATES[-1])
    if before is not None and before[1] > max(share - _BETTER, _LEAST_SHARE):
        return _AS_GIVEN
    shift, turn = _moved(points, correction), Rotation.from_matrix(correction[:3, :3]).magnitude()
    if share < _LEAST_SHARE or shift > _LARGEST_SHIFT or turn > _LARGEST_TURN:
        return Alignment(np.eye(4), aligned=False)
    return Alignment(correction, shift)


def _descend(
    points: np.ndarray, normals: np.ndarray, near: list[MeasuredView], correction: np.ndarray
) -> tuple[np.ndarray, float]:
    """A correction from a first one, and the share of the points that then have a pair, weighted by their distances.

    The share is 0 if there are too few pairs on the way.
    """
    share = 0.0
    for gate in _GATES:
        moved = transform_points(correction, points)
        found = _step(moved, normals @ correction[:3, :3].T, near, gate)
        if found is None:
            return correction, 0.0
        step, share = found
        correction = step @ correction
        if gate == _GATES[-1] and _moved(moved, step) < _STILL:
            break
    return correction, share


def _moved(points: np.ndarray, T: np.ndarray) -> float:
    """Root mean square by which a transform moves (n, 3) points, metres."""
    return float(np.sqrt(((transform_points(T, points) - points) ** 2).sum(axis=1).mean()))


def _step(
    points: np.ndarray, normals: np.ndarray, near: list[MeasuredView], gate: float
) -> tuple[np.ndarray, float] | None:
    """(4, 4) Gauss-Newton step of (n, 3) points in the world towards what other views measured, and the share of
    paired points among those that the views look at; None with too few pairs."""
    middle = points.mean(axis=0)
    radius = np.sqrt(((points - middle) ** 2).sum(axis=1).mean())
    equations = np.zeros((_SIZE + 1, _SIZE + 1))
    counts = np.array([_pair(points, normals, middle, radius, view, gate, equations) for view in near])
    pairs, seen = counts.sum(axis=0)
    if pairs < _LEAST_PAIRS:
        return None
    values, vectors = np.linalg.eigh(equations[:_SIZE, :_SIZE])
    held = values > _LEAST_HELD * equations[_SIZE, _SIZE]
    step = vectors[:, held] @ ((vectors[:, held].T @ equations[:_SIZE, _SIZE]) / values[held])
    rotation = Rotation.from_rotvec(step[:3] / radius).as_matrix()
    return make_transform(rotation, middle + step[3:] - rotation @ middle), equations[_SIZE, _SIZE] / seen


@compiled
def _pair(
    points: np.ndarray,
    normals: np.ndarray,
    middle: np.ndarray,
    radius: float,
    view: MeasuredView,
    gate: float,
    equations: np.ndarray,
) -> tuple[int, int]:
    """Add the pairs of (n, 3) points with the pixels of a view that they fall on.

    Returns the number of pairs, and that of points that the view measures or sees past: they are not hidden from it.

    The unknowns are a rotation about ``middle`` times ``radius``, so that all have the same unit, and a shift. The
    last row and column of the (7, 7) ``equations`` are the right side and the sum of the weights.
    """
    height, width = view.depth.shape
    W, J, count, seen = view.T_camera_world, np.empty(7), 0, 0
    for k in range(len(points)):
        px, py, pz = points[k, 0], points[k, 1], points[k, 2]
        x = W[0, 0] * px + W[0, 1] * py + W[0, 2] * pz + W[0, 3]
        y = W[1, 0] * px + W[1, 1] * py + W[1, 2] * pz + W[1, 3]
        z = W[2, 0] * px + W[2, 1] * py + W[2, 2] * pz + W[2, 3]
        if z < 1e-3:
            continue
        u, v = int(np.rint(x / z * view.fx + view.cx)), int(np.rint(y / z * view.fy + view.cy))
        if u < 0 or v < 0 or u >= width or v >= height:
            continue
        depth = view.depth[v, u]
        dx, dy, dz = (u - view.cx) / view.fx * depth - x, (v - view.cy) / view.fy * depth - y, depth - z
        if dz > -gate:
            seen += 1
        square = (dx * dx + dy * dy + dz * dz) / (gate * gate)
        normal = view.normals[v, u]
        if not square < 1.0 or (normal[0] == 0 and normal[1] == 0 and normal[2] == 0):
            continue
        # The plane's normal in the world.
        nx = (W[0, 0] * normal[0] + W[1, 0] * normal[1] + W[2, 0] * normal[2]) / NORMAL
        ny = (W[0, 1] * normal[0] + W[1, 1] * normal[1] + W[2, 1] * normal[2]) / NORMAL
        nz = (W[0, 2] * normal[0] + W[1, 2] * normal[1] + W[2, 2] * normal[2]) / NORMAL
        if nx * normals[k, 0] + ny * normals[k, 1] + nz * normals[k, 2] < _ALIKE:
            continue
        residual = (normal[0] * dx + normal[1] * dy + normal[2] * dz) / NORMAL
        ax, ay, az = (px - middle[0]) / radius, (py - middle[1]) / radius, (pz - middle[2]) / radius
        J[0], J[1], J[2] = ay * nz - az * ny, az * nx - ax * nz, ax * ny - ay * nx
        J[3], J[4], J[5], J[6] = nx, ny, nz, residual
        weight = (1.0 - square) ** 2
        for i in range(6):
            for j in range(7):
                equations[i, j] += weight * J[i] * J[j]
        equations[6, 6] += weight
        count += 1
    return count, seen
