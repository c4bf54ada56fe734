"""A second host, in a network namespace of its own, does not reach nodes unless they are opened to the network."""

import os
import shutil
import subprocess
import sys

import pytest

NODE = """
import signal, sys, time
from pathlib import Path
from active6d_core.ros.network import keep_on_this_machine, open_to_network
(open_to_network if sys.argv[1] == "open" else keep_on_this_machine)()
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from active6d_core.ros.node import qos_of
from active6d_core.ros.topics import EPISODE_START as START
context, received, ended = Context(), [], []
context.init(args=[], domain_id=5)
signal.signal(signal.SIGTERM, lambda *arguments: ended.append(1))
node = Node(sys.argv[2], context=context)
first, deadline = sys.argv[2] == "first", time.monotonic() + (60 if sys.argv[2] == "first" else 6)
if first:
    node.create_subscription(START.message_type, START.name, received.append, qos_of(START))
    Path(sys.argv[3]).touch()
else:
    publisher = node.create_publisher(START.message_type, START.name, qos_of(START))
    publisher.publish(START.message_type())
executor = SingleThreadedExecutor(context=context)
executor.add_node(node)
while time.monotonic() < deadline and not ended:
    executor.spin_once(0.2)
print(len(received) if first else publisher.get_subscription_count())
"""
# $1: open or closed, $2: Python, $3: the program, $4: a file. Everything is in a namespace that ends with this script.
HOSTS = """
set -e
ip link set lo up
unshare -n sleep 100 &
second=$!
trap 'kill $second' EXIT
until [ "$(readlink /proc/$second/ns/net)" != "$(readlink /proc/self/ns/net)" ]; do sleep 0.1; done
ip link add near type veth peer name far
ip link set far netns $second
ip addr add 10.9.0.1/24 dev near
ip link set near up
nsenter -t $second -n sh -c 'ip link set lo up; ip addr add 10.9.0.2/24 dev far; ip link set far up'
"$2" -c "$3" "$1" first "$4" &
first=$!
until [ -e "$4" ]; do sleep 0.1; done
ROS_STATIC_PEERS=10.9.0.1 nsenter -t $second -n "$2" -c "$3" open second
kill $first
wait $first
"""


def can_have_namespaces():
    tools = all(shutil.which(name) for name in ("unshare", "nsenter", "ip"))
    return tools and subprocess.run(["unshare", "-n", "ip", "link", "add", "x", "type", "veth"]).returncode == 0


@pytest.mark.slow
@pytest.mark.ros
@pytest.mark.skipif(not can_have_namespaces(), reason="network namespaces need root, unshare and ip")
@pytest.mark.parametrize(("reach", "subscribers", "received"), [("closed", 0, 0), ("open", 1, 1)])
def test_a_second_host_that_knows_the_address_is_out_unless_asked(tmp_path, reach, subscribers, received):
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("ROS_", "FASTRTPS", "FASTDDS"))}
    command = ["unshare", "-n", "sh", "-c", HOSTS, "sh", reach, sys.executable, NODE, str(tmp_path / "up")]
    output = subprocess.run(command, env=kept, stdout=subprocess.PIPE, text=True, timeout=90, check=True).stdout
    assert [int(line) for line in output.split()] == [subscribers, received]
