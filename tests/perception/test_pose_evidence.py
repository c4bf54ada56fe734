"""Evidence, registration and selection of poses, on ray-cast images against closed forms and brute force."""

import json

import numpy as np
import open3d as o3d
import pytest
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from active6d_core.camera import PinholeCamera, backproject, normals_from_points, pixel_rays
from active6d_core.metrics import e_add
from active6d_core.object_model import ObjectModel, Symmetry, load_object
from active6d_core.se3 import make_transform, transform_points
from active6d_perception.estimators.image_registration import register
from active6d_perception.estimators.measured_image import measure_image
from active6d_perception.estimators.pose_evidence import EVIDENCE, explained_shares, weigh_poses
from active6d_perception.estimators.pose_selection import FEATURES, SELECTION_FILE, PoseSelection, judge_of
from active6d_perception.model.model_views import model_views
from active6d_perception.model.near_symmetry import near_symmetries
from active6d_perception.model.outline import outline_of
from active6d_perception.model.surface_grid import nearest_sample, surface_grid
from active6d_perception.model.visible_samples import visible_samples

CAMERA = PinholeCamera.from_field_of_view(640, 480, 60.0)
WALL = 1.5  # metres


def captured(placed, wall=WALL):
    """(H, W) depth of meshes at their poses before a wall."""
    scene = o3d.t.geometry.RaycastingScene()
    for mesh, T in placed:
        scene.add_triangles(transform_points(T, np.asarray(mesh.vertices)).astype(np.float32), np.uint32(mesh.faces))
    rays = np.concatenate([np.zeros((480, 640, 3), np.float32), pixel_rays(CAMERA)], axis=-1)
    return np.minimum(scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy(), np.float32(wall))


def pose(seed, distance=0.7):
    return make_transform(Rotation.random(random_state=seed).as_matrix(), np.array([0.03, -0.02, distance]))


def evidence_of(model, T, depth):
    values = weigh_poses(np.asarray(T).reshape(-1, 4, 4), judge_of(model), measure_image(depth, CAMERA))
    return [dict(zip(EVIDENCE, row, strict=True)) for row in values]


@pytest.fixture(scope="module")
def cup():
    return load_object("coffee_cup")


@pytest.fixture(scope="module")
def ball():
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=0.05)
    return ObjectModel("ball", mesh, 0.1, Symmetry(None, np.eye(3)[None]), (1, 1), np.ones(3), {})


def test_normals_of_a_plane_and_of_smoothed_noise():
    normal = np.array([0.3, -0.2, -1.0]) / np.linalg.norm([0.3, -0.2, -1.0])
    rays = pixel_rays(CAMERA).astype(float)
    depth = (normal @ [0.0, 0.0, 0.8]) / (rays @ normal)
    image = measure_image(depth, CAMERA)
    inner = image.normals[10:-10, 10:-10]
    assert np.abs(inner @ normal - 1).max() < 1e-4
    np.testing.assert_allclose(image.points[50, 60], backproject(depth, CAMERA)[50, 60], atol=2e-4)
    # An edge is not smoothed across, an invalid pixel stays invalid and spoils its neighbours' normals only.
    step = np.full((480, 640), 0.8, np.float32)
    step[:, 320:] = 0.9
    step[100, 100] = np.nan
    image = measure_image(step, CAMERA)
    np.testing.assert_allclose(image.points[200, :, 2], step[200], rtol=1e-6)
    assert np.isnan(image.points[100, 100, 2])
    assert np.isnan(image.normals[100, 97]).all()
    assert np.isfinite(image.normals[100, 90]).all()


def test_normals_are_those_of_central_differences(cup):
    depth = captured([(cup.mesh, pose(1))])
    image = measure_image(depth, CAMERA)
    expected = normals_from_points(image.points, reach=3)
    both = np.isfinite(expected).all(axis=-1)
    assert (np.isfinite(image.normals).all(axis=-1) == both).mean() > 0.999
    assert np.abs(np.einsum("hwi,hwi->hw", expected, image.normals)[both] - 1).max() < 1e-3


def test_the_outline_of_a_ball_is_a_circle(ball):
    outline, views = outline_of(ball), model_views(ball)
    assert (outline.number > 30).all()
    for index in (0, 100, 641):
        points = outline.points[index, : outline.number[index]].astype(float)
        outward = outline.outward[index, : outline.number[index]].astype(float)
        direction = views.directions[index]
        assert np.linalg.norm(points, axis=1) == pytest.approx(0.05, rel=0.02)
        across = points - np.outer(points @ direction, direction)
        assert np.linalg.norm(across, axis=1).min() > 0.9 * 0.05
        assert np.abs(outward @ direction).max() < 1e-5
        away = across / np.linalg.norm(across, axis=1, keepdims=True)
        assert np.einsum("ni,ni->n", away, outward).min() > 0.95


@pytest.mark.parametrize("name", ["coffee_cup", "bunny", "mug"])
def test_a_right_pose_fits_and_its_outline_is_confirmed(name):
    model = load_object(name)
    T = pose(3)
    (found,) = evidence_of(model, T, captured([(model.mesh, T)]))
    # The rest is beside edges: the rim of a thin wall is a pixel or two wide.
    assert found["near"] > 0.8
    assert found["fitting"] > 0.6
    assert found["violated"] < 0.08
    assert found["occluded"] < 0.05
    assert found["confirmed"] > 0.9
    assert found["continued"] < 0.05


def test_each_kind_of_evidence(cup):
    T = pose(4)
    depth = captured([(cup.mesh, T)])
    before, behind = T.copy(), T.copy()
    before[2, 3] -= 0.05
    behind[2, 3] += 0.05
    looked_through, hidden = evidence_of(cup, [before, behind], depth)
    assert looked_through["violated"] > 0.9
    assert hidden["occluded"] > 0.8
    nothing = np.full_like(depth, np.nan)
    assert evidence_of(cup, T, nothing)[0]["unmeasured"] == 1.0


def test_the_surface_continues_where_a_ball_lies_in_a_wall(ball):
    # Just inside its outline, the surface of a ball is up to 14 mm before its middle.
    T = make_transform(np.eye(3), np.array([0.0, 0.0, 0.8]))
    alone, in_wall = (evidence_of(ball, T, captured([(ball.mesh, T)], wall))[0] for wall in (WALL, 0.79))
    assert alone["confirmed"] > 0.95
    assert alone["continued"] == 0.0
    assert in_wall["continued"] > 0.95
    assert in_wall["confirmed"] == 0.0


def test_shares_are_those_of_a_count(cup):
    """Brute force over the samples of the direction, in plain numpy."""
    T = pose(5)
    shifted = T.copy()
    shifted[:3, 3] += [0.01, 0.0, 0.004]
    depth = captured([(cup.mesh, T), (trimesh.creation.box((0.06, 0.3, 0.01)), make_transform(np.eye(3), [0, 0, 0.5]))])
    judge, image = judge_of(cup), measure_image(depth, CAMERA)
    (found,) = evidence_of(cup, shifted, depth)
    views = model_views(cup)
    direction = views.nearest_direction(shifted[None])[0]
    index = judge.samples.chosen[direction, : judge.samples.number[direction]]
    points = transform_points(shifted, views.points[index].astype(float))
    u = np.rint(points[:, 0] / points[:, 2] * CAMERA.fx + CAMERA.cx).astype(int)
    v = np.rint(points[:, 1] / points[:, 2] * CAMERA.fy + CAMERA.cy).astype(int)
    off = points[:, 2] - image.points[v, u, 2]
    assert found["violated"] == pytest.approx((off < -0.012).mean(), abs=0.02)
    assert found["occluded"] == pytest.approx((off > 0.012).mean(), abs=0.02)
    assert found["near"] == pytest.approx(np.maximum(1 - (off / 0.006) ** 2, 0).mean(), abs=0.02)


def test_the_grid_names_the_nearest_sample(cup):
    grid, views = surface_grid(cup), model_views(cup)
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.08, 0.08, (500, 3))
    distance, nearest = cKDTree(views.points).query(points)
    found = np.array([nearest_sample(*point, grid) for point in points])
    apart = np.linalg.norm(views.points[found] - points, axis=1)
    known = found >= 0
    # The cell's middle is at most half its diagonal away.
    assert (apart[known] - distance[known]).max() <= np.sqrt(3) * grid.cell + 1e-6
    assert (distance[~known] > 0.1 * cup.diameter - np.sqrt(3) * grid.cell / 2).all()
    assert (found[distance < 1e-9] == nearest[distance < 1e-9]).all()


def test_an_instance_is_explained_by_its_pose_alone(cup):
    T = pose(6)
    depth = captured([(cup.mesh, T)])
    image = measure_image(depth, CAMERA)
    seen = np.argwhere((depth < WALL - 0.1) & np.isfinite(image.normals).all(axis=-1))[::40]
    points = np.ascontiguousarray(image.points[seen[:, 0], seen[:, 1]])[None]
    normals = np.ascontiguousarray(image.normals[seen[:, 0], seen[:, 1]])[None]
    away = T.copy()
    away[0, 3] += 0.04
    poses = np.stack([T, away])[None]
    right, wrong = explained_shares(poses, points, normals, np.array([points.shape[1]]), surface_grid(cup), 0.006)[0]
    assert right > 0.8
    assert wrong < 0.6 * right
    few = explained_shares(poses, points, normals, np.array([0]), surface_grid(cup), 0.006)
    np.testing.assert_array_equal(few, 0.0)


@pytest.mark.parametrize("name", ["coffee_cup", "bunny", "mug"])
def test_registration_finds_the_pose(name):
    model, rng = load_object(name), np.random.default_rng(1)
    T = pose(7)
    image = measure_image(captured([(model.mesh, T)]), CAMERA)
    views = model_views(model)
    samples = visible_samples(views, np.ones(len(views.points), bool), 192, model.mesh.area)
    starts = np.tile(T, (6, 1, 1))
    starts[:, :3, :3] = (
        starts[:, :3, :3] @ Rotation.from_rotvec(np.radians(5) * rng.normal(size=(6, 3)) / 1.7).as_matrix()
    )
    starts[:, :3, 3] += 0.004 * rng.normal(size=(6, 3))
    unchanged = starts.copy()
    found = register(starts, samples, image, np.array([0.02, 0.008, 0.004]), 4)
    np.testing.assert_array_equal(starts, unchanged)
    assert e_add(model, found, np.tile(T, (6, 1, 1))).max() < 0.003
    # Nothing is near: a pose with too few pairs stays as it was.
    far = T.copy()
    far[2, 3] -= 0.3
    np.testing.assert_array_equal(register(far[None], samples, image, np.array([0.008]), 3)[0], far)


@pytest.mark.parametrize("seed", range(6))
def test_the_right_end_of_a_cup_is_selected(cup, seed):
    """Upside down and registered, a cup fits nearly as well; what is left decides."""
    T = pose(20 + seed)
    image = measure_image(captured([(cup.mesh, T)]), CAMERA)
    views = model_views(cup)
    samples = visible_samples(views, np.ones(len(views.points), bool), 192, cup.mesh.area)
    twins = T @ near_symmetries(cup).T_object_twin
    assert len(twins) == 2
    poses = register(twins, samples, image, np.array([0.02, 0.008, 0.004]), 5)
    seen = np.argwhere((image.points[..., 2] < WALL - 0.1) & np.isfinite(image.normals).all(axis=-1))[::60]
    of_instance = tuple(np.ascontiguousarray(part[seen[:, 0], seen[:, 1]])[None] for part in image[:2])
    value = PoseSelection(cup).value(poses[None], image, (*of_instance, np.array([len(seen)])))[0]
    assert value[0] > value[1] + 1.0


def test_the_selection_reads_its_own_features():
    stored = json.loads(SELECTION_FILE.read_text())
    assert tuple(stored["weights"]) == FEATURES
    # Whatever speaks for a pose raises its value, whatever speaks against it lowers it.
    assert all(stored["weights"][name] > 0 for name in ("fitting", "near", "confirmed", "explained"))
    assert all(stored["weights"][name] < 0 for name in ("violated", "violated_comparable", "continued"))
