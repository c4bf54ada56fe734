"""Meshes as users bring them: repaired where that is safe, else refused with the likely cause."""

import numpy as np
import pytest
import trimesh
import yaml

from active6d_core.mesh_file import close_mesh, load_mesh, mesh_notes
from active6d_core.object_model import read_description

BOX = trimesh.creation.box((0.08, 0.06, 0.04))


def describe(tmp_path, mesh, ending="ply", scale=1.0):
    mesh.export(tmp_path / f"part.{ending}")
    keys = {"name": "part", "mesh": f"part.{ending}", "scale": scale, "instances": [1, 2], "color": [0.5, 0.5, 0.5]}
    (tmp_path / "part.yaml").write_text(yaml.safe_dump(keys))
    return tmp_path / "part.yaml"


def open_box(shift=(0, 0, 0)):
    mesh = BOX.copy()
    mesh.update_faces(mesh.face_normals[:, 2] > -0.5)
    mesh.remove_unreferenced_vertices()
    mesh.apply_translation(shift)
    return mesh


@pytest.mark.parametrize("shift", [(0, 0, 0), (0.5, 0.2, 0.1), (0, 0, 1.0), (0, 0, -1.0)])
def test_an_open_box_is_closed_wherever_it_lies(tmp_path, shift):
    model = read_description(describe(tmp_path, open_box(shift)))
    np.testing.assert_allclose(model.origin, shift, atol=1e-5)
    np.testing.assert_allclose(model.mesh.bounds, BOX.bounds, atol=1e-5)


@pytest.mark.parametrize("turned", [slice(None), slice(0, 4)])
def test_faces_that_point_inwards_are_turned(tmp_path, turned):
    mesh = BOX.copy()
    faces = mesh.faces.copy()
    faces[turned] = faces[turned, ::-1]
    mesh = trimesh.Trimesh(mesh.vertices, faces, process=False)
    model = read_description(describe(tmp_path, mesh))
    assert model.mesh.volume == pytest.approx(BOX.volume, rel=1e-4)
    outward = np.einsum("ij,ij->i", model.mesh.face_normals, model.mesh.triangles_center)
    assert (outward > 0).all()


def test_a_sound_mesh_stays_as_it_is():
    mesh = BOX.copy()
    assert close_mesh(mesh) == []
    np.testing.assert_array_equal(mesh.faces, BOX.faces)


def with_normals(path):
    corners = trimesh.Trimesh(BOX.triangles.reshape(-1, 3), np.arange(36).reshape(-1, 3), process=False)
    corners.vertex_normals = np.repeat(BOX.face_normals, 3, axis=0)
    corners.export(path, include_normals=True)


def with_texture(path):
    lines = [f"v {x} {y} {z}" for x, y, z in BOX.vertices]
    lines += [f"vt {u} {v}" for u, v in np.random.default_rng(0).random((36, 2))]
    for face, (a, b, c) in enumerate(BOX.faces + 1):
        lines.append(f"f {a}/{3 * face + 1} {b}/{3 * face + 2} {c}/{3 * face + 3}")
    path.write_text("\n".join(lines))


@pytest.mark.parametrize(("name", "write"), [("box.glb", with_normals), ("box.obj", with_texture)])
def test_seams_of_normals_and_textures_are_no_holes(tmp_path, name, write):
    write(tmp_path / name)
    mesh = load_mesh(tmp_path / name)
    assert close_mesh(mesh) == []
    assert (len(mesh.vertices), len(mesh.faces)) == (8, 12)
    assert mesh.volume == pytest.approx(BOX.volume, rel=1e-5)


def test_what_was_done_is_said():
    assert close_mesh(open_box((0, 0, 1.0))) == ["holes closed with 2 faces"]


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (1000.0, r"107.7 m in diameter; is it in millimetres: scale 0.001 makes it 108 mm"),
        (1e-3, "0.0001077 m in diam"),
    ],
)
def test_an_impossible_size_asks_for_the_unit(tmp_path, factor, words):
    mesh = BOX.copy()
    mesh.apply_scale(factor)
    with pytest.raises(ValueError, match=words):
        read_description(describe(tmp_path, mesh, "stl"))
    if factor > 1:
        assert read_description(describe(tmp_path, mesh, "stl", 1e-3)).diameter == pytest.approx(0.1077, rel=1e-3)


def test_a_sheet_has_no_inside(tmp_path):
    sheet = trimesh.Trimesh([[0, 0, 0], [0.1, 0, 0], [0.1, 0.05, 0], [0, 0.05, 0]], [[0, 1, 2], [0, 2, 3]])
    with pytest.raises(ValueError, match="mesh has no inside: it is open at 4 edges"):
        read_description(describe(tmp_path, sheet))


def test_points_and_broken_numbers_are_refused(tmp_path):
    trimesh.PointCloud(np.random.default_rng(0).random((50, 3))).export(tmp_path / "cloud.ply")
    with pytest.raises(ValueError, match="no faces"):
        load_mesh(tmp_path / "cloud.ply")
    BOX.export(tmp_path / "box.off")
    text = (tmp_path / "box.off").read_text()
    (tmp_path / "box.off").write_text(text.replace("-0.04", "nan", 1))
    with pytest.raises(ValueError, match=r"not finite|cannot be read"):
        load_mesh(tmp_path / "box.off")


def test_a_stray_vertex_does_not_make_the_object_large(tmp_path):
    mesh = trimesh.Trimesh(np.vstack([BOX.vertices, [[10, 10, 10]]]), BOX.faces, process=False)
    assert read_description(describe(tmp_path, mesh)).diameter == pytest.approx(0.1077, rel=1e-3)


def test_what_of_a_file_is_used_otherwise_than_expected_is_said(tmp_path):
    two = trimesh.util.concatenate(
        [trimesh.creation.box((1, 1, 1)), trimesh.creation.box((1, 1, 1)).apply_translation((3, 0, 0))]
    )
    two.export(tmp_path / "two.stl")
    (note,) = mesh_notes(tmp_path / "two.stl")
    assert "2 separate bodies" in note
    trimesh.creation.box((1, 1, 1)).export(tmp_path / "one.obj")
    plain = (tmp_path / "one.obj").read_text()
    (tmp_path / "plain.obj").write_text("".join(line for line in plain.splitlines(True) if "mtl" not in line))
    assert mesh_notes(tmp_path / "plain.obj") == []
    (tmp_path / "painted.obj").write_text(f"mtllib painted.mtl\n{plain}")
    (note,) = mesh_notes(tmp_path / "painted.obj")
    assert "textures of the file are not used" in note


def test_a_mesh_that_the_file_rounds_is_noticed(tmp_path):
    BOX.copy().apply_translation((5000.0, 0, 0)).export(tmp_path / "far.stl")
    (note,) = mesh_notes(tmp_path / "far.stl")
    assert "so far from the file's origin" in note
    BOX.copy().apply_translation((5.0, 0, 0)).export(tmp_path / "near.stl")
    assert mesh_notes(tmp_path / "near.stl") == []


def test_files_that_are_no_mesh_are_refused_with_their_cause(tmp_path):
    (tmp_path / "a.stl").write_bytes(b"")
    (tmp_path / "b.stl").write_text("<html>not found</html>")
    with pytest.raises(ValueError, match=r"a.stl is an empty file"):
        load_mesh(tmp_path / "a.stl")
    with pytest.raises(ValueError, match=r"b.stl has no faces.*no mesh"):
        load_mesh(tmp_path / "b.stl")


def test_sizes_that_no_unit_explains_name_the_limits(tmp_path):
    tiny = trimesh.creation.box((5e-7, 4e-7, 3e-7))
    with pytest.raises(ValueError, match=r"not within 0\.002 to 2 m"):
        read_description(describe(tmp_path, tiny))
