"""Changes to a training view that leave its truth as it is. Mirroring is none of them: it makes another object."""

from dataclasses import replace

import numpy as np

from active6d_perception.dense.network_input import ReducedView


def augment(view: ReducedView, rng: np.random.Generator) -> ReducedView:
    """Another colour balance, exposure, contrast and grain, and some depth missing or coarser."""
    color = view.color.astype(np.float32) / 255
    color = color ** rng.uniform(0.7, 1.4) * rng.uniform(0.75, 1.25) * rng.uniform(0.85, 1.15, 3).astype(np.float32)
    if rng.random() < 0.15:
        color = np.broadcast_to(color.mean(axis=-1, keepdims=True), color.shape)
    color = color + rng.normal(0, rng.uniform(0, 0.03), color.shape).astype(np.float32)
    depth = view.depth + rng.normal(0, rng.uniform(0, 0.001), view.depth.shape).astype(np.float32)
    depth[_blobs(view.depth.shape, rng)] = np.nan
    return replace(view, color=np.rint(np.clip(color, 0, 1) * 255).astype(np.uint8), depth=depth)


def _blobs(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """(h, w) bool: a few ellipses in which depth is missing, as on shiny surfaces; none in half of the views."""
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
