"""What a node waits for, since when, and the likely cause when it does not come."""

import time
from collections.abc import Callable
from dataclasses import dataclass

from rclpy.node import Node
from rclpy.qos import QoSPolicyKind

from active6d_core.ros.topics import CLOCK

#: A node that waits longer than this looks for a cause.
CAUSE_AFTER_SECONDS = 5.0


@dataclass(frozen=True)
class Awaited:
    """What a node needs next.

    Attributes:
        topics: relative names; all of them are needed.
        stamp: of the view that they are needed for in nanoseconds, None for any view.
    """

    topics: tuple[str, ...]
    stamp: int | None = None

    def __str__(self) -> str:
        return ", ".join(self.topics) + ("" if self.stamp is None else f" of {self.stamp * 1e-9:.3f} s")


class Watch:
    """Keeps since when a node has been waiting, and finds out why.

    Args:
        node: the node.
        clock: seconds of a clock that never goes back.
    """

    def __init__(self, node: Node, clock: Callable[[], float] = time.monotonic) -> None:
        self._node, self._clock = node, clock
        self._awaited: Awaited | None = None
        self._since = clock()
        self._mismatched: dict[str, str] = {}
        self._outdated: tuple[float, str] | None = None

    def update(self, awaited: Awaited | None) -> float:
        """Take what is awaited now; the seconds that it has been awaited for."""
        if awaited != self._awaited:
            self._awaited, self._since = awaited, self._clock()
        return self._clock() - self._since

    def mismatch(self, topic: str, policy: int) -> str:
        """Note that a publisher offers less than this node requests on a topic; the cause in words."""
        kind = QoSPolicyKind(policy).name.lower()
        self._mismatched[topic] = f"a publisher of {topic} offers an incompatible QoS ({kind})"
        return self._mismatched[topic]

    def outdated(self, reason: str) -> None:
        """Note that a message was ignored because it belongs to a view that is over."""
        self._outdated = self._clock(), reason

    def cause(self) -> str:
        """Why what is awaited does not come, as far as the node can know; empty when it cannot or need not."""
        if self._awaited is None or self._clock() - self._since < CAUSE_AFTER_SECONDS:
            return ""
        if CLOCK.name in self._awaited.topics:
            return f"use_sim_time needs a publisher of {CLOCK.name}; start one, or set use_sim_time to false"
        silent = [topic for topic in self._awaited.topics if not self._node.count_publishers(topic)]
        if silent:
            where = self._node.get_namespace()
            return f"nobody publishes {', '.join(silent)} in namespace {where} and domain {self._domain()}"
        mismatched = [self._mismatched[topic] for topic in self._awaited.topics if topic in self._mismatched]
        if mismatched:
            return "; ".join(mismatched)
        if self._outdated is not None and self._outdated[0] > self._since:
            return f"what comes is too old ({self._outdated[1]}); if the camera was restarted, restart the other nodes"
        return ""

    def _domain(self) -> int:
        return self._node.context.get_domain_id()
