"""Registration of poses to a measured image: iterative closest point with the visible surface of the model.

Only the part of the model's surface that the camera can see is used. With hidden surface, the far side of a thin-walled
object would be pulled onto measurements of the near side. The nearest measured point is searched for in a window of the
image around each sample's pixel. That finds the same points as a search tree would, and it is compiled. Taking the
measurement at the pixel itself is faster, for a first registration of thousands of poses. As the last one, it loses a
tenth of the objects of the learned estimator on validation views.
"""

import numpy as np

from active6d_perception.compiled import compiled
from active6d_perception.estimators.measured_image import MeasuredImage
from active6d_perception.model.visible_samples import VisibleSamples, direction_of

_ALIKE = 0.5  # least cosine between the normals of a pair
_WIDEST, _EXACT = 8, 4  # pixels, half of a window's side
_FEWEST_PAIRS = 6


@compiled
def register(
    T: np.ndarray,
    samples: VisibleSamples,
    image: MeasuredImage,
    gates: np.ndarray,
    iterations: int,
    widest: int = _WIDEST,
) -> np.ndarray:
    """Point-to-plane ICP. The planes are the model's, which have no noise.

    Args:
        T: (k, 4, 4) initial ``T_camera_object``, metres.
        samples: of the model.
        image: what was measured; pixels with NaN points are not used.
        gates: (g,) metres, largest distance of a pair in each stage.
        iterations: per stage.
        widest: pixels, half of a window's side at most; 0 pairs each sample with the measurement at its own pixel.

    Returns:
        (k, 4, 4) registered poses; one with fewer than 6 pairs stays as it was.
    """
    result = T.copy()
    for k in range(len(T)):
        P = result[k]
        for gate in gates:
            direction = direction_of(P, samples.nearest)
            for _ in range(iterations):
                A, g = np.zeros((6, 6)), np.zeros(6)
                if _add_pairs(P, direction, samples, image, gate, widest, A, g) < _FEWEST_PAIRS:
                    break
                move(P, A, g)
    return result


@compiled
def _add_pairs(
    P: np.ndarray,
    direction: int,
    samples: VisibleSamples,
    image: MeasuredImage,
    gate: float,
    widest: int,
    A: np.ndarray,
    g: np.ndarray,
) -> int:
    """Add the upper half of the normal equations of one (4, 4) pose to (6, 6) ``A`` and (6,) ``g``; number of pairs."""
    pairs = 0
    for place in range(samples.number[direction]):
        s = samples.chosen[direction, place]
        a, b, c = samples.points[s, 0], samples.points[s, 1], samples.points[s, 2]
        # arm from the object's origin, and the sample itself
        ax = P[0, 0] * a + P[0, 1] * b + P[0, 2] * c
        ay = P[1, 0] * a + P[1, 1] * b + P[1, 2] * c
        az = P[2, 0] * a + P[2, 1] * b + P[2, 2] * c
        x, y, z = ax + P[0, 3], ay + P[1, 3], az + P[2, 3]
        if z < 1e-3:
            continue
        v, u = _nearest_pixel(x, y, z, gate, widest, image)
        if v < 0:
            continue
        d, e, f = samples.normals[s, 0], samples.normals[s, 1], samples.normals[s, 2]
        nx = P[0, 0] * d + P[0, 1] * e + P[0, 2] * f
        ny = P[1, 0] * d + P[1, 1] * e + P[1, 2] * f
        nz = P[2, 0] * d + P[2, 1] * e + P[2, 2] * f
        m = image.normals[v, u]
        if not (m[0] * nx + m[1] * ny + m[2] * nz > _ALIKE):
            continue
        q = image.points[v, u]
        residual = (q[0] - x) * nx + (q[1] - y) * ny + (q[2] - z) * nz
        add_equation(ax, ay, az, nx, ny, nz, residual, A, g)
        pairs += 1
    return pairs


@compiled
def _nearest_pixel(x: float, y: float, z: float, gate: float, widest: int, image: MeasuredImage) -> tuple[int, int]:
    """Row and column of the measured point nearest to (x, y, z) within ``gate`` metres; -1 and -1 without one."""
    height, width = image.points.shape[:2]
    u, v = int(np.rint(x / z * image.fx + image.cx)), int(np.rint(y / z * image.fy + image.cy))
    reach = min(int(np.ceil(gate * image.fx / z)), widest)
    # In wide windows every second pixel: while a pose is still that far off, the nearest point need not be exact.
    step = 1 if reach <= _EXACT else 2
    square, row, column = gate * gate, -1, -1
    for i in range(max(v - reach, 0), min(v + reach + 1, height), step):
        for j in range(max(u - reach, 0), min(u + reach + 1, width), step):
            dx, dy, dz = image.points[i, j, 0] - x, image.points[i, j, 1] - y, image.points[i, j, 2] - z
            apart = dx * dx + dy * dy + dz * dz
            if apart < square:
                square, row, column = apart, i, j
    return row, column


@compiled
def add_equation(
    ax: float, ay: float, az: float, nx: float, ny: float, nz: float, residual: float, A: np.ndarray, g: np.ndarray
) -> None:
    """Add one point-to-plane equation to the upper half of (6, 6) ``A`` and to (6,) ``g``.

    Args:
        ax, ay, az: from the pose's origin to the sample, optical frame, metres.
        nx, ny, nz: unit normal of the sample.
        residual: from the sample to its measured point along the normal, metres.
        A: normal equations.
        g: right-hand side.
    """
    J = (ay * nz - az * ny, az * nx - ax * nz, ax * ny - ay * nx, nx, ny, nz)
    for i in range(6):
        g[i] += J[i] * residual
        for j in range(i, 6):
            A[i, j] += J[i] * J[j]


@compiled
def move(P: np.ndarray, A: np.ndarray, g: np.ndarray) -> None:
    """Solve (6, 6) normal equations, of which the upper half is given, and move a (4, 4) pose accordingly; in place.

    It is rotated about its own origin, by at most 0.4 rad, and shifted.
    """
    trace = 0.0
    for i in range(6):
        trace += A[i, i]
        for j in range(i):
            A[i, j] = A[j, i]
    # A direction that the samples leave free (the axis of a cup) must not move; damping holds it.
    for i in range(6):
        A[i, i] += 1e-4 * trace / 6 + 1e-12
    step = np.linalg.solve(A, g)
    angle = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
    if angle > 1e-12:
        x, y, z = step[0] / angle, step[1] / angle, step[2] / angle
        angle = min(angle, 0.4)
        s, c = np.sin(angle), np.cos(angle)
        C = 1 - c
        R = np.array(
            [
                [c + x * x * C, x * y * C - z * s, x * z * C + y * s],
                [y * x * C + z * s, c + y * y * C, y * z * C - x * s],
                [z * x * C - y * s, z * y * C + x * s, c + z * z * C],
            ]
        )
        P[:3, :3] = R @ P[:3, :3].copy()
    P[0, 3] += step[3]
    P[1, 3] += step[4]
    P[2, 3] += step[5]
