"""The SROS 2 policy is well formed and allows every node its topics, and no other node's."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from active6d_core.ros.graph_nodes import NODES
from active6d_core.ros.topics import CONTRACT, DIAGNOSTICS

POLICY = Path(__file__).parents[2] / "src/active6d_bringup/config/sros2/policy.xml"


@pytest.fixture(scope="module")
def enclaves():
    """Node name to its (published, subscribed) topics."""
    root = ElementTree.parse(POLICY).getroot()
    assert (root.tag, root.get("version")) == ("policy", "0.2.0")
    found = {}
    for enclave in root.iterfind("enclaves/enclave"):
        (profile,) = enclave.iterfind("profiles/profile")
        assert enclave.get("path") == f"/active6d/{profile.get('node')}"
        topics = {}
        for group in profile.iterfind("topics"):
            (kind,) = group.keys()
            assert kind in ("publish", "subscribe")
            assert group.get(kind) == "ALLOW"
            topics[kind] = {topic.text for topic in group.iterfind("topic")}
        found[profile.get("node")] = topics["publish"], topics["subscribe"]
    return found


def test_every_node_may_publish_its_own_topics_only(enclaves):
    cameras = {"camera_simulator", "dataset_camera", "bag_player"}
    for topic in CONTRACT:
        publishers = {name for name, (published, _) in enclaves.items() if topic.name in published}
        if topic is DIAGNOSTICS:
            assert publishers == enclaves.keys()
        elif topic.publisher == "camera":
            assert publishers == cameras
        else:
            assert publishers - {"bag_player"} == {topic.publisher}


def test_the_recorder_hears_everything_and_every_node_has_an_enclave(enclaves):
    assert {topic.name for topic in CONTRACT} <= enclaves["episode_recorder"][1]
    assert enclaves.keys() == NODES.keys() - {"camera_adapter"}
