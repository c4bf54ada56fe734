"""What a recording holds, topic by topic."""

from collections import defaultdict
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from active6d_bringup.bags.source import open_source

#: Of messages that cannot be decoded.
_NOT_DEFINED = "definition not in the bag"


@dataclass(frozen=True)
class TopicSummary:
    """One topic.

    Attributes:
        name: of the topic.
        type: of its messages.
        count: number of its messages.
        rate_hz: mean rate by the times of recording, None with fewer than two messages.
        frame: frame of the first message, empty without any.
        content: size and encoding of the first image, or that the type is not defined; empty for other messages.
    """

    name: str
    type: str
    count: int
    rate_hz: float | None
    frame: str
    content: str


@dataclass(frozen=True)
class BagSummary:
    """All topics of a recording.

    Attributes:
        files: that were read.
        messages: number of all messages.
        seconds: between the first and the last.
        topics: in order of name.
    """

    files: list[str]
    messages: int
    seconds: float
    topics: list[TopicSummary]

    def to_json(self) -> dict[str, Any]:
        """The same as dictionaries and lists."""
        return asdict(self)


def summarise(path: Path) -> BagSummary:
    """Read a recording once.

    Raises:
        BagError: there is none, or it is damaged.
    """
    times: dict[tuple[str, str], list[int]] = defaultdict(list)
    first: dict[tuple[str, str], tuple[str, str]] = {}
    with open_source(path) as source:
        files = [file.name for file in source.files]
        keys = sorted({(each.topic, each.msgtype) for each in source.connections})
        for connection, arrival, payload in source.messages(source.connections):
            key = connection.topic, connection.msgtype
            times[key].append(arrival)
            if key not in first:
                known = source.knows(connection.msgtype)
                first[key] = _describe(source.deserialize(payload, connection.msgtype)) if known else ("", _NOT_DEFINED)
    topics = []
    for key in keys:
        at = times[key]
        rate = (len(at) - 1) * 1e9 / (max(at) - min(at)) if len(at) > 1 and max(at) > min(at) else None
        topics.append(TopicSummary(*key, len(at), rate, *first.get(key, ("", ""))))
    every = [stamp for at in times.values() for stamp in at]
    seconds = (max(every) - min(every)) * 1e-9 if every else 0.0
    return BagSummary(files, len(every), seconds, topics)


def _describe(message: Any) -> tuple[str, str]:
    """Frame and content of a message."""
    frame = message.header.frame_id if hasattr(message, "header") else ""
    if hasattr(message, "encoding"):
        return frame, f"{message.width}x{message.height} {message.encoding}"
    if hasattr(message, "distortion_model"):
        return frame, f"{message.width}x{message.height} {message.distortion_model}"
    return frame, getattr(message, "format", "")
