"""The verification score: how well a hypothesis fits the depth image inside its mask (paper, equation 1)."""

import numpy as np

from active6d_core.camera import PinholeCamera
from active6d_core.hypotheses import Hypotheses
from active6d_core.object_model import ObjectModel
from active6d_perception.compiled import compiled
from active6d_perception.model.model_views import ModelViews, model_views


def local_fit(distance: np.ndarray, normal_product: np.ndarray, epsilon: float) -> np.ndarray:
    """delta(p, q) of equation 1, for arrays of pairs.

    Args:
        distance: (...,) ``||p - q||`` in metres.
        normal_product: (...,) ``n_p . n_q`` of unit normals, in [-1, 1].
        epsilon: threshold of the distance, metres.

    Returns:
        (...,) values in [-1/2, 1]; 0 for distances from ``epsilon`` on.
    """
    fit = 0.5 * (1.0 - distance / epsilon) + 0.5 * normal_product
    return np.where(distance < epsilon, fit, 0.0)


class Verifier:
    """Scores hypotheses of one object without ground truth.

    The scene points q are depth pixels inside the hypothesis's mask, evenly spaced in raster order. The model point p
    is the nearest one to q on the surface that the camera sees, see :class:`.ModelViews`. Each sample of the model
    represents a small disc, so that the distance to the surface does not depend on the spacing of the samples.
    """

    def __init__(self, model: ObjectModel, epsilon: float = 0.010, samples: int = 128, reach: int = 3) -> None:
        """
        Args:
            model: the object.
            epsilon: threshold of equation 1 in metres.
            samples: largest number of scene points per mask.
            reach: distance in pixels over which scene normals are measured.

        Raises:
            ValueError: a parameter is not positive.
        """
        for name, value in (("epsilon", epsilon), ("samples", samples), ("reach", reach)):
            if not value > 0:
                raise ValueError(f"verification: {name} must be positive, got {value}")
        self.epsilon, self.samples, self.reach = epsilon, samples, reach
        self.views: ModelViews = model_views(model)
        # Compile now, so that no view has to wait.
        self.score(np.zeros((1, 1), np.float32), PinholeCamera(1, 1, 1.0, 1.0, 0.0, 0.0), Hypotheses.empty(1, 1))

    def score(self, depth: np.ndarray, camera: PinholeCamera, hypotheses: Hypotheses) -> np.ndarray:
        """Compute the verification scores c of all hypotheses of a view.

        Args:
            depth: (H, W) metres along z, NaN where invalid.
            camera: intrinsics of ``depth``.
            hypotheses: k hypotheses with masks of the same size.

        Returns:
            (k,) mean of delta over the scene points in the mask; 0 for a mask without valid depth.

        Raises:
            ValueError: depth image and masks differ in size.
        """
        if depth.shape != hypotheses.segmentation.shape:
            raise ValueError(f"depth image is {depth.shape}, the masks are {hypotheses.segmentation.shape}")
        pixels, owner = self.mask_pixels(depth, hypotheses)
        points, normals = points_and_normals(depth, camera, pixels, self.reach)
        fits = self.fits(points, normals, hypotheses.T_camera_object, owner)
        count = np.bincount(owner, minlength=len(hypotheses))
        return np.bincount(owner, fits, len(hypotheses)) / np.maximum(count, 1)

    def fits(
        self, points: np.ndarray, normals: np.ndarray, T_camera_object: np.ndarray, owner: np.ndarray
    ) -> np.ndarray:
        """delta(p, q) per scene point.

        Args:
            points: (n, 3) scene points q in the optical frame, metres.
            normals: (n, 3) their unit normals facing the camera; zero where unknown, so that only the distance counts.
            T_camera_object: (k, 4, 4) poses of the hypotheses in the optical frame, metres.
            owner: (n,) index of each point's hypothesis.

        Returns:
            (n,) values of equation 1.
        """
        q, n_q = _into_object_frames(points, normals, np.ascontiguousarray(T_camera_object, float), owner)
        direction = self.views.nearest_direction(T_camera_object)[owner]
        distance, p = self.views.nearest_visible(q, direction, self.epsilon + self.views.spacing)
        surface = self.views.points, self.views.normals, self.views.spacing
        distance, agreement = _against_discs(q, n_q, distance, p, surface)
        return local_fit(distance, agreement, self.epsilon)

    def mask_pixels(self, depth: np.ndarray, hypotheses: Hypotheses) -> tuple[np.ndarray, np.ndarray]:
        """Pixels with depth inside the masks, at most ``samples`` of each, evenly spaced in raster order.

        Returns:
            (n,) flat indices, mask by mask, and (n,) indices of their hypotheses.
        """
        height, width = depth.shape
        corners = np.rint(np.clip(np.nan_to_num(hypotheses.box), 0.0, 1.0) * (width, height, width, height)).astype(int)
        images = np.require(hypotheses.segmentation, np.uint16, ["C", "W"]), np.require(depth, np.float32, ["C", "W"])
        return _pixels_in_boxes(*images, corners, hypotheses.label.astype(np.uint16), self.samples)


def points_and_normals(
    depth: np.ndarray, camera: PinholeCamera, pixels: np.ndarray, reach: int
) -> tuple[np.ndarray, np.ndarray]:
    """Compute scene points and normals at a few pixels of a depth image; the other pixels cost nothing.

    A tangent is the central difference over ``reach`` pixels on both sides. If depth is missing on one side or jumps
    there (an occlusion edge), it is the difference on the other side.

    Args:
        depth: (H, W) metres along z, NaN invalid.
        camera: intrinsics.
        pixels: (n,) flat indices with valid depth.
        reach: pixels.

    Returns:
        (n, 3) points in the optical frame, metres, and (n, 3) unit normals facing the camera, zero where unknown.
    """
    intrinsics = camera.fx, camera.fy, camera.cx, camera.cy
    return _points_and_normals(np.require(depth, np.float32, ["C", "W"]), intrinsics, np.asarray(pixels), reach)


_Vector = tuple[float, float, float]


@compiled
def _pixels_in_boxes(
    segmentation: np.ndarray, depth: np.ndarray, corners: np.ndarray, label: np.ndarray, samples: int
) -> tuple[np.ndarray, np.ndarray]:
    """See :meth:`Verifier.mask_pixels`; ``corners`` (k, 4) are the boxes in pixels, maxima excluded."""
    width = depth.shape[1]
    pixels, owner = np.empty(len(label) * samples, np.int64), np.empty(len(label) * samples, np.int64)
    inside, total = np.empty(depth.size, np.int64), 0
    for index in range(len(label)):
        x0, y0, x1, y1 = corners[index]
        count = 0
        for y in range(y0, y1):
            for x in range(x0, x1):
                # Always written, and overwritten if the pixel does not count: a branch would be slower.
                inside[count] = y * width + x
                count += (segmentation[y, x] == label[index]) & np.isfinite(depth[y, x])
        for place in range(min(count, samples)):
            stretched = place * (count - 1) // max(samples - 1, 1) if count > samples else place
            pixels[total], owner[total] = inside[stretched], index
            total += 1
    return pixels[:total], owner[:total]


@compiled
def _points_and_normals(
    depth: np.ndarray, intrinsics: tuple[float, float, float, float], pixels: np.ndarray, reach: int
) -> tuple[np.ndarray, np.ndarray]:
    """See :func:`points_and_normals`; intrinsics are fx, fy, cx and cy."""
    height, width = depth.shape
    points, normals = np.empty((len(pixels), 3)), np.zeros((len(pixels), 3))
    for index in range(len(pixels)):
        v, u = divmod(pixels[index], width)
        centre = x, y, z = _backproject(depth, intrinsics, u, v)
        points[index, 0], points[index, 1], points[index, 2] = centre
        right, left = min(u + reach, width - 1), max(u - reach, 0)
        below, above = min(v + reach, height - 1), max(v - reach, 0)
        ax, ay, az = _tangent(
            _backproject(depth, intrinsics, left, v), centre, _backproject(depth, intrinsics, right, v)
        )
        bx, by, bz = _tangent(
            _backproject(depth, intrinsics, u, above), centre, _backproject(depth, intrinsics, u, below)
        )
        nx, ny, nz = by * az - bz * ay, bz * ax - bx * az, bx * ay - by * ax
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
        if length > 0:
            # A normal that faces the camera points against the ray.
            length = -length if nx * x + ny * y + nz * z > 0 else length
            normals[index, 0], normals[index, 1], normals[index, 2] = nx / length, ny / length, nz / length
    return points, normals


@compiled
def _backproject(depth: np.ndarray, intrinsics: tuple[float, float, float, float], u: int, v: int) -> _Vector:
    """The point of one pixel in the optical frame, metres."""
    fx, fy, cx, cy = intrinsics
    z = float(depth[v, u])
    return (u - cx) / fx * z, (v - cy) / fy * z, z


@compiled
def _tangent(before: _Vector, centre: _Vector, after: _Vector) -> _Vector:
    """Tangent of the surface at ``centre``, from its neighbours on both sides; NaN without a neighbour."""
    jump_after, jump_before = abs(after[2] - centre[2]), abs(centre[2] - before[2])
    # The slope of a smooth surface changes little within a few pixels; 5 mm between the two sides is an edge.
    smooth = abs(jump_after - jump_before) < 0.005
    if not smooth and (jump_after <= jump_before or np.isnan(jump_before)):
        return after[0] - centre[0], after[1] - centre[1], after[2] - centre[2]
    if not smooth:
        return centre[0] - before[0], centre[1] - before[1], centre[2] - before[2]
    return (
        after[0] - centre[0] + (centre[0] - before[0]),
        after[1] - centre[1] + (centre[1] - before[1]),
        after[2] - centre[2] + (centre[2] - before[2]),
    )


@compiled
def _into_object_frames(
    points: np.ndarray, normals: np.ndarray, T_camera_object: np.ndarray, owner: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) points and normals, mapped from the optical frame into the frame of their owner among (k, 4, 4) poses."""
    q, n_q = np.empty(points.shape), np.empty(points.shape)
    for index in range(len(points)):
        T, point, normal = T_camera_object[owner[index]], points[index], normals[index]
        x, y, z = point[0] - T[0, 3], point[1] - T[1, 3], point[2] - T[2, 3]
        for axis in range(3):
            q[index, axis] = x * T[0, axis] + y * T[1, axis] + z * T[2, axis]
            n_q[index, axis] = normal[0] * T[0, axis] + normal[1] * T[1, axis] + normal[2] * T[2, axis]
    return q, n_q


@compiled
def _against_discs(
    q: np.ndarray,
    n_q: np.ndarray,
    distance: np.ndarray,
    p: np.ndarray,
    surface: tuple[np.ndarray, np.ndarray, float],
) -> tuple[np.ndarray, np.ndarray]:
    """Distances and products of normals for equation 1, with each sample of the surface as a disc.

    Args:
        q: (n, 3) points in the object frame, metres.
        n_q: (n, 3) their unit normals.
        distance: (n,) distances to the nearest samples, metres.
        p: (n,) indices of the nearest samples, -1 if none is near.
        surface: (s, 3) samples, (s, 3) their normals, and the radius of their discs, metres.

    Returns:
        (n,) distances to the surface, metres, infinite if no sample is near, and (n,) products of the normals.
    """
    points, normals, radius = surface
    to_surface, product = np.full(len(q), np.inf), np.zeros(len(q))
    for index in range(len(q)):
        sample = p[index]
        if sample < 0:
            continue
        off_plane = 0.0
        for axis in range(3):
            off_plane += (q[index, axis] - points[sample, axis]) * normals[sample, axis]
            product[index] += n_q[index, axis] * normals[sample, axis]
        along = np.sqrt(max(distance[index] ** 2 - off_plane**2, 0.0))
        to_surface[index] = np.hypot(off_plane, max(along - radius, 0.0))
    return to_surface, product
