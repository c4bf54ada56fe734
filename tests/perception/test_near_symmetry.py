"""Near symmetries found from the mesh, against the symmetry groups of bodies that geometry knows."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from active6d_core.object_model import ObjectModel, Symmetry, load_object
from active6d_core.se3 import is_rigid, rotation_angle, transform_points
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
