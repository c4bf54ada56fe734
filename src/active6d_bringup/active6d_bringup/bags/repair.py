"""What can be saved of a damaged recording, as a bag with metadata and index."""

import shutil
import sqlite3
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter

from active6d_bringup.bags.mcap_file import McapFile, RecordedMessage
from active6d_bringup.bags.source import LOG, BagError, find_files
from active6d_bringup.bags.writer import INFORMATION, TYPESTORE, describe_bag, describe_topic, file_number
from active6d_core.files import write_file

_SQLITE, _SQLITE_HEADER = b"SQLite format 3", 100
#: Message type to encoding and text of its definition in the recording.
_Definitions = dict[str, tuple[str, str]]


@dataclass(frozen=True)
class Repaired:
    """What was saved.

    Attributes:
        messages: number of messages in the new bag.
        damage: what is missing or damaged in the old one, in words.
    """

    messages: int
    damage: tuple[str, ...]


def repair(path: Path, into: Path) -> Repaired:
    """Copy every message that can be read into a new rosbag2 folder.

    Args:
        path: folder or file of the damaged recording; it is left as it is.
        into: folder to create.

    Raises:
        BagError: nothing can be saved, ``into`` exists, or the recording is a ROS 1 bag.
    """
    if into.exists():
        raise BagError(f"{into} exists already; name a new folder for the repaired bag")
    # Metadata of a killed recording is missing or wrong: the files themselves are read.
    files = sorted(path.glob("*.mcap"), key=file_number) or sorted(path.glob("*.db3")) if path.is_dir() else []
    files = files or find_files(path)
    if files[0].suffix == ".bag":
        raise BagError(f"{path}: repair is for .mcap and .db3; `rosbag reindex` of ROS 1 repairs this bag")
    if files[0].suffix not in (".mcap", ".db3"):
        raise BagError(f"{path}: no .mcap or .db3 file in it; decompress .zstd files first, with `zstd -d FILE`")
    damage: list[str] = []
    definitions: _Definitions = {}
    count = _write(into, (message for file in files for message in _messages(file, damage, definitions)), definitions)
    if not count:
        shutil.rmtree(into, ignore_errors=True)
        raise BagError("; ".join([f"{path}: not one message can be read", *damage]))
    return Repaired(count, tuple(damage))


def _messages(file: Path, damage: list[str], definitions: _Definitions) -> Iterator[RecordedMessage]:
    """The messages of one file; what is wrong with it and the definitions of their types are added to the others."""
    if file.suffix == ".mcap":
        recording = McapFile(file)
        for message in recording.messages():
            if message.type not in definitions:
                definitions[message.type] = recording.definition(message.type)
            yield message
        damage += recording.damage
        return
    with _database(file) as database:
        try:
            # Recordings of before ROS 2 Iron do not have this table.
            with suppress(sqlite3.Error):
                query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
                definitions |= {kind: (encoding, text) for kind, encoding, text in database.execute(query)}
            topics = {key: (name, kind) for key, name, kind in database.execute("SELECT id, name, type FROM topics")}
            for key, received, payload in database.execute(
                "SELECT topic_id, timestamp, data FROM messages ORDER BY id"
            ):
                if key in topics:
                    yield RecordedMessage(*topics[key], received, payload)
        except sqlite3.Error as error:
            damage.append(f"{file.name} ends early or is damaged ({error})")


@contextmanager
def _database(file: Path) -> Iterator[sqlite3.Connection]:
    """A sqlite3 file with its write-ahead log; what SQLite would change, or not open, is a copy."""
    log = file.with_name(file.name + LOG)
    with file.open("rb") as stream:
        header = stream.read(_SQLITE_HEADER)
    page, pages = int.from_bytes(header[16:18], "big"), int.from_bytes(header[28:32], "big")
    size = page * pages if header.startswith(_SQLITE) else 0
    if not log.is_file() and file.stat().st_size >= size:
        with closing(sqlite3.connect(f"{file.absolute().as_uri()}?immutable=1", uri=True)) as database:
            yield database
        return
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / file.name
        shutil.copyfile(file, copy)
        # SQLite puts a log that it finds beside a file into the file.
        if log.is_file():
            shutil.copyfile(log, copy.with_name(log.name))
        # It opens no file that is shorter than its header says.
        with copy.open("r+b") as stream:
            stream.truncate(max(size, file.stat().st_size))
        with closing(sqlite3.connect(copy)) as database:
            yield database


def _write(into: Path, messages: Iterator[RecordedMessage], definitions: _Definitions) -> int:
    """Number of messages written; payloads are copied as they are, also of types that nobody here knows."""
    into.mkdir(parents=True)
    counts: Counter[tuple[str, str]] = Counter()
    file: dict[str, Any] = {"path": f"{into.name}.mcap", "counts": counts, "first": 2**63 - 1, "last": 0}
    schemas: dict[str, int] = {}
    channels: dict[tuple[str, str], int] = {}
    with (into / file["path"]).open("xb") as stream:
        writer = McapWriter(stream, compression=CompressionType.ZSTD, enable_data_crcs=True)
        writer.start(profile="ros2", library="active6d")
        for message in messages:
            key = message.topic, message.type
            if message.type not in schemas:
                encoding, text = _definition(message.type, definitions)
                schemas[message.type] = writer.register_schema(message.type, encoding, text.encode())
            if key not in channels:
                channels[key] = writer.register_channel(
                    message.topic, "cdr", schemas[message.type], {"offered_qos_profiles": ""}
                )
            writer.add_message(channels[key], message.received, message.payload, message.received)
            counts[key] += 1
            file["first"], file["last"] = min(file["first"], message.received), max(file["last"], message.received)
        writer.finish()
    topics = [describe_topic(*key, [], count) for key, count in counts.items()]
    write_file(into / "metadata.yaml", yaml.safe_dump({INFORMATION: describe_bag([file], topics, {})}, sort_keys=False))
    return sum(counts.values())


def _definition(message_type: str, definitions: _Definitions) -> tuple[str, str]:
    """Encoding and text of a type's definition: the recording's own, else the standard one, else empty texts."""
    encoding, text = definitions.get(message_type, ("", ""))
    if text and encoding not in ("", "unknown"):
        return encoding, text
    if message_type in TYPESTORE.types:
        return "ros2msg", TYPESTORE.generate_msgdef(message_type, ros_version=2)[0]
    return "", ""
