"""Colours of scores and depths, pictures as data URIs, and everything that is drawn onto one view."""

import base64
import io
from dataclasses import dataclass

import matplotlib
import numpy as np
from PIL import Image

from active6d_bringup.report.analysis import StepAnalysis
from active6d_bringup.report.silhouette import Outline, SilhouetteDrawer
from active6d_core.se3 import invert

# Not from red: a red object would swallow it. These differ in brightness, too, for those who see few colours.
_SCORE_COLORS = np.array([(255, 61, 200), (255, 214, 61), (46, 230, 166)], float)


def score_color(score: float) -> str:
    """``#rrggbb`` of a score in [0, 1]: magenta through amber to green, clipped outside; grey for NaN."""
    if not np.isfinite(score):
        return "#9aa0a6"
    position = np.clip(score, 0.0, 1.0) * (len(_SCORE_COLORS) - 1)
    red, green, blue = (np.interp(position, range(len(_SCORE_COLORS)), channel) for channel in _SCORE_COLORS.T)
    return f"#{round(red):02x}{round(green):02x}{round(blue):02x}"


def depth_to_color(depth: np.ndarray) -> tuple[np.ndarray, tuple[float, float]]:
    """(H, W) metres to an (H, W, 3) uint8 RGB picture, near bright and far dark, black where invalid.

    Returns:
        The picture and the depths in metres (2nd and 98th percentile) of the ends of its scale; (0, 0) if all invalid.
    """
    valid = np.isfinite(depth)
    if not valid.any():
        return np.zeros((*depth.shape, 3), np.uint8), (0.0, 0.0)
    near, far = (float(end) for end in np.percentile(depth[valid], (2, 98)))
    level = np.clip((far - np.nan_to_num(depth, nan=far)) / max(far - near, 1e-6), 0.0, 1.0)
    picture = matplotlib.colormaps["magma"](0.15 + 0.85 * level)[..., :3]
    return (255 * np.where(valid[..., None], picture, 0)).astype(np.uint8), (near, far)


def data_uri(picture: np.ndarray, quality: int = 82) -> str:
    """(H, W, 3) uint8 RGB as a ``data:image/jpeg;base64`` address."""
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "JPEG", quality=quality, optimize=True)
    return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


@dataclass(frozen=True, eq=False)
class StepOutlines:
    """Outlines of one view: accumulated ``objects``, this view's ``hypotheses``, ``missed`` true objects."""

    objects: list[Outline]
    hypotheses: list[Outline]
    missed: list[Outline]


def outline_step(drawer: SilhouetteDrawer, step: StepAnalysis, truth: np.ndarray | None) -> StepOutlines:
    """Outlines for one view; ``truth`` are the (n, 4, 4) true poses in the world where they are known."""
    view, hypotheses = step.record.view, step.record.hypotheses
    T_camera_world = invert(view.T_world_camera)
    in_view = hypotheses.T_camera_object if hypotheses is not None else np.zeros((0, 4, 4))
    missed = truth[~step.truth.detected] if step.truth is not None else np.zeros((0, 4, 4))
    groups = (T_camera_world @ step.objects.T_world_object, in_view, T_camera_world @ missed)
    return StepOutlines(*([drawer.outline(T, view.camera, view.depth) for T in poses] for poses in groups))
