"""Structured light and time of flight: their effects against geometry that is computed ray by ray."""

import numpy as np
import pytest
from scipy.ndimage import minimum_filter

from active6d_core.camera import PinholeCamera, pixel_rays
from active6d_core.object_model import load_object
from active6d_core.se3 import look_at
from active6d_sim.rendering.active_stereo import ActiveStereo
from active6d_sim.rendering.random_sensor import random_sensor, sensor_of
from active6d_sim.rendering.renderer import RenderedView, SceneRenderer
from active6d_sim.rendering.sensor_registry import create_sensor
from active6d_sim.rendering.structured_light import StructuredLight, projector_shadow
from active6d_sim.rendering.time_of_flight import TimeOfFlight
from active6d_sim.scenes.scene import Bin, Scene
from active6d_sim.scenes.surroundings import Surroundings

CAMERA = PinholeCamera.from_field_of_view(320, 240, 60.0)
SHAPE = (CAMERA.height, CAMERA.width)
SENSORS = [ActiveStereo(), StructuredLight(), TimeOfFlight()]


def view(depth, albedo=0.4, gloss=0.0) -> RenderedView:
    """A surface that faces the camera at every pixel."""
    rays = pixel_rays(CAMERA)
    normals = -rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    full = [np.broadcast_to(np.asarray(value, np.float32), SHAPE).copy() for value in (depth, albedo, gloss)]
    return RenderedView(
        np.full((*SHAPE, 3), 128, np.uint8),
        full[0],
        np.zeros(SHAPE, np.int16),
        normals.astype(np.float32),
        albedo=full[1],
        gloss=full[2],
    )


def measured(sensor, rendered, seed=0):
    return sensor.measure(rendered, CAMERA, np.random.default_rng(seed))[1]


def step(near=0.6, far=0.9):
    """A near block in the middle columns before a far wall."""
    depth = np.full(SHAPE, far, np.float32)
    depth[:, 130:190] = near
    return depth


@pytest.mark.parametrize("left", [True, False])
def test_shadows_are_where_a_ray_to_the_projector_is_blocked(left):
    """Each pixel's point is joined with the projector; the segment is sampled and compared with the depth image."""
    baseline, depth = 0.08, step()
    shadow = projector_shadow(depth, CAMERA.fx * baseline, left)
    projector = np.array([-baseline if left else baseline, 0.0, 0.0])
    row = CAMERA.height // 2
    blocked = np.zeros(CAMERA.width, bool)
    for column in range(CAMERA.width):
        point = pixel_rays(CAMERA)[row, column].astype(float) * depth[row, column]
        for share in np.linspace(0.02, 0.98, 400):
            x, _, z = point + share * (projector - point)
            seen = round(CAMERA.fx * x / z + CAMERA.cx)
            if 0 <= seen < CAMERA.width and abs(seen - column) > 1 and z > depth[row, seen] + 1e-3:
                # Behind the block's face, which is thick enough to stop light: a wall 0.6 to 0.9 m away.
                blocked[column] = True
    assert blocked.sum() > 10
    assert (shadow[row] != blocked).sum() <= 3
    assert (shadow == shadow[row]).all()


def test_structured_light_rounds_disparity_to_its_steps():
    sensor = StructuredLight().scaled(0)
    stepped = StructuredLight(**{**vars(sensor), "disparity_step": 1.0, "baseline": 0.075})
    ramp = np.linspace(0.5, 1.5, CAMERA.height)[:, None]
    depth = measured(stepped, view(ramp))
    disparity = CAMERA.fx * 0.075 * 640 / CAMERA.width / depth
    assert np.allclose(disparity, np.round(disparity), atol=2e-3)
    # Khoshelham and Elberink: steps grow with the square of the distance.
    steps = np.diff(np.unique(np.round(depth[:, 160], 6)))
    assert steps[-1] / steps[0] == pytest.approx((1.5 / 0.5) ** 2, rel=0.15)


def test_structured_light_loses_dark_and_mirroring_surfaces():
    dark, bright = (np.isnan(measured(StructuredLight(), view(0.8, albedo))).mean() for albedo in (0.004, 0.5))
    assert dark > 0.9
    assert bright < 0.02
    mirror = np.isnan(measured(StructuredLight(), view(0.8, gloss=1.0))).mean()
    assert mirror == pytest.approx(0.9, abs=0.02)


def test_near_surfaces_grow_by_at_most_the_given_pixels():
    grown = StructuredLight(**{**vars(StructuredLight().scaled(0)), "edge_growth": 3})
    depth = measured(grown, view(step()))
    largest = minimum_filter(step(), 7)
    assert (depth >= largest - 1e-4).all()
    assert ((depth < step() - 0.1) & (largest < 0.7)).sum() > 100


def test_flying_pixels_lie_between_the_surfaces():
    flying = TimeOfFlight(**{**vars(TimeOfFlight().scaled(0)), "flying_pixels": 0.5})
    depth = measured(flying, view(step()))
    between = (depth > 0.601) & (depth < 0.899)
    columns = np.flatnonzero(between.any(axis=0))
    assert set(columns) <= {129, 130, 189, 190}
    assert between[:, [129, 130, 189, 190]].mean() == pytest.approx(0.5, abs=0.06)


def test_time_of_flight_is_noisier_far_away_and_on_dark_surfaces():
    noisy = TimeOfFlight(**{**vars(TimeOfFlight().scaled(0)), "noise": 0.002})
    deviations = [np.nanstd(measured(noisy, view(z, albedo)) - z) for z, albedo in ((0.8, 0.4), (1.6, 0.4), (0.8, 0.1))]
    assert deviations == pytest.approx([0.002, 0.008, 0.008], rel=0.05)


def test_corners_look_farther_by_multipath():
    """The bottom of a trough is measured too deep by the share of how much nearer its surroundings are."""
    depth = np.full(SHAPE, 0.80, np.float32)
    depth[:, 155:165] = 0.85
    sensor = TimeOfFlight(**{**vars(TimeOfFlight().scaled(0)), "multipath": 0.1})
    error = measured(sensor, view(depth)) - depth
    around = 0.80 + 0.05 * 10 / 31
    assert error[120, 160] == pytest.approx(0.1 * (0.85 - around), rel=0.05)
    assert abs(error[120, 20]) < 1e-6


@pytest.mark.parametrize("sensor", SENSORS, ids=lambda sensor: type(sensor).__name__)
def test_calibration_errors_scale_and_shift_all_depths(sensor):
    off = type(sensor)(**{**vars(sensor.scaled(0)), "scale_error": 0.01, "offset_error": -0.002})
    assert np.allclose(measured(off, view(step())), step() * 1.01 - 0.002, atol=1e-5)


@pytest.mark.parametrize("sensor", SENSORS, ids=lambda sensor: type(sensor).__name__)
def test_without_noise_the_depth_is_the_true_one(sensor):
    assert np.allclose(measured(sensor.scaled(0), view(step())), step(), atol=1e-5)


def test_colour_is_shifted_against_depth():
    rendered = view(0.8)
    rendered.color[100, 100] = 255
    sensor = StructuredLight(**{**vars(StructuredLight().scaled(0)), "misalignment": (3, -2)})
    color, _ = sensor.measure(rendered, CAMERA, np.random.default_rng(0))
    assert (color[98, 103] == 255).all()
    assert (color[100, 100] == 128).all()


@pytest.mark.parametrize("name", ["active_stereo", "structured_light", "time_of_flight"])
def test_sensors_are_made_by_name(name):
    sensor = create_sensor(name, load_object("mug"), scale_error=0.01)
    assert sensor.scale_error == 0.01
    with pytest.raises(ValueError, match="scale_error"):
        create_sensor(name, load_object("mug"), scale_error=float("nan"))


def test_a_wild_scene_has_a_random_sensor_and_another_the_default_one():
    model, empty = load_object("mug"), np.zeros((0, 4, 4))
    plain, wild = (
        Scene("mug", "x", 5, empty, Bin(0.3, 0.3, 0.1), np.zeros((0, 0)), surroundings=around)
        for around in (None, Surroundings())
    )
    assert sensor_of("auto", model, plain) == ActiveStereo()
    assert sensor_of("auto", model, wild, 1) == sensor_of("auto", model, wild, 1) != sensor_of("auto", model, wild, 2)
    assert sensor_of("time_of_flight", model, wild) == TimeOfFlight()
    kinds = {type(random_sensor(np.random.default_rng(seed))) for seed in range(20)}
    assert kinds == {ActiveStereo, StructuredLight, TimeOfFlight}


def test_things_are_drawn_where_they_are_and_are_no_objects():
    """A box of known size on the table, seen from above, has its place and height in the depth image."""
    T = np.eye(4)
    T[:3, 3] = (0.1, 0.0, 0.05)
    around = Surroundings(("box",), np.array([[0.2, 0.1, 0.1]]), T[None], np.array([[1.0, 0.0, 0.0]]), tray=False)
    scene = Scene("mug", "x", 0, np.eye(4)[None] + np.zeros((1, 4, 4)), Bin(0.3, 0.3, 0.0), np.zeros((0, 1)))
    scene = Scene("mug", "x", 0, scene.T_world_object, scene.bin, np.zeros((0, 1)), surroundings=around)
    T_world_camera = look_at(np.array([0.1, 0.0, 1.0]), np.array([0.1, 0.0, 0.0]))
    rendered = SceneRenderer(scene).render(T_world_camera, CAMERA)
    assert rendered.depth[120, 160] == pytest.approx(0.9, abs=1e-4)
    on_top = np.abs(rendered.depth - 0.9) < 1e-3
    assert on_top.sum() == pytest.approx(0.2 * 0.1 * CAMERA.fx**2 / 0.9**2, rel=0.05)
    assert (rendered.instance[on_top] == -1).all()
    assert rendered.albedo[120, 160] > 0
    assert rendered.gloss[120, 160] == 0
