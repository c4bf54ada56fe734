"""What users bring as RGB-D images is converted, or refused with its cause."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from active6d_core.camera import PinholeCamera, View
from active6d_core.rgbd import check_color, check_depth, check_view, crop_depth, make_view

K = np.array([[500.0, 0.0, 32.0], [0.0, 510.0, 24.0], [0.0, 0.0, 1.0]])
RGB = np.full((48, 64, 3), 90, np.uint8)
DEPTH = np.linspace(0.5, 1.5, 48 * 64, dtype=np.float32).reshape(48, 64)


def test_intrinsics_are_those_of_the_matrix():
    camera = make_view(RGB, DEPTH, K).camera
    assert camera == PinholeCamera(64, 48, 500.0, 510.0, 32.0, 24.0)
    np.testing.assert_array_equal(camera.matrix, K)


@pytest.mark.parametrize(
    ("matrix", "cause"),
    [
        (np.eye(3), "is K the identity"),
        (K.T, "transposed"),
        (np.full((3, 3), np.nan), "finite"),
        (K[:2], r"shape \(2, 3\)"),
        (K + [[0, 0, 64], [0, 0, 0], [0, 0, 0]], "another image size"),
        (K * [[100], [100], [1]], "impossible"),
    ],
)
def test_matrices_that_cannot_be_meant_are_refused(matrix, cause):
    with pytest.raises(ValueError, match=cause):
        make_view(RGB, DEPTH, matrix)


@pytest.mark.parametrize(
    "given_depth",
    [DEPTH.astype(float), np.asfortranarray(DEPTH), DEPTH[..., None], DEPTH.astype(">f4")],
    ids=["float64", "fortran", "one channel", "big-endian"],
)
def test_depth_in_metres_is_taken_as_it_is(given_depth):
    converted = check_depth(given_depth)
    assert converted.dtype == np.float32
    assert converted.dtype.isnative
    np.testing.assert_array_equal(converted, DEPTH)


def test_integers_are_millimetres_unless_a_scale_is_given():
    millimetres = np.rint(1000 * DEPTH).astype(np.uint16)
    np.testing.assert_allclose(check_depth(millimetres), DEPTH, atol=6e-4)
    np.testing.assert_allclose(check_depth(10 * millimetres, 1e-4), DEPTH, atol=6e-4)


@pytest.mark.parametrize("invalid", [0.0, -1.0, np.nan, np.inf, -np.inf])
def test_pixels_without_a_distance_are_invalid(invalid):
    depth = DEPTH.copy()
    depth[3:9, 5] = invalid
    converted = check_depth(depth)
    assert np.isnan(converted[3:9, 5]).all()
    assert np.isfinite(converted).sum() == depth.size - 6


@pytest.mark.parametrize(
    ("depth", "cause"),
    [
        (1000 * DEPTH, "looks like millimetres"),
        (0.001 * DEPTH, "check depth_scale"),
        (np.zeros_like(DEPTH), "no valid pixel"),
        (RGB, "must be"),
        (DEPTH.astype(str), "must be"),
        (DEPTH[:0], "must be"),
    ],
)
def test_depth_that_cannot_be_meant_is_refused(depth, cause):
    with pytest.raises(ValueError, match=cause):
        check_depth(depth)


def test_colour_of_other_kinds():
    grey = np.arange(48 * 64, dtype=np.uint8).reshape(48, 64)
    np.testing.assert_array_equal(check_color(grey), np.dstack([grey] * 3))
    np.testing.assert_array_equal(check_color(np.dstack([RGB, grey])), RGB)
    for wrong in (RGB / 255.0, RGB.astype(np.uint16), np.dstack([grey, grey])):
        with pytest.raises(ValueError, match="rgb must be"):
            check_color(wrong)


def test_images_and_camera_of_other_sizes_are_refused():
    with pytest.raises(ValueError, match="register"):
        make_view(RGB[::2, ::2], DEPTH, K)
    with pytest.raises(ValueError, match="1280x720"):
        make_view(RGB, DEPTH, PinholeCamera(1280, 720, 900.0, 900.0, 640.0, 360.0))
    with pytest.raises(ValueError, match="T_world_camera"):
        make_view(RGB, DEPTH, K, T_world_camera=2 * np.eye(4))


@given(st.floats(0.5, 0.9), st.floats(1.0, 1.5))
def test_range_keeps_what_is_inside(near, far):
    cropped = crop_depth(make_view(RGB, DEPTH, K), (near, far)).depth
    inside = (near <= DEPTH) & (far >= DEPTH)
    np.testing.assert_array_equal(np.isfinite(cropped), inside)
    np.testing.assert_array_equal(cropped[inside], DEPTH[inside])


@pytest.mark.parametrize("in_world", [False, True])
def test_region_is_a_box_in_the_camera_or_the_world(in_world):
    T_world_camera = np.array([[0.0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, -0.4], [0, 0, 0, 1]])
    view = make_view(RGB, DEPTH, K, T_world_camera=T_world_camera)
    low, high = np.array([-0.02, -0.03, 0.6]), np.array([0.03, 0.02, 1.1])
    rows, columns = np.indices(DEPTH.shape)
    points = np.stack([(columns - 32.0) / 500.0 * DEPTH, (rows - 24.0) / 510.0 * DEPTH, DEPTH], axis=-1)
    if in_world:
        points = points @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
        low, high = np.array([0.08, 0.18, 0.2]), np.array([0.13, 0.23, 0.7])
    expected = ((points >= low) & (points <= high)).all(axis=-1)
    cropped = crop_depth(view, region=(low, high), region_in_world=in_world)
    assert 0 < expected.sum() < DEPTH.size
    assert (np.isfinite(cropped.depth) != expected).sum() <= 3  # float32 at the box's faces


def test_what_leaves_nothing_is_refused():
    view = make_view(RGB, DEPTH, K)
    with pytest.raises(ValueError, match=r"measures 0\.50 to 1\.50 m"):
        crop_depth(view, (2.0, 3.0))
    with pytest.raises(ValueError, match="near < far"):
        crop_depth(view, (1.0, 0.5))
    with pytest.raises(ValueError, match="region"):
        crop_depth(view, region=(np.ones(3), np.zeros(3)))


BLACK, NEAR = np.zeros((60, 80, 3), np.uint8), np.full((60, 80), 0.8, np.float32)
SMALL = PinholeCamera(80, 60, 75.0, 75.0, 39.5, 29.5)


@pytest.mark.parametrize("kind", ["f2", "f8", ">f4"])
def test_estimators_get_floating_point_depth_and_makes_what_is_no_distance_nan(kind):
    depth = NEAR.astype(kind)
    depth[0, :4] = 0.0, -1.0, np.inf, np.nan
    found = check_view(View(0, BLACK, depth, SMALL, np.eye(4))).depth
    assert found.dtype == np.float32
    assert np.isnan(found[0, :4]).all()
    np.testing.assert_allclose(found[1:], NEAR[1:], atol=1e-3)


def test_estimators_get_a_usual_view_as_it_is():
    view = View(0, BLACK, NEAR, SMALL, np.eye(4))
    assert check_view(view) is view
    empty = View(0, BLACK, np.zeros_like(NEAR), SMALL, np.eye(4))
    assert np.isnan(check_view(empty).depth).all()


def test_estimators_get_millimetres_and_grey_converted():
    view = View(0, BLACK[..., 0], (1000 * NEAR).astype(np.uint16)[..., None], SMALL, np.eye(4))
    np.testing.assert_allclose(check_view(view).depth, NEAR, atol=1e-6)
    np.testing.assert_array_equal(check_view(view).color, BLACK)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"depth": 1000 * NEAR}, "looks like millimetres"),
        ({"depth": NEAR[::2, ::2]}, "rgb is 80x60 pixels, depth 40x30"),
        ({"color": BLACK / 255.0}, "got float64"),
        ({"color": BLACK[::2]}, "rgb is 80x30"),
        ({"camera": PinholeCamera(1280, 720, 900.0, 900.0, 640.0, 360.0)}, "the camera is for 1280x720"),
    ],
)
def test_estimators_refuse_what_is_no_rgbd_image_of_its_camera(change, words):
    arrays = {"color": BLACK, "depth": NEAR, "camera": SMALL, **change}
    with pytest.raises(ValueError, match=words):
        check_view(View(0, arrays["color"], arrays["depth"], arrays["camera"], np.eye(4)))


def test_estimators_refuse_a_list_of_views():
    with pytest.raises(ValueError, match="got list; estimate views one by one"):
        check_view([View(0, BLACK, NEAR, SMALL, np.eye(4))])
