"""Messages to the core's types and back: what goes round comes back equal, and what is wrong is refused."""

import array
import contextlib

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from rclpy.serialization import deserialize_message, serialize_message
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Image, PointCloud2

from active6d_core.camera import PinholeCamera
from active6d_core.hypotheses import Hypotheses, SceneObjects
from active6d_core.ros import conversions
from active6d_core.ros.conversions import MessageError
from active6d_core.se3 import make_transform

FRAME = "camera_optical_frame"
seeds = st.integers(0, 2**32 - 1)


def random_transforms(rng: np.random.Generator, count: int) -> np.ndarray:
    return make_transform(Rotation.random(count, rng=rng).as_matrix(), rng.uniform(-2, 2, (count, 3)))


def random_hypotheses(seed: int) -> Hypotheses:
    rng = np.random.default_rng(seed)
    k = int(rng.integers(1, 6))
    return Hypotheses(
        T_camera_object=random_transforms(rng, k),
        score=rng.random(k),
        box=rng.random((k, 4)),
        depth=rng.uniform(0.3, 1.2, k),
        label=np.arange(1, k + 1, dtype=np.uint16),
        segmentation=rng.integers(0, k + 1, (12, 16)).astype(np.uint16),
    )


def through_the_wire(message):
    """The message as a subscriber gets it."""
    return deserialize_message(serialize_message(message), type(message))


@given(st.integers(0, 2**31 * 10**9 - 1))
def test_stamps_come_back_to_the_nanosecond(nanoseconds):
    assert conversions.stamp_to_ns(conversions.ns_to_stamp(nanoseconds)) == nanoseconds


@given(seeds)
def test_poses_come_back(seed):
    T = random_transforms(np.random.default_rng(seed), 3)
    back = conversions.poses_from_array(through_the_wire(conversions.poses_to_array(T, 5, FRAME)), FRAME)
    np.testing.assert_allclose(back, T, atol=1e-12)


def test_a_quaternion_means_what_scipy_says_it_means():
    pose = conversions.transform_to_pose(np.eye(4))
    half = np.sqrt(0.5)
    pose.orientation.z, pose.orientation.w = half, half
    # A quarter turn about z takes x to y.
    np.testing.assert_allclose(conversions.pose_to_transform(pose)[:3, 0], [0, 1, 0], atol=1e-12)


@pytest.mark.parametrize(("field", "value"), [("w", 0.0), ("w", 2.0), ("x", float("nan"))])
def test_bad_quaternions_are_refused(field, value):
    pose = conversions.transform_to_pose(np.eye(4))
    setattr(pose.orientation, field, value)
    with pytest.raises(MessageError, match=r"quaternion|finite"):
        conversions.pose_to_transform(pose)


def test_a_pose_in_another_frame_is_refused():
    message = conversions.transform_to_pose_stamped(np.eye(4), 1, "map")
    with pytest.raises(MessageError, match="'map', expected 'world'"):
        conversions.pose_stamped_to_transform(message, "world")


@given(hnp.arrays(np.uint8, (5, 7, 3)))
def test_color_images_come_back(color):
    image = through_the_wire(conversions.color_to_image(color, 3, FRAME))
    assert (image.encoding, image.step, conversions.stamp_to_ns(image.header.stamp)) == ("rgb8", 21, 3)
    np.testing.assert_array_equal(conversions.image_to_color(image), color)


@pytest.mark.parametrize(("encoding", "order"), [("bgr8", [2, 1, 0]), ("rgba8", [0, 1, 2, 0]), ("bgra8", [2, 1, 0, 0])])
def test_other_channel_orders_are_understood(encoding, order):
    color = np.random.default_rng(0).integers(0, 256, (4, 6, 3), dtype=np.uint8)
    stored = np.ascontiguousarray(color[..., order])
    image = Image(height=4, width=6, encoding=encoding, step=6 * len(order), data=array.array("B", stored.tobytes()))
    np.testing.assert_array_equal(conversions.image_to_color(image), color)


@given(hnp.arrays(np.float32, (4, 6), elements=st.floats(width=32, allow_nan=True, allow_infinity=True)))
def test_depth_keeps_what_is_positive_and_finite(depth):
    back = conversions.image_to_depth(through_the_wire(conversions.depth_to_image(depth, 1, FRAME)))
    valid = np.isfinite(depth) & (depth > 0)
    np.testing.assert_array_equal(back[valid], depth[valid])
    assert np.isnan(back[~valid]).all()


def test_millimetres_become_metres_and_zero_becomes_nan():
    stored = np.array([[0, 1, 1500]], "<u2")
    image = Image(height=1, width=3, encoding="16UC1", step=6, data=array.array("B", stored.tobytes()))
    np.testing.assert_allclose(conversions.image_to_depth(image), [[np.nan, 0.001, 1.5]], rtol=1e-6)


def test_rows_with_padding_are_read():
    rows = np.zeros((2, 16), np.uint8)
    rows[:, :12] = np.arange(6, dtype="<f4").reshape(2, 3).view(np.uint8) + 0
    image = Image(height=2, width=3, encoding="32FC1", step=16, data=array.array("B", rows.tobytes()))
    np.testing.assert_array_equal(conversions.image_to_depth(image), [[np.nan, 1, 2], [3, 4, 5]])


@pytest.mark.parametrize(
    "change",
    [
        {"encoding": "mono8"},
        {"width": 0},
        {"step": 4},
        {"height": 9},
        {"data": array.array("B", b"123")},
    ],
)
def test_images_whose_fields_disagree_are_refused(change):
    image = conversions.depth_to_image(np.ones((4, 6), np.float32), 1, FRAME)
    for field, value in change.items():
        setattr(image, field, value)
    with pytest.raises(MessageError):
        conversions.image_to_depth(image)


def test_cameras_come_back_and_distorted_ones_are_refused():
    camera = PinholeCamera(64, 48, 60.0, 61.0, 31.0, 24.5)
    info = through_the_wire(conversions.camera_to_info(camera, 1, FRAME))
    assert conversions.info_to_camera(info) == camera
    info.d[1] = 0.1
    with pytest.raises(MessageError, match="camera_adapter"):
        conversions.info_to_camera(info)


def test_a_camera_without_focal_length_is_refused():
    info = conversions.camera_to_info(PinholeCamera(64, 48, 60.0, 60.0, 31.0, 24.0), 1, FRAME)
    info.k[0] = info.p[0] = 0.0
    with pytest.raises(MessageError, match="focal"):
        conversions.info_to_camera(info)


def test_big_endian_images_are_read():
    image = conversions.depth_to_image(np.ones((4, 6), np.float32), 1, FRAME)
    millimetres = (np.arange(24).reshape(4, 6) * 100).astype(">u2")
    image.encoding, image.step, image.is_bigendian = "16UC1", 12, 1
    image.data = array.array("B", millimetres.tobytes())
    np.testing.assert_allclose(np.nan_to_num(conversions.image_to_depth(image)), millimetres * 1e-3, rtol=1e-6)


@given(seeds)
def test_hypotheses_come_back(seed):
    hypotheses = random_hypotheses(seed)
    cloud = through_the_wire(conversions.hypotheses_to_cloud(hypotheses, 9, FRAME))
    image = through_the_wire(conversions.segmentation_to_image(hypotheses.segmentation, 9, FRAME))
    back = conversions.hypotheses_from_cloud(cloud, conversions.image_to_segmentation(image), FRAME)
    for column in ("T_camera_object", "score", "box", "depth"):
        np.testing.assert_allclose(getattr(back, column), getattr(hypotheses, column), atol=1e-6)
    np.testing.assert_array_equal(back.label, hypotheses.label)
    np.testing.assert_array_equal(back.segmentation, hypotheses.segmentation)


def test_xyz_stand_where_viewers_look_for_them():
    cloud = conversions.hypotheses_to_cloud(random_hypotheses(1), 9, FRAME)
    leading = [(field.name, field.offset, field.datatype) for field in cloud.fields[:3]]
    assert leading == [("x", 0, 7), ("y", 4, 7), ("z", 8, 7)]
    assert all(field.offset % 2 == 0 for field in cloud.fields)
    assert cloud.point_step % 4 == 0


def test_empty_tables_come_back_empty():
    segmentation = np.zeros((4, 4), np.uint16)
    cloud = conversions.hypotheses_to_cloud(Hypotheses.empty(4, 4), 1, FRAME)
    assert len(conversions.hypotheses_from_cloud(through_the_wire(cloud), segmentation, FRAME)) == 0
    cloud = conversions.objects_to_cloud(SceneObjects.empty(), 1, "world")
    assert len(conversions.objects_from_cloud(through_the_wire(cloud), "world")) == 0


def drop_column(cloud: PointCloud2) -> None:
    cloud.fields = [field for field in cloud.fields if field.name != "score"]


def cut_data(cloud: PointCloud2) -> None:
    cloud.data = cloud.data[:-1]


def column_past_the_end(cloud: PointCloud2) -> None:
    cloud.fields[0].offset = cloud.point_step


def several_values_per_column(cloud: PointCloud2) -> None:
    cloud.fields[0].count = 2


def not_a_number(cloud: PointCloud2) -> None:
    cloud.data[:4] = array.array("B", np.float32(np.nan).tobytes())


def huge_width(cloud: PointCloud2) -> None:
    cloud.width = 2**31


def background_label(cloud: PointCloud2) -> None:
    offset = next(field.offset for field in cloud.fields if field.name == "label")
    cloud.data[offset : offset + 2] = array.array("B", b"\0\0")


@pytest.mark.parametrize(
    "damage",
    [drop_column, cut_data, column_past_the_end, several_values_per_column, not_a_number, huge_width, background_label],
)
def test_damaged_tables_are_refused(damage):
    hypotheses = random_hypotheses(3)
    cloud = conversions.hypotheses_to_cloud(hypotheses, 1, FRAME)
    damage(cloud)
    with pytest.raises(MessageError):
        conversions.hypotheses_from_cloud(cloud, hypotheses.segmentation, FRAME)


@given(st.binary(max_size=400), st.integers(0, 8), st.integers(0, 8), st.integers(0, 80), st.integers(0, 200))
def test_arbitrary_tables_are_read_or_refused(data, height, width, point_step, row_step):
    cloud = conversions.hypotheses_to_cloud(random_hypotheses(3), 1, FRAME)
    cloud.height, cloud.width, cloud.point_step, cloud.row_step = height, width, point_step, row_step
    cloud.data = array.array("B", data)
    with contextlib.suppress(MessageError):
        conversions.hypotheses_from_cloud(cloud, np.zeros((4, 4), np.uint16), FRAME)


@given(seeds)
def test_objects_come_back(seed):
    rng = np.random.default_rng(seed)
    n = 4
    objects = SceneObjects(
        random_transforms(rng, n),
        *(rng.random(n) for _ in range(2)),
        rng.random((n, 4)),
        rng.random(n),
        rng.integers(1, 7, n),
        rng.random(n) * 0.01,
        rng.random(n),
        rng.random(n),
    )
    back = conversions.objects_from_cloud(through_the_wire(conversions.objects_to_cloud(objects, 2, "world")), "world")
    for column in ("T_world_object", "verification", "score", "box", "depth", "spread", "probability", "entropy"):
        np.testing.assert_allclose(getattr(back, column), getattr(objects, column), atol=1e-6)
    np.testing.assert_array_equal(back.support, objects.support)


def one_object(**columns):
    ones = np.ones(1)
    table = {name: ones for name in ("verification", "score", "depth", "spread", "probability", "entropy")}
    return SceneObjects(
        T_world_object=np.eye(4)[None], box=np.zeros((1, 4)), support=np.ones(1, int), **{**table, **columns}
    )


def test_objects_of_earlier_recordings_have_their_score_as_probability():
    cloud = conversions.objects_to_cloud(one_object(score=np.array([0.25])), 2, "world")
    cloud.fields = [field for field in cloud.fields if field.name not in ("probability", "entropy")]
    back = conversions.objects_from_cloud(through_the_wire(cloud), "world")
    assert (back.probability[0], back.entropy[0]) == (0.25, 0.0)


@pytest.mark.parametrize("attended", [None, 2])
def test_attention_comes_back(attended):
    cloud = conversions.attention_to_cloud(np.zeros((3, 3)), np.array([0.2, 0.3, 0.5]), attended, 1, "world")
    weight, index = conversions.attention_from_cloud(through_the_wire(cloud), "world")
    np.testing.assert_allclose(weight, [0.2, 0.3, 0.5], atol=1e-7)
    assert index == attended


@pytest.mark.parametrize("count", [0, 1, 5000])
def test_points_come_back(count):
    points = np.random.default_rng(0).uniform(-1, 1, (count, 3))
    cloud = through_the_wire(conversions.points_to_cloud(points, 3, "world"))
    assert (cloud.width, cloud.point_step, len(cloud.fields)) == (count, 12, 3)
    back = conversions.points_from_cloud(cloud, "world")
    np.testing.assert_array_equal(back, points.astype(np.float32))
    with pytest.raises(MessageError, match="frame_id is 'world', expected 'map'"):
        conversions.points_from_cloud(cloud, "map")


def test_points_that_cannot_be_used_are_refused():
    cloud = conversions.points_to_cloud(np.full((2, 3), np.nan), 3, "world")
    with pytest.raises(MessageError, match="'x' holds a number that is not finite"):
        conversions.points_from_cloud(cloud, "world")
    cloud = conversions.points_to_cloud(np.zeros((100_001, 3)), 3, "world")
    with pytest.raises(MessageError, match="100001 rows, more than 100000"):
        conversions.points_from_cloud(cloud, "world")
    cloud = conversions.points_to_cloud(np.zeros((2, 3)), 3, "world")
    cloud.fields[2].name = "w"
    with pytest.raises(MessageError, match="no usable column 'z'"):
        conversions.points_from_cloud(cloud, "world")


def test_tables_too_long_for_any_heap_are_refused():
    hypotheses = random_hypotheses(3)
    cloud = conversions.hypotheses_to_cloud(hypotheses, 1, FRAME)
    copies = 2001 // len(hypotheses) + 1
    cloud.width *= copies
    cloud.row_step *= copies
    cloud.data *= copies
    with pytest.raises(MessageError, match="more than 2000"):
        conversions.hypotheses_from_cloud(cloud, hypotheses.segmentation, FRAME)


@pytest.mark.parametrize(
    ("value", "hardware", "expected"), [("1.5", "active6d", {"n": 1.5}), ("soon", "active6d", {}), ("1.5", "x", {})]
)
def test_latencies_are_read_from_our_nodes_only(value, hardware, expected):
    status = DiagnosticStatus(name="/ns/n", hardware_id=hardware, values=[KeyValue(key="latency_ms", value=value)])
    assert conversions.latencies_from_diagnostics(DiagnosticArray(status=[status])) == expected


def test_markers_colour_by_probability_and_clear_the_last_ones():
    objects = SceneObjects(
        T_world_object=np.eye(4)[None].repeat(2, 0),
        verification=np.array([1.0, 0.0]),
        score=np.zeros(2),
        box=np.zeros((2, 4)),
        depth=np.ones(2),
        support=np.ones(2, int),
        spread=np.zeros(2),
        probability=np.array([0.0, 1.0]),
        entropy=np.zeros(2),
    )
    clear, low, high = conversions.objects_to_markers(objects, "file:///mug.ply", 1, "world").markers
    assert clear.action == clear.DELETEALL
    assert (low.color.r, low.color.g, high.color.r, high.color.g) == (1.0, 0.0, 0.0, 1.0)
    assert low.color.a < high.color.a
