"""The stub camera and estimator as entries of the graph's nodes."""

from active6d_core.ros.graph_nodes import NodeEntry

STUBS = {
    "camera_simulator": NodeEntry("stub_camera", "StubCameraNode"),
    "pose_estimator": NodeEntry("stub_estimator", "PoseEstimatorNode", restarted=True),
}
