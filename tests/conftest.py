"""What all tests share: the packages on the path, ROS kept to this machine, and the graph harness."""

import os
import sys
from pathlib import Path

import pytest

TESTS = Path(__file__).parent
SOURCES = sorted(str(path) for path in (TESTS.parent / "src").glob("active6d_*"))
sys.path[:0] = [str(TESTS), *(path for path in SOURCES if path not in sys.path)]
# Child processes (nodes under `--processes`, the command) import the same sources.
os.environ["PYTHONPATH"] = os.pathsep.join([str(TESTS), *SOURCES, os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
# Several threads that share busy cores wait for each other most of the time.
os.environ["OMP_NUM_THREADS"] = "1"
# What starts nodes without the fixtures for it: in processes, through the command, or in contexts of its own.
STARTS_NODES = {"test_episode", "test_graph_loop", "test_processes", "test_cli_episode", "test_graph_benchmark"}
# Must be set before the first rclpy import.
os.environ.setdefault("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")

from active6d_core.ros.network import keep_on_this_machine  # noqa: E402

keep_on_this_machine()


@pytest.fixture
def graph():
    """A fresh :class:`ros_harness.GraphHarness`, closed after the test."""
    from ros_harness import GraphHarness

    harness = GraphHarness()
    yield harness
    harness.close()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what starts a node: whatever takes the graph or a node, and the modules that start them otherwise."""
    for item in items:
        if {"graph", "node"} & set(item.fixturenames) or item.path.stem in STARTS_NODES:
            item.add_marker(pytest.mark.ros)
