"""Node ``pose_estimator``: runs an estimator on every RGB-D view and publishes hypotheses, poses and label images."""

from typing import Any

import numpy as np

from active6d_core.camera import View
from active6d_core.object_model import load_object
from active6d_core.registry import AUTOMATIC
from active6d_core.ros import topics
from active6d_core.ros.conversions import hypotheses_to_cloud, poses_to_array, segmentation_to_image
from active6d_core.ros.heartbeat import Awaited
from active6d_core.ros.node import GraphNode
from active6d_core.ros.runner import run_node
from active6d_core.ros.view_inputs import ViewInputs
from active6d_perception.estimators.registry import Estimator, create_estimator, list_estimators


class PoseEstimatorNode(GraphNode):
    """Subscribes to ``camera/...``; publishes ``hypotheses``, ``hypotheses/poses`` and ``hypotheses/segmentation``.

    Each view gives one message of each. They are transient local, so that a fusion node that starts late gets the
    last ones.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__("pose_estimator", **options)
        self.declare("object", "mug", "name of the object whose pose is estimated")
        self.declare(
            "estimator",
            AUTOMATIC,
            "name of the estimator; auto: dense if the object has weights, else geometric",
            choices=[AUTOMATIC, *list_estimators()],
        )
        self.declare(
            "estimator_parameters", "{}", "parameters of the estimator, a YAML mapping such as {min_score: 0.4}"
        )
        self.declare(
            "use_camera_pose", False, "wait for the camera's pose too and pass it to the estimator", fixed=True
        )
        self._estimator: Estimator | None = None
        self._hypotheses = self.output(topics.HYPOTHESES)
        self._poses = self.output(topics.HYPOTHESES_POSES)
        self._segmentation = self.output(topics.SEGMENTATION)
        parts = ["color", "depth", "camera"] + ["pose"] * self.value("use_camera_pose")
        self._inputs = ViewInputs(self, parts, self._on_view)

    def setup(self) -> None:
        """Load the object and make the estimator."""
        self._inputs.reset()
        model = load_object(self.value("object"))
        self._estimator = create_estimator(self.value("estimator"), model, **self.mapping("estimator_parameters"))

    def teardown(self) -> None:
        """Release the estimator."""
        self._estimator = None

    def awaited(self) -> Awaited:
        """The camera's topics."""
        return self._inputs.awaited()

    def _on_view(self, stamp: int, values: dict[str, Any]) -> None:
        view = View(stamp, values["color"], values["depth"], values["camera"], values.get("pose", np.eye(4)))
        assert self._estimator is not None, "only an active node takes views"
        with self.measure(stamp) as summary:
            found = self._estimator.estimate(view)
            summary.append(f"{len(found)} hypotheses")
            self._segmentation.publish(segmentation_to_image(found.segmentation, stamp, self.camera_frame))
            self._hypotheses.publish(hypotheses_to_cloud(found, stamp, self.camera_frame))
            self._poses.publish(poses_to_array(found.T_camera_object, stamp, self.camera_frame))


def main() -> None:
    """Entry point of ``ros2 run active6d_perception pose_estimator``."""
    run_node(PoseEstimatorNode)


if __name__ == "__main__":
    main()
