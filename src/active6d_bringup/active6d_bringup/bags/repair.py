"""What can be saved of a damaged recording, as a bag with metadata and index."""

import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from active6d_bringup.bags.mcap_file import McapFile, RecordedMessage
from active6d_bringup.bags.source import LOG, BagError, find_files, open_source
from active6d_bringup.bags.writer import TYPESTORE, file_number

_SQLITE, _SQLITE_HEADER = b"SQLite format 3", 100


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
    count = _write(into, (message for file in files for message in _messages(file, damage)), damage)
    if not count:
        shutil.rmtree(into, ignore_errors=True)
        raise BagError("; ".join([f"{path}: not one message can be read", *damage]))
    return Repaired(count, tuple(damage))


def _messages(file: Path, damage: list[str]) -> Iterator[RecordedMessage]:
    """The messages of one file; what is wrong with it is appended to ``damage``."""
    if file.suffix == ".mcap":
        recording = McapFile(file)
        yield from recording.messages()
        damage += recording.damage
        return
    try:
        with open_source(file) as source:
            for connection, received, payload in source.messages(source.connections):
                yield RecordedMessage(connection.topic, connection.msgtype, received, payload)
    except BagError:
        yield from _rows(file, damage)


def _rows(file: Path, damage: list[str]) -> Iterator[RecordedMessage]:
    """The messages of a cut sqlite3 file, as far as it goes, and of its write-ahead log."""
    with tempfile.TemporaryDirectory() as folder:
        whole, log = Path(folder) / file.name, file.with_name(file.name + LOG)
        shutil.copyfile(file, whole)
        # SQLite puts a log that it finds beside a file into the file: both are copies.
        if log.is_file():
            shutil.copyfile(log, whole.with_name(log.name))
        with file.open("rb") as original:
            header = original.read(_SQLITE_HEADER)
        # SQLite opens no file that is shorter than its header says.
        if header.startswith(_SQLITE):
            page, pages = int.from_bytes(header[16:18], "big"), int.from_bytes(header[28:32], "big")
            with whole.open("r+b") as copy:
                copy.truncate(max(page * pages, file.stat().st_size))
        database = sqlite3.connect(whole)
        try:
            topics = {key: (name, kind) for key, name, kind in database.execute("SELECT id, name, type FROM topics")}
            for key, received, payload in database.execute(
                "SELECT topic_id, timestamp, data FROM messages ORDER BY id"
            ):
                if key in topics:
                    yield RecordedMessage(*topics[key], received, payload)
        except sqlite3.Error as error:
            damage.append(f"{file.name} ends early or is damaged ({error})")
        finally:
            database.close()


def _write(into: Path, messages: Iterator[RecordedMessage], damage: list[str]) -> int:
    """Number of messages written; those of types that are not standard are noted as damage."""
    count, foreign = 0, set()
    writer = Writer(into, version=Writer.VERSION_LATEST, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for message in messages:
            key = message.topic, message.type
            if message.type not in TYPESTORE.types:
                foreign.add(message.type)
                continue
            if key not in connections:
                connections[key] = writer.add_connection(*key, typestore=TYPESTORE)
            writer.write(connections[key], message.received, message.payload)
            count += 1
    damage += [f"messages of {name} are left out: not a standard type" for name in sorted(foreign)]
    return count
