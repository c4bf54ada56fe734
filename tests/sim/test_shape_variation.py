"""Variants of a part's mesh deviate from it by some millimetres and stay what they are."""

from dataclasses import replace

import numpy as np
import open3d as o3d
import pytest
import trimesh

from active6d_core.object_model import load_object
from active6d_sim.datasets.training_views import seen_model
from active6d_sim.scenes.scene import Bin, Scene
from active6d_sim.scenes.shape_variation import ShapeVariation, vary_shape
from active6d_sim.scenes.surroundings import Surroundings


def distance(mesh, points):
    """(n,) metres from the mesh's surface."""
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.uint32))
    return scene.compute_distance(np.asarray(points, np.float32)).numpy()


@pytest.mark.parametrize("name", ["coffee_cup", "bunny", "mug"])
def test_a_variant_deviates_by_some_millimetres(name):
    model = load_object(name)
    for seed in range(3):
        variant = vary_shape(model, np.random.default_rng(seed))
        points, _ = trimesh.sample.sample_surface(variant, 500, seed=0)
        off = distance(model.mesh, points) / model.diameter
        assert 0.003 < off.max() < 0.12
        assert off.mean() > 0.001


def test_a_surface_of_revolution_stays_one():
    model = load_object("coffee_cup")
    variant = vary_shape(model, np.random.default_rng(4))
    quarter = trimesh.transformations.rotation_matrix(np.pi / 2, model.symmetry.axis)
    turned = trimesh.transform_points(variant.vertices, quarter)
    # Within what the flat faces of both differ by.
    assert distance(variant, turned).max() < 0.0005


def test_without_deviations_the_surface_is_that_of_the_mesh():
    model = load_object("mug")
    same = vary_shape(model, np.random.default_rng(0), ShapeVariation(0.0, 0.0, 0.0, 0.0))
    assert same.area == pytest.approx(model.mesh.area)
    assert len(same.faces) > len(model.mesh.faces)
    # No edge is longer than what the deviations need.
    assert same.edges_unique_length.max() < model.diameter / 15


def test_half_of_the_wild_scenes_have_variants():
    model = load_object("bunny")
    bin = Bin.for_model(model)
    scenes = [Scene("bunny", "s", seed, np.zeros((0, 4, 4)), bin, np.zeros((0, 0))) for seed in range(40)]
    assert all(seen_model(scene, model) is model for scene in scenes)
    wild = [seen_model(replace(scene, surroundings=Surroundings()), model) for scene in scenes]
    assert 10 < sum(each is not model for each in wild) < 30
    assert all(each.mesh is model.mesh or len(each.mesh.faces) > len(model.mesh.faces) for each in wild)
