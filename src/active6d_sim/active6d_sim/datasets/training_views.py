"""Views with ground truth to learn a pose estimator from: random heaps, bins, looks, cameras and sensor noise.

Test scenes are never learned from: heaps to learn from are dropped from their own range of seeds, which
:func:`training_heap` insists on.
"""

from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from active6d_core.camera import DEFAULT_CAMERA, PinholeCamera, View
from active6d_core.object_model import ObjectModel, load_object
from active6d_core.se3 import invert, look_at, make_transform
from active6d_core.training_view import TrainingView
from active6d_core.view_sphere import ViewSphere
from active6d_sim.physics.heap import drop_heap
from active6d_sim.rendering.appearance import Appearance
from active6d_sim.rendering.renderer import SceneRenderer
from active6d_sim.rendering.sensor import SensorNoise
from active6d_sim.scenes.scene import Bin, Scene
from active6d_sim.scenes.scene_store import load_scene

#: Heaps to learn from are dropped from seeds from here on; those of stored scenes and of episodes are smaller.
FIRST_SEED = 1_000_000

_VIEWS_PER_LOOK = 8  # a look costs as much as four views


def training_heap(model: ObjectModel, seed: int) -> Scene:
    """Drop a random heap: a single object up to a few more than usual, in a bin with or without walls.

    Raises:
        ValueError: ``seed`` is below :data:`FIRST_SEED`.
    """
    if seed < FIRST_SEED:
        raise ValueError(f"heaps to learn from need seeds from {FIRST_SEED} on, got {seed}: others are for evaluation")
    rng = np.random.default_rng([seed, 1])
    most = model.instances[1]
    count = int(rng.integers(model.instances[0], most + 3) if rng.random() < 0.7 else rng.integers(1, most))
    usual = Bin.for_model(model)
    width, depth = usual.inner_width * rng.uniform(0.85, 1.25, 2)
    height = 0.0 if rng.random() < 0.25 else usual.wall_height * rng.uniform(0.3, 1.5)
    return drop_heap(model, seed, count=count, bin=Bin(width, depth, height), name=f"{model.name}/training/{seed}")


def random_camera(rng: np.random.Generator, width: int = 640, height: int = 480) -> tuple[PinholeCamera, np.ndarray]:
    """Intrinsics, and a (4, 4) ``T_world_camera`` that looks about at the bin from anywhere above the table.

    Most cameras stand upright, as on the view hemisphere; a fifth are turned about their axis at will.
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
    """``count`` views of a heap: random cameras, noise up to doubled, and another look every few views.

    Args:
        scene: from :func:`training_heap`.
        model: its object.
        count: of views.
        rng: source of randomness.
        truth_scale: resolution of the truth, relative to the view's.
        threads: for ray casting, 0 for all cores.
    """
    for index in range(count):
        if index % _VIEWS_PER_LOOK == 0:
            renderer = SceneRenderer(scene, model=model, appearance=Appearance.random(rng), threads=threads)
        camera, T_world_camera = random_camera(rng)
        yield _capture(renderer, camera, T_world_camera, SensorNoise().scaled(rng.uniform(0, 2)), rng, truth_scale)


def validation_views(
    object_name: str, index: int, *, count: int = 12, truth_scale: float = 0.25, threads: int = 0
) -> Iterator[TrainingView]:
    """``count`` views of the grid of one stored scene of the validation split, as the simulator shows them."""
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
