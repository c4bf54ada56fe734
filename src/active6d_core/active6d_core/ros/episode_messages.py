"""Messages about episodes and goals, as dataclasses: the start and the end of an episode, the answer to a goal.

On the wire all of them are a DiagnosticArray with one status. They need its class, but no rclpy, and read the message
objects of rosbags as well.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from active6d_core.ros.conversions import MessageError, make_header, make_status, stamp_to_ns, status_values


@dataclass(frozen=True)
class EpisodeStart:
    """``episode/start``: a camera begins an episode.

    Attributes:
        stamp: of the first view, nanoseconds.
        frame: name of the world's frame.
        info: what is in the bin: ``object``, ``scene``, ``seed``, ``start_view``, as far as the camera knows; and
            ``id``, by which later messages name the episode.
    """

    stamp: int
    frame: str
    info: dict[str, str] = field(default_factory=dict)

    def to_message(self) -> DiagnosticArray:
        """The message to publish."""
        text = f"episode in {self.info['scene']}" if self.info.get("scene") else "episode"
        return _to_message(self.stamp, self.frame, make_status("episode", text, self.info, hardware_id=""))

    @classmethod
    def from_message(cls, message: Any) -> "EpisodeStart":
        """Read a message; one without a status has no information."""
        return cls(stamp_to_ns(message.header.stamp), message.header.frame_id, _values(message))

    @property
    def id(self) -> str:
        """The episode's id; empty for a camera that gives none, and in recordings of earlier versions."""
        return self.info.get("id", "")


@dataclass(frozen=True)
class EpisodeEnd:
    """``episode/end``: no goal follows.

    Attributes:
        stamp: of the last view, nanoseconds.
        frame: name of the world's frame.
        reason: why the episode ended, in words.
        info: ``policy``, ``seed``, ``moves`` and ``metres``, and ``episode``, the id of the episode; as far as the
            publisher knows.
    """

    stamp: int
    frame: str
    reason: str
    info: dict[str, str] = field(default_factory=dict)

    def to_message(self) -> DiagnosticArray:
        """The message to publish."""
        return _to_message(self.stamp, self.frame, make_status("episode", self.reason, self.info))

    @classmethod
    def from_message(cls, message: Any) -> "EpisodeEnd":
        """Read a message; one without a status has no reason."""
        reason = message.status[0].message if message.status else ""
        return cls(stamp_to_ns(message.header.stamp), message.header.frame_id, reason, _values(message))

    @property
    def episode(self) -> str:
        """The id of the episode that ends; empty if it is not known."""
        return self.info.get("episode", "")


def episode_info(starts: Iterable[EpisodeStart], ends: Iterable[EpisodeEnd]) -> dict[str, str]:
    """What the messages of one episode say about it; of the seeds, the camera's is kept: it is the pile's."""
    messages: list[EpisodeStart | EpisodeEnd] = [*ends, *starts]
    return {key: value for message in messages for key, value in message.info.items()}


class GoalState(Enum):
    """What became of a goal."""

    ACCEPTED = "accepted"
    REFUSED = "refused"
    REACHED = "reached"


@dataclass(frozen=True)
class GoalStatus:
    """``view_goal/status``: a camera's answer to a goal.

    Attributes:
        stamp: of the goal, nanoseconds.
        frame: name of the world's frame.
        state: accepted, refused or reached.
        reason: why, in words; empty if there is nothing to say.
        episode: id of the camera's episode; empty if it gives none.
    """

    stamp: int
    frame: str
    state: GoalState
    reason: str = ""
    episode: str = ""

    def to_message(self) -> DiagnosticArray:
        """The message to publish; a refusal has the level WARN."""
        level = DiagnosticStatus.WARN if self.state is GoalState.REFUSED else DiagnosticStatus.OK
        values = {"state": self.state.value} | ({"episode": self.episode} if self.episode else {})
        status = make_status("view_goal", self.reason, values, level)
        return _to_message(self.stamp, self.frame, status)

    @classmethod
    def from_message(cls, message: Any, frame: str | None = None) -> "GoalStatus":
        """Read a message; ``frame`` is what it must be in, None for any.

        Raises:
            MessageError: another frame, or no known state.
        """
        # A status has no place: a motion node need not name the frame.
        if frame is not None and message.header.frame_id not in ("", frame):
            raise MessageError(f"frame_id is '{message.header.frame_id}', expected '{frame}'")
        values = _values(message)
        state = values.get("state", "")
        if state not in (known.value for known in GoalState):
            known = ", ".join(state.value for state in GoalState)
            raise MessageError(f"goal state is '{state}', expected one of {known}")
        stamp = stamp_to_ns(message.header.stamp)
        reason, episode = message.status[0].message, values.get("episode", "")
        return cls(stamp, message.header.frame_id, GoalState(state), reason, episode)


def check_episode(found: str, expected: str) -> None:
    """Check that a message belongs to the episode at hand, as far as both ids are known.

    Raises:
        MessageError: it belongs to another episode.
    """
    if found and expected and found != expected:
        raise MessageError(f"it belongs to episode '{found}', this one is '{expected}'; is another graph here?")


def _to_message(stamp: int, frame: str, status: DiagnosticStatus) -> DiagnosticArray:
    return DiagnosticArray(header=make_header(stamp, frame), status=[status])


def _values(message: Any) -> dict[str, str]:
    return {key: value for status in message.status for key, value in status_values(status).items()}
