"""Any recording behind one interface: rosbag2 folders and files (MCAP, sqlite3), and ROS 1 bags."""

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import zstandard
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection
from rosbags.typesys.store import Typestore

from active6d_bringup.bags.writer import TYPESTORE, stamp_of

_FILES = (".mcap", ".db3", ".bag")
_PACKED = (".mcap.zstd", ".db3.zstd")
#: How Zstandard's frames begin, and no message of ROS 2 does.
_ZSTANDARD = b"\x28\xb5\x2f\xfd"
_LARGEST_MESSAGE = 2**28
#: What SQLite has written and not yet put into its file is in a file with this at the end of its name.
LOG = "-wal"


class BagError(ValueError):
    """A bag that cannot be read as an episode; the text names it and says what to do."""


class BagSource:
    """An open recording.

    Attributes:
        path: as it was named.
        files: what is read: a folder with metadata, or files.
        connections: topic and type of what is in it.
    """

    def __init__(self, path: Path, files: list[Path], reader: AnyReader) -> None:
        self.path, self.files, self._reader = path, files, reader
        self.connections: list[Connection] = reader.connections

    @property
    def typestore(self) -> Typestore:
        """The definitions of its messages."""
        return self._reader.typestore

    def knows(self, message_type: str) -> bool:
        """Whether messages of a type can be decoded: it is defined in the recording, or standard in one without any."""
        return message_type in self.typestore.types

    def messages(self, connections: Collection[Connection]) -> Iterator[tuple[Connection, int, bytes]]:
        """Connection, time of recording (ns) and serialized message, in order of recording."""
        if not connections:
            return
        for connection, received, payload in self._reader.messages(connections):
            if self._reader.is2 and payload[:4] == _ZSTANDARD:  # without metadata nobody says that messages are packed
                payload = zstandard.ZstdDecompressor().decompress(payload, max_output_size=_LARGEST_MESSAGE)
            yield connection, received, payload

    def stamp_of(self, message_type: str, payload: bytes) -> int:
        """Stamp (ns) of the header that a serialized message begins with."""
        if self._reader.is2:
            return stamp_of(message_type, payload)
        # ROS 1: the header's number, then seconds and nanoseconds, little-endian.
        return int.from_bytes(payload[4:8], "little") * 1_000_000_000 + int.from_bytes(payload[8:12], "little")

    def deserialize(self, payload: bytes, message_type: str) -> Any:
        """A message object with the fields of its type."""
        return self._reader.deserialize(payload, message_type)


@contextmanager
def open_source(path: Path) -> Iterator[BagSource]:
    """Open a recording.

    Raises:
        BagError: there is none, or it is damaged; also for what fails while it is read.
    """
    files = find_files(path)
    refuse_unfinished(path)
    try:
        with AnyReader(files, default_typestore=TYPESTORE) as reader:
            yield BagSource(path, files, reader)
    except BagError:
        raise
    # A damaged file fails anywhere in its decoding, with the error of whichever library was at work.
    except Exception as error:
        raise damaged(path, error) from error


def refuse_unfinished(path: Path) -> None:
    """Refuse sqlite3 files whose last messages are in a write-ahead log, which the reader would leave out.

    Raises:
        BagError: there is such a log; the text names it.
    """
    files = sorted(path.glob("*.db3")) if path.is_dir() else [path]
    logs = [log for log in (file.with_name(file.name + LOG) for file in files) if log.is_file() and log.stat().st_size]
    if logs:
        raise damaged(path, BagError(f"messages are in {logs[0].name} and not in the bag yet"))


def damaged(path: Path, error: Exception) -> BagError:
    """The error for a recording that cannot be read to its end, with what can be done."""
    files = [path] if path.is_file() else [each for each in path.iterdir() if each.suffix in _FILES]
    if files and not any(file.stat().st_size for file in files):
        return BagError(f"{path}: the file is empty")
    if not files:
        return BagError(f"{path}: its files are missing; copy them back into the folder ({error})")
    advice = f"`active6d bag repair {path} NEW_FOLDER` saves what is there"
    if any(file.suffix == ".bag" for file in files):
        advice = "`rosbag reindex` of ROS 1 saves what is there"
    return BagError(f"{path}: damaged bag, or its recording was killed ({error}); {advice}")


def find_files(path: Path) -> list[Path]:
    """What to read: the folder itself where it has metadata.yaml, else its files, or the named file.

    Raises:
        BagError: nothing to read there.
    """
    if path.is_file():
        if path.name.endswith(_PACKED):
            raise BagError(f"{path}: a compressed file; name its folder with metadata.yaml, or run `zstd -d {path}`")
        if path.suffix not in _FILES:
            raise BagError(f"{path}: not a bag; bags end in {', '.join(_FILES)} or are folders")
        return [path]
    if not path.is_dir():
        raise BagError(f"{path}: no such folder; name the folder of a bag, or a file ending in {', '.join(_FILES)}")
    if (path / "metadata.yaml").is_file():
        return [path]
    for ending in _FILES:
        found = sorted(path.glob(f"*{ending}"))
        if found:
            return found
    if any(each.name.endswith(_PACKED) for each in path.iterdir()):
        raise BagError(f"{path}: compressed files without metadata.yaml; run `zstd -d {path}/*.zstd` first")
    raise BagError(f"{path}: no metadata.yaml and no file ending in {', '.join(_FILES)}; this is not a bag")
