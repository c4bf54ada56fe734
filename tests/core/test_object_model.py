"""Object descriptions: geometry against trimesh and brute force, and every mistake in a file named."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from active6d_core.object_model import Symmetry, list_objects, load_object, read_description

BASE = "name: thing\ninstances: [1, 3]\ncolor: [0.1, 0.2, 0.3]\n"
PROFILE = "profile: [[0, 0], [0.03, 0], [0.04, 0.1], [0, 0.1]]\n"


def write(tmp_path, text, name="thing"):
    path = tmp_path / f"{name}.yaml"
    path.write_text(text)
    return path


def test_a_revolved_profile_is_the_frustum(tmp_path):
    model = read_description(write(tmp_path, BASE + PROFILE))
    frustum = np.pi * 0.1 / 3 * (0.03**2 + 0.03 * 0.04 + 0.04**2)
    assert model.mesh.is_watertight
    assert model.mesh.volume == pytest.approx(frustum, rel=2e-3)
    # Closed form of a frustum's centroid: (r^2 + 2 r R + 3 R^2) h / (4 (r^2 + r R + R^2)) above its small base.
    centroid = 0.1 * (0.03**2 + 2 * 0.03 * 0.04 + 3 * 0.04**2) / (4 * (0.03**2 + 0.03 * 0.04 + 0.04**2))
    assert model.mesh.vertices[:, 2].min() == pytest.approx(-centroid, abs=1e-6)
    np.testing.assert_allclose(model.mesh.center_mass, 0.0, atol=1e-9)


def test_diameter_scale_and_points_of_a_mesh_file(tmp_path):
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=20.0)
    mesh.vertices *= [1.0, 2.0, 3.0]
    mesh.apply_translation([5.0, 6.0, 7.0])
    mesh.export(tmp_path / "egg.ply")
    model = read_description(write(tmp_path, BASE + "mesh: egg.ply\nscale: 0.001\n"))
    assert model.diameter == pytest.approx(pdist(model.mesh.vertices).max(), rel=1e-12)
    assert model.diameter == pytest.approx(0.12, rel=1e-3)
    np.testing.assert_allclose(model.mesh.center_mass, 0.0, atol=1e-9)
    assert len(model.error_points) == len(mesh.vertices)


def test_surface_points_lie_on_the_surface_with_outward_normals(models):
    model = models["cup"]
    points, normals = model.surface
    assert points.shape == normals.shape == (8192, 3)
    triangles = model.mesh.triangles
    everywhere = np.repeat(points[:20, None], len(triangles), axis=1).reshape(-1, 3)
    on_triangle = trimesh.triangles.closest_point(np.tile(triangles, (20, 1, 1)), everywhere)
    distance = np.linalg.norm(on_triangle - everywhere, axis=1).reshape(20, -1)
    np.testing.assert_allclose(distance.min(axis=1), 0.0, atol=1e-9)
    own = model.mesh.face_normals[distance.argmin(axis=1)]
    np.testing.assert_allclose(normals[:20], own, atol=1e-9)
    # By the divergence theorem outward normals give three times the volume (a Monte Carlo sum, so roughly).
    flux = (points * normals).sum(axis=1).mean() * model.mesh.area
    assert flux == pytest.approx(3 * model.mesh.volume, rel=0.02)
    np.testing.assert_array_equal(points, read_again(model).surface[0])
    assert len(model.error_points) == 2000


def read_again(model):
    return type(model)(**{name: getattr(model, name) for name in model.__dataclass_fields__})


def test_feature_mask(tmp_path):
    model = read_description(write(tmp_path, BASE + PROFILE + "features: {lid: [[-1, -1, 0], [1, 1, 1]]}\n"))
    points = np.array([[0, 0, 0.5], [0, 0, -0.1], [2, 0, 0.5]])
    np.testing.assert_array_equal(model.feature_mask("lid", points), [True, False, False])


@pytest.mark.parametrize(
    ("generators", "size"),
    [([[180, 0, 0]], 2), ([[0, 0, 90]], 4), ([[180, 0, 0], [0, 180, 0]], 4), ([[0, 0, 90], [90, 0, 0]], 24)],
)
def test_discrete_symmetries_are_closed_to_a_group(tmp_path, generators, size):
    symmetry = read_description(
        write(tmp_path, BASE + PROFILE + f"symmetry: {{discrete_rotvec_degrees: {generators}}}\n")
    ).symmetry
    group = symmetry.discrete
    assert len(group) == size
    np.testing.assert_array_equal(group[0], np.eye(3))
    products = (group[:, None] @ group).reshape(-1, 9)
    distance = np.abs(products[:, None] - group.reshape(1, -1, 9)).max(-1)
    assert (distance.min(axis=1) < 1e-9).all(), "products stay in the group"
    assert symmetry.rotations().shape == (size, 3, 3)


def test_continuous_symmetry_is_sampled_about_its_axis():
    axis = np.array([0.0, 0.6, 0.8])
    flip = Rotation.from_rotvec([np.pi, 0, 0]).as_matrix()
    rotations = Symmetry(axis, np.stack([np.eye(3), flip])).rotations(30.0)
    assert rotations.shape == (24, 3, 3)
    np.testing.assert_allclose(np.abs(rotations @ axis @ axis), 1.0)
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[1, 2]", "not a mapping"),
        ("a: [1", "not YAML"),
        (PROFILE, "missing keys"),
        (BASE + PROFILE + "colour: red\n", "unknown keys"),
        (BASE.replace("thing", "other") + PROFILE, "differs from the file's"),
        (BASE, "either mesh"),
        (BASE + PROFILE + "mesh: a.ply\n", "either mesh"),
        (BASE + "mesh: a.ply\n", "does not exist"),
        (BASE + "profile: [[0, 0], [0.03]]\n", "thing.yaml"),
        (BASE.replace("[1, 3]", "[3, 1]") + PROFILE, "instances"),
        (BASE.replace("[1, 3]", "4") + PROFILE, "thing.yaml"),
        (BASE.replace("0.1, ", "") + PROFILE, "color"),
        (BASE + PROFILE + "symmetry: [1]\n", "thing.yaml"),
        (BASE + PROFILE + "scale: -1\n", "scale"),
        (BASE + PROFILE + "scale: big\n", "thing.yaml"),
        (BASE + PROFILE + "symmetry: {axis: [0, 0, 0]}\n", "symmetry.axis"),
        (BASE + PROFILE + "symmetry: {axes: [0, 0, 1]}\n", "symmetry"),
        (BASE + PROFILE + "symmetry: {discrete_rotvec_degrees: [[0, 0, 50.5]]}\n", "finite group"),
        (BASE + PROFILE + "features: {lid: [1, 2]}\n", "thing.yaml"),
    ],
)
def test_a_bad_description_names_the_file_and_the_fault(tmp_path, text, message):
    path = write(tmp_path, text)
    with pytest.raises(ValueError, match=message) as error:
        read_description(path)
    assert str(path) in str(error.value)


def test_objects_are_found_on_the_path_and_unknown_ones_listed(tmp_path, monkeypatch):
    write(tmp_path, BASE.replace("thing", "found_here") + PROFILE, "found_here")
    monkeypatch.setenv("ACTIVE6D_OBJECT_PATH", str(tmp_path))
    assert "found_here" in list_objects()
    assert load_object("found_here").instances == (1, 3)
    with pytest.raises(ValueError, match=r"unknown object 'lost'.*found_here"):
        load_object("lost")


@pytest.mark.parametrize("diameter", [0.003, 0.0069, 0.04, 0.4])
def test_the_usual_bin_of_any_object_has_room_for_it(tmp_path, diameter):
    trimesh.creation.box(np.full(3, diameter / np.sqrt(3))).export(tmp_path / "part.ply")
    (tmp_path / "part.yaml").write_text("name: part\nmesh: part.ply\ninstances: [1, 1]\ncolor: [0.5, 0.5, 0.5]\n")
    model = read_description(tmp_path / "part.yaml")
    assert diameter < model.bin_width < 1.5 * diameter
    assert 0 < model.wall_height < diameter
