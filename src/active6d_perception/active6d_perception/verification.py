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
        for direction in range(len(self.views.directions)):
            self.views.visible_tree(direction)  # now, so that no view waits for it later

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
        pixels = [self._mask_pixels(depth, hypotheses, index) for index in range(len(hypotheses))]
        counts = [len(found) for found in pixels]
        if sum(counts) == 0:
            return np.zeros(len(hypotheses))
        points, normals = points_and_normals(depth, camera, np.concatenate(pixels), self.reach)
        starts = np.concatenate([[0], np.cumsum(counts)])
        directions = self.views.nearest_direction(hypotheses.T_camera_object)
        scores = np.zeros(len(hypotheses))
        for index in np.flatnonzero(counts):
            part = slice(starts[index], starts[index + 1])
            T, direction = hypotheses.T_camera_object[index], directions[index]
            scores[index] = self.fits(points[part], normals[part], T, direction).mean()
        return scores

    def fits(self, points: np.ndarray, normals: np.ndarray, T_camera_object: np.ndarray, direction: int) -> np.ndarray:
        """delta(p, q) per scene point.

        Args:
            points: (n, 3) scene points q in the optical frame.
            normals: (n, 3) their normals facing the camera, zero where unknown: such a point is judged by its distance.
            T_camera_object: (4, 4) pose of the hypothesis.
            direction: index of the model's view direction.

        Returns:
            (n,) values of equation 1.
        """
        R = T_camera_object[:3, :3]
        q = (points - T_camera_object[:3, 3]) @ R
        visible, tree = self.views.visible_tree(int(direction))
        distance, found = tree.query(q, distance_upper_bound=self.epsilon + self.views.spacing)
        reached = np.flatnonzero(np.isfinite(distance))
        p = visible[found[reached]]
        n_p = self.views.normals[p]
        off_plane = np.einsum("ni,ni->n", q[reached] - self.views.points[p], n_p)
        along = np.sqrt(np.maximum(distance[reached] ** 2 - off_plane**2, 0.0))
        to_surface = np.hypot(off_plane, np.maximum(along - self.views.spacing, 0.0))
        fits = np.zeros(len(points))
        fits[reached] = local_fit(to_surface, np.einsum("ni,ni->n", n_p, normals[reached] @ R), self.epsilon)
        return fits

    def _mask_pixels(self, depth: np.ndarray, hypotheses: Hypotheses, index: int) -> np.ndarray:
        """Flat indices of at most ``samples`` pixels with depth inside one mask, evenly spaced in raster order."""
        height, width = depth.shape
        size = (width, height, width, height)
        x0, y0, x1, y1 = np.rint(np.clip(hypotheses.box[index], 0.0, 1.0) * size).astype(int)
        crop = (slice(y0, y1), slice(x0, x1))
        inside = (hypotheses.segmentation[crop] == hypotheses.label[index]) & np.isfinite(depth[crop])
        flat = np.flatnonzero(inside)
        if len(flat) > self.samples:
            flat = flat[np.linspace(0, len(flat) - 1, self.samples).astype(np.intp)]
        rows, columns = np.divmod(flat, max(x1 - x0, 1))
        return (rows + y0) * width + columns + x0


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
    points = _backproject(depth, camera, u, v)
    tangents = []
    for du, dv in ((reach, 0), (0, reach)):
        after = _backproject(depth, camera, np.minimum(u + du, width - 1), np.minimum(v + dv, height - 1)) - points
        before = points - _backproject(depth, camera, np.maximum(u - du, 0), np.maximum(v - dv, 0))
        jump_after, jump_before = np.abs(after[:, 2]), np.abs(before[:, 2])
        flatter = np.nan_to_num(jump_after, nan=np.inf) <= np.nan_to_num(jump_before, nan=np.inf)
        one_side = np.where(flatter[:, None], after, before)
        # A smooth surface changes its slope little within a few pixels; 5 mm between the two sides is an edge.
        smooth = np.abs(jump_after - jump_before) < 0.005
        tangents.append(np.where(smooth[:, None], after + before, one_side))
    cross = np.nan_to_num(np.cross(tangents[1], tangents[0]))
    length = np.linalg.norm(cross, axis=1, keepdims=True)
    normals = np.divide(cross, length, out=np.zeros_like(cross), where=length > 0)
    normals[np.einsum("ni,ni->n", normals, points) > 0] *= -1
    return points, normals


def _backproject(depth: np.ndarray, camera: PinholeCamera, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    z = depth[v, u].astype(float)
    return np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=-1)
