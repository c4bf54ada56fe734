"""Symmetries that a BOP data set names become those of an object's description."""

import json

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from active6d_core.object_model import read_description
from active6d_sim.datasets.bop_models import symmetry_beside
from active6d_tools.cli import app

SHIFT = np.array([200.0, -50.0, 30.0])


def about(rotation, centre):
    """(4, 4) rotation about a centre, rounded as data sets round it."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, centre - rotation @ centre
    return T.round(6).ravel().tolist()


def model(folder, entry, mesh=None):
    """``obj_000012.ply`` in millimetres, away from the file's origin, and what the data set says of it."""
    mesh = mesh or trimesh.creation.box((60.0, 60.0, 90.0))
    mesh.apply_translation(SHIFT)
    mesh.export(folder / "obj_000012.ply")
    (folder / "models_info.json").write_text(json.dumps({"12": {"diameter": 1.0, **entry}, "13": {}}))
    return folder / "obj_000012.ply"


def add(mesh, into):
    command = ["object", "add", str(mesh), "--name", "part", "--scale", "0.001", "--into", str(into)]
    return CliRunner().invoke(app, command)


def test_an_axis_with_an_offset_becomes_the_axis_of_the_object(tmp_path):
    entry = {"symmetries_continuous": [{"axis": [0, 0, 2], "offset": [200.0, -50.0, 0.0]}]}
    mesh = model(tmp_path, entry, trimesh.creation.cylinder(30.0, 90.0))
    added = add(mesh, tmp_path / "objects")
    assert added.exit_code == 0, added.output
    assert "symmetry taken from models_info.json" in added.output
    assert "move the centroid" not in added.output
    np.testing.assert_allclose(read_description(tmp_path / "objects" / "part.yaml").symmetry.axis, [0, 0, 1])


def test_rounded_discrete_symmetries_make_the_whole_group(tmp_path):
    turn = Rotation.from_rotvec(np.radians([0, 0, 90.0])).as_matrix()
    flip = Rotation.from_rotvec(np.radians([180.0, 0, 0])).as_matrix()
    tilted = Rotation.from_rotvec([0.3, -0.5, 0.2]).as_matrix()
    group = [tilted @ flip @ tilted.T, tilted @ turn @ tilted.T, tilted @ turn @ turn @ tilted.T]
    box = trimesh.creation.box((60.0, 60.0, 90.0))
    box.apply_transform(np.vstack([np.c_[tilted, np.zeros(3)], [0, 0, 0, 1]]))
    mesh = model(tmp_path, {"symmetries_discrete": [about(R, SHIFT) for R in group]}, box)
    added = add(mesh, tmp_path / "objects")
    assert added.exit_code == 0, added.output
    assert "move the centroid" not in added.output
    assert len(read_description(tmp_path / "objects" / "part.yaml").symmetry.discrete) == 8


def test_symmetries_of_another_mesh_are_noticed(tmp_path):
    mesh = model(tmp_path, {"symmetries_discrete": [about(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))]})
    assert "these symmetries move the centroid by 412.3 mm" in add(mesh, tmp_path / "objects").output


def test_a_model_without_symmetry_or_data_set_has_none(tmp_path):
    assert symmetry_beside(model(tmp_path, {})) is None
    assert symmetry_beside(tmp_path / "bracket.ply") is None


@pytest.mark.parametrize(
    "entry",
    [
        {"symmetries_discrete": [[1.0] * 16]},
        {"symmetries_discrete": [[1.0] * 3]},
        {"symmetries_continuous": [{"axis": [0, 0, 0]}]},
        {"symmetries_continuous": 7},
    ],
)
def test_damaged_symmetries_are_refused(tmp_path, entry):
    with pytest.raises(ValueError, match=r"models_info.json: model 12: "):
        symmetry_beside(model(tmp_path, entry))
