"""Fit the score of the training-free estimator: a logistic regression of whether a candidate pose is right.

Example: python -m active6d_tools.studies.fit_geometric_score --views 18

Candidates come from validation views of the shipped objects, where poses are known. Views of other objects, and
pictures of random boxes, cylinders, cones and walls, hold no object that is looked for: all candidates there are wrong.
"""

import argparse
from collections.abc import Callable, Iterator
from typing import cast

import numpy as np
import open3d as o3d
import trimesh
from rich.console import Console
from rich.progress import track
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from scipy.special import expit

from active6d_core.camera import DEFAULT_CAMERA, pixel_rays
from active6d_core.metrics import DETECTION_FRACTION, add_s, e_add
from active6d_core.object_model import ObjectModel, load_object
from active6d_core.se3 import invert
from active6d_perception.estimators.geometric.foreground import measure_surface
from active6d_perception.estimators.geometric.geometric_estimator import GeometricEstimator
from active6d_perception.model.model_views import ray_caster
from active6d_sim.scenes.scene_store import SPLITS, load_scene
from active6d_tools.benchmark.grid_views import GridViews

# A mug counts by ADD-S: where its handle is hidden, no estimator can know how it is turned.
OBJECTS = {"coffee_cup": e_add, "bunny": e_add, "mug": add_s}
_REGULARISATION = 1e-3


def validation_views(name: str, count: int, rng: np.random.Generator) -> list[tuple[np.ndarray, np.ndarray]]:
    """(H, W) depth and (n, 4, 4) true ``T_camera_object`` of random views of the validation scenes."""
    scenes = [load_scene(name, "val", index) for index in range(SPLITS["val"])]
    grid = GridViews(load_object(name), scenes, seed=0)
    views = []
    for number in range(count):
        labelled = grid.capture(number % len(scenes), int(rng.integers(100)), 1.0)
        views.append((labelled.view.depth, invert(labelled.view.T_world_camera) @ labelled.T_world_object))
    return views


def clutter(rng: np.random.Generator) -> np.ndarray:
    """(H, W) depth of random primitives and walls as a stereo camera sees them, metres; NaN invalid."""
    far = rng.uniform(0.7, 3.0)
    parts = []
    for _ in range(rng.integers(1, 4)):
        wall = trimesh.creation.box((6.0, 6.0, 0.02))
        wall.apply_transform(_pose(rng, (far, far + 1.0)))
        parts.append(wall)
    for _ in range(rng.integers(8, 30)):
        shapes: list[Callable[[], trimesh.Trimesh]] = [
            lambda: trimesh.creation.box(rng.uniform(0.02, 0.3, 3)),
            lambda: trimesh.creation.cylinder(rng.uniform(0.003, 0.06), rng.uniform(0.05, 0.4)),
            lambda: trimesh.creation.icosphere(3, rng.uniform(0.02, 0.08)),
            lambda: trimesh.creation.capsule(rng.uniform(0.1, 0.5), rng.uniform(0.003, 0.02)),
            lambda: trimesh.creation.cone(rng.uniform(0.02, 0.08), rng.uniform(0.05, 0.15)),
        ]
        part = shapes[rng.integers(5)]()
        part.apply_transform(_pose(rng, (0.5, far)))
        parts.append(part)
    rays = pixel_rays(DEFAULT_CAMERA)
    bundle = o3d.core.Tensor(np.concatenate([np.zeros_like(rays), rays], axis=-1))
    depth = ray_caster(cast(trimesh.Trimesh, trimesh.util.concatenate(parts))).cast_rays(bundle)["t_hit"].numpy()
    depth[~np.isfinite(depth)] = np.nan
    noise = gaussian_filter(rng.normal(size=depth.shape), 1.2)
    inverse = 1.0 / depth + rng.uniform(0.001, 0.004) * noise / noise.std()
    sensed = 1.0 / (np.round(inverse / 0.0015) * 0.0015)
    filled = np.nan_to_num(depth)
    edge = maximum_filter(filled, 5) - minimum_filter(filled, 5) > 0.03
    sensed[edge & (rng.random(depth.shape) < 0.5)] = np.nan
    return sensed.astype(np.float32)


def _pose(rng: np.random.Generator, distances: tuple[float, float]) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.random(rng=rng).as_matrix()
    z = rng.uniform(*distances)
    T[:3, 3] = rng.uniform(-0.5, 0.5) * z, rng.uniform(-0.4, 0.4) * z, z
    return T


def is_right(model: ObjectModel, T: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(k,) whether each of (k, 4, 4) poses is within 10 % of the diameter of a true one."""
    right = np.zeros(len(T), bool)
    near = np.linalg.norm(T[:, None, :3, 3] - truth[:, :3, 3], axis=-1) < 0.5 * model.diameter
    for pose, other in zip(*np.nonzero(near), strict=True):
        right[pose] |= OBJECTS[model.name](model, T[pose], truth[other]) < DETECTION_FRACTION * model.diameter
    return right


def collect(count: int, rng: np.random.Generator) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """(k, features) and (k,) labels of the candidates of every view."""
    views = {name: validation_views(name, count, rng) for name in OBJECTS}
    pictures = [clutter(rng) for _ in range(count)]
    for name in OBJECTS:
        model = load_object(name)
        estimator = GeometricEstimator(model)
        nothing = np.zeros((0, 4, 4))
        empty = [(depth, nothing) for other in OBJECTS if other != name for depth, _ in views[other][: count // 3]]
        empty += [(depth, nothing) for depth in pictures]
        for depth, truth in track([*views[name], *empty], description=name):
            T, _, features = estimator.candidates(measure_surface(depth, DEFAULT_CAMERA, model.diameter))
            yield features, is_right(model, T, truth)


def fit(features: np.ndarray, right: np.ndarray) -> np.ndarray:
    """(features + 1,) weights and offset of a logistic regression."""
    columns = np.column_stack([features, np.ones(len(features))])

    def loss(weights: np.ndarray) -> float:
        logit = columns @ weights
        return np.mean(np.logaddexp(0.0, logit) - right * logit) + _REGULARISATION * np.mean(weights[:-1] ** 2)

    return minimize(loss, np.zeros(columns.shape[1])).x


def main() -> None:
    """Collect candidates, fit, and print the weights."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, default=18, help="of every object, and pictures of clutter")
    arguments = parser.parse_args()
    collected = list(collect(arguments.views, np.random.default_rng(0)))
    features, right = (np.concatenate(parts) for parts in zip(*collected, strict=True))
    weights = fit(features, right)
    sure = expit(np.column_stack([features, np.ones(len(features))]) @ weights) >= 0.5
    console = Console()
    console.print(f"weights {weights[:-1].round(2).tolist()}, offset {weights[-1]:.2f}")
    console.print(f"{len(right)} candidates, {right.sum()} right; with score >= .5: {sure.sum()}", highlight=False)
    console.print(f"of these right {right[sure].mean():.2f}; of the right ones found {sure[right].mean():.2f}")


if __name__ == "__main__":
    main()
