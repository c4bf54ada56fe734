"""One node after the other, as the packaging tests look at them: at their defaults, not configured."""

import pytest
from rclpy.context import Context
from ros_harness import fresh_domain

from active6d_bringup.graph.composition import load_node_type
from active6d_core.registry import BUILT_IN, Registry
from active6d_core.ros.graph_nodes import NODES


@pytest.fixture(params=NODES)
def node(request, monkeypatch):
    """Each node at its defaults, not configured.

    Its choices are those of active6d alone: tests of other modules register parts, and so do installed packages.
    """
    monkeypatch.setattr(Registry, "origins", lambda self: dict.fromkeys(self._built_in, BUILT_IN))
    context = Context()
    context.init(args=[], domain_id=fresh_domain())
    node = load_node_type(request.param)(context=context)
    assert node.get_name() == request.param
    yield node
    node.destroy_node()
    context.try_shutdown()
