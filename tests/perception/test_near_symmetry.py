"""Near symmetries found from the mesh, against the symmetry groups of bodies that geometry knows."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from active6d_core.metrics import e_add
from active6d_core.object_model import ObjectModel, Symmetry, load_object
from active6d_core.se3 import is_rigid, make_transform, rotation_angle, transform_points
from active6d_perception.model.ambiguity import Ambiguity
from active6d_perception.model.model_views import model_views
from active6d_perception.model.near_symmetry import near_symmetries, telling_surface

TILT = Rotation.from_rotvec([0.4, -0.7, 1.1]).as_matrix()


def object_of(mesh, axis=None, discrete=None):
    mesh.apply_translation(-mesh.center_mass)
    span = np.linalg.norm(mesh.extents)
    symmetry = Symmetry(axis, np.eye(3)[None] if discrete is None else discrete)
    return ObjectModel("body", mesh, float(span), symmetry, (1, 1), np.ones(3), {})


def tilted(mesh):
    mesh.apply_transform(np.block([[TILT, np.zeros((3, 1))], [np.zeros((1, 3)), np.ones((1, 1))]]))
    return mesh


@pytest.mark.parametrize(
    ("sides", "count"), [((0.03, 0.07, 0.13), 4), ((0.06, 0.06, 0.12), 8), ((0.08, 0.08, 0.08), 24)]
)
def test_a_box_has_the_rotations_that_permute_its_corners(sides, count):
    mesh = tilted(trimesh.creation.box(sides))
    found = near_symmetries(object_of(mesh))
    assert found.T_object_axis is None
    assert len(found.T_object_twin) == count
    assert np.array_equal(found.T_object_twin[0], np.eye(4))
    corners = np.asarray(mesh.vertices)
    distance, corner = cKDTree(corners).query(transform_points(found.T_object_twin, corners))
    assert distance.max() < 0.002
    assert (np.sort(corner, axis=1) == np.arange(8)).all()
    assert len(np.unique(corner, axis=0)) == count


def test_a_cylinder_has_its_axis_and_one_flip():
    found = near_symmetries(object_of(tilted(trimesh.creation.cylinder(0.03, 0.1))))
    axis = TILT[:, 2]
    assert abs(found.T_object_axis[:3, 2] @ axis) > np.cos(np.radians(1))
    assert np.linalg.norm(np.cross(found.T_object_axis[:3, 3], axis)) < 0.001
    assert len(found.T_object_twin) == 2
    assert found.T_object_twin[1, :3, :3] @ axis @ axis < -0.999
    about = found.rotations_about_axis(np.radians([90.0, 180.0]))
    assert is_rigid(about, 1e-9)
    assert np.degrees(rotation_angle(about[:, :3, :3], np.eye(3))) == pytest.approx([90, 180])


def test_a_cone_has_its_axis_and_no_flip():
    found = near_symmetries(object_of(trimesh.creation.cone(0.05, 0.1)))
    assert abs(found.T_object_axis[2, 2]) > 0.9999
    assert len(found.T_object_twin) == 1


def test_declared_symmetries_are_not_near_symmetries():
    flip = np.stack([np.eye(3), np.diag([1.0, -1.0, -1.0])])
    once = near_symmetries(object_of(trimesh.creation.cylinder(0.03, 0.1), np.array([0.0, 0.0, 1.0])))
    assert once.T_object_axis is None
    assert len(once.T_object_twin) == 2
    both = near_symmetries(object_of(trimesh.creation.cylinder(0.03, 0.1), np.array([0.0, 0.0, 1.0]), flip))
    assert len(both.T_object_twin) == 1
    with pytest.raises(ValueError, match="no axis"):
        both.rotations_about_axis(np.zeros(1))


def test_an_object_without_symmetry_has_no_twin():
    mesh = trimesh.creation.icosphere(4)
    x, y, z = np.asarray(mesh.vertices).T
    mesh.vertices *= 0.05 * (1 + 0.5 * x + 0.5 * np.sin(3 * y + 1) * z + 0.4 * np.cos(4 * x) * y)[:, None]
    for model in (object_of(mesh), load_object("bunny")):
        found = near_symmetries(model)
        assert found.T_object_axis is None
        assert len(found.T_object_twin) == 1


def test_a_cup_and_a_mug_have_twins_upside_down():
    cup, mug = load_object("coffee_cup"), load_object("mug")
    for model in (cup, mug):
        found = near_symmetries(model)
        assert len(found.T_object_twin) == 2
        assert found.T_object_twin[1, 2, 2] < -0.9
        assert found is near_symmetries(model)
    # The axis of the mug's body is beside the centroid, since the handle moves the centroid.
    body = near_symmetries(mug).T_object_axis
    assert abs(body[2, 2]) > 0.9999
    low, high = mug.mesh.bounds
    assert body[:2, 3] == pytest.approx([(low[0] + high[0]) / 2, low[1] + (high[0] - low[0]) / 2], abs=3e-4)


def test_the_handle_tells_a_mug_from_one_turned_about_its_axis():
    mug = load_object("mug")
    views, found = model_views(mug), near_symmetries(mug)
    half_turn = found.rotations_about_axis(np.array([np.pi]))
    tells = telling_surface(mug, half_turn, views.points, views.normals)[0]
    handle = mug.feature_mask("handle", views.points)
    assert tells[handle].mean() > 0.8
    assert tells[~handle].mean() < 0.05
    assert telling_surface(mug, np.eye(4)[None], views.points, views.normals).mean() < 0.02


def dihedral(order: int) -> np.ndarray:
    """(2 * order, 3, 3) the rotations of a prism about z, and its flips."""
    turns = Rotation.from_rotvec(np.outer(np.arange(order), [0.0, 0.0, 2 * np.pi / order])).as_matrix()
    return np.concatenate([turns, turns @ np.diag([1.0, -1.0, -1.0])])


def prism_of(sides: int, radius: float, height: float, turned: np.ndarray = TILT) -> ObjectModel:
    """A regular prism with its declared symmetries, in a frame of its own."""
    mesh = trimesh.creation.cylinder(radius, height, sections=sides)
    mesh.apply_transform(make_transform(turned, np.zeros(3)))
    return object_of(mesh, discrete=turned @ dihedral(sides) @ turned.T)


@pytest.fixture(scope="module")
def hexagonal():
    return Ambiguity(prism_of(6, 0.035, 0.1))


@pytest.mark.parametrize(
    ("sides", "radius", "height", "count"), [(6, 0.03, 0.02, 6), (8, 0.04, 0.06, 6), (40, 0.03, 0.1, 1)]
)
def test_rotations_are_over_the_sector_that_declared_symmetries_leave(sides, radius, height, count):
    ambiguity = Ambiguity(prism_of(sides, radius, height))
    assert len(ambiguity.rotations) == count
    angles = np.degrees(rotation_angle(ambiguity.rotations[:, :3, :3], np.eye(3)))
    assert angles == pytest.approx(np.arange(count) * 360 / sides / count, abs=1e-6)
    axis = TILT[:, 2]
    np.testing.assert_allclose(ambiguity.rotations[:, :3, :3] @ axis, np.tile(axis, (count, 1)), atol=1e-9)
    np.testing.assert_allclose(ambiguity.middle, np.zeros(3), atol=0.002)
    assert np.isfinite(ambiguity.solid.reach)


def test_an_undeclared_prism_keeps_the_rotations_of_a_full_turn(hexagonal):
    model = replace(hexagonal.model, symmetry=Symmetry(None, np.eye(3)[None]))
    assert len(Ambiguity(model).rotations) == 36


def test_errors_between_rotations_are_add_with_the_declared_symmetries(hexagonal):
    rotations, model = hexagonal.rotations, hexagonal.model
    expected = e_add(model, rotations[:, None], rotations[None])
    # Of every fifth point only.
    np.testing.assert_allclose(hexagonal.rotation_errors, expected, rtol=0.03, atol=1e-6)
    assert hexagonal.rotation_errors[0, 5] == pytest.approx(hexagonal.rotation_errors[0, 1], rel=0.01)


def test_the_mean_of_both_ends_of_a_sector_lies_between_them(hexagonal):
    weight = np.zeros((2, 6))
    weight[0, [0, 5]], weight[1, [1, 2, 3]] = 0.5, 1 / 3
    ends, middle = hexagonal.mean_rotation(weight)
    np.testing.assert_allclose(middle, hexagonal.rotations[2], atol=1e-9)
    # Half a step before the first: 5 degrees from the declared symmetry that is the identity.
    assert np.degrees(rotation_angle(ends[:3, :3], np.eye(3))) == pytest.approx(5, abs=1e-6)
    assert e_add(hexagonal.model, ends, hexagonal.rotations[0]) == pytest.approx(
        e_add(hexagonal.model, ends, hexagonal.rotations[5])
    )


def test_distance_of_bodies_is_the_least_over_declared_symmetries_and_turns(hexagonal):
    model, rng = hexagonal.model, np.random.default_rng(2)
    T = make_transform(Rotation.random(4, random_state=1).as_matrix(), rng.uniform(-0.05, 0.05, (4, 3)))
    same = T[0] @ make_transform(model.symmetry.discrete, np.zeros(3))
    assert hexagonal.body_distance.between(T[:1], same).max() < 1e-6
    # Brute force: the best of all products of turns by a degree and declared symmetries.
    axis, points = TILT[:, 2], model.surface[0]
    turns = Rotation.from_rotvec(np.outer(np.radians(np.arange(360)), axis)).as_matrix()
    alike = make_transform(np.concatenate([turns, turns @ model.symmetry.discrete[6]]), np.zeros(3))
    # All that look the same together are symmetric, whereas the samples are not exactly.
    points = np.concatenate([points[:500] @ g.T for g in alike[::30, :3, :3]])

    def apart(a, b):
        moved = transform_points(b @ alike[::3], points) - transform_points(a, points)
        return np.sqrt((moved**2).sum(axis=2).mean(axis=1)).min()

    expected = [[apart(a, b) for b in T] for a in T]
    np.testing.assert_allclose(hexagonal.body_distance.between(T, T), expected, rtol=0.02, atol=1e-6)


def test_a_flip_about_an_axis_beside_the_origin_is_respected():
    """A mug with its handle at half height, and no bottom."""
    handle = trimesh.creation.box((0.03, 0.01, 0.03))
    handle.apply_translation((0.053, 0.0, 0.0))
    mesh = trimesh.util.concatenate([trimesh.creation.cylinder(0.04, 0.1), handle])
    mesh.apply_transform(make_transform(TILT, np.zeros(3)))
    flip = TILT @ np.diag([1.0, -1.0, -1.0]) @ TILT.T
    ambiguity = Ambiguity(object_of(mesh, discrete=np.stack([np.eye(3), flip])))
    assert len(ambiguity.rotations) == 36
    # The handle moves the centroid off the axis.
    assert np.linalg.norm(ambiguity.rotations[18, :3, 3]) > 0.001
    T = make_transform(Rotation.random(random_state=3).as_matrix(), np.array([0.1, 0.2, 0.3]))
    for alike in (T @ ambiguity.rotations, T @ make_transform(flip, np.zeros(3)) @ ambiguity.rotations):
        assert ambiguity.body_distance.between(T[None], alike).max() < 1e-6


def test_an_axis_that_a_declared_symmetry_moves_is_none():
    """A football looks nearly the same at any rotation; its declared ones are those of an icosahedron."""
    mesh = trimesh.creation.icosphere(1, 0.05)
    group, corners = Rotation.create_group("I").as_matrix(), np.asarray(mesh.vertices)
    distance, _ = cKDTree(corners).query(corners @ np.swapaxes(group, 1, 2))
    assert distance.max() < 1e-6
    assert near_symmetries(object_of(mesh)).T_object_axis is not None
    found = near_symmetries(object_of(mesh, discrete=group))
    assert found.T_object_axis is None
    assert found.order == 1
