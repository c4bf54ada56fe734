"""Augmentation of training views. Views are never mirrored, because that would show another object."""

from dataclasses import replace

import numpy as np

from active6d_core.camera import PinholeCamera, View
from active6d_core.training_view import TrainingView
from active6d_perception.estimators.dense.network_input import OUTPUT_STRIDE


def augment(view: View, rng: np.random.Generator) -> View:
    """Change colour balance, exposure, contrast and image noise; add noise to depth and remove some of it.

    Colour helps and must not decide: a fifth of the views have mixed channels, a fifth are grey, a fifth have none.
    """
    color = view.color.astype(np.float32) / 255
    color = color ** rng.uniform(0.7, 1.4) * rng.uniform(0.75, 1.25) * rng.uniform(0.85, 1.15, 3).astype(np.float32)
    draw = rng.random()
    if draw < 0.2:
        color = color @ rng.dirichlet(np.ones(3), 3).astype(np.float32).T
    elif draw < 0.4:
        color = np.broadcast_to(color.mean(axis=-1, keepdims=True), color.shape)
    elif draw < 0.6:
        color = np.full(color.shape, rng.uniform(0.2, 0.8), np.float32)
    color = color + rng.normal(0, rng.uniform(0, 0.03), color.shape).astype(np.float32)
    depth = view.depth + rng.normal(0, rng.uniform(0, 0.001), view.depth.shape).astype(np.float32)
    depth[_blobs(view.depth.shape, rng)] = np.nan
    return replace(view, color=np.rint(np.clip(color, 0, 1) * 255).astype(np.uint8), depth=depth)


def crop(sample: TrainingView, height: int, width: int, rng: np.random.Generator) -> TrainingView:
    """Cut a window around a random object pixel, or by chance (a quarter) any pixel.

    Most of a view shows the table, from which little is learned, but what is no object must be seen as well.

    Args:
        sample: training view at the network's input resolution; a smaller one is returned whole.
        height: of the window in pixels, a multiple of the network's output stride.
        width: of the window in pixels, likewise.
        rng: random generator.
    """
    on_object = np.argwhere(sample.instance >= 0)
    if len(on_object) and rng.random() < 0.75:
        centre = on_object[rng.integers(len(on_object))]
    else:
        centre = rng.integers(0, sample.instance.shape)
    size = np.minimum((height, width), sample.view.depth.shape) // OUTPUT_STRIDE
    top, left = np.clip(centre - size // 2, 0, np.array(sample.instance.shape) - size)
    coarse = slice(top, top + size[0]), slice(left, left + size[1])
    fine = tuple(slice(part.start * OUTPUT_STRIDE, part.stop * OUTPUT_STRIDE) for part in coarse)
    camera = sample.view.camera
    cropped = PinholeCamera(
        int(size[1]) * OUTPUT_STRIDE,
        int(size[0]) * OUTPUT_STRIDE,
        camera.fx,
        camera.fy,
        camera.cx - fine[1].start,
        camera.cy - fine[0].start,
    )
    view = replace(sample.view, color=sample.view.color[fine], depth=sample.view.depth[fine], camera=cropped)
    return replace(sample, view=view, surface_depth=sample.surface_depth[coarse], instance=sample.instance[coarse])


def _blobs(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """(h, w) bool: a few ellipses of missing depth, as on shiny surfaces; half of the views have none."""
    hidden = np.zeros(shape, bool)
    for _ in range(rng.integers(1, 8) if rng.random() < 0.5 else 0):
        centre, radius = rng.uniform(0, shape), rng.uniform(2, 10, 2)
        low = np.maximum(np.ceil(centre - radius), 0).astype(int)
        high = np.minimum(np.floor(centre + radius) + 1, shape).astype(int)
        v, u = np.ogrid[low[0] : high[0], low[1] : high[1]]
        hidden[low[0] : high[0], low[1] : high[1]] |= ((v - centre[0]) / radius[0]) ** 2 + (
            (u - centre[1]) / radius[1]
        ) ** 2 < 1
    return hidden
