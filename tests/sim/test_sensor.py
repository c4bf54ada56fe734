"""The sensor's noise and losses against the formulas that its parameters stand for."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from active6d_core.camera import PinholeCamera, pixel_rays
from active6d_core.object_model import load_object
from active6d_sim.rendering.active_stereo import ActiveStereo
from active6d_sim.rendering.renderer import RenderedView
from active6d_sim.rendering.sensor_registry import create_sensor, sensor_origins

CAMERA = PinholeCamera.from_field_of_view(320, 240, 60.0)
NOTHING = ActiveStereo().scaled(0)


def only(**parameters) -> ActiveStereo:
    return ActiveStereo(**{**vars(NOTHING), **parameters})


def wall(depth=0.8, degrees=0.0) -> RenderedView:
    """A surface whose normal is ``degrees`` away from the ray at every pixel; one depth, or (H, W) of them."""
    rays = pixel_rays(CAMERA).astype(float)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    across = np.cross(rays, [1.0, 0.0, 0.0])
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    normals = -np.cos(np.radians(degrees)) * rays + np.sin(np.radians(degrees)) * across
    shape = (CAMERA.height, CAMERA.width)
    depth = np.broadcast_to(np.asarray(depth, np.float32), shape).copy()
    return RenderedView(np.full((*shape, 3), 128, np.uint8), depth, np.zeros(shape, np.int16), normals.astype("f4"))


def measure(view, noise, seed=0):
    return noise.measure(view, CAMERA, np.random.default_rng(seed))


def missing_share(view, noise) -> float:
    return float(np.isnan(measure(view, noise)[1]).mean())


@pytest.mark.parametrize("depth", [0.4, 0.8, 1.6])
def test_sigma_grows_with_the_square_of_the_distance(depth):
    noise = only(disparity=0.07, patch=3)
    error = measure(wall(depth), noise)[1] - depth
    expected = depth**2 * 0.07 / (CAMERA.fx * 0.055)
    assert noise.depth_sigma(depth, CAMERA) == pytest.approx(expected)
    assert error.std() == pytest.approx(expected, rel=0.05)
    assert abs(error.mean()) < 0.05 * expected


def test_sigma_of_a_vga_image_at_working_distance_is_as_documented():
    vga = PinholeCamera.from_field_of_view(640, 480, 60.0)
    assert ActiveStereo().depth_sigma(0.8, vga) == pytest.approx(1.5e-3, rel=0.03)


def test_error_is_correlated_over_a_patch_and_not_beyond():
    error = measure(wall(), only(disparity=0.07, patch=3))[1] - 0.8
    for lag, expected in ((1, 2 / 3), (2, 1 / 3), (3, 0.0)):  # shared columns of two 3 x 3 windows
        for a, b in ((error[lag:], error[:-lag]), (error[:, lag:], error[:, :-lag])):
            assert np.corrcoef(a.ravel(), b.ravel())[0, 1] == pytest.approx(expected, abs=0.03)
    alone = measure(wall(), only(disparity=0.07, patch=1))[1] - 0.8
    assert abs(np.corrcoef(alone[1:].ravel(), alone[:-1].ravel())[0, 1]) < 0.02


@pytest.mark.parametrize(("degrees", "share"), [(60, 0.0), (80, 0.2689), (82, 0.5), (84, 0.7311)])
def test_grazing_returns_go_missing(degrees, share):
    assert missing_share(wall(degrees=degrees), only(grazing_degrees=82.0)) == pytest.approx(share, abs=0.01)


def test_speckle_goes_missing():
    assert missing_share(wall(), only(speckle_loss=0.1)) == pytest.approx(0.1, abs=0.005)


def test_losses_are_independent_of_each_other():
    noise = only(speckle_loss=0.3, grazing_degrees=82.0)
    assert missing_share(wall(degrees=82), noise) == pytest.approx(1 - 0.7 * 0.5, abs=0.01)


def test_only_pixels_beside_a_step_lose_edges():
    step = np.where(np.arange(CAMERA.width) < 100, 0.8, 0.82)
    lost = np.isnan(measure(wall(step), only(edge_loss=0.5, edge_step=0.015))[1])
    assert lost[:, 99:101].mean() == pytest.approx(0.5, abs=0.07)
    assert not lost[:, :99].any()
    assert not lost[:, 101:].any()
    small = np.where(np.arange(CAMERA.width) < 100, 0.8, 0.81)
    assert missing_share(wall(small), only(edge_loss=0.5, edge_step=0.015)) == 0


def test_jitter_takes_neighbours_only():
    step = np.where(np.arange(CAMERA.width) < 100, 0.8, 0.9).astype(np.float32)
    depth = measure(wall(step), only(jitter=1))[1]
    assert set(np.unique(depth)) == set(step)
    # A pixel beside the edge looks one column across it in a third of the cases.
    assert (depth[:, 99] == step[100]).mean() == pytest.approx(1 / 3, abs=0.1)
    assert (depth[:, :99] == step[0]).all()
    assert (depth[:, 101:] == step[100]).all()


def test_depth_is_rounded_to_the_quantum():
    slope = np.linspace(0.5, 1.0, CAMERA.width, dtype=np.float32)
    depth = measure(wall(slope), only(quantum=0.002))[1].astype(float)
    assert np.abs(depth / 0.002 - np.rint(depth / 0.002)).max() < 1e-4
    assert np.abs(depth - slope).max() <= 0.001 + 1e-6


def test_color_noise_has_its_sigma():
    color = measure(wall(), only(color=5.0))[0]
    assert color.std() == pytest.approx(np.sqrt(25 + 1 / 12), rel=0.01)  # rounding adds a twelfth
    white = RenderedView(np.full((240, 320, 3), 255, np.uint8), *list(vars(wall()).values())[1:])
    assert measure(white, only(color=5.0))[0].min() > 200  # clipped, not wrapped


def test_off_is_the_identity():
    view = wall(np.linspace(0.5, 1.0, CAMERA.width), degrees=89)
    view.depth[:3] = np.nan
    color, depth = measure(view, ActiveStereo().scaled(0))
    np.testing.assert_array_equal(color, view.color)
    np.testing.assert_array_equal(depth, view.depth)
    assert depth.dtype == np.float32


def test_default_sensor_keeps_what_has_no_depth_missing():
    view = wall()
    view.depth[100:110] = np.nan
    assert np.isnan(measure(view, only(disparity=0.07))[1][100:110]).all()


def test_same_generator_same_measurement():
    first, again, other = (measure(wall(), ActiveStereo(), seed) for seed in (3, 3, 4))
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(first[1], other[1], equal_nan=True)


@given(st.floats(0.01, 1e3))
def test_scaled(factor):
    noise = ActiveStereo().scaled(factor)
    assert noise.disparity == pytest.approx(0.07 * factor)
    assert noise.color == pytest.approx(2.0 * factor)
    assert noise.edge_loss == pytest.approx(min(0.5 * factor, 1.0))
    assert noise.speckle_loss == pytest.approx(min(0.002 * factor, 1.0))
    assert (noise.quantum, noise.jitter, noise.grazing_degrees) == (0.0005, 1, 82.0)
    assert ActiveStereo().scaled(0.0) == ActiveStereo().scaled(0)


@pytest.mark.parametrize(
    ("name", "value"),
    [("disparity", -0.1), ("quantum", np.nan), ("color", np.inf), ("edge_loss", 1.1), ("baseline", 0.0), ("patch", 0)],
)
def test_bad_parameters_are_named(name, value):
    with pytest.raises(ValueError, match=name):
        ActiveStereo(**{name: value})


def test_the_default_sensor_is_active_stereo():
    assert create_sensor("active_stereo", load_object("mug")) == ActiveStereo()
    assert sensor_origins()["active_stereo"] == "built in"
    with pytest.raises(ValueError, match="unknown sensor 'sonar'; known: auto, active_stereo"):
        create_sensor("sonar", load_object("mug"))
