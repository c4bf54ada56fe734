"""Simulated training views for pose estimators: random heaps, bins, appearances, cameras and sensor noise.

Heaps for training have their own range of seeds, which :func:`training_heap` enforces, so that none of them is a test
scene.
"""

from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from active6d_core.camera import DEFAULT_CAMERA, PinholeCamera, View
from active6d_core.object_model import ObjectModel, load_object
from active6d_core.se3 import invert, look_at, make_transform
from active6d_core.training_view import TrainingView
from active6d_core.view_sphere import ViewSphere
from active6d_sim.physics.heap import simulate_heap
from active6d_sim.rendering.appearance import Appearance
from active6d_sim.rendering.renderer import SceneRenderer
from active6d_sim.rendering.sensor import SensorNoise
from active6d_sim.scenes.scene import Bin, Scene
from active6d_sim.scenes.scene_store import load_scene

#: Smallest seed of heaps for training; the seeds of stored scenes and of episodes are smaller.
FIRST_SEED = 1_000_000

_VIEWS_PER_APPEARANCE = 8  # a new appearance takes as long as four views


def training_heap(model: ObjectModel, seed: int) -> Scene:
    """Simulate a random heap: from one object to a few more than usual, in a bin with or without walls.

    Raises:
        ValueError: ``seed`` is below :data:`FIRST_SEED`.
    """
    if seed < FIRST_SEED:
        raise ValueError(f"heaps for training need seeds from {FIRST_SEED} on, got {seed}: others are for evaluation")
    rng = np.random.default_rng([seed, 1])
    most = model.instances[1]
    count = int(rng.integers(model.instances[0], most + 3) if rng.random() < 0.7 else rng.integers(1, most))
    usual = Bin.for_model(model)
    width, depth = usual.inner_width * rng.uniform(0.85, 1.25, 2)
    height = 0.0 if rng.random() < 0.25 else usual.wall_height * rng.uniform(0.3, 1.5)
    return simulate_heap(model, seed, count=count, bin=Bin(width, depth, height), name=f"{model.name}/training/{seed}")


def random_camera(rng: np.random.Generator, width: int = 640, height: int = 480) -> tuple[PinholeCamera, np.ndarray]:
    """Random intrinsics, and a (4, 4) ``T_world_camera`` that looks approximately at the bin from above the table.

    Most cameras are nearly upright, as on the view hemisphere; a fifth have a random roll angle.

    Args:
        rng: random generator.
        width: image width in pixels.
        height: image height in pixels.
    """
    camera = PinholeCamera.from_field_of_view(width, height, rng.uniform(56.0, 64.0))
    azimuth, elevation = rng.uniform(0, 2 * np.pi), np.arcsin(rng.uniform(np.sin(np.radians(12)), 1.0))
    direction = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    T_world_camera = look_at(rng.uniform(0.55, 1.05) * direction, rng.normal(0.0, (0.04, 0.04, 0.02)))
    roll = rng.uniform(-np.pi, np.pi) if rng.random() < 0.2 else rng.normal(0.0, 0.15)
    return camera, T_world_camera @ make_transform(Rotation.from_euler("z", roll).as_matrix(), np.zeros(3))


def training_views(
    scene: Scene,
    model: ObjectModel,
    count: int,
    rng: np.random.Generator,
    *,
    truth_scale: float = 0.25,
    threads: int = 0,
) -> Iterator[TrainingView]:
    """Simulate views of a heap from random cameras.

    The sensor noise is up to twice the default, and the appearance changes every few views.

    Args:
        scene: from :func:`training_heap`.
        model: its object.
        count: number of views.
        rng: random generator.
        truth_scale: resolution of the truth relative to the view.
        threads: number of threads for ray casting, 0 for one per core.
    """
    for index in range(count):
        if index % _VIEWS_PER_APPEARANCE == 0:
            renderer = SceneRenderer(scene, model=model, appearance=Appearance.random(rng), threads=threads)
        camera, T_world_camera = random_camera(rng)
        yield _capture(renderer, camera, T_world_camera, SensorNoise().scaled(rng.uniform(0, 2)), rng, truth_scale)


def validation_views(
    object_name: str, index: int, *, count: int = 12, truth_scale: float = 0.25, threads: int = 0
) -> Iterator[TrainingView]:
    """Simulate views of one stored scene of the validation split with the simulator's default camera and noise.

    Args:
        object_name: name of the object.
        index: of the scene in the split.
        count: number of views, drawn from the grid of the view hemisphere.
        truth_scale: resolution of the truth relative to the view.
        threads: number of threads for ray casting, 0 for one per core.
    """
    scene = load_scene(object_name, "val", index)
    renderer = SceneRenderer(scene, model=load_object(object_name), appearance_seed=scene.seed, threads=threads)
    rng, sphere = np.random.default_rng(scene.seed), ViewSphere()
    for view in rng.choice(len(sphere), count, replace=False):
        yield _capture(renderer, DEFAULT_CAMERA, sphere.pose(sphere.positions[view]), SensorNoise(), rng, truth_scale)


def _capture(
    renderer: SceneRenderer,
    camera: PinholeCamera,
    T_world_camera: np.ndarray,
    noise: SensorNoise,
    rng: np.random.Generator,
    truth_scale: float,
) -> TrainingView:
    rendered = renderer.render(T_world_camera, camera)
    color, depth = noise.measure(rendered, camera, rng)
    coarse = camera.scaled(truth_scale)
    truth = renderer.render(T_world_camera, coarse, shaded=False)
    visible, whole = renderer.instance_layers(T_world_camera, coarse)
    return TrainingView(
        View(0, color, depth, camera, T_world_camera),
        truth.depth,
        truth.instance,
        invert(T_world_camera) @ renderer.scene.T_world_all,
        np.divide(visible, whole, out=np.zeros(len(visible)), where=whole > 0),
    )
