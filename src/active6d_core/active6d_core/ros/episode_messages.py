"""Messages about an episode, as standard diagnostics: the camera's answers to view goals."""

from dataclasses import dataclass
from enum import Enum

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from active6d_core.ros.conversions import HARDWARE_ID, MessageError, make_header, stamp_to_ns

_GOAL = "view_goal"


class GoalState(Enum):
    """What a camera answers to a view goal."""

    ACCEPTED = "accepted"
    REFUSED = "refused"
    REACHED = "reached"


@dataclass(frozen=True)
class GoalStatus:
    """A camera's answer to a view goal.

    Attributes:
        stamp: of the goal, in nanoseconds.
        state: the answer.
        reason: why it is refused, empty otherwise.
    """

    stamp: int
    state: GoalState
    reason: str = ""


def goal_status_to_message(status: GoalStatus, frame: str) -> DiagnosticArray:
    """An answer to a goal in ``frame`` as a message of ``view_goal/status``."""
    level = DiagnosticStatus.WARN if status.state == GoalState.REFUSED else DiagnosticStatus.OK
    report = DiagnosticStatus(level=level, name=_GOAL, message=status.reason, hardware_id=HARDWARE_ID)
    report.values = [KeyValue(key="state", value=status.state.value)]
    return DiagnosticArray(header=make_header(status.stamp, frame), status=[report])


def goal_status_from_message(message: DiagnosticArray) -> GoalStatus:
    """A message of ``view_goal/status`` to the answer.

    Raises:
        MessageError: it holds no status of a goal, or an unknown state.
    """
    reports = [status for status in message.status if status.name == _GOAL]
    if len(reports) != 1:
        raise MessageError(f"view_goal/status holds {len(reports)} statuses named '{_GOAL}', expected one")
    state = {pair.key: pair.value for pair in reports[0].values}.get("state", "")
    if state not in [known.value for known in GoalState]:
        raise MessageError(f"view_goal/status has the state '{state}', expected accepted, refused or reached")
    return GoalStatus(stamp_to_ns(message.header.stamp), GoalState(state), reports[0].message)
