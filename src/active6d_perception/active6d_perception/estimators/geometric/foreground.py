"""From a depth image to smoothed points, normals and a mask of the foreground (not table, floor or bin wall)."""

from dataclasses import dataclass

import numpy as np

from active6d_core.camera import PinholeCamera, backproject, normals_from_points


@dataclass(frozen=True, eq=False)
class Surface:
    """The measured surface of one view, in the optical frame.

    Attributes:
        camera: intrinsics of all images.
        depth: (H, W) smoothed metres, NaN invalid.
        points: (H, W, 3) metres, NaN invalid.
        normals: (H, W, 3) unit normals facing the camera, NaN where unknown.
        foreground: (H, W) bool, whether a pixel has depth and lies on no large plane.
    """

    camera: PinholeCamera
    depth: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    foreground: np.ndarray


def measure_surface(depth: np.ndarray, camera: PinholeCamera, object_diameter: float) -> Surface:
    """Smooth a depth image within surfaces but not across edges, and separate bin and table from the foreground.

    Args:
        depth: (H, W) metres along z, NaN invalid.
        camera: intrinsics.
        object_diameter: metres; planes larger than any face of an object are background.
    """
    smooth = smooth_within_surfaces(smooth_within_surfaces(depth.astype(np.float32), axis=0), axis=1)
    points = backproject(smooth, camera)
    normals = normals_from_points(points, reach=3)
    foreground = np.isfinite(smooth)
    for normal, offset in find_large_planes(points, normals, object_diameter):
        # Only surface with the plane's normal is background, because the plane of a wall may cut through objects.
        foreground &= ~((np.abs(points @ normal - offset) < 0.006) & (normals @ normal > 0.8))
    return Surface(camera, smooth, points, normals, foreground)


def smooth_within_surfaces(depth: np.ndarray, axis: int, reach: int = 2, gate: float = 0.008) -> np.ndarray:
    """Smooth along one axis: the mean of neighbours whose depth differs by less than ``gate``.

    Args:
        depth: (H, W) float32 metres, NaN invalid; invalid pixels stay invalid.
        axis: 0 down the columns, 1 along the rows.
        reach: how far neighbours may be away, pixels.
        gate: largest difference in depth, metres.
    """
    total, count = depth.copy(), np.ones(depth.shape, np.float32)
    for shift in range(1, reach + 1):
        ahead = [slice(None), slice(None)]
        behind = ahead.copy()
        ahead[axis], behind[axis] = slice(shift, None), slice(None, -shift)
        difference = depth[tuple(ahead)] - depth[tuple(behind)]
        same = np.abs(difference) < gate  # false where either is NaN
        difference[~same] = 0.0
        total[tuple(behind)] += same * depth[tuple(behind)] + difference
        total[tuple(ahead)] += same * depth[tuple(ahead)] - difference
        count[tuple(behind)] += same
        count[tuple(ahead)] += same
    return total / count


def find_large_planes(
    points: np.ndarray, normals: np.ndarray, object_diameter: float
) -> list[tuple[np.ndarray, float]]:
    """Find planes with more surface than the largest face of an object, by sequential RANSAC with a fixed seed.

    A point with its normal defines a plane, so one good sample is enough.

    Args:
        points: (H, W, 3) in the optical frame, metres.
        normals: (H, W, 3) unit normals facing the camera, NaN unknown.
        object_diameter: metres.

    Returns:
        Pairs of a (3,) float32 unit normal facing the camera and an offset in metres, with ``normal . x = offset``.
        The largest plane is first.
    """
    cell = points[::8, ::8].reshape(-1, 3), normals[::8, ::8].reshape(-1, 3)
    known = np.isfinite(cell[1]).all(axis=1) & np.isfinite(cell[0]).all(axis=1)
    p, n = cell[0][known], cell[1][known]
    rng = np.random.default_rng(0)
    planes: list[tuple[np.ndarray, float]] = []
    for _ in range(6):
        if len(p) < 50:
            break
        draws = rng.choice(len(p), size=min(200, len(p)), replace=False)
        near = np.abs(p @ n[draws].T - np.einsum("di,di->d", p[draws], n[draws])) < 0.008
        aligned = n @ n[draws].T > 0.9
        members = near & aligned
        best = members[:, members.sum(axis=0).argmax()]
        if best.sum() < 20:
            break
        for _ in range(3):
            centre = p[best].mean(axis=0)
            normal = np.linalg.svd(p[best] - centre, full_matrices=False)[2][2]
            normal = normal if normal @ centre < 0 else -normal
            best = (np.abs((p - centre) @ normal) < 0.006) & (n @ normal > 0.9)
            if best.sum() < 20:
                break
        if best.sum() < 20:
            break
        spread = np.ptp(p[best] @ np.linalg.svd(p[best] - p[best].mean(axis=0), full_matrices=False)[2][:2].T, axis=0)
        if spread[0] > 1.8 * object_diameter:
            planes.append((normal.astype(np.float32), float(normal @ centre)))
        p, n = p[~best], n[~best]
    return planes
