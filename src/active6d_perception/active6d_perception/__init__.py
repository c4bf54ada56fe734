"""Pose estimation, verification and fusion of hypotheses."""

from active6d_perception.active6d import Active6D

__all__ = ["Active6D"]
