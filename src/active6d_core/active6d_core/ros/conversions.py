"""ROS messages to the core's types and back; the only module of the core that knows messages.

Everything that comes in is checked here (sizes, encodings, frames, numbers, quaternions) and refused with a
:class:`MessageError` that says what is wrong. The readers need only the fields of a message, so they also read the
message objects that rosbags deserialises.
"""

import math
import re
from array import array
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from copy import copy
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point, Pose, PoseArray, PoseStamped, Quaternion, Vector3
from sensor_msgs.msg import CameraInfo, Image, JointState, PointCloud2, PointField, RegionOfInterest
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from active6d_core.bounds import check_hypotheses, check_image_size, check_objects, check_points
from active6d_core.calibration import Calibration
from active6d_core.camera import PinholeCamera
from active6d_core.hypotheses import Hypotheses, SceneObjects
from active6d_core.se3 import quaternion_from_transform, transform_from_quaternion

_POSE_COLUMNS = {name: "<f4" for name in ("x", "y", "z", "qx", "qy", "qz", "qw")}
_BOX_COLUMNS = {name: "<f4" for name in ("box_x_min", "box_y_min", "box_x_max", "box_y_max")}
HYPOTHESIS_COLUMNS = {**_POSE_COLUMNS, "score": "<f4", **_BOX_COLUMNS, "depth": "<f4", "label": "<u2"}
OBJECT_COLUMNS = {
    **_POSE_COLUMNS,
    "verification": "<f4",
    "score": "<f4",
    **_BOX_COLUMNS,
    "depth": "<f4",
    "support": "<u2",
    "spread": "<f4",
    "probability": "<f4",
    "entropy": "<f4",
}
_OBJECT_NUMBERS = ("verification", "score", "depth", "spread")
_BELIEF_COLUMNS = ("probability", "entropy")
POINT_COLUMNS = {"x": "<f4", "y": "<f4", "z": "<f4"}
ATTENTION_COLUMNS = {"x": "<f4", "y": "<f4", "z": "<f4", "weight": "<f4", "attended": "|u1"}

_DTYPES = {
    PointField.INT8: "|i1",
    PointField.UINT8: "|u1",
    PointField.INT16: "<i2",
    PointField.UINT16: "<u2",
    PointField.INT32: "<i4",
    PointField.UINT32: "<u4",
    PointField.FLOAT32: "<f4",
    PointField.FLOAT64: "<f8",
}
_DATATYPES = {dtype: datatype for datatype, dtype in _DTYPES.items()}
#: Encodings of colour images that the graph uses, with the places of red, green and blue.
COLOR_ENCODINGS = {"rgb8": (0, 1, 2), "bgr8": (2, 1, 0), "rgba8": (0, 1, 2), "bgra8": (2, 1, 0)}
#: A quaternion whose norm is further from one than this was not meant as a rotation.
_QUATERNION_TOLERANCE = 1e-2


#: What marks a diagnostic status as one of this project's nodes.
HARDWARE_ID = "active6d"
#: More rows than any pile needs; fusion's memory grows with their square.
_MAX_ROWS = 2000
#: More points than the surface of any workspace has cells.
_MAX_POINTS = 100_000


class MessageError(ValueError):
    """A message that cannot be used; the text says which field and why."""


class OutdatedError(MessageError):
    """A message of a view that is over: a restarted node repeats its last messages, which is no fault."""


@contextmanager
def refusing(prefix: str = "") -> Iterator[None]:
    """Turn the ValueError of a check into a :class:`MessageError` whose text begins with ``prefix``."""
    try:
        yield
    except MessageError:
        raise
    except ValueError as error:
        raise MessageError(f"{prefix}{error}") from error


def stamp_to_ns(stamp: Time) -> int:
    """A message's stamp in nanoseconds.

    Raises:
        MessageError: the stamp is negative, or its nanoseconds make a second or more.
    """
    if stamp.sec < 0 or not 0 <= stamp.nanosec < 1_000_000_000:
        raise MessageError(f"stamp of {stamp.sec} s and {stamp.nanosec} ns is no time; check the publisher's clock")
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def ns_to_stamp(nanoseconds: int) -> Time:
    """Nanoseconds to a message's stamp."""
    return Time(sec=nanoseconds // 1_000_000_000, nanosec=nanoseconds % 1_000_000_000)


def make_header(stamp: int, frame: str) -> Header:
    """Header with a stamp in nanoseconds."""
    return Header(stamp=ns_to_stamp(stamp), frame_id=frame)


def require_frame(header: Header, frame: str) -> None:
    """Raise :class:`MessageError` unless the header names ``frame``."""
    if header.frame_id != frame:
        raise MessageError(f"frame_id is '{header.frame_id}', expected '{frame}'")


# Poses


def pose_to_transform(pose: Pose) -> np.ndarray:
    """A Pose to (4, 4).

    Raises:
        MessageError: a number is not finite, or the quaternion is not of unit length.
    """
    p, q = pose.position, pose.orientation
    return _rows_to_transforms(np.array([[p.x, p.y, p.z, q.x, q.y, q.z, q.w]]))[0]


def transform_to_pose(T: np.ndarray) -> Pose:
    """(4, 4) to a Pose."""
    return _transforms_to_poses(T[None])[0]


def pose_stamped_to_transform(message: PoseStamped, frame: str) -> np.ndarray:
    """A PoseStamped in ``frame`` to (4, 4).

    Raises:
        MessageError: another frame, or a bad pose.
    """
    require_frame(message.header, frame)
    return pose_to_transform(message.pose)


def transform_to_pose_stamped(T: np.ndarray, stamp: int, frame: str) -> PoseStamped:
    """(4, 4) to a PoseStamped in ``frame``."""
    return PoseStamped(header=make_header(stamp, frame), pose=transform_to_pose(T))


def poses_to_array(T: np.ndarray, stamp: int, frame: str) -> PoseArray:
    """(n, 4, 4) to a PoseArray."""
    return PoseArray(header=make_header(stamp, frame), poses=_transforms_to_poses(T))


def poses_from_array(message: PoseArray, frame: str) -> np.ndarray:
    """A PoseArray in ``frame`` to (n, 4, 4).

    Raises:
        MessageError: another frame, or a bad pose.
    """
    require_frame(message.header, frame)
    rows = [(p.position, p.orientation) for p in message.poses]
    return _rows_to_transforms(np.array([[p.x, p.y, p.z, q.x, q.y, q.z, q.w] for p, q in rows]).reshape(-1, 7))


def _transforms_to_poses(T: np.ndarray) -> list[Pose]:
    """(n, 4, 4) to n Poses; all quaternions at once, which costs what a single one would."""
    if not len(T):
        return []
    return [
        Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))
        for (x, y, z), (qx, qy, qz, qw) in zip(T[:, :3, 3].tolist(), quaternion_from_transform(T).tolist(), strict=True)
    ]


def _rows_to_transforms(rows: np.ndarray) -> np.ndarray:
    """(n, 7) position and xyzw quaternion rows to (n, 4, 4), checked."""
    if not np.isfinite(rows).all():
        raise MessageError("a pose holds a number that is not finite")
    norm = np.linalg.norm(rows[:, 3:], axis=1)
    if (np.abs(norm - 1.0) > _QUATERNION_TOLERANCE).any():
        raise MessageError(f"a quaternion has length {norm[np.argmax(np.abs(norm - 1.0))]:.3g}, expected 1")
    return transform_from_quaternion(rows[:, 3:], rows[:, :3])


# Images


def color_to_image(color: np.ndarray, stamp: int, frame: str) -> Image:
    """(H, W, 3) uint8 RGB to an ``rgb8`` Image."""
    return _array_to_image(color, "rgb8", stamp, frame)


def image_to_color(message: Image) -> np.ndarray:
    """An 8-bit RGB, BGR, RGBA or BGRA Image to (H, W, 3) uint8 RGB.

    Raises:
        MessageError: another encoding, or sizes that disagree.
    """
    channels = COLOR_ENCODINGS.get(message.encoding)
    if channels is None:
        raise MessageError(f"color encoding '{message.encoding}' is not one of {', '.join(COLOR_ENCODINGS)}")
    pixels = image_to_pixels(message, np.dtype("u1"), 4 if message.encoding.endswith("a8") else 3)
    return pixels if message.encoding == "rgb8" else np.ascontiguousarray(pixels[..., channels])


def depth_to_image(depth: np.ndarray, stamp: int, frame: str) -> Image:
    """(H, W) metres to a ``32FC1`` Image (REP-118)."""
    return _array_to_image(depth.astype("<f4", copy=False), "32FC1", stamp, frame)


def image_to_depth(message: Image) -> np.ndarray:
    """A ``32FC1`` (metres) or ``16UC1`` (millimetres) Image to (H, W) float32 metres, NaN unless positive and finite.

    Raises:
        MessageError: another encoding, or sizes that disagree.
    """
    if message.encoding == "32FC1":
        depth = image_to_pixels(message, np.dtype("<f4"), 1)
        valid = (depth > 0) & (depth < np.inf)
        return depth if valid.all() else np.where(valid, depth, np.float32(np.nan))
    if message.encoding == "16UC1":
        millimetres = image_to_pixels(message, np.dtype("<u2"), 1)
        return np.where(millimetres > 0, millimetres * np.float32(0.001), np.float32(np.nan))
    raise MessageError(f"depth encoding '{message.encoding}' is not 32FC1 or 16UC1")


def segmentation_to_image(segmentation: np.ndarray, stamp: int, frame: str) -> Image:
    """(H, W) uint16 labels to a ``mono16`` Image."""
    return _array_to_image(segmentation.astype("<u2", copy=False), "mono16", stamp, frame)


def image_to_segmentation(message: Image) -> np.ndarray:
    """A ``mono16`` Image to (H, W) uint16 labels.

    Raises:
        MessageError: another encoding, or sizes that disagree.
    """
    if message.encoding != "mono16":
        raise MessageError(f"segmentation encoding '{message.encoding}' is not mono16")
    return image_to_pixels(message, np.dtype("<u2"), 1)


def _array_to_image(pixels: np.ndarray, encoding: str, stamp: int, frame: str) -> Image:
    image = Image(header=make_header(stamp, frame), height=pixels.shape[0], width=pixels.shape[1], encoding=encoding)
    image.step = pixels.strides[0] if pixels.flags.c_contiguous else pixels[0].nbytes
    image.data = _bytes_of(pixels)
    return image


def _bytes_of(values: np.ndarray) -> "array[int]":
    """The array's bytes in the one container that a message's setter takes without looking at every byte."""
    data = array("B")
    if values.size:
        data.frombytes(np.ascontiguousarray(values).data.cast("B"))
    return data


def image_to_pixels(message: Any, dtype: np.dtype, channels: int) -> np.ndarray:
    """The pixels of an Image without its padding, in this machine's byte order.

    Args:
        message: the Image.
        dtype: of its numbers.
        channels: numbers per pixel.

    Returns:
        (H, W), or (H, W, channels) for more than one channel.

    Raises:
        MessageError: the message's sizes disagree.
    """
    height, width, step = message.height, message.width, message.step
    row_bytes = width * channels * dtype.itemsize
    if height == 0 or width == 0:
        raise MessageError(f"image is empty ({width}x{height})")
    if step < row_bytes or len(message.data) != step * height:
        raise MessageError(
            f"{message.encoding} image of {width}x{height} has step {step} and {len(message.data)} bytes of data"
        )
    rows = np.frombuffer(message.data, np.uint8).reshape(height, step)[:, :row_bytes]
    pixels = np.ascontiguousarray(rows).view(dtype.newbyteorder(">" if message.is_bigendian else "<"))
    pixels = pixels.astype(dtype.newbyteorder("="), copy=False)
    return pixels.reshape(height, width, channels) if channels > 1 else pixels.reshape(height, width)


# Arms


def joints_to_state(names: Sequence[str], joints: np.ndarray, stamp: int) -> JointState:
    """(n,) angles in radians of named joints to a JointState of an arm at rest."""
    state = JointState(header=make_header(stamp, ""), name=list(names), position=np.asarray(joints, float).tolist())
    state.velocity = [0.0] * len(state.position)
    return state


# Cameras


def camera_to_info(camera: PinholeCamera, stamp: int, frame: str) -> CameraInfo:
    """Intrinsics of a rectified camera to a CameraInfo; an image beside its centre is a region of a larger one."""
    x, width = _whole_side(camera.cx, camera.width)
    y, height = _whole_side(camera.cy, camera.height)
    info = CameraInfo(header=make_header(stamp, frame), height=height, width=width)
    if (width, height) != (camera.width, camera.height):
        info.roi = RegionOfInterest(x_offset=x, y_offset=y, width=camera.width, height=camera.height)
    info.distortion_model = "plumb_bob"
    info.d = [0.0] * 5
    matrix = camera.matrix + [[0, 0, x], [0, 0, y], [0, 0, 0]]
    info.k = matrix.ravel()
    info.r = np.eye(3).ravel()
    info.p = np.hstack([matrix, np.zeros((3, 1))]).ravel()
    return info


def _whole_side(centre: float, side: int) -> tuple[int, int]:
    """Offset of an image in the smallest one around it that has the centre within it, and that one's side, pixels."""
    offset = max(0, math.floor(-centre) + 1)
    return offset, max(offset + side, math.floor(offset + centre) + 1)


def info_to_camera(message: CameraInfo) -> PinholeCamera:
    """A CameraInfo of a rectified camera to the intrinsics of its images, region and binning included.

    P counts, as it does for rectified images; K only where a driver leaves P empty.

    Raises:
        MessageError: the image is not rectified, or the numbers make no camera.
    """
    with refusing("camera_info: "):
        calibration = Calibration.from_info(message)
        if calibration.distorted:
            raise MessageError(
                "camera_info has distortion; put the node camera_adapter between driver and graph, "
                "or publish d = 0 and plumb_bob if the images are rectified already"
            )
        check_image_size(*calibration.image_size)
        return calibration.rectified_camera()


# Tables


def hypotheses_to_cloud(hypotheses: Hypotheses, stamp: int, frame: str) -> PointCloud2:
    """Hypotheses (without their segmentation) to a table with the columns of ``HYPOTHESIS_COLUMNS``."""
    table = np.zeros(len(hypotheses), _layout(HYPOTHESIS_COLUMNS))
    _fill_poses(table, hypotheses.T_camera_object)
    _fill_box(table, hypotheses.box)
    for column in ("score", "depth", "label"):
        table[column] = getattr(hypotheses, column)
    return _table_to_cloud(table, stamp, frame)


def hypotheses_from_cloud(message: PointCloud2, segmentation: np.ndarray, frame: str) -> Hypotheses:
    """A table of hypotheses and the (H, W) label image of the same view to Hypotheses.

    Raises:
        MessageError: another frame, a missing column, a number out of its bounds, or a label without a pixel.
    """
    table = _cloud_to_table(message, HYPOTHESIS_COLUMNS, frame)
    if (table["label"] == 0).any():
        raise MessageError("hypotheses: label 0 means background")
    hypotheses = Hypotheses(
        _read_poses(table), _read(table, "score"), _read_box(table), _read(table, "depth"), table["label"], segmentation
    )
    with refusing():
        check_hypotheses(hypotheses)
    return hypotheses


def objects_to_cloud(objects: SceneObjects, stamp: int, frame: str) -> PointCloud2:
    """Accumulated objects to a table with the columns of ``OBJECT_COLUMNS``."""
    table = np.zeros(len(objects), _layout(OBJECT_COLUMNS))
    _fill_poses(table, objects.T_world_object)
    _fill_box(table, objects.box)
    for column in (*_OBJECT_NUMBERS, *_BELIEF_COLUMNS, "support"):
        table[column] = getattr(objects, column)
    return _table_to_cloud(table, stamp, frame)


def objects_from_cloud(message: PointCloud2, frame: str) -> SceneObjects:
    """A table of accumulated objects to SceneObjects.

    Recordings of earlier versions have no probability and no entropy: the score and 0 stand for them.

    Raises:
        MessageError: another frame, a missing column or a number out of its bounds.
    """
    required = {name: dtype for name, dtype in OBJECT_COLUMNS.items() if name not in _BELIEF_COLUMNS}
    believes = {field.name for field in message.fields}.issuperset(_BELIEF_COLUMNS)
    table = _cloud_to_table(message, OBJECT_COLUMNS if believes else required, frame)
    objects = SceneObjects(
        T_world_object=_read_poses(table),
        box=_read_box(table),
        support=table["support"].astype(int),
        probability=_read(table, "probability" if believes else "score"),
        entropy=_read(table, "entropy") if believes else np.zeros(len(table)),
        **{column: _read(table, column) for column in _OBJECT_NUMBERS},
    )
    with refusing():
        check_objects(objects)
    return objects


def attention_to_cloud(
    positions: np.ndarray, weight: np.ndarray, attended: int | None, stamp: int, frame: str
) -> PointCloud2:
    """Object positions (n, 3), attention weights (n,) and the attended index to a table of ``ATTENTION_COLUMNS``."""
    table = np.zeros(len(weight), _layout(ATTENTION_COLUMNS))
    for axis, column in enumerate("xyz"):
        table[column] = positions[:, axis]
    table["weight"] = weight
    if attended is not None:
        table["attended"][attended] = 1
    return _table_to_cloud(table, stamp, frame)


def attention_from_cloud(message: PointCloud2, frame: str) -> tuple[np.ndarray, int | None]:
    """A table of attention to its weights (n,) and the attended index, None without one.

    Raises:
        MessageError: another frame, a missing column or a bad number.
    """
    table = _cloud_to_table(message, ATTENTION_COLUMNS, frame)
    marked = np.flatnonzero(table["attended"])
    return _read(table, "weight"), int(marked[0]) if len(marked) else None


def points_to_cloud(points: np.ndarray, stamp: int, frame: str) -> PointCloud2:
    """(k, 3) points in metres to a cloud of x, y and z."""
    table = np.ascontiguousarray(points, "<f4").view(_layout(POINT_COLUMNS)).reshape(len(points))
    return _table_to_cloud(table, stamp, frame)


def points_from_cloud(message: PointCloud2, frame: str) -> np.ndarray:
    """A cloud to its (k, 3) points in metres; other columns are ignored.

    Raises:
        MessageError: another frame, too many points, a missing column or a number that is not finite.
    """
    table = _cloud_to_table(message, POINT_COLUMNS, frame, most=_MAX_POINTS)
    points = np.column_stack([_read(table, column) for column in POINT_COLUMNS])
    with refusing():
        check_points(points)
    return points


def _layout(columns: dict[str, str]) -> np.dtype:
    return np.dtype(list(columns.items()), align=True)


def _table_to_cloud(table: np.ndarray, stamp: int, frame: str) -> PointCloud2:
    fields = [
        PointField(name=name, offset=offset, datatype=_DATATYPES[dtype.str], count=1)
        for name, (dtype, offset, *_) in (table.dtype.fields or {}).items()
    ]
    cloud = PointCloud2(header=make_header(stamp, frame), height=1, width=len(table), fields=fields)
    cloud.point_step = table.dtype.itemsize
    cloud.row_step = table.nbytes
    cloud.is_dense = True
    cloud.data = _bytes_of(table.view(np.uint8) if len(table) else table)
    return cloud


def _cloud_to_table(message: PointCloud2, columns: dict[str, str], frame: str, most: int = _MAX_ROWS) -> np.ndarray:
    """A cloud's named columns as a structured array; other columns and any padding are ignored."""
    require_frame(message.header, frame)
    if message.is_bigendian:
        raise MessageError("big-endian tables are not supported")
    rows = message.width * message.height
    if rows > most:
        raise MessageError(f"table of {rows} rows, more than {most}")
    if message.row_step != message.point_step * message.width or len(message.data) != message.row_step * message.height:
        raise MessageError(
            f"table of {rows} rows has steps {message.point_step}, {message.row_step} and {len(message.data)} bytes"
        )
    table = read_table(message)
    for name, dtype in columns.items():
        if name not in (table.dtype.fields or {}) or table.dtype[name].str != dtype:
            raise MessageError(f"table has no usable column '{name}' of type {dtype}")
    return table


def read_table(message: Any) -> np.ndarray:
    """A PointCloud2's points as a structured array with its single-valued columns, whichever library made it.

    Columns of unknown types, with several values per point, or beyond the point's size are left out.

    Raises:
        MessageError: the columns make no table: two of the same name, or points of no size.
    """
    usable = [
        field
        for field in message.fields
        if field.datatype in _DTYPES
        and field.count == 1
        and field.offset + np.dtype(_DTYPES[field.datatype]).itemsize <= message.point_step
    ]
    with refusing("table: "):
        layout = np.dtype(
            {
                "names": [field.name for field in usable],
                "formats": [_DTYPES[field.datatype] for field in usable],
                "offsets": [field.offset for field in usable],
                "itemsize": message.point_step,
            }
        )
        return np.frombuffer(message.data, layout) if message.width * message.height else np.zeros(0, layout)


def _fill_poses(table: np.ndarray, T: np.ndarray) -> None:
    quaternions = quaternion_from_transform(T) if len(T) else np.zeros((0, 4))
    for column, values in zip(_POSE_COLUMNS, [*T[:, :3, 3].T, *quaternions.T], strict=True):
        table[column] = values


def _fill_box(table: np.ndarray, box: np.ndarray) -> None:
    for column, values in zip(_BOX_COLUMNS, box.T, strict=True):
        table[column] = values


def _read(table: np.ndarray, column: str) -> np.ndarray:
    values = table[column].astype(float)
    if not np.isfinite(values).all():
        raise MessageError(f"column '{column}' holds a number that is not finite")
    return values


def _read_poses(table: np.ndarray) -> np.ndarray:
    rows = np.stack([table[column].astype(float) for column in _POSE_COLUMNS], axis=1)
    return _rows_to_transforms(rows) if len(rows) else np.zeros((0, 4, 4))


def _read_box(table: np.ndarray) -> np.ndarray:
    return np.stack([_read(table, column) for column in _BOX_COLUMNS], axis=1)


# Diagnostics


def make_status(
    name: str, text: str, values: dict[str, str], level: bytes = DiagnosticStatus.OK, hardware_id: str = HARDWARE_ID
) -> DiagnosticStatus:
    """A diagnostic status with key-value pairs."""
    status = DiagnosticStatus(level=level, name=name, message=text, hardware_id=hardware_id)
    status.values = [KeyValue(key=key, value=value) for key, value in values.items()]
    return status


def own_statuses(message: DiagnosticArray) -> list[DiagnosticStatus]:
    """The statuses of this project's nodes; other programs publish on the same topic."""
    return [status for status in message.status if status.hardware_id == HARDWARE_ID]


def status_values(status: DiagnosticStatus) -> dict[str, str]:
    """The values of a diagnostic status by key."""
    return {pair.key: pair.value for pair in status.values}


def latencies_from_diagnostics(message: DiagnosticArray) -> dict[str, float]:
    """Milliseconds that this project's nodes worked on a view, by node name."""
    latencies = {}
    for status in own_statuses(message):
        value = status_values(status).get("latency_ms", "")
        if re.fullmatch(r"\d+(\.\d+)?", value):
            latencies[status.name.rsplit("/", 1)[-1]] = float(value)
    return latencies


# Markers


def objects_to_markers(
    objects: SceneObjects, mesh_uri: str, stamp: int, frame: str, confirmed: float = 0.5
) -> MarkerArray:
    """One mesh per object, from red (probability 0) to green (1), after one marker that clears the last ones.

    Objects that are less probable than ``confirmed`` are transparent.
    """
    header = make_header(stamp, frame)
    markers = [Marker(header=header, action=Marker.DELETEALL)]
    # Copies share all that is alike: making a new Marker costs ten times as much.
    alike = Marker(header=header, ns="objects", type=Marker.MESH_RESOURCE, mesh_resource=mesh_uri)
    alike.scale = Vector3(x=1.0, y=1.0, z=1.0)
    poses = _transforms_to_poses(objects.T_world_object)
    for index, (pose, probability) in enumerate(zip(poses, objects.probability, strict=True)):
        marker = copy(alike)
        marker.id = index
        marker.pose = pose
        green = float(np.clip(probability, 0.0, 1.0))
        marker.color = ColorRGBA(r=1.0 - green, g=green, b=0.1, a=0.8 if probability >= confirmed else 0.3)
        markers.append(marker)
    return MarkerArray(markers=markers)
