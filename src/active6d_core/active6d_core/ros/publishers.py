"""Which nodes publish a topic, without those whose process is gone."""

import os
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rclpy.node import Node

# A GUID of Fast DDS: two bytes each of vendor, host and process, then what tells participants of a process apart.
_HOST, _PROCESS, _PARTICIPANT = slice(2, 4), slice(4, 6), slice(0, 12)


def live_publishers(node: Node, topic: str) -> list[str]:
    """Names of the nodes that publish a topic, once for each node.

    The middleware knows of a killed process only after 20 s. Until then its publishers are still listed, beside those
    of the process that was started in its place. Of this machine's processes, only running ones count.
    """
    found = node.get_publishers_info_by_topic(node.resolve_topic_name(topic))
    own = {bytes(each.endpoint_gid)[_HOST] for each in _own(node)}
    running = _process_numbers()
    nodes = {}
    for each in found:
        gid = bytes(each.endpoint_gid)
        if gid[_HOST] in own and gid[_PROCESS] not in running:
            continue
        name = f"{each.node_namespace.rstrip('/')}/{each.node_name}"
        nodes[name, gid[_PARTICIPANT]] = name
    return sorted(nodes.values())


def _own(node: Node) -> list[Any]:
    """Endpoints of this node, which tell what this machine is called in a GUID."""
    return [
        each
        for each in node.get_publishers_info_by_topic("/diagnostics")
        if (each.node_name, each.node_namespace) == (node.get_name(), node.get_namespace())
    ]


def _process_numbers() -> set[bytes]:
    """The lowest two bytes of the ids of all processes, as in a GUID."""
    ids = [int(path.name) for path in Path("/proc").iterdir() if path.name.isdecimal()] or [os.getpid()]
    return {(process & 0xFFFF).to_bytes(2, "little") for process in ids}


def others_in_domain(node: Node, expected: Iterable[str]) -> list[str]:
    """Full names of the nodes that ``node`` has discovered beside itself and the expected ones, each once.

    A node that has an expected name, but is there twice, is another graph's.
    """
    found = Counter(f"{space.rstrip('/')}/{name}" for name, space in node.get_node_names_and_namespaces())
    surplus = found - Counter([*expected, node.get_fully_qualified_name()])
    # Tools of the command line make hidden nodes, which publish nothing of a graph.
    return sorted(name for name in surplus if not name.rpartition("/")[2].startswith("_"))
