"""The measured surface of a depth image, and which of it is foreground (not table, floor or bin wall)."""

from dataclasses import dataclass

import numpy as np

from active6d_core.camera import PinholeCamera
from active6d_perception.estimators.measured_image import MeasuredImage, measure_image


@dataclass(frozen=True, eq=False)
class Surface:
    """The measured surface of one view, in the optical frame.

    Attributes:
        camera: intrinsics.
        image: points and normals.
        foreground: (H, W) bool, whether a pixel has depth and lies on no large plane.
    """

    camera: PinholeCamera
    image: MeasuredImage
    foreground: np.ndarray


def measure_surface(depth: np.ndarray, camera: PinholeCamera, object_diameter: float) -> Surface:
    """Points and normals of a depth image, and its foreground.

    Args:
        depth: (H, W) metres along z, NaN invalid.
        camera: intrinsics.
        object_diameter: metres; planes larger than any face of an object are background.
    """
    image = measure_image(depth, camera)
    foreground = np.isfinite(image.points[..., 2])
    for normal, offset in find_large_planes(image.points, image.normals, object_diameter):
        # Only surface with the plane's normal is background, because the plane of a wall may cut through objects.
        foreground &= ~((np.abs(image.points @ normal - offset) < 0.006) & (image.normals @ normal > 0.8))
    return Surface(camera, image, foreground)


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
