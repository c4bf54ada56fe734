"""The real estimator node with the stub estimator known to it, as a module to run in a process of its own."""

import stub_camera  # noqa: F401  registers the estimator

from active6d_perception.nodes.pose_estimator import PoseEstimatorNode, main

__all__ = ["PoseEstimatorNode"]

if __name__ == "__main__":
    main()
