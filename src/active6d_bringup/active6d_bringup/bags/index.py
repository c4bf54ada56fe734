"""A bag read once: serialized messages by topic and stamp, whatever the bag's namespace. Needs no ROS."""

import json
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader, ReaderError

from active6d_bringup.bags.writer import SETTINGS, TYPESTORE, stamp_of
from active6d_core.ros.topics import CAMERA_POSE, CONTRACT, DIAGNOSTICS, TOPICS

_POSE_ENDING = f"/{CAMERA_POSE.name}"


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
    """

    folder: Path
    payloads: dict[str, dict[int, bytes]]
    received: dict[str, dict[int, int]]
    diagnostics: list[bytes]
    settings: dict[str, dict[str, Any]]

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
    """Read a bag in one pass.

    Raises:
        BagError: no bag, a damaged one, or one that is no episode.
    """
    payloads: dict[str, dict[int, bytes]] = defaultdict(dict)
    received: dict[str, dict[int, int]] = defaultdict(dict)
    diagnostics: list[bytes] = []
    try:
        with open_bag(folder) as reader:
            names = topic_names(reader.connections, folder)
            wanted = [connection for connection in reader.connections if connection.topic in names]
            for connection, timestamp, payload in reader.messages(wanted):
                topic = names[connection.topic]
                if topic == DIAGNOSTICS.name:
                    diagnostics.append(bytes(payload))
                    continue
                stamp = stamp_of(connection.msgtype, payload)
                payloads[topic][stamp] = bytes(payload)
                received[topic][stamp] = timestamp
    except BagError:
        raise
    # A damaged file fails anywhere in its decoding, with the error of whichever library was at work.
    except Exception as error:
        raise BagError(f"{folder}: damaged bag ({error})") from error
    return BagIndex(folder, dict(payloads), dict(received), diagnostics, _read_settings(folder))


def open_bag(folder: Path) -> Reader:
    """A rosbags reader for use in a ``with`` statement.

    Raises:
        BagError: no bag there, or one whose recording was cut off.
    """
    if not folder.is_dir():
        raise BagError(f"{folder}: no such folder; name the folder of a bag, the one with metadata.yaml in it")
    if not (folder / "metadata.yaml").is_file():
        cut_off = any(folder.glob("*.mcap"))
        hint = "its recording was killed; `mcap recover` saves what is there" if cut_off else "this is not a bag"
        raise BagError(f"{folder}: no metadata.yaml; {hint}")
    try:
        return Reader(folder)
    except (ReaderError, OSError) as error:
        raise BagError(f"{folder}: {error}") from error


def topic_names(connections: list[Connection], folder: Path) -> dict[str, str]:
    """Recorded topic to its name in the contract, for the topics of the contract, whatever their namespace.

    Raises:
        BagError: the bag has no camera pose, or several (more than one namespace).
    """
    poses = sorted({connection.topic for connection in connections if connection.topic.endswith(_POSE_ENDING)})
    if len(poses) != 1:
        found = f"several namespaces ({', '.join(poses)})" if poses else f"no topic {CAMERA_POSE.name}"
        raise BagError(f"{folder}: has {found}; it is not an episode of active6d")
    prefix = poses[0].removesuffix(CAMERA_POSE.name)
    known = {topic.name if topic.name.startswith("/") else prefix + topic.name: topic for topic in CONTRACT}
    wrong = [
        connection
        for connection in connections
        if connection.topic in known and connection.msgtype != known[connection.topic].type
    ]
    if wrong:
        expected = known[wrong[0].topic].type
        raise BagError(f"{folder}: {wrong[0].topic} holds {wrong[0].msgtype}, expected {expected}")
    return {name: topic.name for name, topic in known.items()}


def _read_settings(folder: Path) -> dict[str, dict[str, Any]]:
    """Parameters of the nodes when recording; nothing where the bag's metadata does not have them."""
    metadata = yaml.safe_load((folder / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    try:
        settings = json.loads((metadata.get("custom_data") or {})[SETTINGS])
    except (KeyError, TypeError, json.JSONDecodeError):
        return {}
    if not isinstance(settings, dict):
        return {}
    return {node: parameters for node, parameters in settings.items() if isinstance(parameters, dict)}
