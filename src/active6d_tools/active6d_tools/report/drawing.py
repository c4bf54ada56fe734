"""Colours for scores and depths, pictures as data URIs, and the outlines that are drawn onto a view."""

import base64
import io
from dataclasses import dataclass

import matplotlib
import numpy as np
from PIL import Image

from active6d_core.se3 import invert
from active6d_tools.report.analysis import EpisodeAnalysis, StepAnalysis
from active6d_tools.report.silhouette import Outline, SilhouetteDrawer

# Not red, which is hard to see on a red object. The colours differ in brightness, too, for colour-blind readers.
_SCORE_COLORS = np.array([(255, 61, 200), (255, 214, 61), (46, 230, 166)], float)


@dataclass(frozen=True)
class ScoreScale:
    """Colours for scores between ``low`` and ``high``: magenta through amber to green, clipped outside."""

    low: float
    high: float

    @classmethod
    def around(cls, scores: np.ndarray) -> "ScoreScale":
        """The scale whose ends, multiples of 0.05, hold all (n,) scores but the lowest twentieth.

        The scores of one episode often differ little, and over [0, 1] all of them would have one colour.
        """
        finite = scores[np.isfinite(scores)]
        if not len(finite):
            return cls(0.0, 1.0)
        low = np.floor(20 * np.percentile(finite, 5)) / 20
        high = np.ceil(20 * finite.max()) / 20
        return cls(float(low), float(max(high, low + 0.05)))

    def color(self, score: float) -> str:
        """``#rrggbb``; grey for a score that is not finite."""
        if not np.isfinite(score):
            return "#9aa0a6"
        share = np.clip((score - self.low) / (self.high - self.low), 0.0, 1.0)
        steps = np.linspace(0.0, 1.0, len(_SCORE_COLORS))
        red, green, blue = (round(float(np.interp(share, steps, channel))) for channel in _SCORE_COLORS.T)
        return f"#{red:02x}{green:02x}{blue:02x}"

    def ramp(self, count: int = 9) -> list[str]:
        """Colours evenly from the low end to the high one."""
        return [self.color(score) for score in np.linspace(self.low, self.high, count)]


def score_scale(analysis: EpisodeAnalysis) -> ScoreScale:
    """The scale of an episode's verification scores."""
    return ScoreScale.around(np.array([row.verification for step in analysis.steps for row in step.rows]))


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
    T_camera_world = invert(step.record.T_world_camera)
    in_view = hypotheses.T_camera_object if hypotheses is not None else np.zeros((0, 4, 4))
    missed = np.zeros((0, 4, 4)) if truth is None or step.truth is None else truth[~step.truth.detected]
    groups = (T_camera_world @ step.objects.T_world_object, in_view, T_camera_world @ missed)
    return StepOutlines(*([drawer.outline(T, view.camera, view.depth) for T in poses] for poses in groups))
