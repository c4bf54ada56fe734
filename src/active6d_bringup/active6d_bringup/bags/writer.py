"""Writing an episode as a rosbag2 folder: MCAP storage, schemas in the file, zstd chunks. No rclpy in here."""

from pathlib import Path
from typing import Literal

from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore

from active6d_core.ros.topics import CONTRACT, EPISODE_END, EPISODE_START, Per, Topic

#: Definitions and hashes of every standard message type.
TYPESTORE = get_typestore(Stores.ROS2_JAZZY)

_FOREVER = QosTime(0x7FFFFFFF, 0xFFFFFFFF)


#: Key of the nodes' settings among the custom data of metadata.yaml.
SETTINGS = "active6d_settings"


class RecordingError(ValueError):
    """A recording cannot be made; the text names the folder and says what to do."""


class EpisodeWriter:
    """A new bag folder, open for messages that are serialized already.

    Args:
        folder: must not exist; its parents may.
        names: topic of the contract to the name it has in the bag (resolved against namespace and remaps).
        settings: the nodes' parameters as JSON; kept in metadata.yaml so that a replay can set the same.

    Raises:
        RecordingError: the folder exists, or cannot be made.
    """

    def __init__(self, folder: Path, names: dict[str, str], settings: str = "{}") -> None:
        self.folder = folder
        if folder.exists():
            raise RecordingError(f"{folder} exists already; name a new folder for the bag or remove this one")
        self._writer = Writer(folder, version=Writer.VERSION_LATEST, storage_plugin=StoragePlugin.MCAP)
        self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        self._writer.set_custom_data(SETTINGS, settings)
        try:
            self._writer.open()
        except OSError as error:
            raise RecordingError(f"{folder} cannot be created: {error.strerror}") from error
        self._topics = {topic.name: topic for topic in CONTRACT}
        self._connections = {
            topic.name: self._writer.add_connection(
                names[topic.name], topic.type, typestore=TYPESTORE, offered_qos_profiles=[_offered(topic)]
            )
            for topic in CONTRACT
        }
        self._stamps: dict[str, set[int]] = {topic.name: set() for topic in CONTRACT}
        self._closed = False

    def write(self, topic: str, payload: bytes, received: int) -> None:
        """Append one message of the contract's ``topic``: its CDR bytes, and when it came in nanoseconds."""
        message_type = self._topics[topic].type
        self._writer.write(self._connections[topic], received, clear_padding(message_type, payload))
        self._stamps[topic].add(stamp_of(message_type, payload))

    @property
    def message_count(self) -> int:
        """Messages written so far."""
        return sum(self._writer.counts.values())

    @property
    def last_end(self) -> int | None:
        """Stamp in nanoseconds of the last view of the last episode that has ended, None before any has."""
        return max(self._stamps[EPISODE_END.name], default=None)

    def missing(self, stamp: int) -> list[str]:
        """Topics that the recording of the episode ending with the view at ``stamp`` (ns) still waits for.

        A topic per view must have spoken at ``stamp``; one per move, at every view of the same episode before it.
        """
        start = max((begun for begun in self._stamps[EPISODE_START.name] if begun <= stamp), default=0)
        views = set().union(*(self._stamps[topic.name] for topic in CONTRACT if topic.per is Per.VIEW))
        before = {view for view in views if start <= view < stamp}
        required = {
            Per.VIEW: before | {stamp},
            Per.MOVE: before,
            Per.EPISODE: set(),
            Per.WHENEVER: set(),
        }
        late = [topic.name for topic in CONTRACT if not required[topic.per] <= self._stamps[topic.name]]
        ends = ((EPISODE_START.name, start), (EPISODE_END.name, stamp))
        return late + [topic for topic, at in ends if at not in self._stamps[topic]]

    def close(self) -> None:
        """Write the index and metadata.yaml; a second call does nothing."""
        if not self._closed:
            self._closed = True
            self._writer.close()


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


def _offered(topic: Topic) -> Qos:
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=topic.depth,
        reliability=QosReliability.RELIABLE,
        durability=QosDurability.TRANSIENT_LOCAL if topic.transient_local else QosDurability.VOLATILE,
        deadline=_FOREVER,
        lifespan=_FOREVER,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=_FOREVER,
        avoid_ros_namespace_conventions=False,
    )
