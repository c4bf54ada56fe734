"""What every node shares: lifecycle, and guarded inputs and outputs of the graph's topics."""

import json
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from std_srvs.srv import Trigger

from active6d_core.ros.adaptive_subscription import AdaptiveSubscription
from active6d_core.ros.conversions import MessageError, OutdatedError
from active6d_core.ros.diagnostics import DiagnosticNode
from active6d_core.ros.publishers import live_publishers
from active6d_core.ros.topics import Topic


class GraphNode(DiagnosticNode):
    """A lifecycle node that survives bad input and publishes diagnostics.

    Subclasses declare parameters and create inputs and outputs in ``__init__``. They read parameters with
    :meth:`value` and do what is heavy in :meth:`setup`, and start their work in :meth:`begin`. Input is ignored while
    the node is not active. Only the last messages of transient local topics are kept and taken on activation.

    Raises:
        ValueError: a parameter is out of its range or of another type; the message names it.
    """

    def __init__(self, name: str, **options: Any) -> None:
        super().__init__(name, **options)
        self._starting = False
        self._held: list[tuple[Callable[[Any], None], deque[Any]]] = []
        self._failure: Exception | None = None
        self.create_service(Trigger, "~/connections", self._answer_connections)
        self.declare("autostart", True, "configure and activate the node automatically when it starts", fixed=True)
        self.declare("world_frame", "world", "frame of the bin: origin at its centre, z up")
        self.declare("camera_frame", "camera_optical_frame", "optical frame of the camera (REP-103)")
        self._read_frames()

    # What a subclass overrides

    def setup(self) -> None:
        """Heavy start-up: read parameters, load models, simulate scenes. Runs on configure."""

    def begin(self) -> None:
        """First work of an active node. Runs on activate."""

    def teardown(self) -> None:
        """Release what :meth:`setup` made. Runs on cleanup and shutdown."""

    # Inputs and outputs

    def _read_frames(self) -> None:
        self.world_frame, self.camera_frame = self.value("world_frame"), self.value("camera_frame")

    def output(self, topic: Topic) -> Publisher:
        """A reliable publisher of a topic, with the durability that the topic declares."""
        return self.create_lifecycle_publisher(
            topic.message_type, topic.name, qos_of(topic), qos_overriding_options=_overridable()
        )

    def input(self, topic: Topic, callback: Callable[[Any], None]) -> None:
        """Subscribe to a topic; a message for which the callback raises :class:`MessageError` is refused.

        A camera's topic is taken with the quality of service that its publisher offers, whatever driver that is.
        """
        qos = qos_of(topic)
        held: deque[Any] = deque(maxlen=qos.depth)

        def guarded(message: Any) -> None:
            if not self._active:
                if subscription.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL:
                    held.append(message)
                return
            self.guard(topic.name, partial(self._take_from_one, topic, callback, message))

        def incompatible(event: Any) -> None:
            cause = self._watch.mismatch(topic.name, event.last_policy_kind)
            if not topic.from_camera:
                self.get_logger().warning(cause)

        self._held.append((guarded, held))
        events = SubscriptionEventCallbacks(
            incompatible_qos=incompatible,
            message_lost=lambda event: self.lose(f"{event.total_count_change} messages of {topic.name}"),
        )
        subscription: AdaptiveSubscription | Subscription
        if topic.from_camera:
            subscription = AdaptiveSubscription(self, topic, guarded, qos, _overridable(), events)
        else:
            subscription = self.create_subscription(
                topic.message_type,
                topic.name,
                guarded,
                qos,
                event_callbacks=events,
                qos_overriding_options=_overridable(),
            )

    def _take_from_one(self, topic: Topic, callback: Callable[[Any], None], message: Any) -> None:
        """Pass a message on, unless nodes of several graphs publish the topic: its origin would be unknown."""
        if topic.publisher and not topic.shared and self.count_publishers(topic.name) > 1:
            names = live_publishers(self, topic.name)
            if len(names) > 1:
                raise MessageError(
                    f"{len(names)} nodes publish it: {', '.join(names)}; stop all but one, or give each graph a "
                    "ROS_DOMAIN_ID or a namespace of its own"
                )
        callback(message)

    def guard(self, topic: str, action: Callable[[], None]) -> None:
        """Do what input on a topic causes; a :class:`MessageError` is reported and nothing else."""
        try:
            action()
        except OutdatedError as error:
            self.ignore(f"{topic}: {error}")
        except MessageError as error:
            self.reject(f"{topic}: {error}")

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
        """Run :meth:`setup` with the parameters as they are now."""
        self._configured = True
        for sentence in self.unknown_parameters():
            self.say_once(sentence)
        self._read_frames()
        result = self._attempt(self.setup)
        self._configured = result == TransitionCallbackReturn.SUCCESS
        return result

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Open the outputs, run :meth:`begin`, then take what transient local inputs brought before."""
        super().on_activate(state)
        self._active = True
        self.get_logger().info("ready")
        result = self._attempt(self.begin)
        if result == TransitionCallbackReturn.SUCCESS:
            result = self._attempt(self._take_held)
        if result != TransitionCallbackReturn.SUCCESS:
            self.on_deactivate(state)
        elif self.value("heartbeat") > 0:
            self.beat()  # a supervisor judges only who has begun to beat, and the node may hang at its first input
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
        self._configured = False
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
            if not self._starting:  # the exception reaches the caller of start()
                self.get_logger().error(f"{step.__name__} failed: {error}")
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS


def connections(node: Node) -> dict[str, list[tuple[str, int]]]:
    """The topics of a node's ``outputs`` and ``inputs``, each with how many counterparts it has found.

    A supervisor asks for this before it activates any node: discovery takes seconds, and a message to an undiscovered
    subscriber is lost.
    """
    return {
        "outputs": [(output.topic_name, output.get_subscription_count()) for output in node.publishers],
        "inputs": [(input.topic_name, input.get_publisher_count()) for input in node.subscriptions],
    }


def qos_of(topic: Topic, depth: int | None = None) -> QoSProfile:
    """What publishers of a topic offer and its subscribers request; ``depth`` of the queue, None for the topic's."""
    durability = DurabilityPolicy.TRANSIENT_LOCAL if topic.transient_local else DurabilityPolicy.VOLATILE
    return QoSProfile(depth=depth or topic.depth, reliability=ReliabilityPolicy.RELIABLE, durability=durability)


def _overridable() -> QoSOverridingOptions:
    kinds = (QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY, QoSPolicyKind.DURABILITY)
    return QoSOverridingOptions(kinds)
