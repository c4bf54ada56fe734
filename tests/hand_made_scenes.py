"""Hand-made scenes of few objects, so that tests of cameras and files do not wait for physics."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from active6d_core.camera import PinholeCamera
from active6d_core.object_model import ObjectModel, Symmetry
from active6d_core.se3 import make_transform
from active6d_core.view_sphere import ViewSphere
from active6d_sim.scenes import scene_store
from active6d_sim.scenes.scene import Bin, Scene

SPHERE = ViewSphere()
#: A small picture with its principal point off the centre and pixels that are not square.
CAMERA = PinholeCamera(64, 48, 55.0, 57.0, 30.7, 24.2)


def make_model(mesh: trimesh.Trimesh) -> ObjectModel:
    """A grey object without symmetry."""
    diameter = float(np.linalg.norm(mesh.extents))
    return ObjectModel("test", mesh, diameter, Symmetry(None, np.eye(3)[None]), (1, 3), np.full(3, 0.5), {})


def make_scene(T_world_object: np.ndarray, bin: Bin, name: str = "mug/test/0", seed: int = 5) -> Scene:
    """A scene that claims that every view shows everything."""
    return Scene(name.split("/")[0], name, seed, T_world_object, bin, np.ones((len(SPHERE), len(T_world_object))))


def three_mugs() -> Scene:
    """Three mugs side by side."""
    R = Rotation.from_euler("xyz", [[0, 0, 0], [90, 0, 40], [0, 0, 200]], degrees=True).as_matrix()
    T = make_transform(R, [[-0.11, 0.0, 0.05], [0.0, 0.1, 0.05], [0.12, -0.03, 0.05]])
    return make_scene(T, Bin(0.36, 0.36, 0.06, 0.01))


def store_mugs(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Scene:
    """Make mug/test/0, and with one mug less mug/test/1, the only stored scenes; returns the first."""
    mugs = three_mugs()
    monkeypatch.setattr(scene_store, "SHIPPED_SCENES", folder / "none")
    monkeypatch.setenv("ACTIVE6D_SCENE_PATH", str(folder))
    (folder / "mug").mkdir()
    mugs.save(folder / "mug" / "test_00.npz")
    make_scene(mugs.T_world_object[:2], mugs.bin, "mug/test/1", 6).save(folder / "mug" / "test_01.npz")
    return mugs
