"""Writing an episode as a rosbag2 folder: MCAP storage, schemas in the file, zstd chunks with checksums. No rclpy."""

from contextlib import suppress
from fcntl import LOCK_EX, LOCK_NB, flock
from pathlib import Path
from threading import RLock
from typing import Any, BinaryIO, Literal
from zlib import crc32

import yaml
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore

from active6d_bringup.bags.mcap_file import McapFile
from active6d_core.files import write_file
from active6d_core.ros.topics import CAMERA_POSE, CONTRACT, EPISODE_END, EPISODE_START, Per, Topic
from active6d_core.structured_text import parse_json

#: Definitions and hashes of every standard message type.
TYPESTORE = get_typestore(Stores.ROS2_JAZZY)

#: Key of all that metadata.yaml says.
INFORMATION = "rosbag2_bagfile_information"
#: Key of the nodes' settings among the custom data of metadata.yaml, and in the metadata of every file.
SETTINGS = "active6d_settings"
#: Name of this project's metadata record in an MCAP file, and the key of the checksum of metadata.yaml in it.
ACTIVE6D, CHECKSUM = "active6d", "metadata_crc32"


class RecordingError(ValueError):
    """A recording cannot be made; the text names the folder and says what to do."""


def refuse_existing(folder: Path) -> None:
    """Refuse a folder for a new recording that is there.

    Raises:
        RecordingError: it is.
    """
    if folder.exists():
        raise RecordingError(f"{folder} exists already; name a new folder for the bag or remove this one")


def parse_settings(text: str | None) -> dict[str, dict[str, Any]]:
    """Parameters of the nodes when recording; nothing where the bag does not have them."""
    try:
        settings = parse_json(text or "{}")
    except (TypeError, ValueError):
        return {}
    if not isinstance(settings, dict):
        return {}
    return {node: parameters for node, parameters in settings.items() if isinstance(parameters, dict)}


class EpisodeWriter:
    """A bag folder, open for messages that are serialized already.

    Every message is a chunk of its own with a checksum, and handed to the operating system at once: when the process
    is killed, everything that it has written is there.

    Args:
        folder: must not exist unless ``resume``; its parents may.
        names: topic of the contract to the name it has in the bag (resolved against namespace and remaps).
        settings: the nodes' parameters as JSON, so that a replay can set the same.
        resume: go on with the next file of a bag in the folder whose recorder was killed.

    Raises:
        RecordingError: the folder exists, or cannot be made.
    """

    def __init__(self, folder: Path, names: dict[str, str], settings: str = "{}", *, resume: bool = False) -> None:
        self.folder = folder
        self._names, self._settings = names, settings
        self._replayed = "bag_player" in parse_settings(settings)
        self._topics = {topic.name: topic for topic in CONTRACT}
        self._stamps: dict[str, set[int]] = {topic.name: set() for topic in CONTRACT}
        self._files: list[dict[str, Any]] = []
        self._lock = RLock()
        self._writer: McapWriter
        self._stream: BinaryIO
        if not (resume and _was_killed(folder)):
            refuse_existing(folder)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            for path in sorted(folder.glob("*.mcap"), key=file_number):
                self._files.append(self._keep(path))
            number = f"_{len(self._files)}" if self._files else ""
            self._open(folder / f"{folder.name}{number}.mcap")
        except OSError as error:
            raise RecordingError(f"{folder} cannot be written: {error.strerror}") from error

    def write(self, topic: str, payload: bytes, received: int, published: int | None = None) -> None:
        """Append one message of the contract's ``topic``.

        Args:
            topic: name in the contract.
            payload: CDR bytes.
            received: the system's time at which it came, nanoseconds.
            published: the time of its graph, which a simulation may set, nanoseconds; None for the same.

        Raises:
            RecordingError: the disk is full, or the folder is gone; what was written before stays readable.
        """
        message_type = self._topics[topic].type
        content = clear_padding(message_type, payload)
        published = received if published is None else published
        try:
            with self._lock:
                if self._stream.closed:
                    return  # by the thread that ends an interrupted process
                self._writer.add_message(self._channels[topic], received, content, published)
                self._writer.flush()
        except OSError as error:
            self._broken = True
            raise RecordingError(f"{self.folder} cannot be written: {error.strerror}; {self.summary()}") from error
        file = self._files[-1]
        file["counts"][topic] += 1
        file["first"], file["last"] = min(file["first"], received), max(file["last"], received)
        self._stamps[topic].add(stamp_of(message_type, payload))

    @property
    def message_count(self) -> int:
        """Messages written so far."""
        return sum(sum(file["counts"].values()) for file in self._files)

    def summary(self) -> str:
        """How many views and messages the bag holds, in words."""
        views = len(self._stamps[CAMERA_POSE.name])
        return f"it holds {views} views, {self.message_count} messages"

    def _open(self, path: Path) -> None:
        """Begin a file of the bag."""
        self._stream, self._broken = path.open("xb"), False
        flock(self._stream, LOCK_EX | LOCK_NB)
        self._writer = McapWriter(self._stream, compression=CompressionType.ZSTD, enable_data_crcs=True)
        self._writer.start(profile="ros2", library="active6d")
        self._writer.add_metadata(ACTIVE6D, {SETTINGS: self._settings})
        schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        for topic in CONTRACT:
            if topic.type not in schemas:
                definition, _ = TYPESTORE.generate_msgdef(topic.type, ros_version=2)
                schemas[topic.type] = self._writer.register_schema(topic.type, "ros2msg", definition.encode())
            qos = yaml.safe_dump([_offered(topic)], sort_keys=False)
            self._channels[topic.name] = self._writer.register_channel(
                self._names[topic.name], "cdr", schemas[topic.type], {"offered_qos_profiles": qos}
            )
        self._writer.flush()
        self._files.append(_new_file(path))

    def _keep(self, path: Path) -> dict[str, Any]:
        """Take a file that an earlier recorder left, and give it the end that it lacks."""
        whole = McapFile(path)
        topics = {name: topic for topic, name in self._names.items()}
        messages = [message for message in whole.messages() if message.topic in topics]
        repaired = path.with_suffix(".part")
        repaired.unlink(missing_ok=True)
        self._open(repaired)
        for message in messages:
            self.write(topics[message.topic], message.payload, message.received)
        self._finish()
        repaired.replace(path)
        return {**self._files.pop(), "path": path.name}

    @property
    def last_end(self) -> int | None:
        """Stamp in nanoseconds of the last view of the last episode that has ended, None before any has."""
        return max(self._stamps[EPISODE_END.name], default=None)

    def missing(self, stamp: int) -> list[str]:
        """Topics that the recording of the episode ending with the view at ``stamp`` (ns) still waits for.

        A topic per view must have spoken at ``stamp``; one per move, at every view of the same episode before it. A
        replay has no policy, and mostly no ``episode/start``.
        """
        start = max((begun for begun in self._stamps[EPISODE_START.name] if begun <= stamp), default=0)
        views = set().union(*(self._stamps[topic.name] for topic in CONTRACT if topic.per is Per.VIEW))
        before = {view for view in views if start <= view < stamp}
        required = {
            Per.VIEW: before | {stamp},
            Per.MOVE: set() if self._replayed else before,
            Per.EPISODE: set(),
            Per.WHENEVER: set(),
        }
        late = [topic.name for topic in CONTRACT if not required[topic.per] <= self._stamps[topic.name]]
        ends = {EPISODE_END.name: stamp} if self._replayed else {EPISODE_START.name: start, EPISODE_END.name: stamp}
        return late + [topic for topic, at in ends.items() if at not in self._stamps[topic]]

    def close(self) -> None:
        """Write the index and metadata.yaml; a second call does nothing.

        Raises:
            RecordingError: the disk is full; the messages that were written can be read all the same.
        """
        # From another thread when an interrupted process is ended, which cannot wait for a disk that hangs.
        if not self._lock.acquire(timeout=1.0):
            return
        try:
            if not self._stream.closed:
                self._close()
        finally:
            self._lock.release()

    def _close(self) -> None:
        text = yaml.safe_dump({INFORMATION: self._describe()}, sort_keys=False)
        try:
            if self._broken:
                self._stream.close()
            else:
                checksum = f"{crc32(text.encode()):08x}"
                self._writer.add_metadata("rosbag2", {"serialized_metadata": yaml.safe_dump(self._describe())})
                self._writer.add_metadata(ACTIVE6D, {SETTINGS: self._settings, CHECKSUM: checksum})
                self._finish()
            write_file(self.folder / "metadata.yaml", text)
        except OSError as error:
            with suppress(OSError):
                self._stream.close()
            raise RecordingError(f"{self.folder} cannot be written: {error.strerror}; {self.summary()}") from error

    def _finish(self) -> None:
        self._writer.finish()
        self._stream.close()

    def _describe(self) -> dict[str, Any]:
        counts = {topic.name: sum(file["counts"][topic.name] for file in self._files) for topic in CONTRACT}
        topics = [
            describe_topic(self._names[topic.name], topic.type, [_offered(topic)], counts[topic.name])
            for topic in CONTRACT
        ]
        return describe_bag(self._files, topics, {SETTINGS: self._settings})


def _was_killed(folder: Path) -> bool:
    """Whether a folder holds a bag that has no metadata yet, and that no recorder is writing."""
    paths = list(folder.glob("*.mcap"))
    if not paths or (folder / "metadata.yaml").exists():
        return False
    for path in paths:
        with path.open("rb") as file:
            try:
                flock(file, LOCK_EX | LOCK_NB)
            except OSError:
                return False
    return True


def file_number(path: Path) -> int:
    """Number of a file within its bag: 0 for ``NAME.mcap``, 1 for ``NAME_1.mcap``."""
    digits = path.stem.rpartition("_")[2]
    return int(digits) if path.stem != path.parent.name and digits.isdecimal() else 0


def _new_file(path: Path) -> dict[str, Any]:
    return {"path": path.name, "counts": {topic.name: 0 for topic in CONTRACT}, "first": 2**63 - 1, "last": 0}


def clear_padding(message_type: str, payload: bytes) -> bytes:
    """The same serialized message with zeros for padding, so that the same seed gives the same bytes.

    CDR aligns its fields, and the middleware leaves in the gaps whatever its buffer held. A payload that does not
    decode (text that is not UTF-8) is returned as it is: a recorder keeps every message.
    """
    try:
        return bytes(TYPESTORE.serialize_cdr(TYPESTORE.deserialize_cdr(payload, message_type), message_type))
    except (SerdeError, ValueError):
        return payload


def stamp_of(message_type: str, payload: bytes) -> int:
    """The stamp in nanoseconds that serialized (CDR) messages of the contract begin with; 0 without any.

    The header comes first in every type of the contract but MarkerArray, whose first marker's header counts.
    """
    order: Literal["little", "big"] = "little" if payload[1] & 1 else "big"
    offset = 4
    if message_type.endswith("/MarkerArray"):
        if int.from_bytes(payload[4:8], order) == 0:
            return 0
        offset = 8
    seconds = int.from_bytes(payload[offset : offset + 4], order, signed=True)
    return seconds * 1_000_000_000 + int.from_bytes(payload[offset + 4 : offset + 8], order)


def describe_topic(name: str, message_type: str, qos: list[dict[str, Any]], count: int) -> dict[str, Any]:
    """What metadata.yaml says of a topic; the hash of a type that is not standard is left empty, which is allowed."""
    return {
        "topic_metadata": {
            "name": name,
            "type": message_type,
            "serialization_format": "cdr",
            "offered_qos_profiles": qos,
            "type_description_hash": TYPESTORE.hash_rihs01(message_type) if message_type in TYPESTORE.types else "",
        },
        "message_count": count,
    }


def describe_bag(files: list[dict[str, Any]], topics: list[dict[str, Any]], custom: dict[str, str]) -> dict[str, Any]:
    """What metadata.yaml says, in version 9 of rosbag2's format (Jazzy).

    Args:
        files: of each the path, the number of messages by topic (counts), and their first and last time (ns).
        topics: as ``describe_topic`` makes them.
        custom: further keys and values.
    """
    counted = [file for file in files if sum(file["counts"].values())] or files
    start, end = min(file["first"] for file in counted), max(file["last"] for file in counted)

    def span(first: int, last: int) -> dict[str, Any]:
        return {
            "duration": {"nanoseconds": max(last - first, 0)},
            "starting_time": {"nanoseconds_since_epoch": first},
        }

    return {
        "version": 9,
        "storage_identifier": "mcap",
        "relative_file_paths": [file["path"] for file in files],
        **span(start, end),
        "message_count": sum(topic["message_count"] for topic in topics),
        "topics_with_message_count": topics,
        "compression_format": "",
        "compression_mode": "",
        "files": [
            {
                "path": file["path"],
                **span(file["first"], file["last"]),
                "message_count": sum(file["counts"].values()),
            }
            for file in files
        ],
        "custom_data": custom,
        "ros_distro": "jazzy",
    }


def _offered(topic: Topic) -> dict[str, Any]:
    """The quality of service that a topic's publisher offers, in rosbag2's words."""
    forever = {"sec": 9223372036, "nsec": 854775807}
    return {
        "history": "keep_last",
        "depth": topic.depth,
        "reliability": "reliable",
        "durability": "transient_local" if topic.transient_local else "volatile",
        "deadline": dict(forever),
        "lifespan": dict(forever),
        "liveliness": "automatic",
        "liveliness_lease_duration": dict(forever),
        "avoid_ros_namespace_conventions": False,
    }
