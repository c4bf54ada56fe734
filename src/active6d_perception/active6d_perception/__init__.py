"""Pose estimation, verification and fusion of hypotheses."""
