"""How far an object is turned about its axis of near symmetry, by where its named part (a mug's handle) can be.

The network says how likely each turn is by how the object looks. The depth image says more, once the axis is known: at
each turn the part would be seen at certain pixels, and there its surface is measured or it is not: the camera looked
through it, or something hides it. What remains possible is told as a distribution.
"""

import numpy as np

from active6d_core.camera import PinholeCamera
from active6d_core.object_model import ObjectModel
from active6d_perception.dense.gauge import TURNS, Gauge, turn_about_z
from active6d_perception.model_views import model_views

_SAMPLES = 128
_EDGES = np.array([-0.012, -0.006, 0.006, 0.012, np.inf], np.float32)  # metres behind the measured surface
_ALIKE = 0.6  # cosine between normals
# Log-likelihood ratios of what is found where the part would be seen, between the right turn and wrong ones, by whose
# pixel it is (the instance's, nobody's, another's). Measured on training views with axes 2 degrees and 1.5 mm off.
_RATIO = np.array(
    [
        [-1.7, -2.4, -2.6],  # the camera looked through
        [-0.6, -1.1, -2.0],  # measured a little behind the part
        [2.4, 0.5, -0.4],  # measured where the part is, but facing elsewhere
        [2.0, -1.8, -2.5],  # measured a little before the part
        [0.4, 0.1, -0.3],  # hidden
        [1.0, -1.5, -0.8],  # not measured
        [4.2, 1.4, 0.2],  # measured where the part is, facing alike
    ]
)
_FACING_ELSEWHERE, _NOT_MEASURED, _FITTING = 2, 5, 6
# Neighbouring pixels err together: each counts as this share of an independent observation.
_INDEPENDENT = 0.1


class TurnSearch:
    """Log-likelihoods of all :data:`TURNS` about the axis, for many instances at once."""

    def __init__(self, model: ObjectModel, gauge: Gauge) -> None:
        views = model_views(model)
        part = np.flatnonzero(np.any([model.feature_mask(name, views.points) for name in model.features], axis=0))
        chosen = part[np.linspace(0, len(part) - 1, min(_SAMPLES, len(part))).astype(np.intp)]
        self._area = model.mesh.area * len(part) / len(views.points) / len(chosen)
        self._visible = views.visible[:, chosen]
        R, origin = gauge.T_object_axis[:3, :3], gauge.T_object_axis[:3, 3]
        # All in the axis frame; the samples at each of the turns: (turns, samples, 3).
        self._directions, self._from_origin = (views.directions @ R).astype(np.float32), origin @ R
        self._turned = turn_about_z(TURNS)[:, :3, :3]
        self._points = ((views.points[chosen] - origin) @ R @ np.swapaxes(self._turned, 1, 2)).astype(np.float32)
        self._normals = (views.normals[chosen] @ R @ np.swapaxes(self._turned, 1, 2)).astype(np.float32)

    def log_likelihood(
        self,
        T_camera_axis: np.ndarray,
        depth: np.ndarray,
        normals: np.ndarray,
        owner: np.ndarray,
        camera: PinholeCamera,
    ) -> np.ndarray:
        """Log-likelihood of the depth image for each turn, 0 where the part would be hidden by its own object.

        Args:
            T_camera_axis: (n, 4, 4) poses of the axis frame; their own turn is turn 0.
            depth: (H, W) metres, NaN invalid.
            normals: (H, W, 3) facing the camera, NaN unknown.
            owner: (H, W) index of each pixel's instance among the n, -1 for none.
            camera: intrinsics of all three.

        Returns:
            (n, len(TURNS)).
        """
        instance, turn, sample = np.nonzero(self._visible[self._seen_from(T_camera_axis)])
        R, t = T_camera_axis[:, :3, :3].astype(np.float32), T_camera_axis[:, :3, 3].astype(np.float32)
        points = np.einsum("pij,pj->pi", R[instance], self._points[turn, sample]) + t[instance]
        facing = np.einsum("pij,pj->pi", R[instance], self._normals[turn, sample])
        x, y, z = points.T
        u, v = np.rint(x / z * camera.fx + camera.cx), np.rint(y / z * camera.fy + camera.cy)
        inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        pixel = np.where(inside, v * camera.width + u, 0).astype(np.intp)
        behind = np.where(inside, z - depth.ravel()[pixel], np.nan)
        found = np.searchsorted(_EDGES, behind)  # NaN is sorted behind infinity
        alike = np.einsum("pi,pi->p", facing, normals.reshape(-1, 3)[pixel]) > _ALIKE
        found[(found == _FACING_ELSEWHERE) & alike] = _FITTING
        owned = owner.ravel()[pixel]
        whose = np.where(owned == instance, 0, np.where(owned < 0, 1, 2))
        # Pixels that a sample covers: a slanted one covers fewer.
        slant = np.abs(np.einsum("pi,pi->p", facing, points)) / np.linalg.norm(points, axis=1)
        weight = _INDEPENDENT * self._area * slant * camera.fx * camera.fy / z**2
        shape = len(T_camera_axis), len(TURNS)
        total = np.bincount(instance * shape[1] + turn, _RATIO[found, whose] * weight, shape[0] * shape[1])
        return total.reshape(shape)

    def _seen_from(self, T_camera_axis: np.ndarray) -> np.ndarray:
        """(n, turns) index of the model's view direction nearest to the camera's, at each turn."""
        eye = -np.einsum("nji,nj->ni", T_camera_axis[:, :3, :3], T_camera_axis[:, :3, 3])
        turned = (eye[:, None, None] @ self._turned)[:, :, 0] + self._from_origin
        return (turned.astype(np.float32) @ self._directions.T).argmax(axis=2)
