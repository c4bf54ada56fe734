"""A bag read once: serialized messages by topic and stamp, whatever the bag's namespace. Needs no ROS."""

import json
import zlib
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from rosbags.rosbag2 import Reader

from active6d_bringup.bags.mcap_file import McapFile, RecordedMessage
from active6d_bringup.bags.writer import ACTIVE6D, CHECKSUM, INFORMATION, SETTINGS, TYPESTORE, file_number, stamp_of
from active6d_core.ros.topics import CAMERA_POSE, CONTRACT, DIAGNOSTICS, TOPICS

_POSE_ENDING = f"/{CAMERA_POSE.name}"
_ENDINGS = tuple("/" + topic.name.lstrip("/") for topic in CONTRACT)


class BagError(ValueError):
    """A bag that cannot be read as an episode; the text names the folder and says what to do."""


@dataclass(frozen=True, eq=False)
class BagIndex:
    """The messages of a bag's topics of the contract.

    Attributes:
        folder: of the bag.
        payloads: topic of the contract to stamp (ns) to serialized message, the last one of a stamp.
        received: the same to the time (ns) at which it was recorded.
        diagnostics: every serialized message of ``/diagnostics``, in order.
        settings: node name to its parameters when recording; empty where the bag does not have them.
        damage: what is missing or damaged, in words; empty for a whole bag.
    """

    folder: Path
    payloads: dict[str, dict[int, bytes]]
    received: dict[str, dict[int, int]]
    diagnostics: list[bytes]
    settings: dict[str, dict[str, Any]]
    damage: tuple[str, ...] = ()

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


def read_bag(folder: Path) -> BagIndex:
    """Read a bag in one pass. Of a killed, cut or damaged one, the whole chunks are read.

    Raises:
        BagError: no bag, or one that is no episode.
    """
    if not folder.is_dir():
        raise BagError(f"{folder}: no such folder; name the folder of a bag, the one with metadata.yaml in it")
    metadata, damage = _read_metadata(folder)
    if metadata.get("storage_identifier", "mcap") == "mcap" and not metadata.get("compression_mode"):
        messages, recorded, settings, lines = _read_mcap(folder, metadata)
        damage += lines
    else:
        messages, settings = _read_with_rosbags(folder), None
        recorded = {(message.topic, message.type) for message in messages}
    if settings is None:
        settings = (metadata.get("custom_data") or {}).get(SETTINGS)
    try:
        names = topic_names(recorded, folder)
    except BagError as error:
        raise BagError("; ".join([str(error), *damage])) from error
    payloads: dict[str, dict[int, bytes]] = defaultdict(dict)
    received: dict[str, dict[int, int]] = defaultdict(dict)
    diagnostics: list[bytes] = []
    for message in messages:
        topic = names.get(message.topic)
        if topic is None:
            continue
        if topic == DIAGNOSTICS.name:
            diagnostics.append(message.payload)
            continue
        stamp = stamp_of(message.type, message.payload)
        payloads[topic][stamp] = message.payload
        received[topic][stamp] = message.received
    return BagIndex(folder, dict(payloads), dict(received), diagnostics, _parse_settings(settings), tuple(damage))


def _read_metadata(folder: Path) -> tuple[dict[str, Any], list[str]]:
    """What metadata.yaml says, empty without it, and what is wrong with it."""
    path = folder / "metadata.yaml"
    if not path.is_file():
        if not any(folder.glob("*.mcap")):
            raise BagError(f"{folder}: no metadata.yaml and no .mcap file; this is not a bag")
        return {}, ["there is no metadata.yaml, the recording was killed"]
    try:
        metadata = yaml.safe_load(path.read_text())[INFORMATION]
        if not isinstance(metadata, dict):
            raise TypeError
    except (yaml.YAMLError, KeyError, TypeError, ValueError) as error:
        if not any(folder.glob("*.mcap")):
            raise BagError(f"{folder}: metadata.yaml is damaged, and there is no .mcap file") from error
        return {}, ["metadata.yaml is damaged"]
    return metadata, []


def _read_mcap(
    folder: Path, metadata: dict[str, Any]
) -> tuple[list[RecordedMessage], set[tuple[str, str]], str | None, list[str]]:
    """The messages of a bag's MCAP files that may be of an episode, all topics, the settings if any, and the damage."""
    names = metadata.get("relative_file_paths")
    there = sorted(folder.glob("*.mcap"), key=file_number)
    wanted = {Path(str(name)).name for name in names} if isinstance(names, list) else {path.name for path in there}
    damage = [f"{name} is missing" for name in sorted(wanted - {path.name for path in there})]
    messages: list[RecordedMessage] = []
    recorded: set[tuple[str, str]] = set()
    settings, checksum = None, None
    for path in there:
        file = McapFile(path)
        messages += [message for message in file.messages() if message.topic.endswith(_ENDINGS)]
        recorded |= file.topics
        damage += file.damage
        own = file.metadata.get(ACTIVE6D, {})
        settings, checksum = own.get(SETTINGS, settings), own.get(CHECKSUM)
    text = (folder / "metadata.yaml").read_bytes() if metadata else b""
    if metadata and checksum is not None and f"{zlib.crc32(text):08x}" != checksum:
        damage.append("metadata.yaml differs from its checksum")
    return messages, recorded, settings, damage


def _read_with_rosbags(folder: Path) -> list[RecordedMessage]:
    """The messages of a bag in another storage than plain MCAP, in order of time."""
    try:
        with Reader(folder) as reader:
            return [
                RecordedMessage(connection.topic, connection.msgtype, timestamp, bytes(payload))
                for connection, timestamp, payload in reader.messages()
                if connection.topic.endswith(_ENDINGS)
            ]
    # A damaged file fails anywhere in its decoding, with the error of whichever library was at work.
    except Exception as error:
        raise BagError(f"{folder}: damaged bag ({error})") from error


def topic_names(recorded: set[tuple[str, str]], folder: Path) -> dict[str, str]:
    """Recorded topic to its name in the contract, for the topics of the contract, whatever their namespace.

    Raises:
        BagError: the bag has no camera pose, or several (more than one namespace).
    """
    poses = sorted({topic for topic, _ in recorded if topic.endswith(_POSE_ENDING)})
    if len(poses) != 1:
        found = f"several namespaces ({', '.join(poses)})" if poses else f"no topic {CAMERA_POSE.name}"
        raise BagError(f"{folder}: has {found}; it is not an episode of active6d")
    prefix = poses[0].removesuffix(CAMERA_POSE.name)
    known = {topic.name if topic.name.startswith("/") else prefix + topic.name: topic for topic in CONTRACT}
    for topic, message_type in sorted(recorded):
        if topic in known and message_type != known[topic].type:
            raise BagError(f"{folder}: {topic} holds {message_type}, expected {known[topic].type}")
    return {name: topic.name for name, topic in known.items()}


def _parse_settings(text: str | None) -> dict[str, dict[str, Any]]:
    """Parameters of the nodes when recording; nothing where the bag does not have them."""
    try:
        settings = json.loads(text or "{}")
    except (TypeError, json.JSONDecodeError):
        return {}
    if not isinstance(settings, dict):
        return {}
    return {node: parameters for node, parameters in settings.items() if isinstance(parameters, dict)}
