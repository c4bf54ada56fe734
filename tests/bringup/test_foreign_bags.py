"""Recordings of other programs: every storage, transport and naming is read, or refused with its cause."""

import shutil
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from simulated_driver import plane_view

from active6d_bringup.bags.camera_topics import CameraOptions
from active6d_bringup.bags.index import read_bag
from active6d_bringup.bags.reader import read_episodes
from active6d_bringup.bags.repair import Repaired, repair
from active6d_bringup.bags.source import BagError
from active6d_bringup.bags.summary import summarise
from active6d_bringup.bags.writer import TYPESTORE
from active6d_core.camera import PinholeCamera
from active6d_core.se3 import make_transform, quaternion_from_transform
from active6d_core.view_sphere import ViewSphere

CAMERA = PinholeCamera(80, 60, 75.0, 75.0, 39.5, 29.5)
SPHERE = ViewSphere()
VIEWS = [plane_view(CAMERA, SPHERE.pose(SPHERE.positions[index])) for index in (63, 70, 25)]
SECOND = 1_000_000_000
TYPES = TYPESTORE.types
COLOR, DEPTH, INFO, POSE = (
    "/driver/color/image_raw",
    "/driver/aligned_depth/image_raw",
    "/driver/color/camera_info",
    "/robot/tool_pose",
)
FRAME = "driver_color_optical_frame"


def header(stamp, frame, store=TYPESTORE):
    time = store.types["builtin_interfaces/msg/Time"](stamp // SECOND, stamp % SECOND)
    extra = (0,) if "seq" in store.types["std_msgs/msg/Header"].__dataclass_fields__ else ()
    return store.types["std_msgs/msg/Header"](*extra, time, frame)


def image(array, encoding, stamp, frame=FRAME, store=TYPESTORE):
    data = np.ascontiguousarray(array)
    raw = data.view(np.uint8).reshape(-1)
    return store.types["sensor_msgs/msg/Image"](
        header(stamp, frame, store), *array.shape[:2], encoding, 0, raw.size // array.shape[0], raw
    )


def info(stamp, frame=FRAME, store=TYPESTORE, d=(0.0,) * 5, width=80, height=60):
    K = CAMERA.matrix
    region = store.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    P = np.hstack([K, np.zeros((3, 1))]).ravel()
    numbers = (height, width, "plumb_bob", np.array(d), K.ravel(), np.eye(3).ravel(), P, 0, 0)
    return store.types["sensor_msgs/msg/CameraInfo"](header(stamp, frame, store), *numbers, region)


def pose_of(T, store=TYPESTORE):
    q = quaternion_from_transform(T[None])[0]
    point = store.types["geometry_msgs/msg/Point"](*T[:3, 3].tolist())
    return store.types["geometry_msgs/msg/Pose"](point, store.types["geometry_msgs/msg/Quaternion"](*q.tolist()))


def pose(T, stamp, frame="base", store=TYPESTORE):
    return store.types["geometry_msgs/msg/PoseStamped"](header(stamp, frame, store), pose_of(T, store))


def transform(T, stamp, parent, child):
    q = quaternion_from_transform(T[None])[0]
    vector = TYPES["geometry_msgs/msg/Vector3"](*T[:3, 3].tolist())
    moved = TYPES["geometry_msgs/msg/Transform"](vector, TYPES["geometry_msgs/msg/Quaternion"](*q.tolist()))
    return TYPES["geometry_msgs/msg/TransformStamped"](header(stamp, parent), child, moved)


def compressed(data, text, stamp, frame=FRAME):
    return TYPES["sensor_msgs/msg/CompressedImage"](header(stamp, frame), text, np.frombuffer(data, np.uint8))


def driver_messages(store=TYPESTORE):
    """(time of recording, topic, message) of a driver with its own names, 16UC1 depth and 5 ms skew."""
    found = []
    for number, view in enumerate(VIEWS):
        stamp = (100 + number) * SECOND
        millimetres = np.rint(view.depth * 1000).astype(np.uint16)
        found += [
            (stamp, COLOR, image(view.color, "rgb8", stamp, store=store)),
            (stamp + 1, DEPTH, image(millimetres, "16UC1", stamp + 5_000_000, store=store)),
            (stamp + 2, INFO, info(stamp, store=store)),
            (stamp + 3, POSE, pose(view.T_world_camera, stamp - 2_000_000, store=store)),
        ]
    return found


def type_of(message):
    return message.__msgtype__


def write(path, messages, plugin=StoragePlugin.MCAP, mode=None):
    writer = Writer(path, version=9, storage_plugin=plugin)
    if mode is not None:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for arrival, topic, message in messages:
            kind = type_of(message)
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=TYPESTORE)
            writer.write(connections[topic], arrival, TYPESTORE.serialize_cdr(message, kind))
    return path


def assert_views(bag, options=CameraOptions(), views=VIEWS, depth_tolerance=6e-4, color_tolerance=0):
    index = read_bag(bag, options)
    steps = [step for episode in read_episodes(index) for step in episode.steps]
    assert len(steps) == len(views)
    for step, view in zip(steps, views, strict=True):
        np.testing.assert_allclose(step.view.T_world_camera, view.T_world_camera, atol=1e-9)
        np.testing.assert_allclose(step.view.depth, view.depth, atol=depth_tolerance)
        assert np.abs(step.view.color.astype(int) - view.color).mean() <= color_tolerance
        assert step.view.camera == CAMERA
    return index


def test_a_folder_of_mcap_is_read_whatever_its_names_and_frames(tmp_path):
    index = assert_views(write(tmp_path / "bag", driver_messages()))
    assert index.source == f"color={COLOR},depth={DEPTH},info={INFO},pose={POSE}"
    assert index.frames == {"world_frame": "world", "camera_frame": "camera_optical_frame"}
    assert index.left_out == {}


def test_sqlite3_is_read(tmp_path):
    assert_views(write(tmp_path / "bag", driver_messages(), StoragePlugin.SQLITE3))


def test_a_lone_file_and_a_folder_without_metadata_are_read(tmp_path):
    folder = write(tmp_path / "bag", driver_messages())
    assert_views(next(folder.glob("*.mcap")))
    (folder / "metadata.yaml").unlink()
    assert_views(folder)


def test_a_folder_without_metadata_is_foreign_even_if_its_topics_have_the_names_of_the_graph(tmp_path):
    names = {
        COLOR: "/camera/color/image_raw",
        DEPTH: "/camera/depth/image_raw",
        INFO: "/camera/color/camera_info",
        POSE: "/camera/pose",
    }
    folder = write(tmp_path / "bag", [(at, names[topic], message) for at, topic, message in driver_messages()])
    (folder / "metadata.yaml").unlink()
    index = assert_views(folder)  # colour, depth and poses have stamps of their own
    assert index.source
    assert index.left_out == {}


def test_a_ros_1_bag_is_read(tmp_path):
    store = get_typestore(Stores.ROS1_NOETIC)
    with Writer1(tmp_path / "old.bag") as writer:
        connections = {}
        for arrival, topic, message in driver_messages(store):
            kind = type_of(message)
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], arrival, store.serialize_ros1(message, kind))
    assert_views(tmp_path / "old.bag")


def test_compressed_images_in_sqlite3_are_the_same_views(tmp_path):
    messages = []
    for arrival, topic, message in driver_messages():
        stamp = message.header.stamp.sec * SECOND + message.header.stamp.nanosec
        if topic == COLOR:
            pixels = message.data.reshape(60, 80, 3)[..., ::-1]
            data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
            message = compressed(data, "rgb8; jpeg compressed bgr8", stamp)
            topic += "/compressed"
        elif topic == DEPTH:
            png = cv2.imencode(".png", message.data.view(np.uint16).reshape(60, 80))[1].tobytes()
            message = compressed(bytes(12) + png, "16UC1; compressedDepth png", stamp)
            topic += "/compressedDepth"
        messages.append((arrival, topic, message))
    assert_views(
        write(tmp_path / "bag", messages, StoragePlugin.SQLITE3), color_tolerance=12
    )  # JPEG halves the resolution of colour


T_FLANGE_CAMERA = make_transform(np.eye(3), np.array([0.02, 0.0, 0.07]))


def with_transforms(messages, pose_topic=None, flange=True):
    """The messages with the camera on a flange in /tf, or on nothing; and the driver's poses on a topic, or nowhere.

    With another topic than the camera's, these poses are the flange's.
    """
    kind = TYPES["tf2_msgs/msg/TFMessage"]
    found = [entry for entry in messages if entry[1] != POSE]
    found.append((1, "/tf_static", kind([transform(T_FLANGE_CAMERA, 0, "flange", FRAME)])))
    for number, view in enumerate(VIEWS):
        stamp = (100 + number) * SECOND + 1_000_000
        T_base_flange = view.T_world_camera @ np.linalg.inv(T_FLANGE_CAMERA)
        if flange:
            found.append((stamp, "/tf", kind([transform(T_base_flange, stamp, "base", "flange")])))
        if pose_topic is not None:
            T = T_base_flange if flange and "camera" not in pose_topic else view.T_world_camera
            found.append((stamp, pose_topic, pose(T, stamp)))
    return sorted(found, key=lambda entry: entry[0])


def test_poses_come_from_transforms_of_a_moving_flange(tmp_path):
    index = assert_views(write(tmp_path / "bag", with_transforms(driver_messages())))
    assert index.source.endswith("world=base (from /tf)")


def test_transforms_are_preferred_to_the_poses_of_a_tool(tmp_path):
    tool = "/tcp_pose_broadcaster/pose"
    bag = write(tmp_path / "bag", with_transforms(driver_messages(), tool))
    index = assert_views(bag)
    assert f"world=base (from /tf rather than {tool}; --topics pose=NAME" in index.source
    assert read_bag(bag, CameraOptions.parse(f"pose={tool}")).source.endswith(f"pose={tool}")


@pytest.mark.parametrize(("topic", "flange"), [("/my_camera/pose", True), ("/robot/tool_pose", False)])
def test_poses_of_a_camera_and_those_without_a_moving_flange_are_taken(tmp_path, topic, flange):
    bag = write(tmp_path / "bag", with_transforms(driver_messages(), topic, flange))
    assert assert_views(bag).source.endswith(f"pose={topic}")


@pytest.mark.parametrize("stamps", ["zero", "restarted"])
def test_useless_stamps_are_replaced_by_the_times_of_recording(tmp_path, stamps):
    messages = driver_messages()
    for arrival, _, message in messages:
        message.header.stamp.sec = 0 if stamps == "zero" else 5 + (arrival // SECOND) % 2
        message.header.stamp.nanosec = 0
    index = assert_views(write(tmp_path / "bag", messages))
    assert index.notes == ["header stamps are missing or go back: times of recording are used"]


def test_camera_info_once_is_enough(tmp_path):
    messages = driver_messages()
    infos = [entry for entry in messages if entry[1] == INFO]
    assert_views(write(tmp_path / "bag", [entry for entry in messages if entry not in infos[1:]]))


def test_every_view_that_is_left_out_is_counted_with_its_reason(tmp_path):
    messages = driver_messages()
    depths = [entry for entry in messages if entry[1] == DEPTH]
    poses = [entry for entry in messages if entry[1] == POSE]
    kept = [entry for entry in messages if entry is not depths[0] and entry is not poses[2]]
    index = read_bag(write(tmp_path / "bag", kept))
    assert len(index.payloads["camera/pose"]) == 1
    assert sorted(index.left_out.values()) == [1, 1]
    assert {reason.split(" within")[0] for reason in index.left_out} == {"no depth image", "no camera pose"}


def test_a_recording_without_poses_is_refused_with_what_can_be_done(tmp_path):
    kept = [entry for entry in driver_messages() if entry[1] != POSE]
    with pytest.raises(BagError, match=r"no camera poses or /tf in it; .*PoseStamped or /tf; .*estimate --rgb FILE"):
        read_bag(write(tmp_path / "bag", kept))


def test_a_stream_gives_one_view_of_each_place_where_the_camera_stood(tmp_path):
    messages = []
    for number in range(60):  # 15 Hz: two seconds here, half a second on the way, the rest there
        stamp = 100 * SECOND + number * 66_000_000
        start, end = (view.T_world_camera for view in VIEWS[:2])
        share = np.clip((number - 30) / 8, 0, 1)
        position = start[:3, 3] + share * (end[:3, 3] - start[:3, 3])
        T = {0.0: start, 1.0: end}.get(share, SPHERE.pose(position))
        view = plane_view(CAMERA, T)
        millimetres = np.rint(view.depth * 1000).astype(np.uint16)
        messages += [
            (stamp, COLOR, image(view.color, "rgb8", stamp)),
            (stamp + 1, DEPTH, image(millimetres, "16UC1", stamp)),
            (stamp + 2, INFO, info(stamp)),
            (stamp + 3, POSE, pose(T, stamp)),
        ]
    index = assert_views(write(tmp_path / "bag", messages), views=VIEWS[:2])
    assert sum(index.left_out.values()) == 58


def test_topics_can_be_chosen_and_must_be_where_several_could_be_meant(tmp_path):
    messages = driver_messages()
    twin = [(arrival, topic.replace("driver", "left"), message) for arrival, topic, message in messages]
    bag = write(tmp_path / "bag", sorted(messages + [entry for entry in twin if entry[1] != POSE], key=lambda e: e[0]))
    with pytest.raises(BagError, match=r"several depth topics \(/driver/.*, /left/.*choose one with --topics depth="):
        read_bag(bag)
    chosen = CameraOptions.parse(f"depth={DEPTH},color={COLOR}")
    assert_views(bag, chosen)
    with pytest.raises(BagError, match="there are: /driver/aligned_depth"):
        read_bag(bag, CameraOptions.parse("depth=/nothing"))
    with pytest.raises(ValueError, match="is not KEY=NAME"):
        CameraOptions.parse("colour=/x")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"unit": 10_000}, "depth is 10 times what it can be"),
        ({"depth_frame": "driver_depth"}, "depth in 'driver_depth': use the driver's depth that is aligned"),
        ({"size": (160, 120)}, "camera_info is for 160x120 images, these are 80x60"),
    ],
)
def test_what_cannot_be_used_is_refused_with_its_cause(tmp_path, change, words):
    messages = []
    for arrival, topic, message in driver_messages():
        stamp = message.header.stamp.sec * SECOND + message.header.stamp.nanosec
        if topic == DEPTH:
            steps = (message.data.view(np.uint16).reshape(60, 80) * (change.get("unit", 1000) / 1000)).astype(np.uint16)
            message = image(steps, "16UC1", stamp, change.get("depth_frame", FRAME))
        elif topic == INFO and "size" in change:
            message = info(stamp, width=change["size"][0], height=change["size"][1])
        messages.append((arrival, topic, message))
    bag = write(tmp_path / "bag", messages)
    with pytest.raises(BagError, match=words):
        read_bag(bag)
    if "unit" in change:
        assert_views(bag, CameraOptions(depth_scale=1e-4))


def with_infos(change):
    """The driver's messages with camera_info as another driver fills it in."""
    messages = []
    for arrival, topic, message in driver_messages():
        if topic == INFO:
            numbers = {name: getattr(message, name).copy() for name in ("d", "k", "p")}
            numbers |= {"width": message.width, "height": message.height, "roi": message.roi}
            change(numbers)
            message = replace(message, **numbers)
        messages.append((arrival, topic, message))
    return messages


def k_is_the_identity(numbers):
    numbers["k"][:] = np.eye(3).ravel()


def k_is_that_of_the_raw_image(numbers):
    numbers["k"][[0, 2, 4]] += [20.0, 3.0, 20.0]


def a_region_of_a_larger_image(numbers):
    numbers["k"][[2, 5]] += [40, 30]
    numbers["p"][[2, 6]] += [40, 30]
    numbers |= {"width": 160, "height": 120, "roi": TYPES["sensor_msgs/msg/RegionOfInterest"](40, 30, 60, 80, False)}


@pytest.mark.parametrize("change", [k_is_the_identity, k_is_that_of_the_raw_image, a_region_of_a_larger_image])
def test_intrinsics_are_those_of_the_images_however_drivers_write_them(tmp_path, change):
    assert_views(write(tmp_path / "bag", with_infos(change)))


def test_distortion_that_was_left_in_camera_info_is_said_and_can_be_switched_off(tmp_path):
    def distort(numbers):
        numbers["d"][:2] = -0.2, 0.05

    bag = write(tmp_path / "bag", with_infos(distort))
    assert any("if they are already, say so" in note for note in read_bag(bag).notes)
    assert not assert_views(bag, CameraOptions(rectified=True)).notes
    by_name = [
        (at, topic.replace("color/image_raw", "color/image_rect_color"), message)
        for at, topic, message in with_infos(distort)
    ]
    named = write(tmp_path / "named", by_name)
    assert not assert_views(named).notes
    assert any("if they are already, say so" in note for note in read_bag(named, CameraOptions(rectified=False)).notes)


def test_floating_point_millimetres_are_recognised(tmp_path):
    messages = []
    for arrival, topic, message in driver_messages():
        if topic == DEPTH:
            stamp = message.header.stamp.sec * SECOND + message.header.stamp.nanosec
            steps = message.data.view(np.uint16).reshape(60, 80).astype(np.float32)
            message = image(steps, "32FC1", stamp)
        messages.append((arrival, topic, message))
    bag = write(tmp_path / "bag", messages)
    with pytest.raises(BagError, match=r"depth looks like millimetres .*set --depth-scale to 0.001"):
        read_bag(bag)
    assert_views(bag, CameraOptions(depth_scale=1e-3))


def test_a_bag_without_depth_names_what_it_holds(tmp_path):
    bag = write(tmp_path / "bag", [entry for entry in driver_messages() if entry[1] != DEPTH])
    with pytest.raises(BagError, match=rf"no depth images \(.*\) in it; it holds {INFO}, {COLOR} \(rgb8\), {POSE}"):
        read_bag(bag)


def test_a_summary_lists_every_topic(tmp_path):
    summary = summarise(write(tmp_path / "bag", driver_messages()))
    rows = {row.name: row for row in summary.topics}
    assert (rows[COLOR].count, rows[COLOR].content, rows[COLOR].frame) == (3, "80x60 rgb8", FRAME)
    assert rows[COLOR].rate_hz == pytest.approx(1.0)
    assert summary.messages == 12


@pytest.mark.parametrize("keep", [0.5, 0.8, 0.999])
def test_what_a_killed_recording_wrote_is_repaired(tmp_path, keep):
    first = driver_messages()
    many = [(arrival + 10 * lap * SECOND, topic, message) for lap in range(40) for arrival, topic, message in first]
    whole = write(tmp_path / "bag", many)
    file = next(whole.glob("*.mcap"))
    cut = tmp_path / "killed"
    cut.mkdir()
    (cut / file.name).write_bytes(file.read_bytes()[: int(keep * file.stat().st_size)])
    with pytest.raises(BagError, match="active6d bag repair"):
        read_bag(cut)
    saved = repair(cut, tmp_path / "saved")
    assert saved.damage
    assert 0 < saved.messages <= len(many)
    assert summarise(tmp_path / "saved").messages == saved.messages
    if keep > 0.9:
        assert saved.messages > 0.9 * len(many)


def test_repair_refuses_what_holds_nothing(tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(BagError, match="this is not a bag"):
        repair(tmp_path / "empty", tmp_path / "saved")
    (tmp_path / "empty" / "a.mcap").write_bytes(b"something else")
    with pytest.raises(BagError, match="not one message can be read"):
        repair(tmp_path / "empty", tmp_path / "saved")
    assert not (tmp_path / "saved").exists()


def changed(topic, change):
    """The driver's messages, those of one topic as ``change(message, stamp)`` makes them: (topic, message) or none."""
    found = []
    for arrival, name, message in driver_messages():
        stamp = message.header.stamp.sec * SECOND + message.header.stamp.nanosec
        found += [(arrival, *entry) for entry in (change(message, stamp) if name == topic else [(name, message)])]
    return found


def pixels(message):
    return message.data.reshape(60, 80, 3)


def bayer(message):
    rows, columns = np.indices((60, 80)) % 2
    return np.take_along_axis(pixels(message), (rows + columns)[..., None], axis=2)[..., 0]  # red above, blue below


@pytest.mark.parametrize(
    ("encoding", "make"),
    [
        ("bgr8", lambda message: pixels(message)[..., ::-1]),
        ("8UC3", lambda message: pixels(message)[..., ::-1]),
        ("rgb16", lambda message: pixels(message).astype(np.uint16) * 257),
        (
            "bgra16",
            lambda message: np.dstack([pixels(message)[..., ::-1], pixels(message)[..., :1]]).astype("u2") * 257,
        ),
        ("bayer_rggb8", bayer),
        ("bayer_rggb16", lambda message: bayer(message).astype(np.uint16) * 257),
    ],
)
def test_colour_of_every_encoding_is_the_same(tmp_path, encoding, make):
    bag = write(tmp_path / "bag", changed(COLOR, lambda m, stamp: [(COLOR, image(make(m), encoding, stamp))]))
    assert_views(bag, color_tolerance=12 if "bayer" in encoding else 0)


def test_grey_of_16_bits_beside_depth_is_colour(tmp_path):
    def grey(message, stamp):
        return [(COLOR, image((pixels(message).mean(axis=-1) * 16).astype(np.uint16), "mono16", stamp))]

    bag = write(tmp_path / "bag", changed(COLOR, grey))
    view = next(iter(read_episodes(read_bag(bag)))).steps[0].view
    assert np.abs(view.color[..., 0].astype(float) - VIEWS[0].color.mean(axis=-1)).max() < 2


def test_compressed_copies_beside_the_images_are_left_alone(tmp_path):
    def both(message, stamp):
        data = cv2.imencode(".jpg", pixels(message)[..., ::-1])[1].tobytes()
        return [(COLOR, message), (f"{COLOR}/compressed", compressed(data, "rgb8; jpeg compressed bgr8", stamp))]

    bag = write(tmp_path / "bag", changed(COLOR, both))
    assert_views(bag)
    index = read_bag(bag, CameraOptions.parse(f"color={COLOR}/compressed"))
    assert index.source.startswith(f"color={COLOR}/compressed")


def test_depth_in_a_png_that_says_no_more_is_recognised(tmp_path):
    def png(message, stamp):
        data = cv2.imencode(".png", message.data.view(np.uint16).reshape(60, 80))[1].tobytes()
        return [(f"{DEPTH}/compressed", compressed(data, "png", stamp))]

    assert_views(write(tmp_path / "bag", changed(DEPTH, png)))


@pytest.mark.parametrize("known", [True, False])
def test_depth_of_its_own_camera_is_registered_by_the_static_transform(tmp_path, known):
    own, frame = PinholeCamera(106, 60, 55.0, 55.0, 52.5, 29.5), "driver_depth_optical_frame"
    T_color_depth = make_transform(np.eye(3), np.array([-0.05, 0.0, 0.0]))

    def separate(message, stamp):
        view = plane_view(own, VIEWS[(stamp - 100 * SECOND) // SECOND].T_world_camera @ T_color_depth)
        depth = image(np.rint(view.depth * 1000).astype(np.uint16), "16UC1", stamp, frame)
        K, P = own.matrix, np.hstack([own.matrix, np.zeros((3, 1))]).ravel()
        calibration = replace(info(stamp, frame, width=106), k=K.ravel(), p=P)
        return [("/driver/depth/image_raw", depth), ("/driver/depth/camera_info", calibration)]

    messages = changed(DEPTH, separate)
    if known:
        static = TYPES["tf2_msgs/msg/TFMessage"]([transform(T_color_depth, 0, FRAME, frame)])
        messages = [(1, "/tf_static", static), *messages]
    bag = write(tmp_path / "bag", messages)
    if not known:
        with pytest.raises(BagError, match=r"depth is not registered.*no transform from .*: /tf_static is missing"):
            read_bag(bag)
        return
    steps = read_episodes(read_bag(bag))[0].steps
    for step, view in zip(steps, VIEWS, strict=True):
        assert np.isfinite(step.view.depth).mean() > 0.95
        assert np.nanmax(np.abs(step.view.depth / view.depth - 1.0)) < 0.05


def test_without_static_transforms_the_cause_is_named(tmp_path):
    message = TYPES["tf2_msgs/msg/TFMessage"]
    messages = changed(POSE, lambda m, stamp: [("/tf", message([transform(np.eye(4), stamp, "base", "flange")]))])
    with pytest.raises(BagError, match=f"no transform to {FRAME}, the frame of colour: /tf_static is missing"):
        read_bag(write(tmp_path / "bag", messages))


@pytest.mark.parametrize(
    ("pose_at", "words"),
    [
        (lambda T: (T, 5000 * SECOND), "3 left out: the nearest camera pose is 4998 s away or more: are their stamps"),
        (lambda T: (np.block([[T[:3, :3], 1000 * T[:3, 3:]], [T[3:]]]), 0), "is it in millimetres"),
    ],
)
def test_poses_that_cannot_be_used_are_refused_with_their_cause(tmp_path, pose_at, words):
    views = iter(VIEWS)

    def other(message, stamp):
        T, late = pose_at(next(views).T_world_camera)
        return [(POSE, pose(T, stamp + late))]

    with pytest.raises(BagError, match=words):
        read_bag(write(tmp_path / "bag", changed(POSE, other)))


def test_the_pose_of_the_cameras_body_is_noticed(tmp_path):
    body = make_transform(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.zeros(3))
    views = iter(VIEWS)
    messages = changed(POSE, lambda m, stamp: [(POSE, pose(next(views).T_world_camera @ body, stamp))])
    assert any("not of its body" in note for note in read_bag(write(tmp_path / "bag", messages)).notes)


def test_camera_info_that_is_not_finite_is_not_called_a_damaged_bag(tmp_path):
    bag = write(tmp_path / "bag", changed(INFO, lambda m, stamp: [(INFO, replace(m, d=np.full(5, np.nan)))]))
    with pytest.raises(BagError, match=r"no usable view .*d of camera_info holds a number that is not finite"):
        read_bag(bag)


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
@pytest.mark.parametrize("mode", [CompressionMode.FILE, CompressionMode.MESSAGE])
def test_compressed_recordings_are_read_and_without_metadata_read_or_refused_with_the_cause(tmp_path, plugin, mode):
    bag = write(tmp_path / "bag", driver_messages(), plugin, mode)
    assert_views(bag)
    (bag / "metadata.yaml").unlink()
    if mode is CompressionMode.MESSAGE and plugin is StoragePlugin.SQLITE3:
        assert_views(bag)
    elif mode is CompressionMode.FILE:
        for path in (bag, next(bag.glob("*.zstd"))):
            with pytest.raises(BagError, match=r"compressed file.*zstd -d"):
                read_bag(path)


def test_a_cut_sqlite3_file_is_repaired(tmp_path, monkeypatch):
    bag = write(tmp_path / "bag", driver_messages(), StoragePlugin.SQLITE3)
    file = next(bag.glob("*.db3"))
    file.write_bytes(file.read_bytes()[: int(0.9 * file.stat().st_size)])
    with pytest.raises(BagError, match="active6d bag repair"):
        read_bag(bag)
    with monkeypatch.context() as patch:
        patch.delattr(Path, "read_bytes")  # a bag may be larger than the memory
        saved = repair(bag, tmp_path / "saved")
    assert 0 < saved.messages < 12
    assert "ends early" in saved.damage[0]
    assert summarise(tmp_path / "saved").messages == saved.messages


def test_messages_in_the_log_of_a_killed_sqlite3_recording_are_saved(tmp_path):
    bag = write(tmp_path / "bag", driver_messages(), StoragePlugin.SQLITE3)
    file, killed = next(bag.glob("*.db3")), tmp_path / "killed"
    killed.mkdir()
    database = sqlite3.connect(file)
    rows = database.execute("SELECT topic_id, timestamp, data FROM messages WHERE id > 4").fetchall()
    database.execute("DELETE FROM messages WHERE id > 4")
    database.commit()
    database.execute("PRAGMA journal_mode=WAL")
    database.executemany("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", rows)
    database.commit()
    for path in (file, file.with_name(f"{file.name}-wal")):  # the log goes when its database is closed
        shutil.copyfile(path, killed / path.name)
    database.close()
    before = {path.name: path.read_bytes() for path in killed.iterdir()}
    for path in (killed, killed / file.name):
        with pytest.raises(BagError, match=r"messages are in bag.db3-wal and not in the bag yet.*active6d bag repair"):
            read_bag(path)
    assert repair(killed, tmp_path / "saved") == Repaired(12, ())
    assert_views(tmp_path / "saved")
    assert {path.name: path.read_bytes() for path in killed.iterdir()} == before


METADATA, DRIVERS_TYPE = "/driver/color/metadata", "driver_msgs/msg/Metadata"
DEFINITION = "std_msgs/Header header\nstring json\n"


def without_definitions(bag):
    """Remove the definitions from a sqlite3 bag, as recorders of before ROS 2 Iron leave it."""
    with closing(sqlite3.connect(next(bag.glob("*.db3")))) as database:
        database.execute("DELETE FROM message_definitions")
        database.commit()


@pytest.fixture(params=["defined", "not defined"])
def custom(request, tmp_path):
    """A whole sqlite3 bag with a type of the driver's own, and whether its definition is in the bag."""
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(DEFINITION, DRIVERS_TYPE))
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connections = {}
        for arrival, topic, message in driver_messages():
            kind = type_of(message)
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], arrival, store.serialize_cdr(message, kind))
        connection = writer.add_connection(METADATA, DRIVERS_TYPE, typestore=store)
        message = store.types[DRIVERS_TYPE](header(103 * SECOND, FRAME), "{}")
        writer.write(connection, 103 * SECOND, store.serialize_cdr(message, DRIVERS_TYPE))
    if request.param == "not defined":
        without_definitions(tmp_path / "bag")
    return tmp_path / "bag", request.param == "defined"


def test_a_type_without_definition_is_no_damage_and_is_kept_by_repair(tmp_path, custom):
    bag, defined = custom
    saved = repair(bag, tmp_path / "saved")
    assert saved == Repaired(13, ())
    for folder in (bag, tmp_path / "saved"):
        summary = summarise(folder)
        row = next(row for row in summary.topics if row.name == METADATA)
        assert (summary.messages, row.count, row.type) == (13, 1, DRIVERS_TYPE)
        assert (row.frame, row.content) == ((FRAME, "") if defined else ("", "definition not in the bag"))
        assert_views(folder)
    payloads = []
    for folder in (bag, tmp_path / "saved"):
        with Reader(folder) as reader:
            payloads.append({(each.topic, at, bytes(payload)) for each, at, payload in reader.messages()})
    assert payloads[0] == payloads[1]


def test_repair_saves_every_message_of_a_damaged_sqlite3_file_once(tmp_path):
    messages = [(at + 10 * lap * SECOND, *rest) for lap in range(5) for at, *rest in driver_messages()]
    bag = write(tmp_path / "bag", messages, StoragePlugin.SQLITE3)
    file = next(bag.glob("*.db3"))
    data = bytearray(file.read_bytes())
    page = next(at for at in range(len(data) // 2, len(data), 4096) if data[at] == 0)
    data[page : page + 4096] = bytes(4096)  # the middle of an image, so that only its row cannot be read
    file.write_bytes(data)
    saved = repair(bag, tmp_path / "saved")
    assert "ends early or is damaged" in saved.damage[0]
    with Reader(tmp_path / "saved") as reader:
        found = [(each.topic, at) for each, at, _ in reader.messages()]
    assert 12 <= len(set(found)) == len(found) == saved.messages


def test_what_repair_cannot_do_is_said_by_the_reader_too(tmp_path):
    (tmp_path / "cut.bag").write_bytes(b"#ROSBAG V2.0\nshort")
    with pytest.raises(BagError, match="`rosbag reindex` of ROS 1"):
        read_bag(tmp_path / "cut.bag")
    (tmp_path / "empty.mcap").write_bytes(b"")
    with pytest.raises(BagError, match="the file is empty"):
        read_bag(tmp_path / "empty.mcap")
    bag = write(tmp_path / "bag", driver_messages(), StoragePlugin.SQLITE3)
    next(bag.glob("*.db3")).unlink()
    with pytest.raises(BagError, match="its files are missing; copy them back"):
        read_bag(bag)
    with pytest.raises(BagError, match=r"no .mcap or .db3 file"):
        repair(bag, tmp_path / "saved")
