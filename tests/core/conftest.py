"""Small object models with every kind of symmetry, made here so that the tests do not depend on the shipped ones."""

import numpy as np
import pytest
import trimesh

from active6d_core.object_model import ObjectModel, read_description

DESCRIPTIONS = {
    "cup": "profile: [[0, -0.06], [0.03, -0.06], [0.042, 0.05], [0.045, 0.05], [0.045, 0.06], [0, 0.06]]\n"
    "symmetry: {axis: [0, 0, 1]}\n",
    "spool": "profile: [[0, -0.04], [0.03, -0.04], [0.02, 0], [0.03, 0.04], [0, 0.04]]\n"
    "symmetry: {axis: [0, 0, 2], discrete_rotvec_degrees: [[180, 0, 0]]}\n",
    "brick": "mesh: brick.ply\nsymmetry: {discrete_rotvec_degrees: [[180, 0, 0], [0, 180, 0]]}\n",
    "wedge": "mesh: wedge.ply\n",
}


@pytest.fixture(scope="session")
def models(tmp_path_factory: pytest.TempPathFactory) -> dict[str, ObjectModel]:
    """cup: continuous symmetry; spool: continuous with a flip; brick: discrete; wedge: none."""
    folder = tmp_path_factory.mktemp("objects")
    trimesh.creation.box((0.03, 0.05, 0.09)).export(folder / "brick.ply")
    corners = np.array([[0, 0, 0], [0.09, 0, 0], [0, 0.06, 0], [0.01, 0.01, 0.04]])
    trimesh.Trimesh(corners, [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]).export(folder / "wedge.ply")
    loaded = {}
    for name, text in DESCRIPTIONS.items():
        path = folder / f"{name}.yaml"
        path.write_text(f"name: {name}\ninstances: [2, 5]\ncolor: [0.5, 0.5, 0.5]\n{text}")
        loaded[name] = read_description(path)
    return loaded
