"""Flying pixels are removed, surfaces stay."""

import numpy as np

from active6d_core.depth_cameras import DEPTH_CAMERAS, without_flying_pixels


def test_pixels_between_two_surfaces_are_removed():
    depth = np.full((20, 30), 0.9, np.float32)
    depth[5:15, 10:20] = 0.6
    depth[5:15, 10] = 0.75  # in rows
    depth[14, 11:20] = 0.7  # in columns
    cleaned = without_flying_pixels(depth)
    flying = np.zeros(depth.shape, bool)
    flying[5:15, 10] = True
    flying[14, 11:20] = True
    assert np.isnan(cleaned[flying]).all()
    assert np.array_equal(cleaned[~flying], depth[~flying])


def test_steps_slopes_and_holes_stay():
    slope = np.linspace(0.5, 1.0, 200, dtype=np.float32) + np.zeros((4, 1), np.float32)
    slope[:, 100:] += 0.3  # a step
    slope[2, 50] = np.nan
    cleaned = without_flying_pixels(slope)
    assert np.array_equal(cleaned, slope, equal_nan=True)


def test_kinds_are_those_of_the_simulated_sensors():
    from active6d_sim.rendering.sensor_registry import sensor_origins

    built_in = {name for name, origin in sensor_origins().items() if origin == "built in"}
    assert set(DEPTH_CAMERAS) == built_in
    assert all(0 < camera.depth_range[0] < camera.depth_range[1] for camera in DEPTH_CAMERAS.values())
