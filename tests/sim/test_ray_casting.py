"""Rendered depth, object numbers and normals against closed forms and against a ray caster of the test's own."""

import numpy as np
import pytest
import trimesh
from hand_made_scenes import CAMERA, SPHERE, make_model, make_scene, three_mugs
from scipy.spatial.transform import Rotation

from active6d_core.camera import pixel_rays
from active6d_core.object_model import load_object
from active6d_core.se3 import look_at, make_transform, transform_points
from active6d_sim.rendering import renderer as renderer_module
from active6d_sim.rendering.renderer import SceneRenderer, visible_fractions
from active6d_sim.scenes.scene import Bin

BRICK = np.array([0.10, 0.06, 0.04])
WIDE = Bin(2.0, 2.0, 0.0, 0.01)
#: Poses without symmetry, so that no ray meets an edge exactly.
EYES = [(0.31, 0.23, 0.52), (-0.42, 0.17, 0.28), (0.05, -0.61, 0.19), (0.013, 0.021, 0.8)]


def world_rays(T_world_camera):
    """Origin (3,) and (p, 3) directions whose parameter is the depth."""
    return T_world_camera[:3, 3], pixel_rays(CAMERA).reshape(-1, 3).astype(float) @ T_world_camera[:3, :3].T


def meet_box(eye, directions, T_world_box, sizes):
    """Slab method: (p,) ray parameter, inf for a miss, and (p, 3) outward normals in the world."""
    R, centre = T_world_box[:3, :3], T_world_box[:3, 3]
    origin, along = (eye - centre) @ R, directions @ R
    with np.errstate(divide="ignore"):
        ends = np.stack([(-sizes / 2 - origin) / along, (sizes / 2 - origin) / along])
    near, far = ends.min(axis=0), ends.max(axis=0)
    enter, axis = near.max(axis=1), near.argmax(axis=1)
    hit = (enter < far.min(axis=1)) & (enter > 0)
    normals = -np.sign(np.take_along_axis(along, axis[:, None], 1)) * np.eye(3)[axis] @ R.T
    return np.where(hit, enter, np.inf), normals


def at(x, y, z):
    return make_transform(np.eye(3), [x, y, z])


def tray_boxes(bin):
    """Floor and walls, overlapping at the corners."""
    w, d, h, t = bin.inner_width, bin.inner_depth, bin.wall_height, bin.wall_thickness
    yield at(0, 0, -t / 2), np.array([w + 2 * t, d + 2 * t, t])
    for side in (-1, 1):
        yield at(side * (w + t) / 2, 0, h / 2), np.array([t, d + 2 * t, h])
        yield at(0, side * (d + t) / 2, h / 2), np.array([w + 2 * t, t, h])


@pytest.mark.parametrize("eye", EYES)
def test_bricks_in_a_tray_are_where_geometry_puts_them(eye):
    bin = Bin(0.36, 0.30, 0.06, 0.01)
    R = Rotation.from_euler("xyz", [[10, 20, 30], [70, -15, 120]], degrees=True).as_matrix()
    T_world_object = make_transform(R, [[-0.07, 0.02, 0.08], [0.08, -0.03, 0.07]])
    renderer = SceneRenderer(make_scene(T_world_object, bin), model=make_model(trimesh.creation.box(BRICK)))
    T_world_camera = look_at(eye, (0.01, 0.02, 0.03))
    view = renderer.render(T_world_camera, CAMERA)

    origin, directions = world_rays(T_world_camera)
    boxes = [*((T, BRICK) for T in T_world_object), *tray_boxes(bin)]
    depths, normals = map(np.array, zip(*(meet_box(origin, directions, *box) for box in boxes), strict=True))
    table = (-bin.wall_thickness - origin[2]) / directions[:, 2]
    depths = np.concatenate([depths, np.where(table > 0, table, np.inf)[None]])
    normals = np.concatenate([normals, np.broadcast_to([0.0, 0.0, 1.0], (1, len(table), 3))])
    first = depths.argmin(axis=0)
    expected = depths.min(axis=0)
    # What is further than the table reaches is background.
    on_table = np.abs(origin + directions * expected[:, None])[:, :2].max(axis=1) < 2.4

    rays = np.arange(len(first))
    np.testing.assert_allclose(view.depth.ravel()[on_table], expected[on_table], atol=2e-6)
    np.testing.assert_array_equal(view.instance.ravel(), np.where(on_table & (first < 2), first, -1))
    found = view.normals.reshape(-1, 3) @ T_world_camera[:3, :3].T
    np.testing.assert_allclose(found[on_table], normals[first, rays][on_table], atol=1e-5)
    assert set(np.unique(view.instance)) == {-1, 0, 1}


def test_ball_is_round_and_smooth():
    radius, centre = 0.08, np.array([0.03, -0.02, 0.09])
    model = make_model(trimesh.creation.icosphere(subdivisions=4, radius=radius))
    T_world_camera = look_at((0.3, 0.35, 0.4), centre)
    view = SceneRenderer(make_scene(at(*centre)[None], WIDE), model=model).render(T_world_camera, CAMERA)
    origin, directions = world_rays(T_world_camera)
    b, a = directions @ (origin - centre), (directions**2).sum(axis=1)
    discriminant = b**2 - a * ((origin - centre) @ (origin - centre) - radius**2)
    depth = (-b - np.sqrt(np.maximum(discriminant, 0))) / a
    normals = (origin + directions * depth[:, None] - centre) / radius
    # Away from the outline, where a facet's depth and the ball's differ by little.
    seen = (discriminant > 0) & (np.einsum("ij,ij->i", normals, directions) < -0.5)
    assert seen.sum() > 100
    assert (view.instance.ravel()[seen] == 0).all()
    np.testing.assert_allclose(view.depth.ravel()[seen], depth[seen], atol=1e-3)
    found = view.normals.reshape(-1, 3)[seen] @ T_world_camera[:3, :3].T
    angles = np.degrees(np.arccos(np.clip(np.einsum("ij,ij->i", found, normals[seen]), -1, 1)))
    assert angles.max() < 1.5


def test_nothing_is_nan_minus_one_and_zero():
    renderer = SceneRenderer(make_scene(np.zeros((0, 4, 4)), WIDE), model=make_model(trimesh.creation.box(BRICK)))
    view = renderer.render(look_at((0, 0, 0.5), (1, 0, 1.5)), CAMERA)  # upwards
    assert np.isnan(view.depth).all()
    assert (view.instance == -1).all()
    assert not view.normals.any()


def cast(triangles, eye, directions):
    """Möller and Trumbore, every triangle against every ray: (p,) nearest parameter and its triangle."""
    a, ab, ac = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    across = np.cross(directions[:, None], ac)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1 / np.einsum("ptk,tk->pt", across, ab)
        u = np.einsum("ptk,tk->pt", across, eye - a) * inverse
        away = np.cross(eye - a, ab)
        v = directions @ away.T * inverse
        t = np.einsum("tk,tk->t", ac, away) * inverse
    t = np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0), t, np.inf)
    return t.min(axis=1), t.argmin(axis=1)


@pytest.mark.parametrize("view", [7, 45, 83])
def test_mugs_against_brute_force(view):
    scene, mesh = three_mugs(), load_object("mug").mesh
    T_world_camera = SPHERE.pose(SPHERE.positions[view])
    rendered = SceneRenderer(scene).render(T_world_camera, CAMERA)
    eye, directions = world_rays(T_world_camera)
    chosen = np.random.default_rng(view).choice(len(directions), 400, replace=False)
    chosen = np.union1d(chosen, np.flatnonzero(rendered.instance.ravel() >= 0))
    triangles = np.concatenate([transform_points(T, mesh.vertices)[mesh.faces] for T in scene.T_world_object])
    depth, face = cast(triangles, eye, directions[chosen])
    hit = np.isfinite(depth)
    instance = np.where(hit, face // len(mesh.faces), -1)
    # The tray may be in front of a mug.
    seen = rendered.instance.ravel()[chosen]
    in_front = rendered.depth.ravel()[chosen] < depth - 1e-5
    np.testing.assert_array_equal(seen, np.where(in_front, -1, instance))
    assert (seen >= 0).sum() > 50
    shown = seen >= 0
    np.testing.assert_allclose(rendered.depth.ravel()[chosen][shown], depth[shown], atol=2e-6)


def test_whole_silhouettes_are_those_of_each_object_alone():
    scene = three_mugs()
    renderer = SceneRenderer(scene)
    T_world_camera = SPHERE.pose(SPHERE.positions[3])
    visible, whole = renderer.instance_layers(T_world_camera, CAMERA)
    instance = renderer.render(T_world_camera, CAMERA).instance
    np.testing.assert_array_equal(visible, [(instance == i).sum() for i in range(3)])
    # On a table far below nothing is in front of a mug.
    for i, T in enumerate(scene.T_world_object):
        alone = SceneRenderer(make_scene(at(0, 0, 1.0) @ T[None], WIDE))
        seen = alone.render(at(0, 0, 1.0) @ T_world_camera, CAMERA).instance == 0
        assert abs(int(seen.sum()) - whole[i]) <= 1  # rounding at an outline, a metre further up


def test_what_stands_behind_something_else_is_not_seen():
    T_world_object = np.stack([at(0.1, 0, 0.05), at(-0.1, 0, 0.02)])
    scene = make_scene(T_world_object, WIDE)
    model = make_model(trimesh.creation.box((0.02, 0.4, 0.1)))
    fractions = visible_fractions(scene, model)
    assert fractions.shape == (100, 2)
    front, back = fractions[0]  # from +x, 15 degrees above the horizon
    assert front == 1.0
    assert back < 0.5
    np.testing.assert_allclose(fractions[80:].min(), 1.0, atol=0.25)  # from 75 degrees nearly all


def test_looks_follow_the_seed_and_geometry_does_not():
    T_world_camera = SPHERE.pose(SPHERE.positions[45])
    views = [SceneRenderer(three_mugs(), appearance_seed=seed).render(T_world_camera, CAMERA) for seed in (1, 1, 2)]
    np.testing.assert_array_equal(views[0].color, views[1].color)
    assert (views[0].color != views[2].color).any()
    np.testing.assert_array_equal(views[0].depth, views[2].depth)


def test_geometry_is_the_same_without_shading_and_ambient_light_is_not_computed(monkeypatch):
    T_world_camera = look_at((0.3, -0.4, 0.6), (0, 0, 0))
    shaded = SceneRenderer(three_mugs()).render(T_world_camera, CAMERA)
    monkeypatch.setattr(renderer_module, "_ambient_openness", lambda *arguments: pytest.fail("computed and dropped"))
    bare = SceneRenderer(three_mugs()).render(T_world_camera, CAMERA, shaded=False)
    assert bare.color is None
    for name in ("depth", "instance", "normals"):
        np.testing.assert_array_equal(getattr(bare, name), getattr(shaded, name))
