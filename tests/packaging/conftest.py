"""One node after the other, as the packaging tests look at them: at their defaults, not configured."""

import pytest
from rclpy.context import Context
from ros_harness import fresh_domain

from active6d_bringup.graph.composition import load_node_type
from active6d_core.ros.graph_nodes import NODES


@pytest.fixture(params=NODES)
def node(request):
    """Each node at its defaults, not configured."""
    context = Context()
    context.init(args=[], domain_id=fresh_domain())
    node = load_node_type(request.param)(context=context)
    assert node.get_name() == request.param
    yield node
    node.destroy_node()
    context.try_shutdown()
