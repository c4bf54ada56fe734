"""The verification score: how well a hypothesis fits the depth inside its own mask (paper, equation 1)."""

import numpy as np

from active6d_core.camera import PinholeCamera
from active6d_core.hypotheses import Hypotheses
from active6d_core.object_model import ObjectModel
from active6d_perception.model_views import ModelViews, model_views


def local_fit(distance: np.ndarray, normal_product: np.ndarray, epsilon: float) -> np.ndarray:
    """delta(p, q) of equation 1, element by element.

    Args:
        distance: (...,) ``||p - q||`` in metres.
        normal_product: (...,) ``n_p . n_q`` of unit normals, in [-1, 1].
        epsilon: metres.

    Returns:
        (...,) values in [-1/2, 1]; 0 from ``epsilon`` on.
    """
    fit = 0.5 * (1.0 - distance / epsilon) + 0.5 * normal_product
    return np.where(distance < epsilon, fit, 0.0)


class Verifier:
    """Scores hypotheses of one object without ground truth.

    The scene points q are depth pixels inside the hypothesis's mask, evenly taken from it in raster order; p is the
    nearest point to q on the model as the camera sees it. "As the camera sees it" comes from
    :class:`~active6d_perception.model_views.ModelViews`; the sample found there stands for a small disc of surface, so
    that the distance is to the surface and does not grow with the samples' spacing.
    """

    def __init__(self, model: ObjectModel, epsilon: float = 0.010, samples: int = 128, reach: int = 3) -> None:
        """
        Args:
            model: the object.
            epsilon: threshold of equation 1 in metres.
            samples: most scene points per mask.
            reach: pixels each way over which scene normals are measured.

        Raises:
            ValueError: a parameter is not positive.
        """
        for name, value in (("epsilon", epsilon), ("samples", samples), ("reach", reach)):
            if not value > 0:
                raise ValueError(f"verification: {name} must be positive, got {value}")
        self.epsilon, self.samples, self.reach = epsilon, samples, reach
        self.views: ModelViews = model_views(model)
        self.views.nearest_visible(np.zeros((1, 3)), np.zeros(1), epsilon)  # now, so that no view waits for it later

    def score(self, depth: np.ndarray, camera: PinholeCamera, hypotheses: Hypotheses) -> np.ndarray:
        """Verification scores c of all hypotheses of a view.

        Args:
            depth: (H, W) metres along z, NaN where invalid.
            camera: intrinsics of ``depth``.
            hypotheses: k hypotheses with masks of the same size.

        Returns:
            (k,) mean of delta over all scene points in the mask with valid depth; 0 for a mask without any.

        Raises:
            ValueError: the sizes of depth image and masks differ.
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
            points: (n, 3) scene points q in the optical frame.
            normals: (n, 3) their normals facing the camera, zero where unknown: such a point is judged by its distance.
            T_camera_object: (k, 4, 4) poses of the hypotheses.
            owner: (n,) hypothesis that each point is judged by.

        Returns:
            (n,) values of equation 1.
        """
        # Whole rows are taken: several times faster than indexing into them.
        T = T_camera_object.take(owner, axis=0)
        R, t = T[:, :3, :3], T[:, :3, 3]
        q = np.einsum("ni,nij->nj", points - t, R)
        direction = self.views.nearest_direction(T_camera_object)[owner]
        distance, p = self.views.nearest_visible(q, direction, self.epsilon + self.views.spacing)
        reached = np.flatnonzero(p >= 0)
        q, p, distance = q.take(reached, axis=0), p[reached], distance[reached]
        n_p = self.views.normals.take(p, axis=0)
        off_plane = np.einsum("ni,ni->n", q - self.views.points.take(p, axis=0), n_p)
        along = np.sqrt(np.maximum(distance**2 - off_plane**2, 0.0))
        to_surface = np.hypot(off_plane, np.maximum(along - self.views.spacing, 0.0))
        product = np.einsum("ni,ni->n", np.einsum("ni,nij->nj", normals, R).take(reached, axis=0), n_p)
        fits = np.zeros(len(points))
        fits[reached] = local_fit(to_surface, product, self.epsilon)
        return fits

    def mask_pixels(self, depth: np.ndarray, hypotheses: Hypotheses) -> tuple[np.ndarray, np.ndarray]:
        """Pixels with depth inside the masks, at most ``samples`` of each, evenly spaced in raster order.

        Returns:
            (n,) flat indices, mask by mask, and (n,) the hypotheses that they belong to.
        """
        height, width = depth.shape
        corners = np.rint(np.clip(hypotheses.box, 0.0, 1.0) * (width, height, width, height)).astype(int)
        inside = []
        for (x0, y0, x1, y1), label in zip(corners.tolist(), hypotheses.label, strict=True):
            crop = (slice(y0, y1), slice(x0, x1))
            inside.append(np.flatnonzero((hypotheses.segmentation[crop] == label) & np.isfinite(depth[crop])))
        sizes = np.array([len(flat) for flat in inside], int)
        counts = np.minimum(sizes, self.samples)
        owner = np.repeat(np.arange(len(hypotheses)), counts)
        place = np.arange(len(owner)) - (np.cumsum(counts) - counts)[owner]
        stretched = place * (sizes[owner] - 1) // max(self.samples - 1, 1)
        chosen = np.where(sizes[owner] > self.samples, stretched, place) + (np.cumsum(sizes) - sizes)[owner]
        x0, y0, x1, _ = corners.take(owner, axis=0).T
        rows, columns = np.divmod(np.concatenate([*inside, np.zeros(0, int)])[chosen], x1 - x0)
        return (rows + y0) * width + columns + x0, owner


def points_and_normals(
    depth: np.ndarray, camera: PinholeCamera, pixels: np.ndarray, reach: int
) -> tuple[np.ndarray, np.ndarray]:
    """Scene points and normals at a few pixels of a depth image; the rest of the image is not touched.

    A tangent is the central difference over ``reach`` pixels each way or, where depth jumps on one side (an
    occlusion edge) or is missing there, the difference on the other side.

    Args:
        depth: (H, W) metres, NaN invalid.
        camera: intrinsics.
        pixels: (n,) flat indices with valid depth.
        reach: pixels.

    Returns:
        (n, 3) points in the optical frame and (n, 3) unit normals facing the camera, zero where both sides are missing.
    """
    height, width = depth.shape
    v, u = np.divmod(pixels, width)
    # The pixel, then the one after and the one before it along the row, then along the column.
    u = np.clip(u + reach * np.array([[0], [1], [-1], [0], [0]]), 0, width - 1)
    v = np.clip(v + reach * np.array([[0], [0], [0], [1], [-1]]), 0, height - 1)
    z = depth.take(v * width + u).astype(float)
    # Coordinates first, so that each is one contiguous row.
    around = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z])
    points = around[:, 0]
    after, before = around[:, 1::2] - points[:, None], points[:, None] - around[:, 2::2]
    jump_after, jump_before = np.abs(after[2]), np.abs(before[2])
    one_side = np.where((jump_after <= jump_before) | np.isnan(jump_before), after, before)
    # A smooth surface changes its slope little within a few pixels; 5 mm between the two sides is an edge.
    smooth = np.abs(jump_after - jump_before) < 0.005
    (ax, bx), (ay, by), (az, bz) = np.where(smooth, after + before, one_side)
    normals = np.nan_to_num(np.stack([by * az - bz * ay, bz * ax - bx * az, bx * ay - by * ax]))
    length = np.sqrt((normals**2).sum(axis=0))
    # Facing the camera is against the ray to the point.
    length[(normals * points).sum(axis=0) > 0] *= -1
    np.divide(normals, length, out=normals, where=length != 0)
    return points.T, normals.T
