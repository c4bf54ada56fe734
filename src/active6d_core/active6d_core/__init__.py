"""Geometry, data contracts and metrics shared by every active6d package.

Only :mod:`active6d_core.conversions` and :mod:`active6d_core.node` import ROS; everything else needs numpy, scipy and
trimesh alone.
"""
