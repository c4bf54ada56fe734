"""Groups of rotations, against the orders that geometry knows."""

import time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from active6d_core.rotation_group import rotation_group


def rotations(*degrees):
    return Rotation.from_rotvec(degrees, degrees=True).as_matrix()


def test_two_turns_of_an_icosahedron_make_its_sixty_rotations():
    # Neighbouring fivefold axes, through corners of the icosahedron.
    golden = (1 + np.sqrt(5)) / 2
    axes = np.array([[0.0, 1.0, golden], [0.0, -1.0, golden]]) / np.hypot(1.0, golden)
    group = rotation_group(rotations(*(72.0 * axes)))
    assert len(group) == 60
    angles = np.degrees(Rotation.from_matrix(group).magnitude()).round().astype(int)
    assert dict(zip(*np.unique(angles, return_counts=True), strict=True)) == {0: 1, 72: 12, 120: 20, 144: 12, 180: 15}


def test_a_group_of_which_every_rotation_is_listed_takes_little_time():
    """119 rotations have 14,000 products; comparing all of them with each other took 15 GB."""
    group = rotation_group(rotations([0.0, 0.0, 6.0], [180.0, 0.0, 0.0]))
    assert len(group) == 120
    start = time.process_time()
    assert len(rotation_group(group[1:])) == 120
    assert time.process_time() - start < 5.0


def test_rotations_without_a_finite_group_are_refused():
    with pytest.raises(ValueError, match="no finite group of at most 120 rotations"):
        rotation_group(rotations([0.0, 0.0, 90.0], [40.0, 0.0, 0.0]))
