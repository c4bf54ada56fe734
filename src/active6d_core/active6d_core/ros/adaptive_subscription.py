"""A subscription that takes the quality of service its publishers offer, so that any camera driver matches."""

from collections.abc import Callable
from copy import copy
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription

from active6d_core.ros.topics import Topic


class AdaptiveSubscription:
    """Subscribes with what is wanted, and again with less as soon as a publisher turns out to offer less.

    Big best-effort messages are easily lost, so best effort is taken only from publishers that offer nothing better.

    Args:
        node: the node that subscribes.
        topic: what to subscribe to.
        callback: called with each message, serialized if ``raw``.
        qos: what is wanted.
        overriding: which policies parameters of the node may override; None for none.
        events: more event callbacks; ``incompatible_qos`` is called when a publisher offers less than was asked.
        raw: hand on serialized messages.
    """

    def __init__(
        self,
        node: Node,
        topic: Topic,
        callback: Callable[[Any], None],
        qos: QoSProfile,
        overriding: QoSOverridingOptions | None = None,
        events: SubscriptionEventCallbacks | None = None,
        raw: bool = False,
    ) -> None:
        self._node, self._topic, self._callback, self._raw = node, topic, callback, raw
        self._qos = copy(qos)
        self._events = events or SubscriptionEventCallbacks()
        self._on_incompatible = self._events.incompatible_qos
        self._events.incompatible_qos = self._adapt
        self.subscription = self._subscribe(overriding)

    @property
    def qos_profile(self) -> QoSProfile:
        """What is asked for now."""
        return self.subscription.qos_profile

    def _subscribe(self, overriding: QoSOverridingOptions | None = None) -> Subscription:
        return self._node.create_subscription(
            self._topic.message_type,
            self._topic.name,
            self._callback,
            self._qos,
            event_callbacks=self._events,
            qos_overriding_options=overriding,
            raw=self._raw,
        )

    def _adapt(self, event: Any) -> None:
        if self._on_incompatible is not None:
            self._on_incompatible(event)
        # The event names one policy; after the next subscription another event names the other, if that differs too.
        if event.last_policy_kind == QoSPolicyKind.DURABILITY:
            self._qos.durability = DurabilityPolicy.VOLATILE
        elif event.last_policy_kind == QoSPolicyKind.RELIABILITY:
            self._qos.reliability = ReliabilityPolicy.BEST_EFFORT
        else:
            return
        outdated, self.subscription = self.subscription, self._subscribe()
        self._node.destroy_subscription(outdated)
        kinds = f"{self._qos.reliability.name}, {self._qos.durability.name}".lower().replace("_", " ")
        self._node.get_logger().info(f"{self.subscription.topic_name} is taken as its publisher offers it: {kinds}")
