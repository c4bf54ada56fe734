"""Parameter file and documentation against what the nodes declare, both ways."""

import re
from pathlib import Path

import yaml

from active6d_core.ros.graph_nodes import NODES
from active6d_core.ros.node import GraphNode
from active6d_tools import describe_nodes

ROOT = Path(__file__).parents[2]
FILE = ROOT / "src/active6d_bringup/config/active6d.yaml"
UPDATE = "run python -m active6d_tools.describe_nodes"


def declared(node: GraphNode) -> dict:
    """The node's own parameters and their defaults, arrays as lists."""
    foreign = ("qos_overrides.", "use_sim_time", "start_type_description_service")
    found = {name: parameter.value for name, parameter in node.get_parameters_by_prefix("").items()}
    own = {name: value for name, value in found.items() if not name.startswith(foreign)}
    return {name: value.tolist() if hasattr(value, "tolist") else value for name, value in own.items()}


def test_names_and_defaults_agree(node):
    written = yaml.safe_load(FILE.read_text())[f"/**/{node.get_name()}"]["ros__parameters"]
    defaults = declared(node)
    assert written == defaults, UPDATE
    assert [type(written[name]) for name in defaults] == [type(value) for value in defaults.values()]


def test_the_generated_sections_are_what_would_be_written_now(node):
    """Descriptions, limits and choices too, which the other tests do not look at."""
    name, file, page = node.get_name(), FILE.read_text(), (ROOT / "docs/graph.md").read_text()
    section = re.search(rf"^/\*\*/{name}:\n.*?(?=\n/\*\*/|\Z)", file, re.DOTALL | re.MULTILINE)[0]
    assert section == describe_nodes.parameter_section(name, node), UPDATE
    tables = re.search(rf"<!-- tables of {name} -->\n(.*?)\n<!-- end -->", page, re.DOTALL)[1]
    assert tables == describe_nodes.page_section(node), UPDATE


def test_the_file_has_a_section_for_every_node():
    assert re.findall(r"^/\*\*/(\w+):", FILE.read_text(), re.MULTILINE) == list(reversed(NODES)), UPDATE


def test_parameters_are_described(node):
    for name in declared(node):
        assert len(node.describe_parameter(name).description) > 10, name


def test_the_page_has_the_same_parameters(node):
    page = (ROOT / "docs/graph.md").read_text()
    section = re.search(rf"<!-- tables of {node.get_name()} -->(.*?)<!-- end -->", page, re.DOTALL)[1]
    rows = re.findall(r"^\| `(\w+)` \| `(.*?)` \| .+ \|$", section, re.MULTILINE)
    assert {name: yaml.safe_load(value) for name, value in rows} == declared(node), UPDATE


def test_the_page_has_the_same_topics(node):
    page = (ROOT / "docs/graph.md").read_text()
    section = re.search(rf"<!-- tables of {node.get_name()} -->(.*?)<!-- end -->", page, re.DOTALL)[1]
    rows = set(re.findall(r"^\| (subscribes|publishes|serves) \| `(\S+)` \|", section, re.MULTILINE))
    own = ("rcl_interfaces", "lifecycle_msgs", "type_description_interfaces")
    topics = {("subscribes", e.topic_name) for e in node.subscriptions if not e.msg_type.__module__.startswith(own)}
    topics |= {("publishes", e.topic_name) for e in node.publishers if not e.msg_type.__module__.startswith(own)}
    topics |= {("serves", s.srv_name) for s in node.services if not s.srv_type.__module__.startswith(own)}
    assert {(way, name if name[0] in "/~" else f"/{name}") for way, name in rows} == topics, UPDATE
