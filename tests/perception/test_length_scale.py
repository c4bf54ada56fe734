"""How near two objects can be, by their shape."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hand_made_scenes import make_model
from scipy.spatial.transform import Rotation

from active6d_core.object_model import load_object
from active6d_core.se3 import make_transform
from active6d_perception.model.ambiguity import ambiguity_of
from active6d_perception.model.length_scale import slimness, spacing


@pytest.mark.parametrize("name", ["mug", "coffee_cup", "bunny"])
def test_the_shipped_objects_are_not_slim(name):
    """Their weights and banks depend on it."""
    model = load_object(name)
    assert slimness(model) == 1.0
    assert ambiguity_of(model).spacing == model.diameter


@pytest.mark.parametrize(("thickness", "expected"), [(0.2, 0.1), (0.14, 0.1), (0.1, 0.075), (0.04, 0.03)])
def test_a_fifth_of_the_spacing_is_three_quarters_of_the_thickness(thickness, expected):
    """Of bars with a diameter of 0.5 m, in a frame of their own; no more than a fifth of the diameter."""
    length = np.sqrt(0.5**2 - 2 * thickness**2)
    bar = trimesh.creation.box((thickness, length, thickness))
    bar.apply_transform(make_transform(Rotation.from_rotvec([0.4, -0.7, 1.1]).as_matrix(), np.zeros(3)))
    model = replace(make_model(bar), diameter=0.5)
    assert 0.2 * spacing(model) == pytest.approx(expected, rel=1e-6)


def test_a_needle_keeps_a_quarter_of_its_spacing():
    needle = make_model(trimesh.creation.cylinder(0.001, 0.2))
    assert spacing(needle) == pytest.approx(0.25 * needle.diameter)
