"""Files from strangers: refused in one line before memory is taken, and never outside of what they may name."""

import io
import json
import resource
import struct
import subprocess
import sys
import zipfile

import numpy as np
import pytest
import trimesh
import yaml

from active6d_core import mesh_limits, object_model, structured_text
from active6d_core.array_archive import read_archive, read_array
from active6d_core.images import read_color
from active6d_core.mesh_file import load_mesh
from active6d_core.object_model import list_objects, load_object, read_description

BOX = trimesh.creation.box((0.08, 0.06, 0.04))
KEYS = {"name": "part", "mesh": "part.ply", "instances": [1, 2], "color": [0.5, 0.5, 0.5]}


def describe(folder, **changes):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "part.yaml").write_text(yaml.safe_dump({**KEYS, **changes}))
    return folder / "part.yaml"


def glb(scene):
    text = json.dumps(scene).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<4sIIII", b"glTF", 2, 20 + len(text), len(text), 0x4E4F534A) + text


@pytest.mark.parametrize("suffix", ["zip", "3mf", "dae", "step", "json", "xyz", "gltf"])
def test_other_formats_are_refused_whatever_is_in_them(tmp_path, suffix):
    path = tmp_path / f"part.{suffix}"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("part.stl", BOX.export(file_type="stl"))
    with pytest.raises(ValueError, match="no known format"):
        load_mesh(path)


ANNOUNCED = {
    "part.ply": b"ply\nformat binary_little_endian 1.0\nelement vertex 2000000000\nproperty float x\n"
    b"property float y\nproperty float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n",
    "part.off": b"OFF\n# a comment 1 2\n8 2000000000 0\n",
    "part.stl": b" " * 80 + struct.pack("<I", mesh_limits.MOST_FACES + 1) + bytes(50 * (mesh_limits.MOST_FACES + 1)),
    "part.obj": b"v 0 0 0\n" * 3 + b"f 1 2 3\n" * (mesh_limits.MOST_FACES + 1),
    "part.glb": glb({"accessors": [{"count": 2_000_000_000, "componentType": 5126, "type": "VEC3"}]}),
}


@pytest.mark.parametrize("name", ANNOUNCED)
def test_what_a_mesh_announces_is_limited_before_it_is_read(tmp_path, name, monkeypatch):
    (tmp_path / name).write_bytes(ANNOUNCED[name])
    monkeypatch.setattr(trimesh, "load_mesh", lambda *_, **__: pytest.fail("the reader was called"))
    with pytest.raises(ValueError, match=r"at most|too long"):
        load_mesh(tmp_path / name)


def test_a_mesh_that_is_shown_by_many_nodes_counts_for_each(tmp_path):
    node, accessor = {"mesh": 0}, {"count": 300, "componentType": 5126, "type": "VEC3"}
    meshes = [{"primitives": [{"attributes": {"POSITION": 0}}]}]
    (tmp_path / "part.glb").write_bytes(glb({"accessors": [accessor], "meshes": meshes, "nodes": [node] * 10_000}))
    with pytest.raises(ValueError, match="announces 3000000 vertices"):
        load_mesh(tmp_path / "part.glb")
    nodes = [{"children": [1, 1]}, {"mesh": 0}]
    (tmp_path / "part.glb").write_bytes(glb({"accessors": [accessor], "meshes": meshes, "nodes": nodes}))
    with pytest.raises(ValueError, match="two parents"):
        load_mesh(tmp_path / "part.glb")


@pytest.mark.parametrize("suffix", ["glb", "obj", "off", "ply", "stl"])
def test_formats_that_are_read(tmp_path, suffix):
    BOX.export(tmp_path / f"part.{suffix}")
    assert load_mesh(tmp_path / f"part.{suffix}").volume == pytest.approx(BOX.volume, rel=1e-5)


def test_text_formats_that_are_read(tmp_path):
    (tmp_path / "part.stl").write_bytes(BOX.export(file_type="stl_ascii").encode())
    (tmp_path / "part.ply").write_bytes(BOX.export(file_type="ply", encoding="ascii"))
    for name in ("part.stl", "part.ply"):
        assert load_mesh(tmp_path / name).volume == pytest.approx(BOX.volume, rel=1e-5)


def test_a_mesh_names_no_other_file(tmp_path):
    (tmp_path / "secret.mtl").write_text("newmtl a\nKd 1 0 0\nmap_Kd picture.png\n")
    text = "mtllib secret.mtl\nusemtl a\n" + trimesh.exchange.obj.export_obj(BOX, include_normals=False)
    (tmp_path / "part.obj").write_text(text)
    assert load_mesh(tmp_path / "part.obj").visual.kind != "texture"
    outside = glb({"buffers": [{"uri": "other.bin", "byteLength": 8}]})
    (tmp_path / "part.glb").write_bytes(outside)
    with pytest.raises(ValueError, match="outside of the file"):
        load_mesh(tmp_path / "part.glb")


@pytest.mark.parametrize("link", [False, True])
def test_a_mesh_outside_of_the_folder_is_refused_unless_allowed(tmp_path, link, monkeypatch):
    BOX.export(tmp_path / "part.ply")
    path = describe(tmp_path / "objects", mesh="part.ply" if link else "../part.ply")
    if link:
        (path.parent / "part.ply").symlink_to(tmp_path / "part.ply")
    with pytest.raises(ValueError, match=r"outside of the description's folder.*--allow-outside"):
        read_description(path)
    monkeypatch.setenv(object_model.ALLOW_OUTSIDE_VARIABLE, "1")
    assert read_description(path).diameter == pytest.approx(0.1077, rel=1e-3)


def test_the_diameter_of_a_smooth_mesh_takes_little_memory():
    code = (
        "import re, trimesh; from active6d_core.object_model import _diameter\n"
        "mesh = trimesh.creation.icosphere(subdivisions=6, radius=0.05); mesh.vertices *= [1.0, 0.99, 0.98]\n"
        "diameter = _diameter(mesh)\n"
        # getrusage would count the memory of the process that started this one.
        "peak = re.search(r'VmHWM:\\s+(\\d+)', open('/proc/self/status').read())[1]\n"
        "print(len(mesh.faces), diameter, int(peak) // 1024)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    faces, diameter, megabytes = map(float, result.stdout.split())
    assert faces == 81_920
    assert diameter == pytest.approx(0.1, rel=1e-6)
    assert megabytes < 1000, "all pairs of 40,962 vertices are 6,700 MB"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a: &x [1]\nb: *x\n", "alias in line 2"),
        ("a: &x {<<: *x}\n", "alias"),
        ("[" * 100 + "]" * 100, "inside one another"),
        ("- 1\n" * 200_000, "more than"),
        ("a: !!python/object/apply:os.system [ls]\n", "not YAML"),
        ("a: !!timestamp x\n", "not YAML"),
        ("a: " + "9" * 5000, "digits"),
        ("x" * 2**21, "characters"),
    ],
)
def test_yaml_that_multiplies_or_recurses_is_refused(text, words):
    with pytest.raises(ValueError, match=words):
        structured_text.parse_yaml(text)


def test_yaml_of_plain_values_is_read():
    text = (object_model.SHIPPED_OBJECTS / "coffee_cup.yaml").read_text()
    assert structured_text.parse_yaml(text) == yaml.safe_load(text)


@pytest.mark.parametrize("text", ["1e-4", "-2E5", ".5e-3", "1.e+3", "1.0e-4", "12e03"])
def test_numbers_in_scientific_notation_are_numbers(text):
    """PyYAML alone reads 1e-4 as a text."""
    assert structured_text.parse_yaml(text) == float(text)
    assert structured_text.parse_yaml(f"a: [{text}]") == {"a": [float(text)]}


@pytest.mark.parametrize("text", ["1e", "e4", "1e-4m", "v1e4", "1_0e3"])
def test_texts_that_only_look_like_them_are_texts(text):
    assert structured_text.parse_yaml(text) == text


@pytest.mark.parametrize("content", [b"[" * 100_000, b"\xff\xfe", b"{"])
def test_json_that_recurses_or_is_no_text_is_refused(tmp_path, content):
    (tmp_path / "a.json").write_bytes(content)
    with pytest.raises(ValueError, match=r"."):
        structured_text.read_json(tmp_path / "a.json")


@pytest.mark.parametrize(
    "changes",
    [
        {"instances": [1, 10**9]},
        {"instances": [float("inf"), float("inf")]},
        {"color": [float("nan"), 0, 0]},
        {"symmetry": {"discrete_rotvec_degrees": [[0, 0, 1.0]] * 20_000}},
        {"symmetry": {"axis": [float("inf"), 0, 0]}},
        {"features": {"lid": [[float("nan")] * 3] * 2}},
        {"mesh": None},
        {"scale": 1e308},
    ],
)
def test_values_of_a_description_are_bounded(tmp_path, changes):
    path = describe(tmp_path, **changes)
    BOX.export(tmp_path / "part.ply")
    with pytest.raises(ValueError, match=r"part\.yaml: ."):
        read_description(path)


def test_a_profile_is_bounded(tmp_path):
    keys = {name: value for name, value in KEYS.items() if name != "mesh"}
    for profile in ([[0.1, 0.001 * row] for row in range(5000)], [[0, 0], [float("nan"), 1]], [[0, 0], [-1, 1]]):
        (tmp_path / "part.yaml").write_text(yaml.safe_dump({**keys, "profile": profile}))
        with pytest.raises(ValueError, match="profile needs"):
            read_description(tmp_path / "part.yaml")


def test_a_name_leads_to_no_other_folder_and_a_near_one_is_suggested(tmp_path, monkeypatch):
    BOX.export(tmp_path / "part.ply")
    describe(tmp_path)
    (tmp_path / "objects").mkdir()
    monkeypatch.setenv("ACTIVE6D_OBJECT_PATH", str(tmp_path / "objects"))
    with pytest.raises(ValueError, match="unknown object"):
        load_object("../part")
    with pytest.raises(ValueError, match="did you mean 'coffee_cup'"):
        load_object("cofee_cup")


def test_what_is_no_file_is_not_listed(tmp_path, monkeypatch):
    (tmp_path / "folder.yaml").mkdir()
    monkeypatch.setenv("ACTIVE6D_OBJECT_PATH", str(tmp_path))
    assert "folder" not in list_objects()


def archive_with(path, header_shape, content):
    data = io.BytesIO()
    np.lib.format.write_array_header_1_0(data, {"descr": "<f8", "fortran_order": False, "shape": header_shape})
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.npy", data.getvalue() + content)
    return path


def test_arrays_that_announce_more_than_they_hold_are_refused(tmp_path):
    assert read_archive(archive_with(tmp_path / "good.npz", (2,), bytes(16)))["a"].shape == (2,)
    with pytest.raises(ValueError, match="not what it holds"):
        read_archive(archive_with(tmp_path / "bad.npz", (10**9,), bytes(16)))
    np.savez(tmp_path / "objects.npz", a=np.array([{}], object))
    with pytest.raises(ValueError, match="not what it holds"):
        read_archive(tmp_path / "objects.npz")


def test_an_archive_that_inflates_is_refused(tmp_path):
    bomb = zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED)
    with bomb, bomb.open("a.npy", "w", force_zip64=True) as file:
        for _ in range(600):
            file.write(bytes(2**20))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ValueError, match="MB"):
        read_archive(tmp_path / "bomb.npz")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000


def test_a_cut_array_is_refused(tmp_path):
    np.save(tmp_path / "a.npy", np.ones(1000))
    assert read_array(tmp_path / "a.npy").sum() == 1000
    (tmp_path / "a.npy").write_bytes((tmp_path / "a.npy").read_bytes()[:500])
    with pytest.raises(ValueError, match=r"."):
        read_array(tmp_path / "a.npy")


def test_an_image_format_that_runs_programs_is_refused(tmp_path):
    (tmp_path / "a.png").write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 10 10\n%%EndComments\nshowpage\n")
    with pytest.raises(ValueError, match="not a readable image"):
        read_color(tmp_path / "a.png")
