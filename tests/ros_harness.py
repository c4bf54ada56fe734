"""A graph of nodes inside one test: own context, own domain, one executor, no sleeping.

A callback's exception leaves :meth:`GraphHarness.spin_until` and so fails the test, because ``SingleThreadedExecutor``
raises it again.
"""

import gc
import itertools
import os
import time
from collections.abc import Callable, Iterable

from rcl_interfaces.msg import Log
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from active6d_core.ros.network import DomainClaim, DomainError, is_used

# Linux hands out ephemeral ports from 32768 on, which leaves the domains 0 to 101 to DDS; 0 is everybody's default.
_DOMAINS = 100
_count = itertools.count()


def fresh_domain() -> int:
    """A ROS domain that no other test of this run and no other process on this machine uses.

    Test processes that run side by side take theirs from ranges of their own.
    """
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    share = _DOMAINS // workers
    for _ in range(share):
        domain = 1 + worker * share + (os.getpid() * 7 + next(_count)) % share
        if not is_used(domain) and not _is_claimed(domain):
            return domain
    raise AssertionError(f"all {share} ROS domains of this test process are in use")


def _is_claimed(domain: int) -> bool:
    try:
        DomainClaim(domain).release()
    except DomainError:
        return True
    return False


def reliable(latched: bool = False, depth: int = 100) -> QoSProfile:
    """Reliable, the last ``depth`` messages kept; ``latched`` is transient-local."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


class GraphHarness:
    """Nodes under test with a node of its own beside them, which listens in mailboxes and publishes by hand.

    Attributes:
        context: pass it to every node: ``PoseEstimatorNode(context=graph.context, overrides={...})``.
        domain: ROS domain of the context; a child process joins it through ``ROS_DOMAIN_ID``.
        node: the tester's own node.
    """

    def __init__(self) -> None:
        self.domain = fresh_domain()
        self.context = Context()
        self.context.init(args=[], domain_id=self.domain)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.node = Node("tester", context=self.context, start_parameter_services=False, enable_rosout=False)
        self.executor.add_node(self.node)
        self._nodes: list[Node] = []
        self._publishers: dict = {}

    def add(self, node: Node, start: bool = True) -> Node:
        """Take over a node: spin it, destroy it at the end; ``start`` configures and activates a graph node."""
        self._nodes.append(node)
        self.executor.add_node(node)
        if start and hasattr(node, "start"):
            node.start()
        return node

    def remove(self, node: Node) -> None:
        """Destroy a node now, as if its process had died."""
        self._nodes.remove(node)
        self.executor.remove_node(node)
        node.destroy_node()

    def mailbox(self, message_type: type, topic: str, latched: bool = False) -> list:
        """A list that collects every message of a topic from now on (and the latched ones before)."""
        messages: list = []
        self.node.create_subscription(message_type, topic, messages.append, reliable(latched))
        return messages

    def log(self) -> list[Log]:
        """A mailbox of the log lines of all nodes that are added after this call.

        A node whose constructor raised lives until it is collected. Then it removes the /rosout publisher of any node
        with its name, even of a later test, so it is collected first.
        """
        assert not self._nodes, "log() comes before the first node"
        gc.collect()
        return self.mailbox(Log, "/rosout", latched=True)

    def publish(self, topic: str, message, latched: bool = False, subscribers: int = 1, timeout: float = 5.0) -> None:
        """Publish reliably as soon as ``subscribers`` have found the publisher."""
        key = (topic, type(message), latched)
        if key not in self._publishers:
            self._publishers[key] = self.node.create_publisher(type(message), topic, reliable(latched))
        publisher = self._publishers[key]
        self.spin_until(lambda: publisher.get_subscription_count() >= subscribers, timeout, f"a subscriber of {topic}")
        publisher.publish(message)

    def spin_until(self, predicate: Callable[[], object], timeout: float = 10.0, what: str = "the predicate"):
        """Run callbacks until ``predicate()`` is true; returns what it returned.

        Raises:
            AssertionError: not within ``timeout`` seconds.
        """
        deadline = time.monotonic() + timeout
        while not (result := predicate()):
            if time.monotonic() > deadline:
                raise AssertionError(f"waited {timeout} s in vain for {what}")
            self.executor.spin_once(timeout_sec=0.02)
        return result

    def spin_until_filled(self, mailboxes: Iterable[list], count: int = 1, timeout: float = 10.0) -> None:
        """Run callbacks until every mailbox holds at least ``count`` messages."""
        boxes = list(mailboxes)
        self.spin_until(lambda: all(len(box) >= count for box in boxes), timeout, f"{count} messages in every mailbox")

    def spin_for(self, seconds: float) -> None:
        """Run callbacks for a while: only to show that something does NOT happen."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            self.executor.spin_once(timeout_sec=0.02)

    def call(self, service_type: type, name: str, request=None, timeout: float = 10.0):
        """Call a service and return its response."""
        client = self.node.create_client(service_type, name)
        self.spin_until(client.service_is_ready, timeout, f"service {name}")
        future = client.call_async(request or service_type.Request())
        self.spin_until(future.done, timeout, f"the response of {name}")
        self.node.destroy_client(client)
        return future.result()

    def close(self) -> None:
        """Destroy everything."""
        for node in reversed(self._nodes):
            self.executor.remove_node(node)
            node.destroy_node()
        self._nodes.clear()
        self.node.destroy_node()
        self.executor.shutdown()
        self.context.try_shutdown()
