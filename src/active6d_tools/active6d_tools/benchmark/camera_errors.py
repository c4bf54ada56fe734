"""What wrong camera poses cost the fusion of all views, with and without aligning the views."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from active6d_core.registry import AUTOMATIC
from active6d_perception.scene.all_views_fusion import AllViewsFusion
from active6d_perception.scene.fusion_parameters import FusionParameters
from active6d_sim.rendering.pose_error import PoseError
from active6d_tools.benchmark.fusion_methods import KINDS, MethodResults, draw_episodes, fuse_episode
from active6d_tools.processed_scene import ProcessedScene, disturb
from active6d_tools.report.line_plots import Panel

ALIGNED, NOT_ALIGNED = "aligned", "not aligned"


def parse_errors(text: str) -> list[PoseError]:
    """Errors of a text such as ``0/0,5/0.5``: millimetres and degrees.

    Raises:
        ValueError: the text is something else, or an error is negative.
    """
    errors = []
    for part in text.split(","):
        try:
            millimetres, degrees = (float(number) for number in part.split("/"))
        except ValueError:
            raise ValueError(f"--errors: '{part}' must be millimetres/degrees, such as 5/0.5") from None
        if not (0 <= millimetres < np.inf and 0 <= degrees < np.inf):
            raise ValueError(f"--errors: '{part}' must be two finite numbers of at least 0")
        errors.append(PoseError(millimetres, degrees))
    return errors


def measure_errors(
    names: Sequence[str],
    errors: Sequence[PoseError],
    *,
    episodes: int = 2,
    estimator: str = AUTOMATIC,
    seed: int = 0,
    parameters: FusionParameters | None = None,
    on_progress: Callable[[str, int, int], None] = lambda what, done, total: None,
) -> list[dict[str, Any]]:
    """Fuse the same views with each error of the camera's poses, aligned and not aligned.

    Every error draws the same random numbers, so only its size differs.

    Args:
        names: of stored scenes of one object.
        errors: to measure.
        episodes: of six views on a ring, and as many of six random views, in each scene.
        estimator: name of the deployed one.
        seed: of the views, of the sensor's noise and of the errors.
        parameters: of the fusion.
        on_progress: called with a scene's name, the number of scenes done and that of all.

    Returns:
        For each error and variant, its ``millimetres``, ``degrees``, ``variant`` and :meth:`.MethodResults.summarise`.
    """
    parameters = parameters or FusionParameters()
    results: dict[tuple[PoseError, str], MethodResults] = {}
    for done, name in enumerate(names):
        on_progress(name, done, len(names))
        processed, index = ProcessedScene(name, estimator, seed=seed), int(name.split("/")[-1])
        variants = {
            ALIGNED: AllViewsFusion(processed.model, parameters),
            NOT_ALIGNED: AllViewsFusion(processed.model, parameters, align=False),
        }
        drawn = list(draw_episodes(processed, KINDS[:2], episodes, np.random.default_rng([seed + 1, index])))
        for error in errors:
            rng = np.random.default_rng([seed + 2, index])
            for _, exact in drawn:
                views = [disturb(view, error, rng) for view in exact]
                for variant, fusion in variants.items():
                    result = results.setdefault((error, variant), MethodResults(processed.model.diameter))
                    fuse_episode(fusion, views, result, processed)
    return [
        {
            "millimetres": error.millimetres,
            "degrees": error.degrees,
            "variant": variant,
            **result.summarise(parameters.confirmed),
        }
        for (error, variant), result in results.items()
    ]


def error_panels(rows: Sequence[dict[str, Any]]) -> list[Panel]:
    """What is found, its ADD and what is wrong of rows of :func:`measure_errors`, over the camera's error."""
    panels = []
    for key, label in (("found", "found and confirmed"), ("e_add_mm", "ADD [mm]"), ("wrong", "wrong of the confirmed")):
        lines = {}
        for variant in (ALIGNED, NOT_ALIGNED):
            own = [row for row in rows if row["variant"] == variant]
            values = [np.nan if row[key] is None else row[key] for row in own]
            lines[variant] = ([row["millimetres"] for row in own], values)
        panels.append(Panel("error of the camera's positions [mm]", label, lines))
    return panels
