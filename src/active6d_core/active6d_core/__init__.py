"""Geometry, data contracts and metrics shared by every active6d package.

Only the modules in :mod:`active6d_core.ros` import ROS.
"""
