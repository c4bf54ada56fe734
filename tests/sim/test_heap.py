"""Heaps: reproducible, at rest, in the bin, and no object in another."""

import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import open3d as o3d
import pytest
import trimesh

from active6d_core.object_model import load_object
from active6d_core.se3 import invert, is_rigid, transform_points
from active6d_sim.physics import heap
from active6d_sim.physics.bullet import connect, decompose
from active6d_sim.scenes.scene import Bin, Scene


def closed_part(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The largest closed body, of which inside and outside are defined (the mug's handle is open inside the wall)."""
    return max(mesh.split(only_watertight=True), key=lambda body: body.volume)


def deepest_penetration(name: str, T_world_object: np.ndarray) -> float:
    """Metres that a surface point of one object lies inside another, at most."""
    model = load_object(name)
    body = closed_part(model.mesh)
    caster = o3d.t.geometry.RaycastingScene()
    caster.add_triangles(body.vertices.astype(np.float32), body.faces.astype(np.uint32))
    points = model.surface[0][::4]
    deepest = 0.0
    for i, T_a in enumerate(T_world_object):
        for j, T_b in enumerate(T_world_object):
            if i != j and np.linalg.norm(T_a[:3, 3] - T_b[:3, 3]) < model.diameter:
                in_a = transform_points(invert(T_a) @ T_b, points).astype(np.float32)
                deepest = max(deepest, -float(caster.compute_signed_distance(in_a, nsamples=3).numpy().min()))
    return deepest


@pytest.fixture(params=["bunny_heap", "mug_heap"])
def scene(request) -> Scene:
    return request.getfixturevalue(request.param)


def test_objects_do_not_penetrate_each_other(scene):
    assert deepest_penetration(scene.object_name, scene.T_world_all) < 0.0015
    squeezed = scene.T_world_all.copy()
    squeezed[:, :3, 3] *= 0.8
    assert deepest_penetration(scene.object_name, squeezed) > 0.003  # the measure does see penetration


def test_objects_lie_in_the_bin(scene):
    vertices = transform_points(scene.T_world_all, np.asarray(load_object(scene.object_name).mesh.vertices))
    assert vertices[..., 2].min() > -0.001
    outer = scene.bin.inner_width / 2 + scene.bin.wall_thickness
    assert np.abs(scene.T_world_all[:, :2, 3]).max() < outer
    below_rim = vertices[vertices[..., 2] < scene.bin.wall_height]
    assert np.abs(below_rim[:, :2]).max() < scene.bin.inner_width / 2 + 0.002


def test_objects_rest(scene):
    """Half a second later, in a fresh physics server with little damping, nothing has moved by a millimetre."""
    model = load_object(scene.object_name)
    client = connect()
    client.setGravity(0, 0, -9.81)
    client.setPhysicsEngineParameter(fixedTimeStep=1 / 240, numSolverIterations=50)
    heap.add_bin(client, scene.bin)
    shape = client.createCollisionShape(client.GEOM_MESH, fileName=str(heap.collision_file(model)))
    bodies = []
    for T in scene.T_world_all:
        quaternion = heap.Rotation.from_matrix(T[:3, :3]).as_quat()
        bodies.append(client.createMultiBody(0.2, shape, basePosition=T[:3, 3], baseOrientation=quaternion))
        client.changeDynamics(bodies[-1], -1, lateralFriction=0.5)
    for _ in range(120):
        client.stepSimulation()
    moved = [np.linalg.norm(np.array(client.getBasePositionAndOrientation(b)[0]) - T[:3, 3])
             for b, T in zip(bodies, scene.T_world_all, strict=True)]  # fmt: skip
    client.disconnect()
    assert max(moved) < 0.001


def test_same_seed_same_heap_other_seed_other_heap():
    model = load_object("coffee_cup")
    first, again, other = (heap.simulate_heap(model, seed, count=2) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.T_world_object, again.T_world_object)
    np.testing.assert_array_equal(first.visible_fraction, again.visible_fraction)
    assert not np.allclose(first.T_world_object, other.T_world_object)


def test_scene_says_where_it_comes_from(bunny_heap):
    assert bunny_heap.name == "bunny/seed/5"
    assert is_rigid(bunny_heap.T_world_all)
    assert len(bunny_heap) + len(bunny_heap.T_world_hidden) == 7
    assert bunny_heap.visible_fraction.shape == (100, len(bunny_heap))
    assert (bunny_heap.visible_fraction.max(axis=0) >= heap.VISIBILITY_THRESHOLD).all()


def test_fallen_objects_leave():
    """On a plate too small for them, objects fall to the table: they are in no scene."""
    model = load_object("coffee_cup")
    scene = heap.simulate_heap(model, 1, count=3, bin=Bin(0.08, 0.08, 0.0))
    assert len(scene.T_world_all) < 3


def test_count_below_one_is_refused():
    with pytest.raises(ValueError, match="count=0"):
        heap.simulate_heap(load_object("mug"), 0, count=0)


@pytest.mark.parametrize("name", ["mug", "bunny", "coffee_cup"])
def test_collision_shape_is_near_the_mesh(name):
    """Convex parts enclose the surface, and by little: hollow mugs stay hollow."""
    model = load_object(name)
    text = heap.collision_file(model).read_text().splitlines()
    vertices = np.array([line.split()[1:4] for line in text if line.startswith("v ")], float)
    groups, current = [], []
    for line in text:
        if line.startswith("o "):
            current = []
            groups.append(current)
        elif line.startswith("f "):
            current.extend(int(part.split("/")[0]) - 1 for part in line.split()[1:])
    volume = sum(trimesh.convex.convex_hull(vertices[np.unique(group)]).volume for group in groups)
    assert volume < {"mug": 1.5, "bunny": 1.4, "coffee_cup": 1.15}[name] * model.mesh.volume
    np.testing.assert_allclose(np.ptp(vertices, axis=0), model.mesh.extents, atol=0.002)


def test_scene_survives_its_file(bunny_heap, tmp_path):
    bunny_heap.save(tmp_path / "scene.npz")
    again = Scene.load(tmp_path / "scene.npz")
    np.testing.assert_array_equal(again.T_world_object, bunny_heap.T_world_object)
    np.testing.assert_allclose(again.visible_fraction, bunny_heap.visible_fraction, atol=1e-6)
    assert (again.name, again.seed, again.bin, again.object_name) == (
        bunny_heap.name, bunny_heap.seed, bunny_heap.bin, "bunny")  # fmt: skip


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 damaged", None])
def test_damaged_scene_files_are_named(content, tmp_path):
    path = tmp_path / "scene.npz"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ValueError, match=r"scene\.npz"):
        Scene.load(path)


def test_pickled_scene_is_refused(tmp_path):
    np.savez(tmp_path / "scene.npz", object_name=np.array([{"a": 1}], dtype=object))
    with pytest.raises(ValueError, match="not a stored scene"):
        Scene.load(tmp_path / "scene.npz")


@pytest.mark.parametrize("sizes", [(0, 0.3, 0.1), (0.3, -1, 0.1), (0.3, 0.3, -0.1), (np.nan, 0.3, 0.1)])
def test_impossible_bins_are_refused(sizes):
    with pytest.raises(ValueError, match="bin sizes"):
        Bin(*sizes)


def test_convex_parts_are_made_without_pythons_lock(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    model, longest, began = load_object("coffee_cup"), 0.0, time.monotonic()
    with ThreadPoolExecutor(1) as pool:
        made = pool.submit(heap.collision_file, model)
        while not made.done():
            last = time.monotonic()
            time.sleep(0.001)
            longest = max(longest, time.monotonic() - last)
    assert made.result().is_file()
    assert longest < (time.monotonic() - began) / 4, "Ctrl-C would have waited for as long"


def test_convex_parts_that_cannot_be_made_are_named(tmp_path):
    with pytest.raises(OSError, match=r"parts\.obj was not made from .*none\.obj"):
        decompose(str(tmp_path / "none.obj"), str(tmp_path / "parts.obj"), str(tmp_path / "log"))
