"""What every node publishes about itself: results of its work, refused and lost input, and what it waits for."""

import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.clock import Clock, ClockType
from rclpy.timer import Timer

from active6d_core.ros.conversions import make_status, ns_to_stamp
from active6d_core.ros.heartbeat import Awaited, Watch
from active6d_core.ros.parameters import ParameterNode

_LOG_PERIOD_SECONDS = 5.0
#: A number that stands alone; those within names of topics and frames tell them apart.
_NUMBER = re.compile(r"(?<=[ (])[\d.]+")


class DiagnosticNode(ParameterNode):
    """A lifecycle node that publishes a heartbeat and reports on ``/diagnostics``.

    Subclasses keep ``_active`` up to date, and override :meth:`awaited`.
    """

    def __init__(self, name: str, **options: Any) -> None:
        super().__init__(name, **options)
        self._active = False
        self._views_measured = 0
        self._rejected = 0
        self._lost = 0
        self._said: set[str] = set()
        self._last_view_at: float | None = None
        self._last_cause = ""
        self._watch = Watch(self)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 100)
        self.declare(
            "heartbeat", 1.0, "seconds between two heartbeats on /diagnostics, 0 for none", minimum=0.0, fixed=True
        )
        if self.value("heartbeat") > 0:
            self.wall_timer(self.value("heartbeat"), self.beat)

    @property
    def active(self) -> bool:
        """Whether the node takes input now."""
        return self._active

    def awaited(self) -> Awaited | None:
        """What the active node waits for now; None when there is nothing left to do."""
        return None

    def wall_timer(self, seconds: float, callback: Callable[[], None]) -> Timer:
        """A timer on a clock that no simulation sets; it is for watching, results must not depend on it."""
        return self.create_timer(seconds, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def reject(self, reason: str) -> None:
        """Log a refused message (throttled) and publish it on /diagnostics."""
        self._rejected += 1
        self.get_logger().error(reason, throttle_duration_sec=_LOG_PERIOD_SECONDS)
        self._diagnose(DiagnosticStatus.ERROR, reason, 0, {})

    def lose(self, what: str) -> None:
        """Log input that is lost, such as an incomplete view (throttled), and count and publish it on /diagnostics."""
        self._lost += 1
        text = f"lost ({self._lost} so far): {what}"
        self.get_logger().warning(text, throttle_duration_sec=_LOG_PERIOD_SECONDS)
        self._diagnose(DiagnosticStatus.WARN, text, 0, {})

    def say_once(self, text: str) -> bool:
        """Log and publish a warning the first time that it is given; whether there is one (it is not empty).

        The same words with other numbers are the same warning: a measured number differs from image to image.
        """
        words = _NUMBER.sub("#", text)
        if text and words not in self._said:
            self._said.add(words)
            self.get_logger().warning(text)
            self._diagnose(DiagnosticStatus.WARN, text, 0, {})
        return bool(text)

    def ignore(self, reason: str) -> None:
        """Drop a message of a view that is over: a neighbour that was restarted repeats its last messages."""
        self.get_logger().info(f"ignored {reason}", throttle_duration_sec=_LOG_PERIOD_SECONDS)
        self._watch.outdated(reason)
        self._diagnose(DiagnosticStatus.OK, f"ignored {reason}", 0, {})

    @contextmanager
    def measure(self, stamp: int) -> Iterator[list[str]]:
        """Time the work on the view with this stamp: latency and rate go to /diagnostics, one line to the log.

        What the block appends to the list it gets, such as "8 hypotheses", is in that line and in the diagnostics.
        """
        summary: list[str] = []
        started = time.perf_counter()
        yield summary
        finished = time.perf_counter()
        self._views_measured += 1
        latency_ms = (finished - started) * 1e3
        values = {"latency_ms": f"{latency_ms:.3f}", "summary": ", ".join(summary)}
        if self._last_view_at is not None:
            values["rate_hz"] = f"{1.0 / max(finished - self._last_view_at, 1e-9):.3f}"
        self._last_view_at = finished
        self._diagnose(DiagnosticStatus.OK, "view processed", stamp, values)
        self.get_logger().info(
            ": ".join([f"view of {stamp * 1e-9:.3f} s", ", ".join([*summary, f"{latency_ms:.0f} ms"])])
        )

    def beat(self) -> None:
        """Publish what the node waits for, since when and, after some seconds, why. It changes nothing else."""
        now = self.get_clock().now().nanoseconds
        if not self._active:
            self._watch.update(None)
            state = "inactive" if self._configured else "unconfigured"
            text = f"{state}, waiting for a lifecycle transition"
            self._diagnose(DiagnosticStatus.OK, text, now, {"state": state})
            return
        awaited = self.awaited()
        seconds, cause = self._watch.update(awaited), self._watch.cause()
        if awaited is None:
            self._diagnose(DiagnosticStatus.OK, "ready", now, {"state": "ready"})
            return
        text = f"waiting for {awaited} for {seconds:.0f} s"
        if cause:
            text += f": {cause}"
            if cause != self._last_cause:
                self.get_logger().warning(text)
        self._last_cause = cause
        topics = ",".join(self.resolve_topic_name(topic) for topic in awaited.topics)
        values = {"state": "waiting", "waiting_for": topics, "waiting_s": f"{seconds:.0f}"}
        self._diagnose(DiagnosticStatus.WARN if cause else DiagnosticStatus.OK, text, now, values)

    def _diagnose(self, level: bytes, message: str, stamp: int, values: dict[str, str]) -> None:
        values = {**values, "views": str(self._views_measured)}
        values |= {"rejected": str(self._rejected), "lost": str(self._lost)}
        status = make_status(self.get_fully_qualified_name(), message, values, level)
        report = DiagnosticArray(status=[status])
        report.header.stamp = ns_to_stamp(stamp)
        self._diagnostics.publish(report)
