"""Geometry, data contracts and metrics shared by every active6d package.

Only :mod:`.conversions`, :mod:`.node` and :mod:`.optional_outputs` import ROS; everything else needs numpy, scipy and
trimesh alone.
"""
