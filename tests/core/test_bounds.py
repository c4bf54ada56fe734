"""Values that are finite and of the right type, and still impossible: refused at the border with their likely cause."""

from dataclasses import replace

import numpy as np
import pytest
from sensor_msgs.msg import RegionOfInterest

from active6d_core.bounds import (
    check_camera_pose,
    check_hypotheses,
    check_image_size,
    check_in_front,
    check_objects,
    check_points,
    limit_depth,
)
from active6d_core.camera import PinholeCamera
from active6d_core.hypotheses import Hypotheses, SceneObjects
from active6d_core.rgbd import make_view
from active6d_core.ros.conversions import MessageError, camera_to_info, info_to_camera, objects_from_cloud
from active6d_core.ros.conversions import objects_to_cloud as to_cloud
from active6d_core.se3 import make_transform
from active6d_core.view_sphere import ViewSphere

CAMERA = PinholeCamera.from_field_of_view(64, 48, 60.0)
MASK = np.array([[0, 1], [2, 2]], np.uint16)
HYPOTHESES = Hypotheses(
    make_transform(np.tile(np.eye(3), (2, 1, 1)), np.array([[0.0, 0.0, 0.7], [0.1, 0.0, 0.8]])),
    np.array([0.0, 1.0]),
    np.array([[0.0, 0.0, 1.0, 1.0], [0.2, 0.2, 0.4, 0.4]]),
    np.array([0.7, 0.8]),
    np.array([1, 2], np.uint16),
    MASK,
)
OBJECTS = SceneObjects(
    HYPOTHESES.T_camera_object,
    np.array([-1.0, 1.0]),
    HYPOTHESES.score,
    HYPOTHESES.box,
    np.array([-0.5, 0.8]),
    np.array([1, 6]),
    np.array([0.0, 0.01]),
    np.array([0.0, 1.0]),
    np.array([0.0, 2.0]),
)


def with_value(table, column, value):
    values = np.array(getattr(table, column), float)
    values[0] = value
    return replace(table, **{column: values})


def moved(table, column, z):
    T = getattr(table, column).copy()
    T[0, 2, 3] = z
    return replace(table, **{column: T})


def test_what_is_at_its_bounds_is_accepted():
    check_hypotheses(HYPOTHESES)
    check_in_front(HYPOTHESES.T_camera_object)
    check_objects(OBJECTS)
    check_points(np.array([[0.0, -100.0, 100.0]]))


@pytest.mark.parametrize(("column", "value"), [("score", -1), ("score", 2), ("box", 7), ("depth", 0), ("depth", 1e30)])
def test_hypotheses_out_of_bounds_are_named(column, value):
    with pytest.raises(ValueError, match=f"column '{column}' holds"):
        check_hypotheses(with_value(HYPOTHESES, column, value))


def test_hypotheses_need_a_mask_and_a_place_before_the_camera():
    with pytest.raises(ValueError, match="label 60000 has no pixel"):
        check_hypotheses(replace(HYPOTHESES, label=np.array([1, 60000], np.uint16)))
    with pytest.raises(ValueError, match="column 'position' holds 1e\\+10"):
        check_hypotheses(moved(HYPOTHESES, "T_camera_object", 1e10))
    with pytest.raises(ValueError, match="column 'z' holds -1"):
        check_in_front(moved(HYPOTHESES, "T_camera_object", -1.0).T_camera_object)


@pytest.mark.parametrize(
    ("column", "value"),
    [("verification", -7), ("score", 1e30), ("box", -1e30), ("depth", 1e30), ("support", 0), ("spread", -1)]
    + [("support", 65535), ("spread", 1e30), ("probability", -0.1), ("probability", 1.1), ("entropy", -1)],
)
def test_objects_out_of_bounds_are_named_also_in_messages(column, value):
    wrong = with_value(OBJECTS, column, value)
    with pytest.raises(ValueError, match=f"column '{column}' holds"):
        check_objects(wrong)
    with pytest.raises(MessageError, match=f"column '{column}' holds"):
        objects_from_cloud(to_cloud(wrong, 1, "world"), "world")


def test_depth_outside_the_range_is_invalid():
    depth = np.array([[0.01, 0.7, np.nan, 1000.0, 20.0]], np.float32)
    np.testing.assert_array_equal(limit_depth(depth), np.array([[np.nan, 0.7, np.nan, np.nan, 20.0]], np.float32))
    assert limit_depth(depth[:, 1:3]) is not None
    nothing = np.full((2, 2), np.nan, np.float32)
    assert limit_depth(nothing) is nothing
    with pytest.raises(ValueError, match="median is 750 m; it looks like millimetres"):
        limit_depth(np.full((2, 2), 750.0, np.float32))
    with pytest.raises(ValueError, match=r"within 0.05 to 1 m, the median is 1.5 m; check the range and the unit"):
        limit_depth(np.full((2, 2), 1.5, np.float32), (0.05, 1.0))


@pytest.mark.parametrize("size", [(1, 1), (15, 480), (5000, 480), (4000, 3000)])
def test_images_of_impossible_sizes_are_refused(size):
    with pytest.raises(ValueError, match="sides must be 16 to 4096 pixels"):
        check_image_size(*size)


def test_cameras_are_above_the_bin_and_near():
    pose = ViewSphere().pose(ViewSphere().positions[0])
    check_camera_pose(pose)
    for place, cause in (([0, 0, 1000.0], "millimetres"), ([0.1, 0.1, -0.8], "inverted"), ([0, 0, 0], "inverted")):
        pose[:3, 3] = place
        with pytest.raises(ValueError, match=cause):
            check_camera_pose(pose)


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        ({"binning_x": 8}, "8x48 pixels"),
        ({"roi": RegionOfInterest(x_offset=50, width=14, height=48)}, "14x48 pixels"),
        ({"r": [0.0, -1, 0, 1, 0, 0, 0, 0, 1]}, "distortion"),
        ({"distortion_model": "equidistant"}, "distortion"),
        ({"d": [float("nan")] * 5}, "finite"),
        ({"p": [1e-3, 0, 31.5, 0, 0, 1e-3, 23.5, 0, 0, 0, 1, 0]}, "focal lengths"),
        ({"p": [55.4, 50, 31.5, 0, 0, 55.4, 23.5, 0, 0, 0, 1, 0]}, "skew"),
        ({"p": [55.4, 0, 310, 0, 0, 55.4, 23.5, 0, 0, 0, 1, 0]}, "outside the 64x48 image"),
        ({"k": [float("nan")] * 9}, "finite"),
        ({"width": 1, "height": 1}, "1x1"),
        ({"width": 2**31}, "2147483648x48"),
    ],
)
def test_a_camera_info_is_used_or_refused(change, cause):
    info = camera_to_info(CAMERA, 1, "camera")
    for name, value in change.items():
        setattr(info, name, value)
    with pytest.raises(MessageError, match=cause):
        info_to_camera(info)


@pytest.mark.parametrize("centre", [(-20.5, 23.5), (31.5, 70.0), (90.0, -3.0)])
def test_a_camera_info_may_be_of_a_part_of_a_larger_image(centre):
    part = replace(CAMERA, cx=centre[0], cy=centre[1])
    info = camera_to_info(part, 1, "camera")
    assert 0 < info.k[2] < info.width
    assert 0 < info.k[5] < info.height
    assert info_to_camera(info) == part


def test_a_camera_info_may_leave_out_what_it_does_not_need():
    info = camera_to_info(CAMERA, 1, "camera")
    info.p, info.r, info.d, info.distortion_model = [0.0] * 12, [0.0] * 9, [], ""
    info.roi, info.binning_x = RegionOfInterest(width=64, height=48), 1
    assert info_to_camera(info) == CAMERA


def test_library_calls_have_the_same_bounds():
    color, depth = np.zeros((48, 64, 3), np.uint8), np.full((48, 64), 0.7, np.float32)
    depth[0, :5] = 1000.0
    assert np.isnan(make_view(color, depth, CAMERA).depth[0, :5]).all()
    far = np.eye(4)
    far[0, 3] = 1000.0
    with pytest.raises(ValueError, match="millimetres"):
        make_view(color, depth, CAMERA, T_world_camera=far)
    with pytest.raises(ValueError, match="8x8 pixels"):
        make_view(color[:8, :8], depth[8:16, :8], CAMERA)
