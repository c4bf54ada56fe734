"""Whether the processes of a graph still live: a hung one is noticed within seconds, a busy one is left alone."""

import os
import time
from collections.abc import Callable
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node

from active6d_core.ros.conversions import own_statuses
from active6d_core.ros.topics import DIAGNOSTICS

#: A process that neither beats nor computes for this long hangs.
HUNG_SECONDS = 5.0
#: Processor time that counts as work; the middleware's threads use less in a process whose node hangs.
_WORK_SECONDS = 0.25
#: The supervisor itself was stopped if it did not look for this long: no silence of the others counts then.
_ABSENT_SECONDS = 2.0


class Pulses:
    """Listens to the heartbeats of nodes, and looks at the processor time of those that are silent.

    An estimator cannot beat while it computes, but it uses processor time. A process that was stopped or waits for
    ever does neither. A node whose first heartbeat has not come is not judged, nor one with the parameter
    ``heartbeat`` 0.

    Args:
        node: listens to /diagnostics.
        clock: seconds of a clock that never goes back.
    """

    def __init__(self, node: Node, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._last: dict[str, float] = {}
        self._computed: dict[str, float] = {}
        self._looked: dict[str, float] = {}
        node.create_subscription(DIAGNOSTICS.message_type, DIAGNOSTICS.name, self._on_diagnostics, DIAGNOSTICS.depth)

    def forget(self, name: str) -> None:
        """Forget a node that is started again."""
        for each in (self._last, self._computed, self._looked):
            each.pop(name, None)

    def stopped(self, name: str, process: int) -> bool:
        """Whether the node in the process of this id hangs."""
        now = self._clock()
        if name not in self._last:
            return False
        computed, absent = processor_seconds(process), now - self._looked.get(name, now)
        self._looked[name] = now
        if absent > _ABSENT_SECONDS or computed - self._computed.get(name, -1.0) > _WORK_SECONDS:
            self._last[name], self._computed[name] = now, computed
        return now - self._last[name] > HUNG_SECONDS

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in own_statuses(message):
            self._last[status.name.rsplit("/", 1)[-1]] = self._clock()


def processor_seconds(process: int) -> float:
    """Seconds that a process has computed, to a hundredth; 0 where the proc file system does not say."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    except (OSError, IndexError, ValueError):
        return 0.0
