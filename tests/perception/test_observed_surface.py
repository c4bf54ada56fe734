"""The unexplained surface: cells against pixels counted one by one, explanations against distances to the mesh."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from active6d_core.camera import DEFAULT_CAMERA
from active6d_core.object_model import load_object
from active6d_core.se3 import make_transform
from active6d_core.view_sphere import ViewSphere
from active6d_perception.scene.observed_surface import EXPLAINED_WITHIN, Explainer, ObservedSurface, WorkspaceGrid
from active6d_sim.rendering.simulator import Simulator
from active6d_sim.scenes.scene import Bin
from active6d_sim.scenes.scene_store import load_scene

SPHERE = ViewSphere()


@pytest.fixture(scope="module")
def heap():
    """Three noisy views of a validation heap, and what lies there."""
    scene = load_scene("coffee_cup", "val", 0)
    simulator = Simulator(scene)
    views = [simulator.capture(SPHERE.pose(SPHERE.positions[i]), i * 1_000_000_000) for i in (3, 49, 88)]
    return scene, views


def add(surface, views):
    for view in views:
        surface.add_view(view.stamp, view.depth, view.camera, view.T_world_camera)


def count_points(grid, depth, camera, T_world_camera, stride):
    """Pixels, one by one, into the cell they lie in."""
    counts = np.zeros(grid.shape, int)
    for v in range(0, camera.height, stride):
        for u in range(0, camera.width, stride):
            z = float(depth[v, u])
            ray = np.array([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0])
            point = T_world_camera[:3, :3] @ (ray * z) + T_world_camera[:3, 3]
            if np.isfinite(z):
                x, y, z = (np.array(grid.shape) * grid.cell / 2 + (*point[:2], 0)) / grid.cell
                cell = np.floor([x, y, (point[2] - grid.floor) / grid.cell]).astype(int)
                if (cell >= 0).all() and (cell < grid.shape).all():
                    counts[tuple(cell)] += 1
    return counts.ravel()


@pytest.mark.parametrize(("view", "scale", "stride"), [(0, 0.25, 1), (37, 0.5, 1), (95, 1.0, 2)])
def test_cells_are_seen_where_three_points_lie(render, view, scale, stride):
    camera = DEFAULT_CAMERA.scaled(scale)
    model, rng = load_object("mug"), np.random.default_rng(view)
    depth, _ = render(model, make_transform(Rotation.random(rng=rng).as_matrix(), [0.02, 0.01, 0.79])[None], camera)
    depth[rng.random(depth.shape) < 0.2] = np.nan
    grid = WorkspaceGrid((0.2, 0.15), -0.06, 0.09, 0.017)
    T_world_camera = SPHERE.pose(SPHERE.positions[view])
    counts = count_points(grid, depth, camera, T_world_camera, stride)
    seen = grid.observe(depth, camera, T_world_camera)
    np.testing.assert_array_equal(seen, counts >= 3)
    assert 10 < seen.sum() < (counts > 0).sum()


def test_a_camera_within_or_turned_away_from_the_box():
    """No part of the image can be left out, or all of it."""
    grid, camera = WorkspaceGrid((0.8, 0.8), -0.4, 0.4, 0.1), DEFAULT_CAMERA.scaled(0.1)
    depth = np.random.default_rng(0).uniform(0.1, 0.6, (camera.height, camera.width))
    T_world_camera = make_transform(Rotation.from_euler("xyz", [0.3, 0.2, 0.1]).as_matrix(), [0.1, 0.0, -0.1])
    seen = grid.observe(depth, camera, T_world_camera)
    np.testing.assert_array_equal(seen, count_points(grid, depth, camera, T_world_camera, 1) >= 3)
    assert seen.sum() > 20
    T_world_camera[0, 3] = 1.5  # the box is to the left of the image now
    assert not grid.observe(depth, camera, T_world_camera).any()


def test_centres_are_numbered_as_cells_are():
    grid = WorkspaceGrid((0.3, 0.2), 0.01, 0.11, 0.05)
    assert grid.shape == (6, 4, 2)
    assert len(grid) == len(grid.centres) == 48
    np.testing.assert_allclose(grid.centres[0], [-0.125, -0.075, 0.035], atol=1e-8)
    np.testing.assert_allclose(grid.centres[(2 * 4 + 3) * 2 + 1], [-0.025, 0.075, 0.085], atol=1e-8)


@pytest.mark.parametrize("name", ["mug", "bunny", "coffee_cup"])
def test_the_usual_grid_fills_the_usual_bin(name):
    model = load_object(name)
    grid, tray = WorkspaceGrid.for_model(model), Bin.for_model(model)
    gap = np.array([tray.inner_width, tray.inner_depth]) / 2 - np.abs(grid.centres[:, :2]).max(axis=0) - grid.cell / 2
    assert (gap > 0.03 * model.diameter).all()
    assert (gap < 0.1 * model.diameter).all()
    assert grid.centres[:, 2].min() - grid.cell / 2 == pytest.approx(0.05 * model.diameter)


@pytest.mark.parametrize(
    "sizes",
    [((0.3,), 0.0, 0.1, 0.01), ((0.3, -0.3), 0.0, 0.1, 0.01), ((0.3, 0.3), 0.1, 0.1, 0.01), ((1, 1), 0, 1, 0.001)],
)
def test_impossible_grids_are_refused(sizes):
    with pytest.raises(ValueError, match="surface grid"):
        WorkspaceGrid(*sizes)


@pytest.mark.parametrize("cell", [0.0, -0.01, np.nan])
def test_impossible_cells_are_refused(cell):
    with pytest.raises(ValueError, match="surface grid: sizes must be finite and the cell positive"):
        WorkspaceGrid((0.3, 0.3), 0.0, 0.1, cell)


def test_explained_is_what_is_near_the_mesh():
    """Against trimesh, triangle by triangle; the table may be wrong only close to the limit."""
    model, rng = load_object("coffee_cup"), np.random.default_rng(0)
    T = make_transform(Rotation.random(2, rng=rng).as_matrix(), rng.uniform(-0.05, 0.05, (2, 3)))
    points = rng.uniform(-0.12, 0.12, (200, 3))
    corners = np.asarray(model.mesh.triangles)
    explains = Explainer(model, 0.1).explains(points, T)
    for row, pose in zip(explains, T, strict=True):
        local = (points - pose[:3, 3]) @ pose[:3, :3]
        pairs = np.tile(corners, (len(local), 1, 1)), np.repeat(local, len(corners), axis=0)
        apart = np.linalg.norm(trimesh.triangles.closest_point(*pairs) - pairs[1], axis=1)
        distance = apart.reshape(len(local), -1).min(axis=1) / model.diameter
        unsure = np.abs(distance - 0.1) < np.sqrt(3) / 2 / 48  # half a voxel's diagonal
        np.testing.assert_array_equal(row[~unsure], distance[~unsure] < 0.1)
        assert row.any()
        assert unsure.mean() < 0.3


def test_points_far_away_are_explained_by_nothing():
    explainer = Explainer(load_object("bunny"), EXPLAINED_WITHIN)
    points = np.array([[9.0, 0, 0], [-9.0, 0, 0], [0, 9.0, 0], [0, -9.0, 0], [0, 0, 9.0], [0, 0, -9.0]])
    assert not explainer.explains(points, np.eye(4)[None]).any()
    assert explainer.explains(points, np.zeros((0, 4, 4))).shape == (0, 6)


def test_nothing_is_left_of_a_heap_that_is_known(heap):
    """Neither walls nor floor nor noise are unexplained surface; what is left belongs to the object left out."""
    scene, views = heap
    model = load_object("coffee_cup")
    surface = ObservedSurface(model)
    add(surface, views)
    assert len(surface.unexplained(scene.T_world_all)) == 0
    seen = [round(view.stamp * 1e-9) for view in views]
    best = int(scene.visible_fraction[seen].max(axis=0).argmax())
    left = surface.unexplained(np.delete(scene.T_world_all, best, axis=0))
    assert len(left) > 20
    assert Explainer(model, 0.1).explains(left, scene.T_world_object[best : best + 1]).all()


def test_views_add_up_in_any_order_and_are_forgotten(heap):
    scene, views = heap
    model, known = load_object("coffee_cup"), scene.T_world_object[:4]
    forwards, backwards, last = ObservedSurface(model), ObservedSurface(model), ObservedSurface(model)
    assert forwards.unexplained(known).shape == (0, 3)
    add(forwards, [*views, views[0]])
    add(backwards, views[::-1])
    add(last, views[2:])
    both = forwards.unexplained(known)
    np.testing.assert_array_equal(both, backwards.unexplained(known))
    forwards.forget_before(views[2].stamp)
    only = forwards.unexplained(known)
    np.testing.assert_array_equal(only, last.unexplained(known))
    assert 0 < len(only) < len(both)
    forwards.reset()
    assert len(forwards.unexplained(known)) == 0
    everything = last.unexplained(np.zeros((0, 4, 4)))
    np.testing.assert_array_equal(
        everything, last.grid.centres[last.grid.observe(views[2].depth, views[2].camera, views[2].T_world_camera)]
    )


def test_objects_in_the_world_explain_views_in_a_frame_beside_it(heap):
    """As objects in the frame of the views do, whose centres are then moved to the world."""
    scene, views = heap
    surface, known = ObservedSurface(load_object("coffee_cup")), scene.T_world_object[4:]
    add(surface, views)
    T_world_anchor = make_transform(Rotation.from_euler("z", 5, degrees=True).as_matrix(), [0.03, -0.02, 0.01])
    left = surface.unexplained(known)
    found = surface.unexplained(T_world_anchor @ known, T_world_anchor)
    moved = left @ T_world_anchor[:3, :3].T + T_world_anchor[:3, 3]
    np.testing.assert_allclose(found, moved[surface.grid.holds(moved)], atol=1e-9)
    assert len(surface.unexplained(known, T_world_anchor)) > len(left) > 0


def test_nothing_is_unexplained_beside_the_workspace(heap):
    """Cells that the correction of the cameras moves below the workspace, such as those of the floor, are left out."""
    surface = ObservedSurface(load_object("coffee_cup"))
    add(surface, heap[1])
    none, down = np.zeros((0, 4, 4)), make_transform(np.eye(3), [0.0, 0.0, -0.05])
    every, left = surface.unexplained(none), surface.unexplained(none, down)
    expected = every[every[:, 2] - 0.05 >= surface.grid.floor]
    np.testing.assert_allclose(left, expected - [0.0, 0.0, 0.05], atol=1e-9)
    assert 0 < len(left) < len(every)
