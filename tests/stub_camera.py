"""A camera and an estimator that answer at once, for tests of the graph's running rather than of its parts."""

from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped

from active6d_core.camera import PinholeCamera, View
from active6d_core.hypotheses import Hypotheses
from active6d_core.object_model import ObjectModel
from active6d_core.ros import topics
from active6d_core.ros.conversions import (
    MessageError,
    camera_to_info,
    color_to_image,
    depth_to_image,
    make_header,
    pose_stamped_to_transform,
    poses_to_array,
    stamp_to_ns,
    transform_to_pose_stamped,
)
from active6d_core.ros.episode_messages import GoalState, GoalStatus
from active6d_core.ros.node import GraphNode
from active6d_core.ros.runner import run_node
from active6d_core.se3 import make_transform
from active6d_core.view_sphere import ViewSphere
from active6d_perception.estimators.registry import list_estimators, register_estimator

CAMERA = PinholeCamera.from_field_of_view(64, 48, 60.0)


class StubCameraNode(GraphNode):
    """Goes to every goal at once and sees seeded noise there."""

    def __init__(self, **arguments: Any) -> None:
        super().__init__("camera_simulator", **arguments)
        self.declare("object", "mug", "name of the object to announce")
        self.declare("seed", 0, "seed of the noise")
        self.declare("refused", 0, "number of goals that are refused before any is accepted")
        self.declare("ignored", 0, "number of goals after the refused ones that are accepted and never reached")
        self.declare("deaf_from", -1, "number of the first goal that is ignored, -1: none")
        self._object, self._seed = self.value("object"), self.value("seed")
        self._refused, self._ignored = self.value("refused"), self.value("ignored")
        self._deaf_from = self.value("deaf_from")
        self._pose = ViewSphere().pose(ViewSphere().positions[self._seed % 100])
        self._count = 0
        self._color = self.output(topics.CAMERA_COLOR)
        self._depth = self.output(topics.CAMERA_DEPTH)
        self._info = self.output(topics.CAMERA_INFO)
        self._where = self.output(topics.CAMERA_POSE)
        self._truth = self.output(topics.GROUND_TRUTH)
        self._start = self.output(topics.EPISODE_START)
        self._status = self.output(topics.GOAL_STATUS)
        self.input(topics.VIEW_GOAL, self._on_goal)

    def begin(self) -> None:
        """Announce the episode and publish the first view."""
        status = DiagnosticStatus(name="episode", message="started")
        values = {"object": self._object, "scene": f"{self._object}/seed/{self._seed}", "seed": str(self._seed)}
        status.values = [KeyValue(key=key, value=value) for key, value in values.items()]
        self._start.publish(DiagnosticArray(header=make_header(10**9, self.world_frame), status=[status]))
        self._truth.publish(poses_to_array(np.eye(4)[None], 10**9, self.world_frame))
        self._publish()

    def _on_goal(self, message: PoseStamped) -> None:
        stamp = stamp_to_ns(message.header.stamp)
        if stamp < self._stamp():
            raise MessageError("stale goal")  # of a view that was estimated again
        if self._refused:
            self._refused -= 1
            self._answer(stamp, GoalState.REFUSED, "a wall is in the way")
            return
        self._answer(stamp, GoalState.ACCEPTED)
        if self._ignored:
            self._ignored -= 1
            return
        self._count += 1
        if self._count != self._deaf_from:
            self._pose = pose_stamped_to_transform(message, self.world_frame)
            self._publish()
            self._answer(stamp, GoalState.REACHED)

    def _answer(self, stamp: int, state: GoalState, reason: str = "") -> None:
        self._status.publish(GoalStatus(stamp, self.world_frame, state, reason).to_message())

    def _stamp(self) -> int:
        return 10**9 + self._count * 500_000_000

    def _publish(self) -> None:
        stamp = self._stamp()
        with self.measure(stamp):
            rng = np.random.default_rng([self._seed, stamp])
            depth = rng.uniform(0.6, 0.9, (CAMERA.height, CAMERA.width)).astype(np.float32)
            color = rng.integers(0, 256, (*depth.shape, 3)).astype(np.uint8)
            self._color.publish(color_to_image(color, stamp, self.camera_frame))
            self._depth.publish(depth_to_image(depth, stamp, self.camera_frame))
            self._info.publish(camera_to_info(CAMERA, stamp, self.camera_frame))
            self._where.publish(transform_to_pose_stamped(self._pose, stamp, self.world_frame))


class StubEstimator:
    """One hypothesis per quarter of the image, at the mean depth of the quarter's pixels nearer than 0.75 m.

    Args:
        model: not used.
        offset: metres added to every depth.
    """

    def __init__(self, model: ObjectModel, offset: float = 0.0) -> None:
        self._offset = offset

    def estimate(self, view: View) -> Hypotheses:
        """A function of the view alone."""
        rows, columns = np.indices(view.depth.shape)
        quarter = 1 + 2 * (rows >= rows.shape[0] // 2) + (columns >= rows.shape[1] // 2)
        segmentation = np.where(view.depth < 0.75, quarter, 0).astype(np.uint16)
        labels = np.unique(segmentation[segmentation > 0])
        depth = np.array([view.depth[segmentation == label].mean() for label in labels]) + self._offset
        directions = np.array([[-0.2, -0.15, 1], [0.2, -0.15, 1], [-0.2, 0.15, 1], [0.2, 0.15, 1]])
        T = make_transform(np.broadcast_to(np.eye(3), (len(labels), 3, 3)), directions[labels - 1] * depth[:, None])
        return Hypotheses.from_masks(T, np.full(len(labels), 0.5), labels, segmentation, view.depth)


if "stub" not in list_estimators():
    register_estimator("stub")(StubEstimator)


def main() -> None:
    """Entry point."""
    run_node(StubCameraNode)


if __name__ == "__main__":
    main()
