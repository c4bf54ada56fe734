"""Kinds of depth cameras by name: the distances that they measure well, and errors that can be removed."""

from dataclasses import dataclass

import numpy as np

# A flying pixel differs from the surfaces before and behind it by more than this share of its depth.
_JUMP = 0.01


@dataclass(frozen=True)
class DepthCamera:
    """What is known of a kind of camera.

    Attributes:
        depth_range: nearest and farthest distance that it measures well, metres.
        flying_pixels: whether pixels at edges mix the near and the far surface.
    """

    depth_range: tuple[float, float]
    flying_pixels: bool = False


#: By the names of the simulated sensors. Ranges are those of common short-range models.
DEPTH_CAMERAS = {
    "active_stereo": DepthCamera((0.2, 3.0)),
    "structured_light": DepthCamera((0.3, 3.5)),
    "time_of_flight": DepthCamera((0.2, 4.5), flying_pixels=True),
}


def depth_camera(name: str) -> DepthCamera:
    """The kind of that name.

    Raises:
        ValueError: no such kind; the message lists the known ones.
    """
    if name not in DEPTH_CAMERAS:
        raise ValueError(f"unknown kind of depth camera '{name}'; known: {', '.join(DEPTH_CAMERAS)}")
    return DEPTH_CAMERAS[name]


def without_flying_pixels(depth: np.ndarray) -> np.ndarray:
    """Depth with NaN for pixels that hang between the surfaces on both sides, in a row or in a column.

    Args:
        depth: (H, W) float32 metres, NaN where invalid.
    """
    flying = np.zeros(depth.shape, bool)
    for across in (depth, depth.T):
        before, pixel, after = across[:, :-2], across[:, 1:-1], across[:, 2:]
        least = _JUMP * pixel
        falls = (before - pixel > least) & (pixel - after > least)
        rises = (pixel - before > least) & (after - pixel > least)
        (flying if across is depth else flying.T)[:, 1:-1] |= falls | rises
    return np.where(flying, np.float32(np.nan), depth)
