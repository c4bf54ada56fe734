"""Heaps that physics dropped once for all tests of them."""

import pytest

from active6d_core.object_model import load_object
from active6d_sim.physics.heap import simulate_heap
from active6d_sim.scenes.scene import Scene


@pytest.fixture(scope="session")
def bunny_heap() -> Scene:
    """Seven bunnies."""
    return simulate_heap(load_object("bunny"), 5, count=7)


@pytest.fixture(scope="session")
def mug_heap() -> Scene:
    """Eight mugs."""
    return simulate_heap(load_object("mug"), 5, count=8)
