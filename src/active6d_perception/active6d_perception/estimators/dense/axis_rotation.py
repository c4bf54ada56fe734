"""The rotation of an object about its axis of near symmetry, from where its named part (a mug's handle) can be.

The network predicts a distribution of the rotation from the object's appearance. The depth image adds to it, once the
axis is known. At each angle the part would appear at certain pixels. There the image shows the part's surface, or a
surface behind it (the camera looked through the part), or one before it (something hides the part). The result is the
likelihood of each angle.
"""

import numpy as np
from scipy.spatial import cKDTree

from active6d_core.object_model import ObjectModel
from active6d_perception.estimators.dense.canonical_frame import AXIS_ANGLES, CanonicalFrame, rotation_about_z
from active6d_perception.estimators.dense.measured_surface import MeasuredSurface
from active6d_perception.model.model_views import model_views

_SAMPLES = 64
_EDGES = np.array([-0.012, -0.006, 0.006, 0.012, np.inf], np.float32)  # metres behind the measured surface
_ALIKE = 0.6  # cosine between normals
# Log-likelihood ratios, between the right angle and wrong ones, of what is measured where the part would appear.
# Columns: the pixel belongs to the instance and is off its body; to another instance and off that one's body; to no
# instance; to any instance and is on its body. Counted by active6d_tools.studies.measure_axis_rotation_evidence on
# training views, with a network's poses where their axes were right.
_RATIO = np.array(
    [
        [-1.6, -1.2, -2.6, -3.2],  # the camera looked through
        [0.0, -0.5, -1.4, -2.2],  # measured a little behind the part
        [3.3, 2.7, 1.5, 0.5],  # measured where the part is, but facing elsewhere
        [0.9, 0.5, -0.8, -1.6],  # measured a little before the part
        [-0.6, -0.6, -0.1, -0.4],  # hidden
        [0.0, 0.0, -0.2, 0.0],  # not measured
        [5.3, 4.7, 3.2, 2.3],  # measured where the part is, facing alike
    ]
)
_FACING_ELSEWHERE, _FITTING = 2, 6
# Errors of neighbouring pixels are correlated: each pixel counts as this share of an independent observation.
_INDEPENDENT = 0.03
_ON_BODY = 0.004  # metres
# Rotations about the axis this close to the chosen one count towards its certainty.
_SAME_ROTATION = np.radians(30.0)
_CELL = 0.001  # metres, of the body's profile


class AxisRotationSearch:
    """Log-likelihoods of all :data:`AXIS_ANGLES` for many instances at once."""

    def __init__(self, model: ObjectModel, canonical_frame: CanonicalFrame) -> None:
        views = model_views(model)
        R, origin = canonical_frame.T_object_axis[:3, :3], canonical_frame.T_object_axis[:3, 3]
        is_part = np.any([model.feature_mask(name, views.points) for name in model.features], axis=0)
        part = np.flatnonzero(is_part)
        chosen = part[np.linspace(0, len(part) - 1, min(_SAMPLES, len(part))).astype(np.intp)]
        self._area = model.mesh.area * len(part) / len(views.points) / len(chosen)
        self._visible = views.visible[:, chosen]
        # All in the axis frame; the samples at each of the angles: (angles, samples, 3).
        self._directions, self._from_origin = (views.directions @ R).astype(np.float32), origin @ R
        self._rotated = rotation_about_z(AXIS_ANGLES)[:, :3, :3]
        self._points = ((views.points[chosen] - origin) @ R @ np.swapaxes(self._rotated, 1, 2)).astype(np.float32)
        self._normals = (views.normals[chosen] @ R @ np.swapaxes(self._rotated, 1, 2)).astype(np.float32)
        self._body = _profile((views.points[~is_part] - origin) @ R)

    def log_likelihood(self, T_camera_axis: np.ndarray, surface: MeasuredSurface) -> np.ndarray:
        """Log-likelihood of the depth image for each angle, 0 where the object itself would hide the part.

        Args:
            T_camera_axis: (n, 4, 4) poses of the axis frame of the surface's instances; angles are relative to them.
            surface: what the view measured.

        Returns:
            (n, len(AXIS_ANGLES)).
        """
        instance, angle, case, pixels = self.cases(T_camera_axis, surface)
        shape = len(T_camera_axis), len(AXIS_ANGLES)
        value = _INDEPENDENT * _RATIO.ravel()[case] * pixels
        return np.bincount(instance * shape[1] + angle, value, minlength=shape[0] * shape[1]).reshape(shape)

    def cases(
        self, T_camera_axis: np.ndarray, surface: MeasuredSurface
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """What is measured where the part's samples would appear; arguments as for :meth:`log_likelihood`.

        Returns:
            Four (p,) arrays over the samples in sight: index of the instance, index of the angle, index of the case
            (row * 4 + column of the ratios), and the number of pixels that the sample covers.
        """
        camera = surface.camera
        instance, angle, sample = np.nonzero(self._visible[self._seen_from(T_camera_axis)])
        R, t = T_camera_axis[:, :3, :3].astype(np.float32), T_camera_axis[:, :3, 3].astype(np.float32)
        points = np.einsum("pij,pj->pi", R[instance], self._points[angle, sample]) + t[instance]
        facing = np.einsum("pij,pj->pi", R[instance], self._normals[angle, sample])
        x, y, z = points.T
        u, v = np.rint(x / z * camera.fx + camera.cx), np.rint(y / z * camera.fy + camera.cy)
        inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        pixel = np.where(inside, v * camera.width + u, 0).astype(np.intp)
        behind = np.where(inside, z - surface.depth.ravel()[pixel], np.nan)
        found = np.searchsorted(_EDGES, behind)  # NaN is sorted behind infinity
        alike = np.einsum("pi,pi->p", facing, surface.normals.reshape(-1, 3)[pixel]) > _ALIKE
        found[(found == _FACING_ELSEWHERE) & alike] = _FITTING
        owner = surface.owner.ravel()[pixel]
        whose = np.where(owner < 0, 2, np.where(self._on_body(T_camera_axis, surface)[pixel], 3, owner != instance))
        # A sample that is seen at a slant covers fewer pixels.
        slant = np.abs(np.einsum("pi,pi->p", facing, points)) / np.linalg.norm(points, axis=1)
        pixels = self._area * slant * camera.fx * camera.fy / z**2
        return instance, angle, found * _RATIO.shape[1] + whose, pixels

    def _seen_from(self, T_camera_axis: np.ndarray) -> np.ndarray:
        """(n, angles) index of the model's view direction nearest to the camera's."""
        eye = -np.einsum("nji,nj->ni", T_camera_axis[:, :3, :3], T_camera_axis[:, :3, 3])
        rotated = (eye[:, None, None] @ self._rotated)[:, :, 0] + self._from_origin
        return (rotated.astype(np.float32) @ self._directions.T).argmax(axis=2)

    def _on_body(self, T_camera_axis: np.ndarray, surface: MeasuredSurface) -> np.ndarray:
        """(h * w,) bool, whether a pixel lies on its own instance's body of revolution."""
        owner = surface.owner.ravel()
        pixel = np.flatnonzero(owner >= 0)
        T = T_camera_axis[owner[pixel]].astype(np.float32)
        local = np.einsum("pij,pi->pj", T[:, :3, :3], surface.points.reshape(-1, 3)[pixel] - T[:, :3, 3])
        cell = _cell(local, np.array(self._body.shape))
        on_body = np.zeros(owner.size, bool)
        on_body[pixel] = self._body[cell[:, 0], cell[:, 1]]
        return on_body


def likely_axis_rotations(probability: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The most likely rotations of each instance about its axis, at least 30 degrees apart.

    Args:
        probability: (n, len(AXIS_ANGLES)) rows that sum to 1.
        count: number of rotations per instance.

    Returns:
        (n, count) indices into :data:`AXIS_ANGLES`, and (n, count) the probability within 30 degrees of each.
    """
    chosen, certainty = [], []
    for _ in range(count):
        best = probability.argmax(axis=1)
        near = np.abs((AXIS_ANGLES - AXIS_ANGLES[best][:, None] + np.pi) % (2 * np.pi) - np.pi) < _SAME_ROTATION
        chosen.append(best)
        certainty.append((probability * near).sum(axis=1))
        probability = np.where(near, 0.0, probability)
    return np.stack(chosen, axis=1), np.stack(certainty, axis=1)


def _profile(points: np.ndarray) -> np.ndarray:
    """(radius, height) bool grid of :data:`_CELL`: which cells are near the body that ``points`` sample.

    Height 0 is in the middle. The last radius and the first and last height are outside the body.
    """
    profile = np.stack([np.hypot(points[:, 0], points[:, 1]), points[:, 2]], axis=1)
    reach = np.ceil((np.abs(profile).max(axis=0) + _ON_BODY) / _CELL).astype(int) + 2
    radius, height = np.meshgrid(np.arange(reach[0]), np.arange(-reach[1], reach[1] + 1), indexing="ij")
    return cKDTree(profile).query(_CELL * np.stack([radius, height], axis=-1))[0] < _ON_BODY


def _cell(points: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """(p, 2) indices into a :func:`_profile` of (p, 3) points in the axis frame."""
    place = np.stack([np.hypot(points[:, 0], points[:, 1]), points[:, 2]], axis=1) / _CELL + [0, shape[1] // 2]
    return np.clip(np.rint(place), 0, shape - 1).astype(np.intp)
