"""Expected visibility against ray casting of the same meshes."""

import numpy as np
import open3d as o3d
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from active6d_core.object_model import ObjectModel, Symmetry, load_object
from active6d_core.se3 import make_transform
from active6d_core.view_sphere import ViewSphere
from active6d_perception.scene.expected_visibility import (
    OPEN_TABLE,
    ExpectedVisibility,
    Tray,
    expected_visibility,
    walled,
)

NAMES = ("mug", "bunny", "coffee_cup")


def cast(model, poses, eye, target, side=120):
    """(side, side) index of the object that each pixel of a camera at ``eye`` shows, -1 for none, and what single
    objects would fill."""

    def look(some):
        scene = o3d.t.geometry.RaycastingScene()
        for T in some:
            vertices = model.mesh.vertices @ T[:3, :3].T + T[:3, 3]
            scene.add_triangles(vertices.astype(np.float32), np.asarray(model.mesh.faces, np.uint32))
        rays = scene.create_rays_pinhole(25.0, target, eye, [0.0, 0.0, 1.0], side, side)
        found = scene.cast_rays(rays)["geometry_ids"].numpy().astype(np.int64)
        return np.where(found == scene.INVALID_ID, -1, found)

    return look(poses), np.array([(look([T]) == 0).sum() for T in poses])


def heap(model, rng, count):
    """Poses close together, but not in each other."""
    side = 0.8 * model.diameter
    places = [(x, y, z) for z in range(2) for x in range(3) for y in range(2)][:count]
    turns = Rotation.random(count, random_state=int(rng.integers(1 << 30))).as_matrix()
    offsets = np.array(places) * side - [side, side / 2, 0.0] + rng.normal(0, 0.1 * side, (count, 3))
    return np.stack([make_transform(*pair) for pair in zip(turns, offsets, strict=True)])


@pytest.mark.parametrize("name", NAMES)
def test_shares_are_those_of_a_rendering(name):
    model, rng = load_object(name), np.random.default_rng(0)
    expected, told = [], []
    for _ in range(4):
        T = heap(model, rng, 10)
        eyes = ViewSphere().positions[rng.integers(100, size=5)]
        told.append(expected_visibility(model).shares(T, eyes).T.ravel())
        for eye in eyes:
            shown, alone = cast(model, T, eye, T[:, :3, 3].mean(axis=0))
            expected.append([(shown == index).sum() / alone[index] for index in range(len(T))])
    expected, told = np.concatenate(expected), np.concatenate(told)
    assert np.ptp(expected) > 0.9, "some are hidden and some are not"
    assert np.abs(told - expected).mean() < 0.06
    assert np.corrcoef(told, expected)[0, 1] > 0.96


@pytest.fixture(scope="module")
def ball():
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=0.05)
    symmetry = Symmetry(None, np.eye(3)[None])
    return ExpectedVisibility(ObjectModel("ball", mesh, 0.1, symmetry, (1, 1), np.ones(3), {}))


@pytest.mark.parametrize("aside", [0.0, 0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 0.07, 0.1, 0.12])
def test_balls_hide_as_much_as_circles_overlap(ball, aside):
    """From far away, one ball shows all but the lens in which the two circles lie over each other."""
    low, high = (make_transform(np.eye(3), [x, 0.0, z]) for x, z in ((0.0, 0.0), (aside, 0.2)))
    above = np.array([[0.0, 0.0, 100.0], [0.0, 100.0, 0.0]])
    shares = ball.shares(np.stack([low, high]), above)
    half = min(aside / 0.1, 1.0)
    lens = 2 / np.pi * (np.arccos(half) - half * np.sqrt(1 - half**2))
    np.testing.assert_allclose(shares[0, 0], 1 - lens, atol=0.08)
    assert shares[1, 0] == 1.0
    np.testing.assert_array_equal(shares[:, 1], 1.0)


def test_only_those_that_hide_hide():
    """What the others would hide is seen; they themselves are hidden as before."""
    model, rng = load_object("mug"), np.random.default_rng(1)
    T, eyes = heap(model, rng, 6), ViewSphere().positions[::3]
    visibility = expected_visibility(model)
    everything, some = visibility.shares(T, eyes), visibility.shares(T, eyes, hiding=4)
    for index in (4, 5):
        alone = visibility.shares(T[[0, 1, 2, 3, index]], eyes)
        np.testing.assert_array_equal(some[index], alone[-1])
    np.testing.assert_array_equal(some[:4], visibility.shares(T[:4], eyes))
    assert (some >= everything).all()
    assert (some > everything).any()


def test_walls_hide_what_rays_through_boxes_miss():
    """Against ray casting of four thin walls, from all sides and levels."""
    rng, tray = np.random.default_rng(2), Tray(0.3, 0.2, 0.08)
    points = rng.uniform([-0.15, -0.1, 0.0], [0.15, 0.1, 0.12], (30, 3))
    eyes = ViewSphere().positions
    scene = o3d.t.geometry.RaycastingScene()
    for size, centre in [((0.3, 1e-4), (0.0, 0.1)), ((1e-4, 0.2), (0.15, 0.0))]:
        for sign in (-1, 1):
            box = o3d.t.geometry.TriangleMesh.create_box(*size, tray.wall_height)
            corner = [sign * centre[0] - size[0] / 2, sign * centre[1] - size[1] / 2, 0.0]
            scene.add_triangles(box.translate(o3d.core.Tensor(corner, dtype=o3d.core.float32)))
    rays = np.concatenate(np.broadcast_arrays(points[:, None], eyes - points[:, None]), axis=-1).astype(np.float32)
    hidden = scene.test_occlusions(o3d.core.Tensor(rays)).numpy()
    points, eyes = points.astype(np.float32), eyes.astype(np.float32)
    told = np.array([[walled(point, eye, Tray(*np.float32(tray))) for eye in eyes] for point in points])
    assert 0.05 < hidden.mean() < 0.5
    assert (told == hidden).mean() > 0.999
    assert not any(walled(point, eye, Tray(*np.float32(OPEN_TABLE))) for eye in eyes for point in points)


def test_a_tray_hides_the_low_from_low_eyes():
    model = load_object("bunny")
    T, tray = make_transform(np.eye(3), [0.0, 0.0, 0.03])[None], Tray.for_model(load_object("bunny"))
    level, above = np.array([[0.8, 0.0, 0.05], [0.0, 0.01, 0.8]])
    shares = expected_visibility(model).shares(T, np.stack([level, above]), tray)
    np.testing.assert_array_equal(shares, [[0.0, 1.0]])


def test_nothing_is_seen_of_nothing():
    eyes = ViewSphere().positions
    assert expected_visibility(load_object("bunny")).shares(np.zeros((0, 4, 4)), eyes).shape == (0, 100)
