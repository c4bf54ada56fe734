"""Distance between two poses of a symmetric object, in closed form."""

import numpy as np
from scipy.spatial.distance import cdist

from active6d_core.object_model import ObjectModel, Symmetry

# Metres. Distances are rounded to this, so that they do not depend on the order of summation.
_RESOLUTION = 1e-7


class SymmetricDistance:
    """Root mean square distance of the model's surface points between two poses, least over the symmetries.

    With second moment ``S = E[x x^T]`` and mean ``m = E[x]`` over the surface, poses ``(R_a, t_a)`` and ``(R_b, t_b)``
    and a symmetry g, the mean square distance is ``2 tr S - 2 tr(R_b^T R_a S g^T) + |dt|^2 + 2 dt . (R_a - R_b) m``.
    Only the second term depends on g, and linearly. For rotations about an axis, its maximum is the length of a phasor.
    So neither points nor angles are sampled. The distance is an upper bound of ADD (the mean distance), and equal to
    ADD if all points move equally.
    """

    def __init__(self, model: ObjectModel) -> None:
        self._measure(model.surface[0], model.symmetry)

    @classmethod
    def of_points(cls, points: np.ndarray, symmetry: Symmetry) -> "SymmetricDistance":
        """The distance of (n, 3) points, metres, that spread over a surface with a symmetry about their origin."""
        made = cls.__new__(cls)
        made._measure(points, symmetry)
        return made

    def _measure(self, points: np.ndarray, symmetry: Symmetry) -> None:
        self._group, self._axis = symmetry.discrete, symmetry.axis
        mean, moment = points.mean(axis=0), points.T @ points / len(points)
        # The samples are not exactly symmetric, so their moments are averaged over the symmetry group.
        rotations = symmetry.rotations(step_degrees=10.0)
        self._mean = (rotations @ mean).mean(axis=0)
        self._moment = (rotations @ moment @ np.swapaxes(rotations, 1, 2)).mean(axis=0)

    def between(self, T_a: np.ndarray, T_b: np.ndarray) -> np.ndarray:
        """(n, m) distances in metres between (n, 4, 4) and (m, 4, 4) poses in one frame."""
        R_a, R_b, t_a, t_b = T_a[:, :3, :3], T_b[:, :3, :3], T_a[:, :3, 3], T_b[:, :3, 3]
        overlap = np.max([self._overlap(R_a, R_b @ g) for g in self._group], axis=0)
        # |dt|^2 + 2 dt.(R_a m - R_b m) = |dt + R_a m - R_b m|^2 - |R_a m - R_b m|^2
        mean_a, mean_b = R_a @ self._mean, R_b @ self._mean
        square = 2 * (np.trace(self._moment) - overlap)
        square += cdist(t_a + mean_a, t_b + mean_b, "sqeuclidean") - cdist(mean_a, mean_b, "sqeuclidean")
        return np.round(np.sqrt(np.maximum(square, 0.0)) / _RESOLUTION) * _RESOLUTION

    def _overlap(self, R_a: np.ndarray, R_b: np.ndarray) -> np.ndarray:
        """(n, m) max over the axis rotations g of ``tr(R_b^T R_a S g^T)``."""
        RS = R_a @ self._moment
        trace = RS.reshape(-1, 9) @ R_b.reshape(-1, 9).T
        if self._axis is None:
            return trace
        along = (RS @ self._axis) @ (R_b @ self._axis).T
        x, y, z = self._axis
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        around = (RS @ cross.T).reshape(-1, 9) @ R_b.reshape(-1, 9).T
        return along + np.hypot(trace - along, around)
