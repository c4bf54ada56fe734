"""The views of a recording that another program made, as the camera's topics of the graph."""

from bisect import bisect_right
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal

import numpy as np

from active6d_bringup.bags.camera_topics import INFO, TRANSFORMS, CameraOptions, CameraTopics, find_camera, with_options
from active6d_bringup.bags.source import BagError, BagSource, open_source
from active6d_bringup.bags.writer import TYPESTORE
from active6d_bringup.camera.rectification import are_rectified
from active6d_bringup.camera.stream import (
    SECOND,
    ArrivalGate,
    GateLimits,
    PoseHistory,
    Verdict,
    pose_difference,
)
from active6d_bringup.camera.view_maker import ViewMaker
from active6d_core.camera import View
from active6d_core.nearest_stamp import nearest_position
from active6d_core.ros.conversions import MessageError, pose_to_transform
from active6d_core.ros.topics import CAMERA_COLOR, CAMERA_DEPTH, CAMERA_INFO, CAMERA_POSE
from active6d_core.ros.transform_tree import TransformTree
from active6d_core.se3 import quaternion_from_transform

#: Colour and depth further apart than this are not of one view; poses may be twice as far.
_TOLERANCE = 20_000_000
#: Recordings by arrival, where headers have no stamps, are less exact.
_ARRIVAL_TOLERANCE = 200_000_000
#: Images closer than this are a stream, of which one is taken wherever the camera stood.
_STREAM_NS = SECOND // 2
_STATIC = "/tf_static is missing, or in another file of the recording"
_FRAMES = {"camera": "camera_optical_frame", "world": "world"}


@dataclass(frozen=True, eq=False)
class RecordedCamera:
    """The views that a recording holds.

    Attributes:
        topics: where they come from.
        payloads: topic of the contract to stamp (ns) to serialized message.
        received: the same to the time (ns) of recording.
        left_out: reason to number of views.
        notes: what is doubtful, in words.
    """

    topics: CameraTopics
    payloads: dict[str, dict[int, bytes]]
    received: dict[str, dict[int, int]]
    left_out: dict[str, int]
    notes: list[str]


@dataclass
class _Scan:
    """Stamps of images, and all small messages."""

    color: list[tuple[int, int]]  # stamp used, position among the topic's messages
    depth: list[tuple[int, int]]  # in order of stamps
    arrival: list[int]  # of colour
    infos: list[tuple[int, Any]]
    depth_infos: list[tuple[int, Any]]
    poses: PoseHistory
    tree: TransformTree
    color_frame: str
    depth_frame: str
    by_arrival: bool


@dataclass(frozen=True)
class _Chosen:
    """A view: positions of its images, and where the camera was."""

    stamp: int
    color: int
    depth: int
    T_world_camera: np.ndarray


def import_camera(path: Path, options: CameraOptions = CameraOptions()) -> RecordedCamera:
    """Read a recording's views.

    Raises:
        BagError: it has no camera, or not one usable view; the text has the reasons.
    """
    with open_source(path) as source:
        topics = find_camera(source, options)
        left_out: Counter[str] = Counter()
        scan = _scan(source, topics)
        if topics.pose is None and topics.world is None and scan.tree.has(scan.color_frame):
            world = "world" if scan.tree.has("world") else scan.tree.root(scan.color_frame)
            topics = replace(topics, world=world)
        chosen = list(_choose_views(scan, topics, left_out))
        maker = ViewMaker(options.depth_scale, are_rectified(options.rectified, topics.color))
        payloads: dict[str, dict[int, bytes]] = defaultdict(dict)
        received: dict[str, dict[int, int]] = defaultdict(dict)
        notes = ["header stamps are missing or go back: times of recording are used"] if scan.by_arrival else []
        for view in _views(source, topics, scan, chosen, maker, left_out):
            notes += [warning for warning in maker.warnings if warning not in notes]
            for topic, payload in _messages(view).items():
                payloads[topic][view.stamp] = payload
                received[topic][view.stamp] = view.stamp
    given: Counter[str] = Counter()
    for reason, count in left_out.items():  # several may become one
        given[with_options(reason)] += count
    if not payloads:
        reasons = "; ".join(f"{count} left out: {reason}" for reason, count in given.most_common(5))
        raise BagError(f"{path}: no usable view of {topics} ({reasons or 'no images'})")
    return RecordedCamera(topics, dict(payloads), dict(received), dict(given), [with_options(note) for note in notes])


def _scan(source: BagSource, topics: CameraTopics) -> _Scan:
    """Read the small messages, and of images their stamps only."""
    wanted = {name for name in (topics.color, topics.depth, topics.info, topics.depth_info, topics.pose) if name}
    connections = [
        each
        for each in source.connections
        if each.topic in wanted or (each.msgtype == TRANSFORMS and (topics.pose is None or topics.depth_info))
    ]
    stamps: dict[str, list[tuple[int, int]]] = {topics.color: [], topics.depth: []}
    frames: dict[str, str] = {}
    infos: dict[str, list[tuple[int, Any]]] = defaultdict(list)
    poses: list[tuple[int, int, np.ndarray]] = []
    tree = TransformTree()
    for connection, arrival, payload in source.messages(connections):
        if connection.topic in stamps:
            stamps[connection.topic].append((source.stamp_of(connection.msgtype, payload), arrival))
            if connection.topic not in frames:
                frames[connection.topic] = source.deserialize(payload, connection.msgtype).header.frame_id
            continue
        message = source.deserialize(payload, connection.msgtype)
        if connection.msgtype == INFO:
            infos[connection.topic].append((arrival, message))
        elif connection.msgtype == TRANSFORMS:
            tree.add(message, connection.topic.endswith("static"))
        else:
            pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
            poses.append((source.stamp_of(connection.msgtype, payload), arrival, pose_to_transform(pose)))
    by_arrival = any(_unusable([stamp for stamp, _ in each]) for each in stamps.values())
    which: Literal[0, 1] = 1 if by_arrival else 0
    history = PoseHistory(keep=None)
    for at, T in sorted(((entry[which], entry[2]) for entry in poses), key=itemgetter(0)):
        history.add(at, T)
    color, depth = ([(entry[which], index) for index, entry in enumerate(each)] for each in stamps.values())
    return _Scan(
        color,
        sorted(depth),
        [arrival for _, arrival in stamps[topics.color]],
        infos[topics.info],
        infos[topics.depth_info] if topics.depth_info else [],
        history,
        tree,
        frames.get(topics.color, ""),
        frames.get(topics.depth, ""),
        by_arrival,
    )


def _unusable(stamps: list[int]) -> bool:
    """Whether stamps are zero, repeat or go back."""
    return any(stamp <= 0 for stamp in stamps) or any(b <= a for a, b in pairwise(stamps))


def _choose_views(scan: _Scan, topics: CameraTopics, left_out: Counter[str]) -> Iterator[_Chosen]:
    """Pairs of images with a camera pose; of a stream, one for each place where the camera stood."""
    tolerance = _ARRIVAL_TOLERANCE if scan.by_arrival else _TOLERANCE
    found, late = [], _Late()
    depth_stamps = [stamp for stamp, _ in scan.depth]
    for stamp, position in scan.color:
        nearest = nearest_position(depth_stamps, stamp)
        if nearest is None or abs(depth_stamps[nearest] - stamp) > tolerance:
            late.add("depth image", tolerance, None if nearest is None else abs(depth_stamps[nearest] - stamp))
            continue
        if topics.pose is not None:
            pose = scan.poses.nearest(stamp)
            if pose is None or abs(pose[0] - stamp) > 2 * tolerance:
                late.add("camera pose", 2 * tolerance, None if pose is None else abs(pose[0] - stamp))
                continue
        try:
            T = _camera_pose(scan, topics, stamp, 2 * tolerance)
        except MessageError as error:
            left_out[str(error)] += 1
            continue
        found.append(_Chosen(stamp, position, scan.depth[nearest][1], T))
    left_out.update(late.reasons(len(scan.color)))
    gaps = np.diff([view.stamp for view in found])
    if len(gaps) and np.median(gaps) < _STREAM_NS:
        found = list(_stops(found, left_out))
    yield from found


def _camera_pose(scan: _Scan, topics: CameraTopics, stamp: int, tolerance: int) -> np.ndarray:
    if topics.pose is None:
        if not scan.tree.has(scan.color_frame):
            raise MessageError(f"no transform to {scan.color_frame}, the frame of colour: {_STATIC}")
        return scan.tree.lookup(topics.world or "world", scan.color_frame, stamp, tolerance)
    nearest = scan.poses.nearest(stamp)
    assert nearest is not None, "only images with a pose get here"
    return nearest[1]


class _Late:
    """Counts what was not there in time, by its kind, with how late it was."""

    def __init__(self) -> None:
        self._nearest: dict[tuple[str, int], list[int | None]] = defaultdict(list)

    def add(self, what: str, tolerance: int, nearest: int | None) -> None:
        """The nearest is this far away, or there is none; all in nanoseconds."""
        self._nearest[what, tolerance].append(nearest)

    def reasons(self, images: int) -> Counter[str]:
        """Reason in words to number of images, of ``images`` in all."""
        found: Counter[str] = Counter()
        for (what, tolerance), every in self._nearest.items():
            known = sorted(each for each in every if each is not None)
            if not known:
                text = f"no {what}"
            elif known[0] > SECOND and len(every) == images:
                text = f"the nearest {what} is {known[0] * 1e-9:.0f} s away or more: are their stamps of one clock?"
            else:
                text = f"no {what} within {tolerance * 1e-6:.0f} ms (the nearest is {known[0] * 1e-6:.0f} ms away)"
            found[text] += len(every)
        return found


def _stops(views: list[_Chosen], left_out: Counter[str]) -> Iterator[_Chosen]:
    """The first image of each place where the camera stood still."""
    limits, poses = GateLimits(), PoseHistory()
    gate, last = ArrivalGate(limits, poses), None
    for view in views:
        poses.add(view.stamp, view.T_world_camera)
        if last is not None and not gate.waiting:
            metres, degrees = pose_difference(last, view.T_world_camera)
            if metres <= limits.still_metres and degrees <= limits.still_degrees:
                left_out["a stream's further images from the same place"] += 1
                continue
            gate.ask(None)
        if gate.judge(view.stamp)[0] is Verdict.TAKE:
            last = view.T_world_camera
            yield view
        else:
            left_out["the camera had not stood still for 0.3 s"] += 1


def _views(
    source: BagSource,
    topics: CameraTopics,
    scan: _Scan,
    chosen: list[_Chosen],
    maker: ViewMaker,
    left_out: Counter[str],
) -> Iterator[View]:
    """Decode the chosen images, in order of colour."""
    images: dict[str, dict[int, Any]] = {topics.color: {}, topics.depth: {}}
    waiting = {topics.color: {view.color for view in chosen}, topics.depth: {view.depth for view in chosen}}
    pending, position = list(chosen), Counter[str]()
    connections = [each for each in source.connections if each.topic in images]
    for connection, _, payload in source.messages(connections):
        index = position[connection.topic]
        position[connection.topic] += 1
        if index not in waiting[connection.topic]:
            continue
        images[connection.topic][index] = source.deserialize(payload, connection.msgtype)
        while pending and pending[0].color in images[topics.color] and pending[0].depth in images[topics.depth]:
            view = pending.pop(0)
            color = images[topics.color].pop(view.color)
            depth = images[topics.depth].get(view.depth)
            for other in [other for other in images[topics.depth] if other < view.depth]:
                del images[topics.depth][other]
            try:
                yield _make(topics, scan, view, color, depth, maker)
            except ValueError as error:
                left_out[str(error)] += 1


def _make(topics: CameraTopics, scan: _Scan, view: _Chosen, color: Any, depth: Any, maker: ViewMaker) -> View:
    if not scan.infos:
        raise MessageError(f"no message on {topics.info}")
    arrival = scan.arrival[view.color]
    info = _latest(scan.infos, arrival)
    depth_info = _latest(scan.depth_infos, arrival) if scan.depth_infos else None
    T_color_depth = None
    if depth_info is not None:
        try:
            T_color_depth = scan.tree.lookup(scan.color_frame, scan.depth_frame, view.stamp, 2 * _TOLERANCE)
        except MessageError as error:
            raise MessageError(f"depth is not registered to colour, and there is {error}: {_STATIC}") from error
    return maker.make(view.stamp, color, depth, info, view.T_world_camera, depth_info, T_color_depth)


def _latest(messages: list[tuple[int, Any]], arrival: int) -> Any:
    """The last message, of messages in order of arrival, that had come by then, or the first one."""
    later = bisect_right(messages, arrival, key=itemgetter(0))
    return messages[max(later - 1, 0)][1]


def _messages(view: View) -> dict[str, bytes]:
    """The camera's serialized messages of the contract, in its own frames."""
    types = TYPESTORE.types
    stamp = types["builtin_interfaces/msg/Time"](view.stamp // SECOND, view.stamp % SECOND)
    header, world = (types["std_msgs/msg/Header"](stamp, frame) for frame in _FRAMES.values())
    image, camera = types["sensor_msgs/msg/Image"], view.camera
    height, width = view.depth.shape
    region = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    K, P = camera.matrix, np.hstack([camera.matrix, np.zeros((3, 1))])
    info = types["sensor_msgs/msg/CameraInfo"](
        header, height, width, "plumb_bob", np.zeros(5), K.ravel(), np.eye(3).ravel(), P.ravel(), 0, 0, region
    )
    quaternion = quaternion_from_transform(view.T_world_camera[None])[0]
    pose = types["geometry_msgs/msg/Pose"](
        types["geometry_msgs/msg/Point"](*view.T_world_camera[:3, 3].tolist()),
        types["geometry_msgs/msg/Quaternion"](*quaternion.tolist()),
    )
    color = np.ascontiguousarray(view.color).reshape(-1)
    depth = np.ascontiguousarray(view.depth, "<f4").view(np.uint8).reshape(-1)
    made = {
        CAMERA_COLOR: image(header, height, width, "rgb8", 0, 3 * width, color),
        CAMERA_DEPTH: image(header, height, width, "32FC1", 0, 4 * width, depth),
        CAMERA_INFO: info,
        CAMERA_POSE: types["geometry_msgs/msg/PoseStamped"](world, pose),
    }
    return {topic.name: bytes(TYPESTORE.serialize_cdr(message, topic.type)) for topic, message in made.items()}
