"""Nodes are reached from this machine only unless asked, a graph has a domain of its own, a topic one publisher."""

import os
import re
import socket
import subprocess
import sys
import time

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.context import Context
from rclpy.node import Node
from ros_harness import fresh_domain, reliable
from sensor_msgs.msg import Image

from active6d_core.ros.conversions import depth_to_image
from active6d_core.ros.network import (
    DomainClaim,
    DomainError,
    describe_reach,
    domain_of,
    is_used,
    keep_on_this_machine,
    open_to_network,
)
from active6d_core.ros.node import GraphNode
from active6d_core.ros.publishers import live_publishers, others_in_domain
from active6d_core.ros.topics import CAMERA_DEPTH

SOCKETS = """
import os, re, sys
from rclpy.context import Context
from rclpy.node import Node
context = Context()
context.init(args=[], domain_id=int(sys.argv[1]))
node = Node("lone", context=context)
paths = [f"/proc/self/fd/{each}" for each in os.listdir("/proc/self/fd")]
links = [os.readlink(path) for path in paths if os.path.islink(path)]
own = {match.group(1) for match in map(re.compile(r"socket:.(\\d+).").match, links) if match}
for kind in ("udp", "udp6", "tcp", "tcp6"):
    for line in open(f"/proc/net/{kind}").readlines()[1:]:
        if line.split()[9] in own:
            print(kind, line.split()[1])
print("mapped", sum("/dev/shm/fastrtps" in line for line in open("/proc/self/maps")))
"""


def sockets(environment, domain):
    """(address, port) of the sockets of a process with one node, which has no shared memory."""
    clean = {key: value for key, value in os.environ.items() if not key.startswith(("ROS_AUTO", "FASTRTPS"))}
    command = [sys.executable, "-c", SOCKETS, str(domain)]
    output = subprocess.run(command, env={**clean, **environment}, capture_output=True, text=True, check=True).stdout
    *lines, mapped = output.splitlines()
    assert mapped == "mapped 0", "a killed process leaves ports in shared memory that its successor may not get"
    return [(line.split()[1].split(":")[0], int(line.split(":")[1], 16)) for line in lines]


def test_what_receives_is_bound_to_the_loopback_interface_only():
    environment = {}
    keep_on_this_machine(environment)
    domain = fresh_domain()
    receiving = [at for at in sockets(environment, domain) if 7400 <= at[1] - 250 * domain < 7650]
    assert len(receiving) >= 2
    assert {address for address, _ in receiving} == {"0100007F"}
    assert describe_reach(environment) == "on this machine only"
    environment = {"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"}
    keep_on_this_machine(environment)
    assert environment["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "LOCALHOST"  # other middleware does not read the profile


def test_programs_after_many_others_see_each_other():
    """The ports of forty participants are taken, as by eight episodes with a process for each node."""
    domain, taken = fresh_domain(), []
    for number in range(40):
        taken.append(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        taken[-1].bind(("127.0.0.1", 7410 + 250 * domain + 2 * number))
    contexts = [Context() for _ in range(2)]
    for context in contexts:
        context.init(args=[], domain_id=domain)
    nodes = [Node(name, context=context) for name, context in zip(("first", "second"), contexts, strict=True)]
    deadline = time.monotonic() + 20
    while time.monotonic() < deadline and not all(len(node.get_node_names()) == 2 for node in nodes):
        time.sleep(0.05)
    assert all(sorted(node.get_node_names()) == ["first", "second"] for node in nodes)
    for node, context in zip(nodes, contexts, strict=True):
        node.destroy_node()
        context.try_shutdown()
    for each in taken:
        each.close()


def test_a_graph_on_the_network_has_sockets_only():
    environment = {}
    open_to_network(environment)
    assert "00000000" in {address for address, _ in sockets(environment, fresh_domain())}
    assert describe_reach(environment) == "from the network"


def test_what_the_user_set_is_kept_and_described():
    environment = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET", "FASTRTPS_DEFAULT_PROFILES_FILE": "mine.xml"}
    keep_on_this_machine(environment)
    assert environment["FASTRTPS_DEFAULT_PROFILES_FILE"] == "mine.xml"
    assert describe_reach(environment) == "as mine.xml says"
    assert "hosts that know the address" in describe_reach({"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"})
    assert describe_reach({}) == "from the network"
    assert "SROS 2" in describe_reach({"ROS_SECURITY_ENABLE": "true"})


@pytest.mark.parametrize("text", ["seven", "-1", "1.5", "300", "²"])
def test_a_domain_that_is_no_number_is_named(text):
    with pytest.raises(DomainError, match=f"ROS_DOMAIN_ID is '{re.escape(text)}', expected a number"):
        domain_of({"ROS_DOMAIN_ID": text})


def test_a_domain_has_one_graph_and_a_free_one_is_found(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert domain_of({}) is None
    first = DomainClaim(90)
    with pytest.raises(DomainError, match="another active6d command runs a graph in ROS domain 90"):
        DomainClaim(90)
    DomainClaim(90, "left").release()
    first.release()
    DomainClaim(90).release()
    claims = [DomainClaim() for _ in range(5)]
    assert len({claim.domain for claim in claims}) == 5
    assert not any(is_used(claim.domain) for claim in claims)
    for claim in claims:
        claim.release()


def test_a_domain_with_a_participant_of_somebody_else_is_not_free(graph):
    assert is_used(graph.domain)


class Viewer(GraphNode):
    """Counts depth images."""

    def __init__(self, **arguments):
        super().__init__("viewer", **arguments)
        self.count = 0
        self.input(CAMERA_DEPTH, self.take)

    def take(self, message):
        self.count += 1


def test_two_publishers_of_one_topic_are_refused_by_name_until_one_is_gone(graph):
    viewer = graph.add(Viewer(context=graph.context))
    diagnostics = graph.mailbox(DiagnosticArray, "/diagnostics")
    image = depth_to_image(np.ones((4, 4), np.float32), 1, "camera_optical_frame")
    other = Context()
    other.init(args=[], domain_id=graph.domain)
    intruder = Node("other_camera", context=other)
    publisher = intruder.create_publisher(Image, "camera/depth/image_raw", reliable(True))
    graph.publish("camera/depth/image_raw", image, latched=True)
    both = ["/other_camera", "/tester"]
    graph.spin_until(lambda: live_publishers(viewer, "camera/depth/image_raw") == both, what="both publishers")
    seen = viewer.count
    graph.publish("camera/depth/image_raw", image, latched=True)
    names = "2 nodes publish it: /other_camera, /tester"
    graph.spin_until(lambda: any(names in d.status[0].message for d in diagnostics), what=names)
    assert viewer.count == seen
    intruder.destroy_publisher(publisher)
    intruder.destroy_node()
    other.try_shutdown()
    graph.spin_until(lambda: viewer.count_publishers("camera/depth/image_raw") == 1)
    graph.publish("camera/depth/image_raw", image, latched=True)
    graph.spin_until(lambda: viewer.count == seen + 1)


def test_the_publisher_of_a_killed_process_does_not_count(graph):
    viewer = graph.add(Viewer(context=graph.context))
    script = (
        "import sys, time; from rclpy.context import Context; from rclpy.node import Node;"
        "from sensor_msgs.msg import Image; context = Context(); context.init(args=[], domain_id=int(sys.argv[1]));"
        "node = Node('tester', context=context);"
        "publisher = node.create_publisher(Image, 'camera/depth/image_raw', 1); time.sleep(100)"
    )
    process = subprocess.Popen([sys.executable, "-c", script, str(graph.domain)])
    try:
        graph.spin_until(lambda: viewer.count_publishers("camera/depth/image_raw") == 1, timeout=30)
    finally:
        process.kill()
        process.wait()
    image = depth_to_image(np.ones((4, 4), np.float32), 1, "camera_optical_frame")
    graph.publish("camera/depth/image_raw", image, latched=True)
    graph.spin_until(lambda: viewer.count == 1)
    assert viewer.count_publishers("camera/depth/image_raw") == 2  # the middleware does not know yet


def test_other_nodes_in_a_domain_are_named(graph):
    viewer = graph.add(Viewer(context=graph.context))
    other = Context()
    other.init(args=[], domain_id=graph.domain)
    strangers = [Node(name, context=other) for name in ("stranger", "viewer", "_hidden")]
    expected = ["/tester", "/viewer"]
    graph.spin_until(
        lambda: others_in_domain(viewer, [*expected, "/viewer"]) == ["/stranger"] or None, what="the other graph's"
    )
    assert "/viewer" not in others_in_domain(viewer, [*expected, "/viewer"])
    for stranger in strangers:
        stranger.destroy_node()
    other.try_shutdown()
