"""Write the declared parameters and topics of all nodes to the parameter file and to the tables of docs/graph.md.

Run it after changing a parameter or a topic: `python -m active6d_tools.describe_nodes`
"""

from collections.abc import Iterator
from pathlib import Path

import yaml
from rclpy.context import Context
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy

from active6d_bringup.graph.composition import load_node_type
from active6d_core.ros.graph_nodes import NODES
from active6d_core.ros.node import GraphNode
from active6d_core.ros.parameters import describe_limits

ROOT = Path(__file__).parents[3]
PARAMETER_FILE = ROOT / "src/active6d_bringup/config/active6d.yaml"
GRAPH_PAGE = ROOT / "docs/graph.md"
# What rclpy itself declares: every node has it, nobody sets it in a file.
FOREIGN = ("qos_overrides.", "use_sim_time", "start_type_description_service")
HEADER = """\
# Every parameter of every node at its default; `ros2 run PACKAGE NODE --ros-args --params-file THIS_FILE`.
# Written by python -m active6d_tools.describe_nodes.
"""


def parameters(node: GraphNode) -> Iterator[tuple[Parameter, str, str]]:
    """Each declared parameter, its description and its limits."""
    for name in sorted(node.get_parameters_by_prefix("")):
        if not name.startswith(FOREIGN):
            descriptor = node.describe_parameter(name)
            yield node.get_parameter(name), descriptor.description, describe_limits(descriptor)


def as_yaml(value: object) -> str:
    """A parameter's value on one line of YAML."""
    return yaml.safe_dump(value, default_flow_style=True, width=1000).removesuffix("...\n").strip()


def relative(name: str) -> str:
    """A name without the root namespace; diagnostics belong to the machine."""
    return name if name == "/diagnostics" else name.removeprefix("/")


def endpoints(node: GraphNode) -> Iterator[tuple[str, str, str, str]]:
    """Direction, name, type and durability of each topic and service, rclpy's own left out."""
    for direction, found in (("subscribes", node.subscriptions), ("publishes", node.publishers)):
        for endpoint in sorted(found, key=lambda endpoint: endpoint.topic_name):
            module = endpoint.msg_type.__module__.split(".")[0]
            if module in ("rcl_interfaces", "lifecycle_msgs"):
                continue
            latched = endpoint.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
            yield (
                direction,
                relative(endpoint.topic_name),
                f"{module}/{endpoint.msg_type.__name__}",
                "transient local" if latched else "",
            )
    for service in sorted(node.services, key=lambda service: service.srv_name):
        module = service.srv_type.__module__.split(".")[0]
        if module not in ("rcl_interfaces", "lifecycle_msgs", "type_description_interfaces"):
            yield "serves", relative(service.srv_name), f"{module}/{service.srv_type.__name__}", ""


def parameter_section(executable: str, node: GraphNode) -> str:
    """The node's part of the parameter file, for any namespace."""
    lines = [f"/**/{executable}:", "  ros__parameters:"]
    for parameter, description, limits in parameters(node):
        comment = f"{description} ({limits})" if limits else description
        lines.append(f"    # {comment}\n    {parameter.name}: {as_yaml(parameter.value)}")
    return "\n".join(lines) + "\n"


def page_section(node: GraphNode) -> str:
    """The node's tables for docs/graph.md."""
    lines = ["| | topic or service | type | |", "|---|---|---|---|"]
    lines += [f"| {way} | `{name}` | {kind} | {note} |" for way, name, kind, note in endpoints(node)]
    lines += ["", "| parameter | default | meaning |", "|---|---|---|"]
    for parameter, description, limits in parameters(node):
        meaning = f"{description} ({limits})" if limits else description
        lines.append(f"| `{parameter.name}` | `{as_yaml(parameter.value)}` | {meaning} |")
    return "\n".join(lines).replace("||", "\\|\\|")


def main() -> None:
    """Write both files."""
    context = Context()
    context.init()
    page, sections = GRAPH_PAGE.read_text(), []
    for name in reversed(NODES):  # from the camera on, as the data go
        node = load_node_type(name)(context=context)
        sections.append(parameter_section(name, node))
        before, marker, rest = page.partition(f"<!-- tables of {name} -->\n")
        page = f"{before}{marker}{page_section(node)}\n<!-- end -->{rest.partition('<!-- end -->')[2]}"
        node.destroy_node()
    context.try_shutdown()
    PARAMETER_FILE.write_text(HEADER + "\n" + "\n".join(sections))
    GRAPH_PAGE.write_text(page)


if __name__ == "__main__":
    main()
