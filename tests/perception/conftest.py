"""What perception's tests share: rendering a single object, and poses in front of the camera."""

import numpy as np
import open3d as o3d
import pytest
from scipy.spatial.transform import Rotation

from active6d_core.camera import DEFAULT_CAMERA, pixel_rays
from active6d_core.se3 import make_transform


def _render(model, T_camera_object, camera=DEFAULT_CAMERA):
    """(H, W) depth and (H, W, 3) normals facing the camera of objects alone, NaN where there is none."""
    scene = o3d.t.geometry.RaycastingScene()
    for T in T_camera_object:
        vertices = np.asarray(model.mesh.vertices) @ T[:3, :3].T + T[:3, 3]
        scene.add_triangles(vertices.astype(np.float32), np.asarray(model.mesh.faces, np.uint32))
    directions = pixel_rays(camera)
    rays = np.concatenate([np.zeros_like(directions), directions], axis=-1)
    hit = scene.cast_rays(o3d.core.Tensor(rays))
    depth, normals = hit["t_hit"].numpy(), hit["primitive_normals"].numpy()
    depth[~np.isfinite(depth)] = np.nan
    normals[np.einsum("hwi,hwi->hw", normals, directions) > 0] *= -1
    return depth, normals


def _pose(seed, distance=0.8):
    rng = np.random.default_rng(seed)
    return make_transform(Rotation.random(rng=rng).as_matrix(), [*rng.uniform(-0.1, 0.1, 2), distance])[None]


@pytest.fixture(scope="session")
def render():
    return _render


@pytest.fixture(scope="session")
def pose():
    return _pose
