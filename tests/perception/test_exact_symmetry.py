"""Symmetries found from meshes, against the symmetry groups of bodies that geometry knows."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from active6d_core.object_model import ObjectModel, Symmetry, load_object
from active6d_core.rotation_group import rotation_group
from active6d_perception.model.exact_symmetry import Turn, TurnedSurface, exact_symmetries

TILT = Rotation.from_rotvec([0.4, -0.7, 1.1]).as_matrix()


def object_of(mesh, tilt=None):
    if tilt is not None:
        mesh.vertices = mesh.vertices @ tilt.T
    mesh.apply_translation(-mesh.center_mass)
    symmetry = Symmetry(None, np.eye(3)[None])
    return ObjectModel("body", mesh, float(np.linalg.norm(mesh.extents)), symmetry, (1, 1), np.ones(3), {})


def prism(sides):
    return trimesh.creation.cylinder(0.03, 0.04, sections=sides)


def corners_kept(group, corners):
    """Whether (s, 3, 3) rotations map (n, 3) corners onto corners, to half a millimetre."""
    moved = np.einsum("sij,nj->sni", group, corners)
    return np.linalg.norm(moved[:, :, None] - corners, axis=-1).min(axis=2).max() < 5e-4


@pytest.mark.parametrize("tilt", [None, TILT], ids=["upright", "tilted"])
@pytest.mark.parametrize(
    ("mesh", "fold", "size"),
    [
        (lambda: trimesh.creation.box((0.03, 0.07, 0.13)), 2, 4),
        (lambda: trimesh.creation.box((0.06, 0.06, 0.12)), 4, 8),
        (lambda: prism(3), 3, 6),
        (lambda: prism(6), 6, 12),
        (lambda: prism(7), 7, 14),
    ],
    ids=["brick", "square", "three", "six", "seven"],
)
def test_prisms_have_their_dihedral_groups(mesh, fold, size, tilt):
    model = object_of(mesh(), tilt)
    found = exact_symmetries(model)
    assert found.axis is None
    assert [turn.fold for turn in found.turns] == [fold, 2]
    group = rotation_group(np.concatenate([turn.rotations for turn in found.turns]))
    assert len(group) == size
    corners = np.asarray(model.mesh.vertices)
    assert corners_kept(group, corners[np.linalg.norm(corners, axis=1) > 0.025])


def test_a_cube_along_its_frame_has_24_rotations():
    turns = exact_symmetries(object_of(trimesh.creation.box((0.08, 0.08, 0.08)))).turns
    assert len(rotation_group(np.concatenate([turn.rotations for turn in turns]))) == 24


@pytest.mark.parametrize(
    ("mesh", "flips"),
    [(lambda: trimesh.creation.cylinder(0.03, 0.1), True), (lambda: trimesh.creation.cone(0.03, 0.1), False)],
    ids=["cylinder", "cone"],
)
def test_a_round_body_has_its_axis_and_at_most_a_flip(mesh, flips):
    found = exact_symmetries(object_of(mesh(), TILT))
    assert abs(found.axis @ TILT[:, 2]) > np.cos(np.radians(0.5))
    assert [turn.fold for turn in found.turns] == [2] * flips
    assert all(abs(turn.axis @ found.axis) < 1e-6 for turn in found.turns)


@pytest.mark.parametrize("name", ["mug", "bunny"])
def test_nearly_symmetric_objects_have_none(name):
    found = exact_symmetries(load_object(name))
    assert found.axis is None
    assert not found.turns


def test_sides_that_differ_by_a_twentieth_are_not_equal():
    turns = exact_symmetries(object_of(trimesh.creation.box((0.06, 0.063, 0.1)))).turns
    assert len(rotation_group(np.concatenate([turn.rotations for turn in turns]))) == 4


@pytest.mark.parametrize(("radius", "folds"), [(0.003, [2, 2]), (0.012, [])], ids=["small", "large"])
def test_a_detail_may_differ_and_a_part_may_not(radius, folds):
    """A peg near a corner of a brick; the small one has 1.4 % of the surface, the large one 9 %."""
    brick, peg = trimesh.creation.box((0.05, 0.09, 0.03)), trimesh.creation.cylinder(radius, 0.01)
    peg.apply_translation((0.012, 0.03, 0.017))
    assert [turn.fold for turn in exact_symmetries(object_of(trimesh.util.concatenate([brick, peg]))).turns] == folds


def test_deviations_are_quantiles_of_the_distance_to_the_surface():
    half = np.array([0.02, 0.035, 0.05])
    model = object_of(trimesh.creation.box(2 * half))
    R = Rotation.from_rotvec([[0.0, 0.0, np.pi / 2], [0.0, np.pi, 0.0], [0.3, 0.2, 0.1]]).as_matrix()
    # The distance to a box in closed form, outside and inside.
    beyond = np.abs(np.einsum("kij,nj->kni", R, model.surface[0][:2048])) - half
    outside, inside = np.linalg.norm(np.maximum(beyond, 0.0), axis=-1), np.minimum(beyond.max(axis=-1), 0.0)
    expected = np.quantile(outside - inside, 0.98, axis=1)
    assert expected[0] > 0.01
    assert TurnedSurface(model).deviations(R) == pytest.approx(expected, abs=1e-6)


def test_a_turn_has_all_its_rotations_but_the_identity():
    rotations = Turn(np.array([0.0, 0.6, 0.8]), 5).rotations
    assert np.degrees(Rotation.from_matrix(rotations).magnitude()) == pytest.approx([72, 144, 144, 72])
    np.testing.assert_allclose(np.linalg.matrix_power(rotations[0], 5), np.eye(3), atol=1e-12)
