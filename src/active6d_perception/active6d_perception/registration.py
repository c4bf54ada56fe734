"""One step of the iterative closest point method, for many poses at once."""

import numpy as np
from scipy.spatial.transform import Rotation


def point_to_plane_step(
    T: np.ndarray, points: np.ndarray, normals: np.ndarray, targets: np.ndarray, matched: np.ndarray
) -> np.ndarray:
    """One Gauss-Newton step that brings the planes through ``points`` onto ``targets``.

    Each pose is rotated about its own origin, to keep the system well scaled. Damping keeps a pose from moving where
    the points leave it free, as about the axis of a cup.

    Args:
        T: (k, 4, 4) poses, metres.
        points: (k, n, 3) points that move with the pose, in the same frame as the pose's translation.
        normals: (k, n, 3) unit normals of their planes.
        targets: (k, n, 3) where each point's plane should lie.
        matched: (k, n) bool, or the factor of each residual.

    Returns:
        (k, 4, 4) moved poses; one with fewer than 6 pairs stays as it was.
    """
    arms = points - T[:, None, :3, 3]
    jacobian = np.concatenate([np.cross(arms, normals), normals], axis=-1) * matched[..., None]
    residual = np.einsum("ksi,ksi->ks", targets - points, normals) * matched
    A = np.swapaxes(jacobian, 1, 2) @ jacobian
    A += np.eye(6) * (1e-4 * np.trace(A, axis1=1, axis2=2)[:, None, None] / 6 + 1e-12)
    step = np.linalg.solve(A, np.einsum("ksi,ks->ki", jacobian, residual)[..., None])[..., 0]
    step[(matched > 0).sum(axis=1) < 6] = 0.0
    moved = T.copy()
    moved[:, :3, :3] = Rotation.from_rotvec(step[:, :3]).as_matrix() @ T[:, :3, :3]
    moved[:, :3, 3] += step[:, 3:]
    return moved
