"""Simulated training views for pose estimators: random scenes, appearances, cameras and sensors.

Scenes for training have their own range of seeds, which :func:`training_scene` enforces, so that none of them is a test
scene.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from active6d_core.camera import DEFAULT_CAMERA, PinholeCamera, View
from active6d_core.object_model import ObjectModel, load_object
from active6d_core.registry import AUTOMATIC
from active6d_core.se3 import invert, look_at, make_transform
from active6d_core.training_view import TrainingView
from active6d_core.view_sphere import ViewSphere
from active6d_sim.physics.heap import simulate_heap
from active6d_sim.rendering.active_stereo import ActiveStereo
from active6d_sim.rendering.appearance import Appearance
from active6d_sim.rendering.random_sensor import random_sensor, sensor_of
from active6d_sim.rendering.renderer import SceneRenderer
from active6d_sim.rendering.sensor_registry import Sensor
from active6d_sim.scenes.scene import Bin, Scene
from active6d_sim.scenes.scene_store import load_scene
from active6d_sim.scenes.shape_variation import vary_shape
from active6d_sim.scenes.wild_scene import wild_pile

#: Smallest seed of heaps for training; the seeds of stored scenes and of episodes are smaller.
FIRST_SEED = 1_000_000

_VIEWS_PER_APPEARANCE = 4
_WILD_SHARE = 0.75
#: Share of wild scenes whose objects deviate from the mesh, all alike.
_VARIED_SHARE = 0.5
#: Widths and heights of images of wild scenes, pixels; one per scene.
_SIZES = ((640, 480), (640, 480), (640, 360), (512, 424), (720, 540))
_TRUTH_SCALE = 0.25  # resolution of the truth relative to the view
_TOO_NEAR = 0.15  # metres
_TRIES = 4  # cameras until one sees something useful


def training_scene(model: ObjectModel, seed: int) -> Scene:
    """Simulate a random scene to train on: a wild one, or by chance a bin of one to a few more objects than usual.

    Raises:
        ValueError: ``seed`` is below :data:`FIRST_SEED`.
    """
    if seed < FIRST_SEED:
        raise ValueError(f"heaps for training need seeds from {FIRST_SEED} on, got {seed}: others are for evaluation")
    rng = np.random.default_rng([seed, 1])
    name = f"{model.name}/training/{seed}"
    if rng.random() < _WILD_SHARE:
        T_objects, bin, around = wild_pile(model, seed)
        return Scene(model.name, name, seed, T_objects, bin, np.zeros((0, len(T_objects))), surroundings=around)
    most = model.instances[1]
    count = int(rng.integers(model.instances[0], most + 3) if rng.random() < 0.7 else rng.integers(1, most))
    usual = Bin.for_model(model)
    width, depth = usual.inner_width * rng.uniform(0.85, 1.25, 2)
    height = 0.0 if rng.random() < 0.25 else usual.wall_height * rng.uniform(0.3, 1.5)
    return simulate_heap(model, seed, count=count, bin=Bin(width, depth, height), name=name)


def seen_model(scene: Scene, model: ObjectModel) -> ObjectModel:
    """The object as it is in a scene for training: in half of the wild ones, of another shape."""
    rng = np.random.default_rng([scene.seed, 5])
    if scene.surroundings is None or rng.random() > _VARIED_SHARE:
        return model
    return replace(model, mesh=vary_shape(model, rng))


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


def wild_camera(rng: np.random.Generator, width: int, height: int) -> tuple[PinholeCamera, np.ndarray]:
    """As :func:`random_camera`, from a wider range of lenses, distances (0.35 to 1.5 m) and aims."""
    _, T_world_camera = random_camera(rng, width, height)
    camera = PinholeCamera.from_field_of_view(width, height, rng.uniform(42.0, 76.0))
    distance = np.exp(rng.uniform(np.log(0.35), np.log(1.5)))
    position = T_world_camera[:3, 3]
    moved = T_world_camera.copy()
    aside = T_world_camera[:3, :2] @ rng.normal(0.0, 0.12 * distance, 2)
    moved[:3, 3] = position * distance / np.linalg.norm(position) + aside
    moved[2, 3] = max(moved[2, 3], 0.08)
    return camera, moved


def training_views(
    scene: Scene,
    model: ObjectModel,
    count: int,
    rng: np.random.Generator,
    *,
    threads: int = 0,
) -> Iterator[TrainingView]:
    """Simulate views of a scene from random cameras; the appearance changes every few views.

    A wild scene is seen by sensors of all kinds, with errors of calibration, by cameras of any lens and distance; its
    objects may deviate from the mesh. A bin on an empty table is seen by the default sensor with up to twice its noise.

    Args:
        scene: from :func:`training_scene`.
        model: its object.
        count: number of views.
        rng: random generator.
        threads: number of threads for ray casting, 0 for one per core.
    """
    wild = scene.surroundings is not None
    renderer = SceneRenderer(scene, model=seen_model(scene, model), threads=threads)
    size = _SIZES[int(rng.integers(len(_SIZES)))] if wild else (640, 480)
    for index in range(count):
        if index % _VIEWS_PER_APPEARANCE == 0:
            renderer.dress(Appearance.wild(rng) if wild else Appearance.random(rng))
        sensor = random_sensor(rng) if wild else ActiveStereo().scaled(rng.uniform(0, 2))
        for _ in range(_TRIES):
            camera, T_world_camera = (wild_camera if wild else random_camera)(rng, *size)
            item = _capture(renderer, camera, T_world_camera, sensor, rng)
            if not wild or _useful(item):
                break
        yield item


def _useful(item: TrainingView) -> bool:
    """Whether a view shows an object and no thing right before the camera."""
    near = np.nan_to_num(item.surface_depth, nan=np.inf) < _TOO_NEAR
    return bool((item.visible_fraction > 0.1).any() and near.mean() < 0.03)


def validation_views(
    object_name: str, split: str, index: int, *, count: int = 12, threads: int = 0
) -> Iterator[TrainingView]:
    """Simulate views of one stored scene with the simulator's default camera, and its default sensor or, of a wild
    scene, random ones.

    Args:
        object_name: name of the object.
        split: ``val`` or ``wild_val``.
        index: of the scene in the split.
        count: number of views, drawn from the grid of the view hemisphere.
        threads: number of threads for ray casting, 0 for one per core.
    """
    scene = load_scene(object_name, split, index)
    renderer = SceneRenderer(scene, model=load_object(object_name), appearance_seed=scene.seed, threads=threads)
    rng, sphere = np.random.default_rng(scene.seed), ViewSphere()
    for view in rng.choice(len(sphere), count, replace=False):
        sensor = sensor_of(AUTOMATIC, renderer.model, scene, int(view))
        yield _capture(renderer, DEFAULT_CAMERA, sphere.pose(sphere.positions[view]), sensor, rng)


def _capture(
    renderer: SceneRenderer,
    camera: PinholeCamera,
    T_world_camera: np.ndarray,
    sensor: Sensor,
    rng: np.random.Generator,
) -> TrainingView:
    rendered = renderer.render(T_world_camera, camera)
    color, depth = sensor.measure(rendered, camera, rng)
    coarse = camera.scaled(_TRUTH_SCALE)
    truth = renderer.render(T_world_camera, coarse, shaded=False)
    visible, whole = renderer.instance_layers(T_world_camera, coarse)
    return TrainingView(
        View(0, color, depth, camera, T_world_camera),
        truth.depth,
        truth.instance,
        invert(T_world_camera) @ renderer.scene.T_world_all,
        np.divide(visible, whole, out=np.zeros(len(visible)), where=whole > 0),
    )
