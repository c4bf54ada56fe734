"""A bag read once: serialized messages by topic and stamp, whatever the bag's namespace. Needs no ROS."""

import zlib
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rosbags.rosbag2 import Reader

from active6d_bringup.bags.camera_topics import CameraOptions
from active6d_bringup.bags.mcap_file import McapFile, RecordedMessage
from active6d_bringup.bags.recorded_camera import import_camera
from active6d_bringup.bags.source import BagError, damaged, refuse_unfinished
from active6d_bringup.bags.writer import (
    ACTIVE6D,
    CHECKSUM,
    INFORMATION,
    SETTINGS,
    TYPESTORE,
    file_number,
    parse_settings,
    stamp_of,
)
from active6d_core.calibration import Calibration
from active6d_core.ros.conversions import COLOR_ENCODINGS
from active6d_core.ros.topics import (
    CAMERA_COLOR,
    CAMERA_DEPTH,
    CAMERA_INFO,
    CAMERA_POSE,
    CAMERA_TOPICS,
    CONTRACT,
    DIAGNOSTICS,
    TOPICS,
)
from active6d_core.structured_text import read_yaml

_POSE_ENDING = f"/{CAMERA_POSE.name}"
_ENDINGS = tuple("/" + topic.name.lstrip("/") for topic in CONTRACT)


@dataclass(frozen=True, eq=False)
class BagIndex:
    """The messages of a bag's topics of the contract.

    Attributes:
        folder: of the bag, or its file where that was named.
        payloads: topic of the contract to stamp (ns) to serialized message, the last one of a stamp.
        received: the same to the time (ns) at which it was recorded.
        diagnostics: every serialized message of ``/diagnostics``, in order.
        settings: node name to its parameters when recording; empty where the bag does not have them.
        damage: what is missing or damaged, in words; empty for a whole bag.
        left_out: reason to the number of views that are not in it.
        notes: what is doubtful, in words.
        source: topics of another program's camera from which the camera's were made, empty for a bag of this project.
    """

    folder: Path
    payloads: dict[str, dict[int, bytes]]
    received: dict[str, dict[int, int]]
    diagnostics: list[bytes]
    settings: dict[str, dict[str, Any]]
    damage: tuple[str, ...] = ()
    left_out: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    source: str = ""

    @property
    def frames(self) -> dict[str, str]:
        """The nodes' parameters ``world_frame`` and ``camera_frame`` for the frames of the recording."""
        found = {}
        for name, topic in (("world_frame", CAMERA_POSE), ("camera_frame", CAMERA_COLOR)):
            first: Any = TYPESTORE.deserialize_cdr(next(iter(self.payloads[topic.name].values())), topic.type)
            found[name] = first.header.frame_id
        return found

    def messages(self, topic: str) -> dict[int, Any]:
        """Stamp (ns) to deserialized message of one topic.

        Raises:
            BagError: a message is damaged.
        """
        try:
            return {
                stamp: TYPESTORE.deserialize_cdr(payload, TOPICS[topic].type)
                for stamp, payload in self.payloads.get(topic, {}).items()
            }
        # A damaged message fails anywhere in its decoding, with the error of whichever library was at work.
        except Exception as error:
            raise BagError(f"{self.folder}: damaged message of {topic} ({error})") from error


def read_bag(path: Path, options: CameraOptions = CameraOptions()) -> BagIndex:
    """Read a bag of this project, or the camera of any other recording.

    Of a killed, cut or damaged bag of this project, the whole chunks are read.

    Args:
        path: folder of a bag, or a file of rosbag2 (MCAP, sqlite3) or of ROS 1.
        options: what the user says of the camera; without, a bag of this project is read as it is.

    Raises:
        BagError: no bag, or one without a usable view.
    """
    index: BagIndex | None = None
    damage: tuple[str, ...] = ()
    if not options.given and _may_be_of_the_contract(path):
        index, damage = _read_own(path)
    if index is not None:
        return index
    try:
        camera = import_camera(path, options)
    except BagError as error:
        raise BagError("; ".join([str(error), *damage])) from error
    made = camera.payloads, camera.received
    return BagIndex(path, *made, [], {}, damage, camera.left_out, camera.notes, str(camera.topics))


def _may_be_of_the_contract(path: Path) -> bool:
    """Whether a recording may hold the graph's topics as they are; of lone files only those of this project do."""
    if path.is_file():
        return path.suffix == ".mcap" and McapFile(path).begins_with(ACTIVE6D)
    return (path / "metadata.yaml").is_file() or any(path.glob("*.mcap"))


def _read_own(path: Path) -> tuple[BagIndex | None, tuple[str, ...]]:
    """The bag's topics of the contract, None where its camera is not what the graph publishes; and the damage."""
    # metadata.yaml describes all files of a bag: a lone file is whole without it.
    metadata, damage = _read_metadata(path) if path.is_dir() else ({}, [])
    if metadata.get("storage_identifier", "mcap") == "mcap" and not metadata.get("compression_mode"):
        messages, recorded, settings, lines = _read_mcap(path, metadata)
        damage += lines
    else:
        messages, settings = _read_with_rosbags(path), None
        recorded = {(message.topic, message.type) for message in messages}
    # Only files of this project have a record that holds them.
    own = settings is not None
    if settings is None:
        settings = (metadata.get("custom_data") or {}).get(SETTINGS)
    names = topic_names(recorded, path)
    if names is None:
        return None, tuple(damage)
    payloads: dict[str, dict[int, bytes]] = defaultdict(dict)
    received: dict[str, dict[int, int]] = defaultdict(dict)
    diagnostics: list[bytes] = []
    repeated = False
    for message in messages:
        topic = names.get(message.topic)
        if topic is None:
            continue
        if topic == DIAGNOSTICS.name:
            diagnostics.append(message.payload)
            continue
        stamp = stamp_of(message.type, message.payload)
        # A recorder that was restarted gets the last messages once more; they are the same.
        known = payloads[topic].get(stamp)
        repeated |= TOPICS[topic] in CAMERA_TOPICS and known is not None and known != message.payload
        payloads[topic][stamp] = message.payload
        received[topic][stamp] = message.received
    recording = dict(payloads), dict(received), diagnostics, parse_settings(settings)
    index = BagIndex(path, *recording, tuple(damage), _incomplete(payloads))
    # Of a damaged bag of this project, what is whole is read. Another camera's messages must be those of the contract.
    usable = (own and bool(damage)) or (not repeated and _is_of_the_contract(index))
    return index if usable else None, tuple(damage)


def _incomplete(payloads: dict[str, dict[int, bytes]]) -> dict[str, int]:
    """Reason to number of views that lack a topic of the camera."""
    stamps = {topic.name: payloads.get(topic.name, {}).keys() for topic in CAMERA_TOPICS}
    lacking = [
        ", ".join(name for name, known in stamps.items() if stamp not in known)
        for stamp in set().union(*stamps.values())
        if not all(stamp in known for known in stamps.values())
    ]
    return {f"no message of {names} for it": count for names, count in Counter(lacking).items()}


def _is_of_the_contract(index: BagIndex) -> bool:
    """Whether the camera's messages can be used as they are; else they are read as those of a foreign recording."""
    stamps = [list(index.payloads.get(topic.name, {})) for topic in CAMERA_TOPICS]
    complete = set.intersection(*map(set, stamps))
    # A recording may begin or end within a view, and no further.
    if not complete or min(complete) <= 0 or any(each != sorted(each) for each in stamps):
        return False
    incomplete = set().union(*stamps) - complete
    before, after = (sum(at(stamp) for stamp in incomplete) for at in (min(complete).__gt__, max(complete).__lt__))
    if before > 1 or after > 1 or before + after < len(incomplete):
        return False
    camera = [index.messages(topic.name) for topic in (CAMERA_COLOR, CAMERA_DEPTH, CAMERA_INFO)]
    for stamp in complete:
        color, depth, info = (messages[stamp] for messages in camera)
        try:
            calibration = Calibration.from_info(info)
        except ValueError:
            return False
        encodings = color.encoding in COLOR_ENCODINGS and depth.encoding in ("32FC1", "16UC1")
        if calibration.distorted or not encodings or color.header.frame_id != depth.header.frame_id:
            return False
        if any((image.width, image.height) != calibration.image_size for image in (color, depth)):
            return False
    return True


def _read_metadata(folder: Path) -> tuple[dict[str, Any], list[str]]:
    """What metadata.yaml says, empty without it, and what is wrong with it."""
    path = folder / "metadata.yaml"
    if not path.is_file():
        if not any(folder.glob("*.mcap")):
            raise BagError(f"{folder}: no metadata.yaml and no .mcap file; this is not a bag")
        return {}, ["there is no metadata.yaml: the recording was killed, or its file was moved"]
    try:
        metadata = read_yaml(path)[INFORMATION]
        if not isinstance(metadata, dict):
            raise TypeError
    except (OSError, KeyError, TypeError, ValueError) as error:
        if not any(folder.glob("*.mcap")):
            raise BagError(f"{folder}: metadata.yaml is damaged, and there is no .mcap file") from error
        return {}, ["metadata.yaml is damaged"]
    return metadata, []


def _read_mcap(
    path: Path, metadata: dict[str, Any]
) -> tuple[list[RecordedMessage], set[tuple[str, str]], str | None, list[str]]:
    """The messages of MCAP files that may be of an episode, all topics, the settings if any, and the damage.

    The files are those of a folder, or the one that ``path`` names.
    """
    names = metadata.get("relative_file_paths")
    files = sorted(path.glob("*.mcap"), key=file_number) if path.is_dir() else [path]
    there = {each.name for each in files}
    wanted = {Path(str(name)).name for name in names} if isinstance(names, list) else there
    damage = [f"{name} is missing" for name in sorted(wanted - there)]
    messages: list[RecordedMessage] = []
    recorded: set[tuple[str, str]] = set()
    settings, checksum = None, None
    for each in files:
        file = McapFile(each)
        messages += [message for message in file.messages() if message.topic.endswith(_ENDINGS)]
        recorded |= file.topics
        damage += file.damage
        own = file.metadata.get(ACTIVE6D, {})
        settings, checksum = own.get(SETTINGS, settings), own.get(CHECKSUM)
    text = (path / "metadata.yaml").read_bytes() if metadata else b""
    if metadata and checksum is not None and f"{zlib.crc32(text):08x}" != checksum:
        damage.append("metadata.yaml differs from its checksum")
    return messages, recorded, settings, damage


def _read_with_rosbags(folder: Path) -> list[RecordedMessage]:
    """The messages of a bag in another storage than plain MCAP, in order of time."""
    refuse_unfinished(folder)
    try:
        with Reader(folder) as reader:
            return [
                RecordedMessage(connection.topic, connection.msgtype, timestamp, bytes(payload))
                for connection, timestamp, payload in reader.messages()
                if connection.topic.endswith(_ENDINGS)
            ]
    # A damaged file fails anywhere in its decoding, with the error of whichever library was at work.
    except Exception as error:
        raise damaged(folder, error) from error


def topic_names(recorded: set[tuple[str, str]], folder: Path) -> dict[str, str] | None:
    """Recorded topic to its name in the contract, for the topics of the contract, whatever their namespace.

    None where the camera's topics are not there, or are of other types.

    Raises:
        BagError: the bag has several camera poses (more than one namespace).
    """
    poses = sorted({topic for topic, _ in recorded if topic.endswith(_POSE_ENDING)})
    if len(poses) > 1:
        raise BagError(f"{folder}: has several namespaces ({', '.join(poses)}); choose topics with --topics")
    if not poses:
        return None
    prefix = poses[0].removesuffix(CAMERA_POSE.name)
    if not {(prefix + topic.name, topic.type) for topic in CAMERA_TOPICS} <= recorded:
        return None
    known = {topic.name if topic.name.startswith("/") else prefix + topic.name: topic for topic in CONTRACT}
    for topic, message_type in sorted(recorded):
        if topic in known and message_type != known[topic].type:
            raise BagError(f"{folder}: {topic} holds {message_type}, expected {known[topic].type}")
    return {name: topic.name for name, topic in known.items()}
