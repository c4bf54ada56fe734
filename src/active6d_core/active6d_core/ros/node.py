"""What every node shares: lifecycle, checked parameters, guarded inputs, diagnostics, matching of stamps."""

import json
import signal
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.context import Context
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from rclpy.utilities import remove_ros_args
from std_srvs.srv import Trigger

from active6d_core.ros.conversions import HARDWARE_ID, MessageError, ns_to_stamp

# Both ends: a reliable writer forgets what its queue cannot hold, received by everybody or not.
_QUEUE_DEPTH = 10
_LOG_PERIOD_SECONDS = 5.0
_WAKE_SECONDS = 1.0


class GraphNode(LifecycleNode):
    """A lifecycle node that survives bad input and says how it is doing.

    Subclasses declare parameters and create inputs and outputs in ``__init__``, do what is heavy in :meth:`setup`, and
    start their work in :meth:`begin`. What comes while the node is not active is ignored, but for the last messages of
    latched inputs: the node gets them when it is activated, as if it had come late.

    Raises:
        ValueError: a parameter is out of its range or of another type; the message names it.
    """

    def __init__(
        self,
        name: str,
        *,
        context: Context | None = None,
        namespace: str = "",
        overrides: dict[str, Any] | None = None,
    ) -> None:
        parameters = [Parameter(key, value=value) for key, value in (overrides or {}).items()]
        super().__init__(name, context=context, namespace=namespace, parameter_overrides=parameters)
        self._active = False
        self._starting = False
        self._held: list[tuple[Callable[[Any], None], deque]] = []
        self._failure: Exception | None = None
        self._views_measured = 0
        self._rejected = 0
        self._last_view_at: float | None = None
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 100)
        self.create_service(Trigger, "~/connections", self._answer_connections)
        self.autostart = self.declare("autostart", True, "configure and activate the node by itself when it starts")
        self.world_frame = self.declare("world_frame", "world", "frame of the bin: origin at its centre, z up")
        self.camera_frame = self.declare(
            "camera_frame", "camera_optical_frame", "optical frame of the camera (REP-103)"
        )

    # What a subclass overrides

    def setup(self) -> None:
        """Heavy start-up: load models, drop scenes. Runs on configure."""

    def begin(self) -> None:
        """First work of an active node. Runs on activate."""

    def teardown(self) -> None:
        """Release what :meth:`setup` made. Runs on cleanup and shutdown."""

    # Parameters, inputs and outputs

    def declare(
        self,
        name: str,
        default: Any,
        description: str,
        *,
        minimum: float | None = None,
        maximum: float | None = None,
        choices: Sequence[str] | None = None,
    ) -> Any:
        """Declare a read-only parameter and return its checked value."""
        limits = [f">= {minimum}"] * (minimum is not None) + [f"<= {maximum}"] * (maximum is not None)
        if choices is not None:
            limits.append("one of " + ", ".join(choices))
        descriptor = ParameterDescriptor(
            description=description, additional_constraints="; ".join(limits), read_only=True
        )
        try:
            value = self.declare_parameter(name, default, descriptor).value
        except (InvalidParameterTypeException, InvalidParameterValueException) as error:
            expected = f"a {type(default).__name__} such as {default!r}"
            raise ValueError(f"{self.get_name()}: parameter '{name}' must be {expected} ({error})") from error
        low = minimum is not None and not value >= minimum
        high = maximum is not None and not value <= maximum
        if low or high or (choices is not None and value not in choices):
            raise ValueError(f"{self.get_name()}: parameter '{name}' is {value!r}, must be {' and '.join(limits)}")
        return value

    def output(self, message_type: type, topic: str, latched: bool = False) -> Publisher:
        """A reliable publisher; ``latched`` keeps its last messages for those who come later (transient-local)."""
        return self.create_lifecycle_publisher(
            message_type, topic, _qos(latched, depth=_QUEUE_DEPTH), qos_overriding_options=_overridable()
        )

    def input(
        self, message_type: type, topic: str, callback: Callable[[Any], None], latched: bool = False
    ) -> Subscription:
        """A reliable subscription whose callback may raise :class:`MessageError`: that message is refused, no more."""
        return self._subscribe(message_type, topic, callback, _qos(latched, depth=_QUEUE_DEPTH))

    def camera_input(
        self, message_type: type, topic: str, callback: Callable[[Any], None], latched: bool
    ) -> Subscription:
        """An :meth:`input` from a camera: latched as this project's are, else best effort, which suits all drivers."""
        qos = _qos(latched, depth=_QUEUE_DEPTH)
        if not latched:
            qos.reliability = ReliabilityPolicy.BEST_EFFORT
        return self._subscribe(message_type, topic, callback, qos)

    def _subscribe(
        self, message_type: type, topic: str, callback: Callable[[Any], None], qos: QoSProfile
    ) -> Subscription:
        latched = qos.durability == DurabilityPolicy.TRANSIENT_LOCAL
        held = deque(maxlen=qos.depth if latched else 0)

        def guarded(message: Any) -> None:
            if not self._active:
                held.append(message)
                return
            try:
                callback(message)
            except MessageError as error:
                self.reject(f"{topic}: {error}")

        self._held.append((guarded, held))
        return self.create_subscription(message_type, topic, guarded, qos, qos_overriding_options=_overridable())

    # Diagnostics

    def reject(self, reason: str) -> None:
        """Log a refused message (throttled) and tell /diagnostics."""
        self._rejected += 1
        self.get_logger().error(reason, throttle_duration_sec=_LOG_PERIOD_SECONDS)
        self._diagnose(DiagnosticStatus.ERROR, reason, 0, {})

    @contextmanager
    def measure(self, stamp: int) -> Iterator[None]:
        """Time the work on the view with this stamp and publish latency and rate on /diagnostics."""
        started = time.perf_counter()
        yield
        finished = time.perf_counter()
        self._views_measured += 1
        values = {"latency_ms": f"{(finished - started) * 1e3:.3f}"}
        if self._last_view_at is not None:
            values["rate_hz"] = f"{1.0 / max(finished - self._last_view_at, 1e-9):.3f}"
        self._last_view_at = finished
        self._diagnose(DiagnosticStatus.OK, "view processed", stamp, values)

    def _diagnose(self, level: bytes, message: str, stamp: int, values: dict[str, str]) -> None:
        values = {**values, "views": str(self._views_measured), "rejected": str(self._rejected)}
        status = DiagnosticStatus(
            level=level, name=self.get_fully_qualified_name(), message=message, hardware_id=HARDWARE_ID
        )
        status.values = [KeyValue(key=key, value=value) for key, value in values.items()]
        report = DiagnosticArray(status=[status])
        report.header.stamp = ns_to_stamp(stamp)
        self._diagnostics.publish(report)

    def _answer_connections(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = True
        response.message = json.dumps(connections(self))
        return response

    # Lifecycle

    def start(self) -> None:
        """Configure and activate.

        Raises:
            Exception: what :meth:`setup` or :meth:`begin` raised.
        """
        self._starting = True
        try:
            for transition in (self.trigger_configure, self.trigger_activate):
                if transition() != TransitionCallbackReturn.SUCCESS:
                    raise self._failure or RuntimeError(f"{self.get_name()}: could not start")
        finally:
            self._starting = False

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Run :meth:`setup`."""
        return self._attempt(self.setup)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Open the outputs, run :meth:`begin`, then take what latched inputs brought before."""
        super().on_activate(state)
        self._active = True
        result = self._attempt(self.begin)
        if result == TransitionCallbackReturn.SUCCESS:
            result = self._attempt(self._take_held)
        if result != TransitionCallbackReturn.SUCCESS:
            self.on_deactivate(state)
        return result

    def _take_held(self) -> None:
        for callback, held in self._held:
            while held:
                callback(held.popleft())

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Close inputs and outputs."""
        self._active = False
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Run :meth:`teardown`."""
        return self._attempt(self.teardown)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Run :meth:`teardown`."""
        self._active = False
        return self._attempt(self.teardown)

    def destroy_node(self) -> None:
        """Destroy the node, and with the last one of its context the DDS participant.

        rclpy leaves a lifecycle node's state machine to the garbage collector, and with it node and participant: a
        process that makes many nodes would carry the threads of all of them, and their discovery can deadlock.
        """
        self._state_machine.destroy_when_not_in_use()
        super().destroy_node()

    def _attempt(self, step: Callable[[], None]) -> TransitionCallbackReturn:
        try:
            step()
        # Any failure must become a refused transition: rclpy would swallow the exception and lose its text.
        except Exception as error:
            self._failure = error
            if not self._starting:  # who calls start() is told by the exception
                self.get_logger().error(f"{step.__name__} failed: {error}")
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS


def connections(node: Node) -> dict[str, list[tuple[str, int]]]:
    """The topics of a node's ``outputs`` and ``inputs``, each with how many counterparts it has found.

    Whoever starts a graph asks for this before letting anybody speak: the middleware takes seconds to introduce
    processes to each other, and a message to a stranger is lost.
    """
    return {
        "outputs": [(output.topic_name, output.get_subscription_count()) for output in node.publishers],
        "inputs": [(input.topic_name, input.get_publisher_count()) for input in node.subscriptions],
    }


class StampSynchronizer:
    """Collects one value per name for each stamp and hands complete sets on, in order of their stamps.

    Args:
        names: what makes a set complete.
        callback: called with the stamp (ns) and {name: value}.
        depth: incomplete stamps kept, more than a latched topic repeats; the oldest is dropped first.
    """

    def __init__(self, names: Sequence[str], callback: Callable[[int, dict[str, Any]], None], depth: int = 16) -> None:
        self._names = frozenset(names)
        self._callback = callback
        self._depth = depth
        self._pending: dict[int, dict[str, Any]] = {}
        self._last_complete = -1

    def add(self, name: str, stamp: int, value: Any) -> None:
        """Take a value; a second one for an incomplete stamp replaces the first (its sender was restarted).

        Raises:
            MessageError: the stamp was completed already, or is older than the last complete one; or, with the value
                taken, an older incomplete set had to make room.
        """
        if stamp <= self._last_complete:
            kind = "duplicate" if stamp == self._last_complete else "stale"
            raise MessageError(
                f"{kind} stamp {stamp * 1e-9:.3f} s of {name}, already at {self._last_complete * 1e-9:.3f} s; "
                "a camera whose stamps begin anew needs the other nodes started anew, too"
            )
        self._pending.setdefault(stamp, {})[name] = value
        if self._pending[stamp].keys() == self._names:
            values = self._pending[stamp]
            self._last_complete = stamp
            self._pending = {later: kept for later, kept in self._pending.items() if later > stamp}
            self._callback(stamp, values)
        elif len(self._pending) > self._depth:
            oldest = min(self._pending)
            absent = ", ".join(sorted(self._names - self._pending.pop(oldest).keys()))
            raise MessageError(f"view of {oldest * 1e-9:.3f} s is dropped: no {absent} for it")

    def missing(self) -> dict[int, set[str]]:
        """Names still awaited, per incomplete stamp."""
        return {stamp: set(self._names - values.keys()) for stamp, values in self._pending.items()}


def run_node(node_type: type[GraphNode], args: Sequence[str] | None = None) -> None:
    """The main function of every executable: spin one node until interrupted. Exit code 2 on bad arguments."""
    _refuse_words(list(sys.argv if args is None else args))
    rclpy.init(args=args)
    node = None
    try:
        try:
            node = node_type()
            if node.autostart:
                node.start()
        # Only here: a ValueError in a callback is a defect, which needs its traceback and the supervisor's restart.
        except ValueError as error:
            print(f"error: {error}", file=sys.stderr)
            sys.exit(2)
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        # Not spin(): on an interrupt rclpy wakes the executor a moment before it ends the context, and one that waits
        # again in that moment would sleep until the next message.
        while rclpy.ok():
            executor.spin_once(timeout_sec=_WAKE_SECONDS)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except RuntimeError:
        # An interrupt between the executor's look at the context and its wait ends in rcl's own error.
        if rclpy.ok():
            raise
    finally:
        # A terminal and `ros2 launch` both interrupt their children: the second must not tear the clean-up.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()


def _refuse_words(arguments: list[str]) -> None:
    """End with usage, or with an error: rclpy would drop silently what stands before ``--ros-args``."""
    words = remove_ros_args(arguments)[1:]
    if not words:
        return
    usage = f"usage: {Path(arguments[0]).stem} [--ros-args -p NAME:=VALUE ... --params-file FILE]"
    if set(words) & {"-h", "--help"}:
        print(f"{usage}\nparameters and topics: docs/graph.md, or `ros2 param describe` while it runs")
        sys.exit(0)
    print(f"error: '{words[0]}' is not for a node; parameters come after --ros-args\n{usage}", file=sys.stderr)
    sys.exit(2)


def _qos(latched: bool, depth: int) -> QoSProfile:
    durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
    return QoSProfile(depth=depth, reliability=ReliabilityPolicy.RELIABLE, durability=durability)


def _overridable() -> QoSOverridingOptions:
    kinds = (QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY, QoSPolicyKind.DURABILITY)
    return QoSOverridingOptions(kinds)
