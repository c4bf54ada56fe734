"""Scenes and observations for policies, made by hand."""

import numpy as np
import pytest
import trimesh

from active6d_agent.policies.registry import Observation
from active6d_core.hypotheses import SceneObjects
from active6d_core.object_model import ObjectModel, Symmetry
from active6d_core.se3 import make_transform
from active6d_core.view_sphere import ViewSphere


@pytest.fixture(scope="session")
def model() -> ObjectModel:
    """A ball, 0.1 m across."""
    return ObjectModel(
        name="ball",
        mesh=trimesh.creation.icosphere(subdivisions=2, radius=0.05),
        diameter=0.1,
        symmetry=Symmetry(None, np.eye(3)[None]),
        instances=(3, 6),
        color=np.full(3, 0.5),
        features={},
    )


@pytest.fixture
def make_objects():
    """Objects at given centres with given verification scores."""

    def make(centres=(), verification=()) -> SceneObjects:
        n = len(verification)
        centres = np.asarray(centres, float).reshape(n, 3)
        return SceneObjects(
            T_world_object=make_transform(np.eye(3), centres) if n else np.zeros((0, 4, 4)),
            verification=np.asarray(verification, float),
            score=np.full(n, 0.5),
            box=np.tile([0.4, 0.4, 0.6, 0.6], (n, 1)),
            depth=np.full(n, 0.8),
            support=np.ones(n, int),
            spread=np.zeros(n),
            probability=np.full(n, 0.5),
            entropy=np.zeros(n),
        )

    return make


@pytest.fixture
def observe(make_objects):
    """An observation after the given views of the default grid."""

    def make(views, steps=5, objects=None, allowed=None, metres_left=np.inf) -> Observation:
        sphere = ViewSphere()
        return Observation(
            objects=make_objects() if objects is None else objects,
            positions=sphere.positions[list(views)],
            sphere=sphere,
            allowed=np.ones(len(sphere), bool) if allowed is None else allowed,
            steps_left=steps - (len(views) - 1),
            metres_left=metres_left,
        )

    return make
