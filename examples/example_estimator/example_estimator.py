"""Example of an estimator: an upright object under each of the highest points of the depth image.

It ignores the object's shape, so its poses are poor. It shows what an estimator receives and returns.
"""

import numpy as np
from scipy.spatial import cKDTree

from active6d_core.camera import View, backproject
from active6d_core.hypotheses import Hypotheses
from active6d_core.object_model import ObjectModel
from active6d_core.se3 import invert


class HighestPoint:
    """Takes the highest point, removes the surface around it, and repeats.

    Args:
        model: the object that fills the bin; here only its diameter counts.
        count: largest number of hypotheses.

    Raises:
        ValueError: count is not positive.
    """

    def __init__(self, model: ObjectModel, count: int = 10) -> None:
        if count < 1:
            raise ValueError(f"count is {count}, must be at least 1")
        self._diameter, self._count = model.diameter, count

    def estimate(self, view: View) -> Hypotheses:
        """Pose hypotheses in the camera's optical frame, each with its mask."""
        rows, columns = np.nonzero(np.isfinite(view.depth))
        in_camera = backproject(view.depth, view.camera)[rows, columns].astype(float)
        points = in_camera @ view.T_world_camera[:3, :3].T + view.T_world_camera[:3, 3]
        free = points[:, 2] > 0.25 * self._diameter  # not the floor
        segmentation = np.zeros(view.depth.shape, np.uint16)
        tree, poses = cKDTree(points), []
        while free.any() and len(poses) < self._count:
            top = points[np.where(free, points[:, 2], -np.inf).argmax()]
            near = np.array(tree.query_ball_point(top, 0.5 * self._diameter))
            near = near[free[near]]
            free[near] = False
            segmentation[rows[near], columns[near]] = len(poses) + 1
            T_world_object = np.eye(4)
            T_world_object[:3, 3] = top - [0.0, 0.0, 0.5 * self._diameter]
            poses.append(invert(view.T_world_camera) @ T_world_object)
        if not poses:
            return Hypotheses.empty(*view.depth.shape)
        label = np.arange(1, len(poses) + 1)
        return Hypotheses.from_masks(np.stack(poses), np.full(len(poses), 0.5), label, segmentation, view.depth)
