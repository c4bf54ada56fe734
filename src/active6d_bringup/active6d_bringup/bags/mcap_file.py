"""Reading an MCAP file as far as it is whole: killed, cut, full and damaged recordings keep their whole chunks."""

import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import zstandard
from mcap.records import Channel, Chunk, DataEnd, Footer, Header, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk

#: Bytes of a chunk without compression; a chunk holds one message or some of them, and an image is the largest.
_LARGEST_CHUNK = 2**28
_MAGIC_BYTES = 8


@dataclass(frozen=True)
class RecordedMessage:
    """One message as it was recorded.

    Attributes:
        topic: its name in the file.
        type: such as ``sensor_msgs/msg/Image``.
        received: when it was recorded, nanoseconds.
        payload: serialized (CDR).
    """

    topic: str
    type: str
    received: int
    payload: bytes


class McapFile:
    """An MCAP file, read from its beginning. It needs neither an index nor an end, and checks every checksum.

    Attributes:
        path: of the file.
        damage: what is missing or wrong, in words; complete when :meth:`messages` has ended.
        metadata: name to values of the metadata records read so far.
        ended: whether the file has its end; a recording that was killed or cut has none.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damage: list[str] = []
        self.metadata: dict[str, dict[str, str]] = {}
        self.ended = False
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}

    @property
    def topics(self) -> set[tuple[str, str]]:
        """Name and type of every topic read so far, with messages or without."""
        channels = self._channels.values()
        return {
            (each.topic, self._schemas[each.schema_id].name) for each in channels if each.schema_id in self._schemas
        }

    def definition(self, message_type: str) -> tuple[str, str]:
        """Encoding and text of a type's definition, of the types read so far; empty where the file has none."""
        found = next((each for each in self._schemas.values() if each.name == message_type), None)
        return ("", "") if found is None else (found.encoding, found.data.decode(errors="replace"))

    def begins_with(self, name: str) -> bool:
        """Whether a metadata record of this name comes first in the file, before any message."""
        with self.path.open("rb") as file:
            for record in self._records(file, self.path.stat().st_size):
                if not isinstance(record, Header):
                    return isinstance(record, Metadata) and record.name == name
        return False

    def messages(self) -> Iterator[RecordedMessage]:
        """The messages of all whole chunks, in order of the file.

        Raises:
            OSError: the file cannot be read.
        """
        size, chunks = self.path.stat().st_size, 0
        with self.path.open("rb") as file:
            for record in self._records(file, size):
                inner: list[McapRecord] = [record]
                if isinstance(record, Chunk):
                    chunks += 1
                    inner = self._open_chunk(record, chunks)
                for each in inner:
                    if isinstance(each, Message):
                        message = self._named(each)
                        if message is not None:
                            yield message
                    else:
                        self._take(each)
        if not self.ended and not self.damage:
            self._note("has no end, its recording was killed")

    def _records(self, file: BinaryIO, size: int) -> Iterator[McapRecord]:
        reader = StreamReader(file, emit_chunks=True, validate_crcs=True, record_size_limit=size)
        records = reader.records
        while True:
            position = file.tell()
            try:
                record = next(records, None)
            except CRCValidationError:
                self._note("differs from its checksum")
                self.ended = True
                return
            # A damaged record fails anywhere in its decoding, with whatever error the library has there.
            except Exception:
                self._note(f"cannot be read from byte {position} of {size} on; it was cut, killed or damaged there")
                return
            if record is None:
                break
            if isinstance(record, DataEnd) and file.tell() < size:
                self.ended = True
            if isinstance(record, Footer):
                self._check_summary(file, record, size)
            yield record
        if file.tell() != size:
            self._note(f"has {size - file.tell()} bytes after its end")

    def _open_chunk(self, chunk: Chunk, number: int) -> list[McapRecord]:
        try:
            declared = chunk.uncompressed_size
            if chunk.compression == "zstd":
                declared = max(declared, zstandard.frame_content_size(chunk.data))
            if declared > _LARGEST_CHUNK:
                raise ValueError(f"chunk of {declared} bytes")
            return breakup_chunk(chunk, validate_crc=True)
        except Exception:  # as above
            self._note(f"chunk {number} is damaged and left out")
            return []

    def _take(self, record: McapRecord) -> None:
        if isinstance(record, Schema):
            self._schemas[record.id] = record
        elif isinstance(record, Channel):
            self._channels[record.id] = record
        elif isinstance(record, Metadata):
            self.metadata[record.name] = record.metadata

    def _named(self, message: Message) -> RecordedMessage | None:
        channel = self._channels.get(message.channel_id)
        schema = self._schemas.get(channel.schema_id) if channel is not None else None
        if channel is None or schema is None:
            self._note("holds messages of an unknown topic")
            return None
        return RecordedMessage(channel.topic, schema.name, message.log_time, message.data)

    def _check_summary(self, file: BinaryIO, footer: Footer, size: int) -> None:
        if not footer.summary_crc:
            return
        if footer.summary_start > size:
            self._note("has an index beyond its end")
            return
        position = file.tell()
        file.seek(footer.summary_start)
        covered = file.read(size - footer.summary_start - _MAGIC_BYTES - 4)
        file.seek(position)
        if zlib.crc32(covered) != footer.summary_crc:
            self._note("index differs from its checksum")

    def _note(self, what: str) -> None:
        text = f"{self.path.name} {what}"
        if text not in self.damage:
            self.damage.append(text)
