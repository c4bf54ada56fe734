"""Many starting poses near the measured surface, refined by projective ICP and thinned out by what depth says of them.

Every start puts a point of the model onto a measured point, with its normal along the measured one. Compiled, since a
view has a hundred thousand starts and each looks at few pixels.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from active6d_core.se3 import invert
from active6d_perception.compiled import compiled
from active6d_perception.estimators.geometric.foreground import Surface
from active6d_perception.estimators.image_registration import add_equation, move
from active6d_perception.estimators.measured_image import MeasuredImage
from active6d_perception.model.model_views import ModelViews
from active6d_perception.model.symmetric_distance import SymmetricDistance


class VisibleSamples(NamedTuple):
    """The model's visible samples per direction for compiled loops."""

    points: np.ndarray
    """(s, 3) float32 object frame, metres"""
    normals: np.ndarray
    """(s, 3) float32"""
    visible: np.ndarray
    """(m, c) samples visible from a direction"""
    counts: np.ndarray
    """(m,) how many of the c are used"""
    directions: np.ndarray
    """(m, 3) unit vectors from the object to the eye, object frame"""


def image_of(surface: Surface) -> MeasuredImage:
    """The surface of a view as compiled loops take it."""
    camera = surface.camera
    return MeasuredImage(
        np.ascontiguousarray(surface.points, np.float32),
        np.ascontiguousarray(surface.normals, np.float32),
        camera.fx,
        camera.fy,
        camera.cx,
        camera.cy,
    )


def samples_of(views: ModelViews, count: int) -> VisibleSamples:
    """At most ``count`` visible samples per direction."""
    index, used = views.visible_subset(count)
    return VisibleSamples(views.points, views.normals, index, used.sum(axis=1), np.ascontiguousarray(views.directions))


@compiled
def _nearest_direction(T: np.ndarray, directions: np.ndarray) -> int:
    """Index of the direction nearest to the camera's for a (4, 4) pose."""
    x = -(T[0, 0] * T[0, 3] + T[1, 0] * T[1, 3] + T[2, 0] * T[2, 3])
    y = -(T[0, 1] * T[0, 3] + T[1, 1] * T[1, 3] + T[2, 1] * T[2, 3])
    z = -(T[0, 2] * T[0, 3] + T[1, 2] * T[1, 3] + T[2, 2] * T[2, 3])
    best, found = -np.inf, 0
    for index in range(len(directions)):
        value = x * directions[index, 0] + y * directions[index, 1] + z * directions[index, 2]
        if value > best:
            best, found = value, index
    return found


@compiled
def compare(T: np.ndarray, samples: VisibleSamples, image: MeasuredImage, tolerance: float, alike: float) -> np.ndarray:
    """(k, 3) shares of each pose's visible samples that fit the measurement, are looked through, and are occluded.

    A sample fits by degrees: fully where depth and normal agree, less towards the tolerance. With a plain count, wrong
    orientations of a smooth object fit as well as the right one.

    Args:
        T: (k, 4, 4) ``T_camera_object``.
        samples: of the model.
        image: measured surface.
        tolerance: metres along the ray; twice that is a violation or an occlusion.
        alike: least cosine between normals of a fitting sample.
    """
    height, width = image.points.shape[:2]
    result = np.zeros((len(T), 3))
    for k in range(len(T)):
        P = T[k]
        direction = _nearest_direction(P, samples.directions)
        used, fitting, violated, occluded = 0, 0.0, 0, 0
        for place in range(samples.counts[direction]):
            s = samples.visible[direction, place]
            a, b, c = samples.points[s, 0], samples.points[s, 1], samples.points[s, 2]
            z = P[2, 0] * a + P[2, 1] * b + P[2, 2] * c + P[2, 3]
            if z < 1e-3:
                continue
            x = P[0, 0] * a + P[0, 1] * b + P[0, 2] * c + P[0, 3]
            y = P[1, 0] * a + P[1, 1] * b + P[1, 2] * c + P[1, 3]
            u, v = int(np.rint(x / z * image.fx + image.cx)), int(np.rint(y / z * image.fy + image.cy))
            if u < 0 or v < 0 or u >= width or v >= height:
                used += 1
                continue
            measured = image.points[v, u, 2]
            if not np.isfinite(measured):
                continue
            used += 1
            behind = z - measured
            if behind < -2 * tolerance:
                violated += 1
            elif behind > 2 * tolerance:
                occluded += 1
            elif abs(behind) < tolerance:
                d, e, f = samples.normals[s, 0], samples.normals[s, 1], samples.normals[s, 2]
                cosine = (
                    (P[0, 0] * d + P[0, 1] * e + P[0, 2] * f) * image.normals[v, u, 0]
                    + (P[1, 0] * d + P[1, 1] * e + P[1, 2] * f) * image.normals[v, u, 1]
                    + (P[2, 0] * d + P[2, 1] * e + P[2, 2] * f) * image.normals[v, u, 2]
                )
                if cosine > alike:
                    off = behind / tolerance
                    fitting += (1.0 - off * off) * min(1.0, (cosine - alike) / (0.95 - alike))
        # Half of the samples without a measurement are no evidence; fewer measured ones count as half.
        total = max(used, samples.counts[direction] // 2, 1)
        result[k, 0], result[k, 1], result[k, 2] = fitting / total, violated / total, occluded / total
    return result


@compiled
def refine_projectively(
    T: np.ndarray, samples: VisibleSamples, image: MeasuredImage, gates: np.ndarray, iterations: int
) -> np.ndarray:
    """Point-to-plane ICP where each visible sample is paired with the measurement at its own pixel.

    Args:
        T: (k, 4, 4) initial ``T_camera_object``.
        samples: of the model.
        image: measured surface.
        gates: metres, largest distance of a pair in each stage.
        iterations: per stage.

    Returns:
        (k, 4, 4) refined poses; one with fewer than 6 pairs stays as it was.
    """
    result = T.copy()
    for k in range(len(T)):
        P = result[k]
        for gate in gates:
            direction = _nearest_direction(P, samples.directions)
            for _ in range(iterations):
                A, g = np.zeros((6, 6)), np.zeros(6)
                if _add_pairs(P, direction, samples, image, gate, A, g) < 6:
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
    A: np.ndarray,
    g: np.ndarray,
) -> int:
    """Add the upper half of the normal equations of one (4, 4) pose to (6, 6) ``A`` and (6,) ``g``; number of pairs."""
    height, width = image.points.shape[:2]
    pairs = 0
    for place in range(samples.counts[direction]):
        s = samples.visible[direction, place]
        a, b, c = samples.points[s, 0], samples.points[s, 1], samples.points[s, 2]
        # arm from the object's origin, and the sample itself
        ax = P[0, 0] * a + P[0, 1] * b + P[0, 2] * c
        ay = P[1, 0] * a + P[1, 1] * b + P[1, 2] * c
        az = P[2, 0] * a + P[2, 1] * b + P[2, 2] * c
        x, y, z = ax + P[0, 3], ay + P[1, 3], az + P[2, 3]
        if z < 1e-3:
            continue
        u, v = int(np.rint(x / z * image.fx + image.cx)), int(np.rint(y / z * image.fy + image.cy))
        if u < 0 or v < 0 or u >= width or v >= height or not np.isfinite(image.points[v, u, 2]):
            continue
        d, e, f = samples.normals[s, 0], samples.normals[s, 1], samples.normals[s, 2]
        nx = P[0, 0] * d + P[0, 1] * e + P[0, 2] * f
        ny = P[1, 0] * d + P[1, 1] * e + P[1, 2] * f
        nz = P[2, 0] * d + P[2, 1] * e + P[2, 2] * f
        qx, qy, qz = image.points[v, u, 0] - x, image.points[v, u, 1] - y, image.points[v, u, 2] - z
        if qx * qx + qy * qy + qz * qz > gate * gate:
            continue
        m = image.normals[v, u]
        if not (m[0] * nx + m[1] * ny + m[2] * nz > 0.5):
            continue
        add_equation(ax, ay, az, nx, ny, nz, qx * nx + qy * ny + qz * nz, A, g)
        pairs += 1
    return pairs


def surface_frames(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(n, 4, 4) frames at (n, 3) points with z along (n, 3) unit normals."""
    helper = np.where(np.abs(normals[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    x = np.cross(helper, normals)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    T = np.tile(np.eye(4), (len(points), 1, 1))
    T[:, :3, 0], T[:, :3, 1], T[:, :3, 2], T[:, :3, 3] = x, np.cross(normals, x), normals, points
    return T


class Starts:
    """Starting poses at a measured surface.

    Args:
        views: of the model.
        places: points of the model that are put onto a measured point.
        angles: rotations about the normal tried for each.
    """

    def __init__(self, views: ModelViews, places: int = 40, angles: int = 8) -> None:
        seen = np.flatnonzero(views.visible.any(axis=0))
        points, normals = views.points[seen].astype(float), views.normals[seen].astype(float)
        # Spread over places and normals together: a thin wall has two sides.
        chosen = _farthest_points(np.hstack([points / np.ptp(points, axis=0).max(), 0.35 * normals]), places)
        turns = np.tile(np.eye(4), (angles, 1, 1))
        about_z = Rotation.from_rotvec(np.outer(np.arange(angles) * 2 * np.pi / angles, [0.0, 0.0, 1.0]))
        turns[:, :3, :3] = about_z.as_matrix()
        frames = surface_frames(points[chosen], normals[chosen])
        self._T_start_object = (turns[None] @ invert(frames)[:, None]).reshape(-1, 4, 4)

    def at(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """(n, starts, 4, 4) ``T_camera_object`` at (n, 3) measured points with (n, 3) unit normals."""
        return surface_frames(points, normals)[:, None] @ self._T_start_object[None]


def thin_out(
    T: np.ndarray, value: np.ndarray, distance: SymmetricDistance, radius: float, *, most: int, quota: int
) -> np.ndarray:
    """Indices of the best poses, best first: none near a better one, and few at each place.

    Args:
        T: (k, 4, 4).
        value: (k,) higher is better.
        distance: between poses.
        radius: metres, least distance between two kept poses.
        most: kept at most.
        quota: poses kept at most whose origins are within two radii of each other.
    """
    free, crowd, kept = np.ones(len(T), bool), np.zeros(len(T), int), []
    positions = np.ascontiguousarray(T[:, :3, 3])
    for index in np.argsort(-value, kind="stable"):
        if not free[index] or crowd[index] >= quota:
            continue
        kept.append(index)
        if len(kept) == most:
            break
        apart = np.linalg.norm(positions - positions[index], axis=1)
        crowd += apart < 2 * radius
        # No pose is nearer than its points on average; far poses need no comparison.
        near = np.flatnonzero(free & (apart < 2 * radius))
        free[near[distance.between(T[near], T[index][None])[:, 0] < radius]] = False
    return np.array(kept, np.intp)


def _farthest_points(points: np.ndarray, count: int) -> np.ndarray:
    """Indices of ``count`` of (n, d) points, each the farthest from those before."""
    chosen = [0]
    apart = np.linalg.norm(points - points[0], axis=1)
    for _ in range(min(count, len(points)) - 1):
        chosen.append(int(apart.argmax()))
        apart = np.minimum(apart, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.array(chosen)
