"""Runs an estimator on every registered RGB-D view and publishes its hypotheses, poses and label masks."""

from typing import Any

import numpy as np
import yaml
from geometry_msgs.msg import PoseArray
from sensor_msgs.msg import Image, PointCloud2

from active6d_core.camera import View
from active6d_core.object_model import load_object
from active6d_core.registry import AUTOMATIC
from active6d_core.ros.conversions import hypotheses_to_cloud, poses_to_array, segmentation_to_image
from active6d_core.ros.node import GraphNode, run_node
from active6d_core.ros.view_inputs import ViewInputs
from active6d_perception.estimators.registry import Estimator, create_estimator, list_estimators


class PoseEstimatorNode(GraphNode):
    """``camera/...`` in; ``hypotheses``, ``hypotheses/poses`` and ``hypotheses/segmentation`` out, one set a view.

    The results are latched, so that a fusion node that starts late still gets those of the last view.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__("pose_estimator", **options)
        self._object = self.declare("object", "mug", "name of the object to look for")
        self._name = self.declare(
            "estimator",
            AUTOMATIC,
            "which estimator runs; auto: the learned one if the object has weights",
            choices=[AUTOMATIC, *list_estimators()],
        )
        self._settings = self.declare(
            "estimator_parameters", "{}", "the estimator's own parameters, a YAML mapping such as {min_score: 0.4}"
        )
        use_pose = self.declare("use_camera_pose", False, "wait for camera/pose too and pass it to the estimator")
        self._estimator: Estimator | None = None
        self._hypotheses = self.output(PointCloud2, "hypotheses", latched=True)
        self._poses = self.output(PoseArray, "hypotheses/poses", latched=True)
        self._segmentation = self.output(Image, "hypotheses/segmentation", latched=True)
        parts = ["color", "depth", "camera"] + ["pose"] * use_pose
        self._inputs = ViewInputs(self, parts, self._on_view)

    def setup(self) -> None:
        """Load the object and make the estimator."""
        self._inputs.reset()
        self._estimator = create_estimator(self._name, load_object(self._object), **self._read_settings())

    def teardown(self) -> None:
        """Let the estimator go."""
        self._estimator = None

    def _read_settings(self) -> dict[str, Any]:
        try:
            settings = yaml.safe_load(self._settings)
        except yaml.YAMLError:
            settings = None
        if not isinstance(settings, dict):
            raise ValueError(f"{self.get_name()}: parameter 'estimator_parameters' must be a YAML mapping")
        return settings

    def _on_view(self, stamp: int, values: dict[str, Any]) -> None:
        view = View(stamp, values["color"], values["depth"], values["camera"], values.get("pose", np.eye(4)))
        with self.measure(stamp):
            found = self._estimator.estimate(view)
            self._segmentation.publish(segmentation_to_image(found.segmentation, stamp, self.camera_frame))
            self._hypotheses.publish(hypotheses_to_cloud(found, stamp, self.camera_frame))
            self._poses.publish(poses_to_array(found.T_camera_object, stamp, self.camera_frame))


def main() -> None:
    """Entry point of ``ros2 run active6d_perception pose_estimator``."""
    run_node(PoseEstimatorNode)


if __name__ == "__main__":
    main()
