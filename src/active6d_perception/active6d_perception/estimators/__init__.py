"""Pose estimators of one view, their registry, and their evaluation against ground truth."""
