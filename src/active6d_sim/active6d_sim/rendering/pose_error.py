"""Errors of the camera's pose, as a robot with an imperfect calibration and joint angles has them."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from active6d_core.se3 import make_transform


@dataclass(frozen=True)
class PoseError:
    """How wrong the poses of the camera are said to be: root mean squares of a shift and of a rotation angle.

    Every view has its own error.
    """

    millimetres: float = 0.0
    degrees: float = 0.0

    def draw(self, rng: np.random.Generator) -> np.ndarray:
        """(4, 4) ``T_said_true``, the pose of the true optical frame in the one that is said, metres."""
        turn = rng.normal(0.0, np.radians(self.degrees) / np.sqrt(3), 3)
        shift = rng.normal(0.0, 1e-3 * self.millimetres / np.sqrt(3), 3)
        return make_transform(Rotation.from_rotvec(turn).as_matrix(), shift)
