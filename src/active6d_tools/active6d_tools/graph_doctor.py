"""Looks at a running graph: silent topics, incompatible QoS, and which node waits for which."""

import time
from collections import defaultdict
from collections.abc import Iterator
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSCompatibility, QoSProfile, ReliabilityPolicy, qos_check_compatible

from active6d_core.ros.conversions import own_statuses, status_values
from active6d_core.ros.graph_nodes import NODES
from active6d_core.ros.network import domain_of, explain_start
from active6d_core.ros.topics import CAMERA_TOPICS, CONTRACT, Per
from active6d_tools.machine_doctor import Check

_NAME = "active6d_doctor"
#: Who publishes the topics that an episode or a replay cannot do without, besides the camera.
_PUBLISHERS = {topic.publisher for topic in CONTRACT if topic.per in (Per.VIEW, Per.MOVE)} - {"camera"}
_DIAGNOSTICS = "/diagnostics"
#: Group of what a whole graph has and this one lacks.
PARTS = "Missing"
#: From what the least demanding publisher offers to the most.
_RELIABILITIES = ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE
_DURABILITIES = DurabilityPolicy.VOLATILE, DurabilityPolicy.TRANSIENT_LOCAL


def examine_graph(domain: int | None = None, namespace: str = "", seconds: float = 6.0) -> Iterator[Check]:
    """Listen to a running graph for some seconds, then report on its nodes and topics.

    Args:
        domain: ROS domain, None for ``ROS_DOMAIN_ID`` or 0.
        namespace: of the graph's nodes and topics.
        seconds: how long to listen: discovery takes some seconds, and nodes send a heartbeat every second.

    Raises:
        ValueError: ``ROS_DOMAIN_ID`` is no domain, or the log folder cannot be written.
    """
    domain = domain_of() or 0 if domain is None else domain
    context = Context()
    try:
        context.init(args=[], domain_id=domain)
    except RuntimeError as error:
        raise ValueError(explain_start(error)) from error
    executor = SingleThreadedExecutor(context=context)
    listener = _Listener(context, namespace)
    executor.add_node(listener)
    try:
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            listener.subscribe()
            executor.spin_once(timeout_sec=0.1)
        where = f"in domain {domain}, namespace /{namespace.strip('/')}"
        yield from _check_nodes(listener, where)
        yield from _check_parts(listener)
        yield from _check_topics(listener, seconds)
    finally:
        executor.shutdown()
        listener.destroy_node()
        context.try_shutdown()


class _Listener(Node):
    """Counts messages per topic of the contract and keeps each node's last heartbeat."""

    def __init__(self, context: Context, namespace: str) -> None:
        super().__init__(
            _NAME, context=context, namespace=namespace, start_parameter_services=False, enable_rosout=False
        )
        self.topics = {topic.name: self.resolve_topic_name(topic.name) for topic in CONTRACT}
        self.received: dict[str, int] = defaultdict(int)
        self.heartbeats: dict[str, DiagnosticStatus] = {}
        self.latched = {topic.name for topic in CONTRACT if topic.transient_local}
        self._subscribed = {_DIAGNOSTICS}
        self.create_subscription(DiagnosticArray, _DIAGNOSTICS, self._on_diagnostics, 100)

    def subscribe(self) -> None:
        """Subscribe to topics discovered since the last call, with QoS that their publishers match."""
        for topic in CONTRACT:
            offered = [end.qos_profile for end in self.publishers(self.topics[topic.name])]
            if topic.name in self._subscribed or not offered:
                continue
            self._subscribed.add(topic.name)
            qos = QoSProfile(
                depth=1,
                reliability=min((each.reliability for each in offered), key=_RELIABILITIES.index),
                durability=min((each.durability for each in offered), key=_DURABILITIES.index),
            )
            self.create_subscription(topic.message_type, topic.name, partial(self._count, topic.name), qos, raw=True)

    def publishers(self, topic: str) -> list[Any]:
        """Endpoints that publish a topic, this node left out."""
        return [end for end in self.get_publishers_info_by_topic(topic) if end.node_name != _NAME]

    def subscribers(self, topic: str) -> list[Any]:
        """Endpoints that subscribe to a topic, this node left out."""
        return [end for end in self.get_subscriptions_info_by_topic(topic) if end.node_name != _NAME]

    def _count(self, topic: str, payload: bytes) -> None:
        self.received[topic] += 1

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in own_statuses(message):
            inside = status.name.startswith(self.get_namespace().rstrip("/") + "/")
            if inside and "state" in status_values(status):
                self.heartbeats[status.name] = status


def _check_nodes(listener: _Listener, where: str) -> Iterator[Check]:
    if not listener.heartbeats:
        fix = "start the graph, or name it with --domain and --namespace"
        yield Check("Nodes", "heartbeats", False, True, f"no node publishes diagnostics {where}", fix)
    for name, status in sorted(listener.heartbeats.items()):
        detail = status.message
        awaited = status_values(status).get("waiting_for", "")
        sources = {end.node_name for topic in awaited.split(",") if topic for end in listener.publishers(topic)}
        if sources:
            detail += f" (published by {', '.join(sorted(sources))})"
        warned = status.level != DiagnosticStatus.OK
        yield Check("Nodes", name, not warned, warned, detail, "see the topics below" if warned else "")


def _check_parts(listener: _Listener) -> Iterator[Check]:
    """What a whole graph has and this one lacks; another node that publishes a node's topics stands in for it."""
    seen = {name.rpartition("/")[2] for name in listener.heartbeats}
    cameras = all(listener.publishers(listener.topics[topic.name]) for topic in CAMERA_TOPICS)
    if not cameras:
        fix = "start camera_adapter, camera_simulator, dataset_camera or bag_player"
        yield Check(PARTS, "a camera", False, False, "camera/* topics without a publisher", fix)
    for name in (node for node in NODES if node in _PUBLISHERS - seen):
        outputs = [topic.name for topic in CONTRACT if topic.publisher == name and topic.per is not Per.EPISODE]
        if not all(listener.publishers(listener.topics[topic]) for topic in outputs):
            yield Check(PARTS, name, False, False, "not seen", "needed for episodes; start it, or launch the graph")


def verdict(checks: list[Check]) -> str:
    """What follows from the checks of a graph without a fault: how many nodes were seen, and what a whole one lacks."""
    count = sum(check.group == "Nodes" for check in checks)
    missing = ", ".join(check.name for check in checks if check.group == PARTS)
    seen = f"no fault in the {count} node{'s' if count != 1 else ''} seen"
    return f"The graph is not whole: {seen}; missing: {missing}." if missing else f"The graph works: {seen}."


def _check_topics(listener: _Listener, seconds: float) -> Iterator[Check]:
    for name, topic in listener.topics.items():
        publishers, subscribers = listener.publishers(topic), listener.subscribers(topic)
        who = _names(subscribers)
        if not publishers:
            if subscribers:
                fix = f"start the node that publishes {topic}, or check remaps, namespace and domain"
                yield Check("Topics", topic, False, False, f"nobody publishes it; subscribed by {who}", fix)
            continue
        mismatches = list(_mismatches(publishers, subscribers))
        if mismatches:
            fix = "publish what the subscriber asks for, or see qos_overrides in docs/graph.md"
            yield Check("Topics", topic, False, True, "; ".join(mismatches), fix)
        elif name != _DIAGNOSTICS and not listener.received[name]:
            # Topics that are not transient local are silent whenever nothing is decided.
            silent = f"published by {_names(publishers)}, silent for {seconds:.0f} s"
            fix = "see in the list of nodes what its publisher waits for" if name in listener.latched else ""
            yield Check("Topics", topic, not fix, False, silent, fix)
        else:
            detail = f"published by {_names(publishers)}, subscribed by {who or 'nobody'}"
            yield Check("Topics", topic, True, False, detail)


def _mismatches(publishers: list[Any], subscribers: list[Any]) -> Iterator[str]:
    for publisher in publishers:
        for subscriber in subscribers:
            compatibility, reason = qos_check_compatible(publisher.qos_profile, subscriber.qos_profile)
            if compatibility == QoSCompatibility.ERROR:
                reason = reason.strip().rstrip(";").removeprefix("ERROR: ")
                yield f"{publisher.node_name} does not reach {subscriber.node_name}: {reason}"


def _names(endpoints: list[Any]) -> str:
    return ", ".join(sorted({end.node_name for end in endpoints}))
