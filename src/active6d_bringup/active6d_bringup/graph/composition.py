"""Which nodes make the graph, and how they run together in one process on one executor."""

import gc
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from importlib import import_module
from pathlib import Path
from threading import Event
from typing import Any, Protocol

from rclpy.context import Context
from rclpy.experimental import EventsExecutor
from rclpy.node import Node

from active6d_bringup.graph.params_file import default_params_file, read_params_file, unused_sections
from active6d_core.interrupts import INTERRUPTS
from active6d_core.ros.graph_nodes import NODES
from active6d_core.ros.network import DomainClaim, domain_of, explain_start
from active6d_core.ros.publishers import others_in_domain

OnEvent = Callable[[str], None]
#: What is missing as long as a recorder has not said what it lacks.
UNANSWERED = "the recorder's answer"


class EpisodeInterrupted(KeyboardInterrupt):
    """Interrupted by Ctrl-C or SIGTERM; the bag is closed and readable."""


@dataclass(frozen=True)
class GraphDescription:
    """The nodes to run and their parameters.

    Attributes:
        nodes: names in ``NODES``, each with the parameters that override the file's.
        params_file: ROS parameters YAML for all of them; None leaves the nodes' own defaults.
        namespace: of all topics and nodes.
        domain: ROS domain; None takes ``ROS_DOMAIN_ID`` or, without it, one that nobody is in, so that episodes that
            run side by side do not talk to each other.
    """

    nodes: dict[str, dict[str, Any]]
    params_file: Path | None = None
    namespace: str = ""
    domain: int | None = None
    log_level: str = field(default="warn", kw_only=True)

    def __post_init__(self) -> None:
        unknown = self.nodes.keys() - NODES.keys()
        if unknown:
            raise ValueError(f"unknown node '{min(unknown)}'; known: {', '.join(NODES)}")
        if self.params_file is not None and self.params_file != default_params_file():
            read_params_file(self.params_file)

    def in_order(self) -> list[str]:
        """The nodes' names in the order of starting."""
        return [name for name in NODES if name in self.nodes]

    def ros_arguments(self) -> list[str]:
        """What the description says to every node alike, as ROS command line arguments."""
        parameters = ["--params-file", str(self.params_file)] if self.params_file else []
        return ["--ros-args", "--log-level", self.log_level, *parameters]

    def domain_id(self) -> int:
        """The domain that the graph runs in; this process has it for this graph alone.

        Raises:
            DomainError: another command's graph is in it.
        """
        return self._claim.domain

    @cached_property
    def _claim(self) -> DomainClaim:
        return DomainClaim(self.domain if self.domain is not None else domain_of(), self.namespace)

    def name_unused(self, on_event: OnEvent) -> None:
        """Report sections of the params file that are for no node: ROS would ignore a mistyped name."""
        if self.params_file is not None:
            for sentence in unused_sections(read_params_file(self.params_file), self.nodes, self.namespace):
                on_event(f"params file {self.params_file}: {sentence}")

    def name_others(self, node: Node, on_event: OnEvent) -> bool:
        """Report other nodes in a domain that the user named, if ``node`` of this graph has discovered any."""
        if self.domain is None and domain_of() is None:
            return False
        space = f"/{self.namespace.strip('/')}/" if self.namespace else "/"
        if others := others_in_domain(node, [space + name for name in (*self.nodes, "supervisor")]):
            on_event(f"also in ROS domain {self.domain_id()}: {', '.join(others)}")
        return bool(others)

    def release_domain(self) -> None:
        """Let others have the domain."""
        self._claim.release()


class Graph(Protocol):
    """A running graph, whatever its processes."""

    context: Context
    restarted: list[str]
    """nodes that died and were started again, in order"""

    def add(self, node: Node) -> None:
        """Spin one more node of the caller's in this process."""

    def start(self) -> None:
        """Bring all nodes to life."""

    def spin_once(self, timeout: float) -> None:
        """Run at most one callback of this process, waiting for it at most ``timeout`` seconds."""

    def missing(self, stamp: int) -> list[str]:
        """Topics that the recorder, if any, still waits for to have the episode that ends at ``stamp`` in full."""

    def close(self) -> None:
        """End all nodes; a recorded bag is complete and readable afterwards."""


class ComposedGraph:
    """All nodes in this process, one executor, no threads of our own.

    Raises:
        ValueError: a parameter is wrong; the message names node and parameter.
    """

    def __init__(
        self,
        description: GraphDescription,
        on_event: OnEvent = lambda text: None,
        interrupted: Event | None = None,
    ) -> None:
        self._description = description
        self._interrupted = interrupted or Event()
        self._on_event = on_event
        self.context = open_context(description)
        self.executor = EventsExecutor(context=self.context)
        self.nodes: dict[str, Node] = {}
        self.restarted: list[str] = []
        self._guests: list[Node] = []
        self._closing = ExitStack()

    def add(self, node: Node) -> None:
        """Spin one more node of the caller's; it is destroyed with the graph."""
        self._guests.append(node)
        self.executor.add_node(node)

    def start(self) -> None:
        """Make all nodes before any of them publishes, then start them one after the other."""
        for name in self._description.in_order():
            node_type = load_node_type(name)
            self.nodes[name] = node_type(
                context=self.context,
                namespace=self._description.namespace,
                overrides=self._description.nodes[name],
            )
            self.executor.add_node(self.nodes[name])
        if (recorder := self.nodes.get("episode_recorder")) is not None:
            self._closing.enter_context(INTERRUPTS.before_end(recorder.close_bag))
        for name, node in self.nodes.items():
            if self._interrupted.is_set():
                raise EpisodeInterrupted
            self._on_event(f"starting {name}")
            node.start()

    def spin_once(self, timeout: float) -> None:
        """Run one callback; what it raises is raised here."""
        self.executor.spin_once(timeout_sec=timeout)

    def missing(self, stamp: int) -> list[str]:
        """What the recorder, if there is one, still waits for."""
        recorder = self.nodes.get("episode_recorder")
        return recorder.missing(stamp) if recorder else []

    def close(self) -> None:
        """Destroy all nodes."""
        self._closing.close()
        for node in [*self._guests, *reversed(self.nodes.values())]:
            self.executor.remove_node(node)
            node.destroy_node()
        self.executor.shutdown()
        self.context.try_shutdown()
        self._description.release_domain()
        self._guests.clear()
        self.nodes.clear()


def load_node_type(name: str) -> type[Node]:
    """The class of a node in ``NODES``."""
    entry = NODES[name]
    return getattr(import_module(entry.module), entry.type_name)


def open_context(description: GraphDescription) -> Context:
    """A context in the description's domain that passes its parameter file to every node.

    Raises:
        ValueError: the parameter file cannot be parsed.
    """
    context = Context()
    try:
        context.init(args=description.ros_arguments(), domain_id=description.domain_id())
    except RuntimeError as error:
        explained = explain_start(error)
        of_file = "" if "ROS_LOG_DIR" in explained else f"params file {description.params_file}: "
        raise ValueError(f"{of_file}{explained}") from error
    return context


@contextmanager
def running(graph: Graph) -> Iterator[Graph]:
    """The graph, closed on every way out."""
    try:
        yield graph
    finally:
        graph.close()
        # Nodes and their callbacks refer to each other. Python would collect them after hundreds of graphs, because it
        # counts objects, of which an image is one.
        gc.collect()
