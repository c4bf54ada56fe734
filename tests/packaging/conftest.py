"""One node after the other, as the packaging tests look at them: at their defaults, not configured."""

import inspect
from importlib import import_module

import pytest
from rclpy.context import Context

from active6d_core.node import GraphNode

NODES = {
    "camera_simulator": "active6d_sim",
    "dataset_camera": "active6d_sim",
    "pose_estimator": "active6d_perception",
    "hypothesis_fusion": "active6d_perception",
    "attention_policy": "active6d_agent",
    "episode_recorder": "active6d_bringup",
    "bag_player": "active6d_bringup",
}


@pytest.fixture(params=NODES)
def node(request):
    """Each node at its defaults, not configured."""
    module = import_module(f"{NODES[request.param]}.nodes.{request.param}")
    classes = [c for c in vars(module).values() if inspect.isclass(c) and c.__module__ == module.__name__]
    (node_class,) = [c for c in classes if issubclass(c, GraphNode)]
    context = Context()
    context.init()
    node = node_class(context=context)
    assert node.get_name() == request.param
    yield node
    node.destroy_node()
    context.try_shutdown()
