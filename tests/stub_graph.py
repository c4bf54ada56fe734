"""Stubs in place of the camera and the estimator: ``active6d episode --import stub_graph --estimator stub``."""

import stub_camera  # noqa: F401  registers the estimator
from stub_nodes import STUBS

from active6d_core.ros.graph_nodes import NODES

NODES.update(STUBS)
