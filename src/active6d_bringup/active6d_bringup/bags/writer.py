"""Writing an episode as a rosbag2 folder: MCAP storage, schemas in the file, zstd chunks. No rclpy in here."""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum, auto
from pathlib import Path
from typing import Literal

from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore

#: Definitions and hashes of every standard message type.
TYPESTORE = get_typestore(Stores.ROS2_JAZZY)

_FOREVER = QosTime(0x7FFFFFFF, 0xFFFFFFFF)


class Per(Enum):
    """How often a topic speaks, and so when a recording of it is complete."""

    VIEW = auto()
    """once for every view of an episode"""
    MOVE = auto()
    """once for every view but the last"""
    EPISODE = auto()
    """once for an episode"""
    WHENEVER = auto()
    """whenever there is something to say; no recording waits for it"""


@dataclass(frozen=True)
class RecordedTopic:
    """A topic of the contract between the nodes.

    Attributes:
        name: relative, unless it belongs to the whole machine.
        type: such as ``sensor_msgs/msg/Image``.
        per: what one message stands for.
        latched: offered transient-local.
        depth: of the offered queue.
    """

    name: str
    type: str
    per: Per
    latched: bool = False
    depth: int = 10


CAMERA_TOPICS = (
    RecordedTopic("camera/color/image_raw", "sensor_msgs/msg/Image", Per.VIEW, latched=True),
    RecordedTopic("camera/depth/image_raw", "sensor_msgs/msg/Image", Per.VIEW, latched=True),
    RecordedTopic("camera/color/camera_info", "sensor_msgs/msg/CameraInfo", Per.VIEW, latched=True),
    RecordedTopic("camera/pose", "geometry_msgs/msg/PoseStamped", Per.VIEW, latched=True),
)
CONTRACT = (
    *CAMERA_TOPICS,
    RecordedTopic("ground_truth/poses", "geometry_msgs/msg/PoseArray", Per.WHENEVER, latched=True),
    RecordedTopic("episode/start", "diagnostic_msgs/msg/DiagnosticArray", Per.EPISODE, latched=True),
    RecordedTopic("hypotheses", "sensor_msgs/msg/PointCloud2", Per.VIEW, latched=True),
    RecordedTopic("hypotheses/poses", "geometry_msgs/msg/PoseArray", Per.VIEW, latched=True),
    RecordedTopic("hypotheses/segmentation", "sensor_msgs/msg/Image", Per.VIEW, latched=True),
    RecordedTopic("objects", "sensor_msgs/msg/PointCloud2", Per.VIEW, latched=True),
    RecordedTopic("objects/poses", "geometry_msgs/msg/PoseArray", Per.VIEW, latched=True),
    RecordedTopic("objects/markers", "visualization_msgs/msg/MarkerArray", Per.VIEW, latched=True),
    RecordedTopic("objects/unexplained", "sensor_msgs/msg/PointCloud2", Per.VIEW, latched=True),
    RecordedTopic("attention", "sensor_msgs/msg/PointCloud2", Per.MOVE),
    RecordedTopic("view_goal", "geometry_msgs/msg/PoseStamped", Per.MOVE),
    RecordedTopic("view_goal/status", "diagnostic_msgs/msg/DiagnosticArray", Per.WHENEVER, latched=True),
    RecordedTopic("episode/end", "diagnostic_msgs/msg/DiagnosticArray", Per.EPISODE, latched=True),
    RecordedTopic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", Per.WHENEVER, depth=100),
)
#: Key of the nodes' settings among the custom data of metadata.yaml.
SETTINGS = "active6d_settings"
START, END, POSE = "episode/start", "episode/end", "camera/pose"


class RecordingError(ValueError):
    """A recording cannot be made; the text names the folder and says what to do."""


class EpisodeWriter:
    """A new bag folder, open for messages that are serialized already.

    Args:
        folder: must not exist; its parents may.
        names: topic of the contract to the name it has in the bag (resolved against namespace and remaps).
        settings: what the nodes were told, as JSON; kept in metadata.yaml so that a replay can tell them the same.

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
        return max(self._stamps[END], default=None)

    def missing(self, stamp: int) -> list[str]:
        """Topics that the recording of the episode ending with the view at ``stamp`` (ns) still waits for.

        A topic per view must have spoken at ``stamp``; one per move, at every view of the same episode before it.
        """
        start = max((begun for begun in self._stamps[START] if begun <= stamp), default=0)
        views = set().union(*(self._stamps[topic.name] for topic in CONTRACT if topic.per is Per.VIEW))
        before = {view for view in views if start <= view < stamp}
        required = {
            Per.VIEW: before | {stamp},
            Per.MOVE: before,
            Per.EPISODE: set(),
            Per.WHENEVER: set(),
        }
        late = [topic.name for topic in CONTRACT if not required[topic.per] <= self._stamps[topic.name]]
        return late + [topic for topic, at in ((START, start), (END, stamp)) if at not in self._stamps[topic]]

    def close(self) -> None:
        """Write the index and metadata.yaml; a second call does nothing."""
        if not self._closed:
            self._closed = True
            self._writer.close()


def clear_padding(message_type: str, payload: bytes) -> bytes:
    """The same serialized message with zeros for padding, so that the same seed gives the same bytes.

    CDR aligns its fields, and the middleware leaves in the gaps whatever its buffer held. A payload that does not
    decode (text that is not UTF-8) is returned as it is: a recorder keeps what it hears.
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


def describe_missing(topics: Iterable[str]) -> str:
    """Which node has not answered, said from the topics that are missing."""
    owner = {
        "camera": "camera_simulator",
        "episode/start": "camera_simulator",
        "hypotheses": "pose_estimator",
        "objects": "hypothesis_fusion",
        "attention": "attention_policy",
        "view_goal": "attention_policy",
        "episode/end": "attention_policy",
    }
    topics = list(topics)
    nodes = {node for prefix, node in owner.items() for topic in topics if topic.startswith(prefix)}
    return f"{', '.join(sorted(nodes))} (waiting for {', '.join(topics)})" if nodes else ", ".join(topics)


def _offered(topic: RecordedTopic) -> Qos:
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=topic.depth,
        reliability=QosReliability.RELIABLE,
        durability=QosDurability.TRANSIENT_LOCAL if topic.latched else QosDurability.VOLATILE,
        deadline=_FOREVER,
        lifespan=_FOREVER,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=_FOREVER,
        avoid_ros_namespace_conventions=False,
    )
