"""``active6d object add``: symmetries that are found, declared and refused, and the size in the image."""

import re

import numpy as np
import pytest
import trimesh
import yaml
from typer.testing import CliRunner

from active6d_core.object_model import read_description
from active6d_tools.cli import app

TILT = trimesh.transformations.rotation_matrix(0.8, (0.3, 0.5, -0.7))


def run(*arguments: str):
    return CliRunner().invoke(app, list(arguments), env={"COLUMNS": "200", "TERM": "dumb"})


@pytest.fixture
def add_part(tmp_path):
    """Adds a mesh in millimetres under a new name each time, by the arguments given; also gives the description."""
    into = tmp_path / "objects"

    def add(mesh, *arguments):
        name = f"part{len(list(into.glob('*.yaml')))}"
        mesh.export(tmp_path / "part.stl")
        command = ("object", "add", str(tmp_path / "part.stl"), "--name", name, "--scale", "0.001", "--into", str(into))
        return run(*command, *arguments), into / f"{name}.yaml"

    return add


@pytest.mark.parametrize(
    ("mesh", "words", "options", "size"),
    [
        (
            lambda: trimesh.creation.cylinder(19.0, 15.0, sections=6),
            "a sixth of a turn about z and half a turn about x; if these do not matter",
            ["--symmetry", "z:6", "--symmetry", "x:2"],
            12,
        ),
        (
            lambda: trimesh.creation.cylinder(15.0, 80.0),
            "any turn about z and half a turn about x; if these do not matter",
            ["--axis", "0", "0", "1", "--symmetry", "x:2"],
            2,
        ),
        (lambda: trimesh.creation.cylinder(19.0, 15.0, sections=3).apply_transform(TILT), "a third of a turn", None, 6),
    ],
    ids=["nut", "pin", "tilted"],
)
def test_what_is_suggested_is_taken_and_then_nothing_more(add_part, mesh, words, options, size):
    added, _ = add_part(mesh())
    said = " ".join(added.stdout.split())
    assert f"it looks the same after {words}" in said
    suggested = re.search(r"another --name and (--[^a-z]*.*?) (?:added|it looks|from)", said)[1].split()
    assert options is None or suggested == options
    again, description = add_part(mesh(), *suggested)
    assert again.exit_code == 0, again.output
    assert "it looks" not in again.stdout
    assert len(read_description(description).symmetry.discrete) == size
    assert len(yaml.safe_load(description.read_text())["symmetry"]["discrete_rotvec_degrees"]) == size - 1


def test_a_symmetry_that_the_mesh_does_not_have_is_refused(tmp_path, add_part):
    refused, _ = add_part(trimesh.creation.cylinder(19.0, 15.0, sections=6), "--symmetry", "x:2", "--symmetry", "z:4")
    words = " ".join(refused.stderr.split())
    assert refused.exit_code == 2
    assert "--symmetry z:4 does not hold: turned by 90 degrees about" in words
    # A corner leaves the hexagon by 19 mm (1 - cos 30 degrees), the middle of a side less.
    assert (
        1.2 < float(re.search(r"surface move by ([\d.]+) mm or more", words)[1]) < 19.0 * (1 - np.cos(np.pi / 6)) + 0.1
    )
    assert words.endswith("what was found is --symmetry z:6 --symmetry x:2")
    assert not [path for path in (tmp_path / "objects").rglob("*") if path.is_file()]


def test_a_part_without_a_symmetry_is_given_none(add_part):
    # No two edges from the corner are equal or opposite.
    wedge = trimesh.convex.convex_hull([[0, 0, 0], [40, 0, 0], [0, 70, 0], [0, 0, 100]])
    added, description = add_part(wedge)
    assert "it looks" not in added.stdout
    assert "symmetry" not in description.read_text()
    assert "no symmetry was found, so leave --symmetry out" in " ".join(
        add_part(wedge, "--symmetry", "0,0.6,0.8:2")[0].stderr.split()
    )


@pytest.mark.parametrize("text", ["z", "z:1", "z:x", "w:2", "xy:2", "0,0:2", "0,0,0:2", "0,0,inf:2", "z:61", ":2"])
def test_a_symmetry_that_cannot_be_read_says_how_to_write_it(add_part, text):
    refused, _ = add_part(trimesh.creation.box((30.0, 40.0, 120.0)), "--symmetry", text)
    assert refused.exit_code == 2
    assert f"--symmetry '{text}': write AXIS:FOLD, such as z:6" in " ".join(refused.stderr.split())


def test_symmetries_that_do_not_fit_together_are_refused(add_part):
    refused, _ = add_part(trimesh.creation.icosphere(3, 20.0), "--symmetry", "z:4", "--symmetry", "0,0.6,0.8:5")
    assert "--symmetry z:4 --symmetry 0,0.6,0.8:5: they generate no finite group" in " ".join(refused.stderr.split())


@pytest.mark.parametrize(
    ("diameter", "radius"), [(100.0, None), (38.0, 0.52), (5.0, 0.1)], ids=["large", "nut", "screw"]
)
def test_the_size_in_the_image_is_said(add_part, diameter, radius):
    mesh = trimesh.creation.box(np.full(3, diameter / np.sqrt(3)))
    words = " ".join(add_part(mesh)[0].stdout.split())
    # 640 pixels across 60 degrees.
    pixels = 320 / np.tan(np.pi / 6) * 1e-3 * diameter
    assert f"from the simulated camera's 0.8 m it spans {pixels / 0.8:.0f} pixels" in words
    assert ("small parts are hard" in words) == (radius is not None)
    if radius is not None:
        assert f"from {radius:g} m {pixels / radius:.0f}: episode --set camera_simulator.radius={radius:g} " in words
        assert f"--set attention_policy.radius={radius:g}" in words
