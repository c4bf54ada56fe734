"""A recorded episode whose scores are known by construction."""

from pathlib import Path

import numpy as np

from active6d_bringup.bags.reader import EpisodeRecord, RecordedStep
from active6d_core.camera import PinholeCamera, View
from active6d_core.hypotheses import Hypotheses, SceneObjects
from active6d_core.se3 import make_transform
from active6d_core.view_sphere import ViewSphere

CAMERA = PinholeCamera.from_field_of_view(160, 120, 60.0)
#: Millimetres that an estimate is off in each step; None where the object is not estimated. The mug's limit is 13.8.
OFFSETS = [[5.0, 30.0, None, None], [5.0, 12.0, 1.0, None], [4.0, 12.0, 1.0, 21.0]]


def make_objects(T: np.ndarray, verification: np.ndarray) -> SceneObjects:
    n = len(T)
    return SceneObjects(
        T,
        verification,
        verification,
        np.zeros((n, 4)),
        np.ones(n),
        np.arange(1, n + 1),
        np.full(n, 0.002),
        verification,
        np.zeros(n),
    )


def make_record(
    *, truth: bool = True, info: dict[str, str] | None = None, node: str = "pose_estimator"
) -> EpisodeRecord:
    """Four mugs far from each other; each estimate is off by a translation, so its e_ADD is that one's length."""
    sphere = ViewSphere()
    centers = np.array([(x, y, 0.05) for x in (-0.12, 0.12) for y in (-0.12, 0.12)])
    T_true = make_transform(np.eye(3), centers)
    steps = []
    for number, offsets in enumerate(OFFSETS):
        known = [i for i, offset in enumerate(offsets) if offset is not None]
        T = T_true[known].copy()
        T[:, 2, 3] += [1e-3 * offsets[i] for i in known]
        # The last object of every step is nowhere near a true one.
        T = np.concatenate([T, make_transform(np.eye(3), np.array([[0.0, 0.0, 0.5]]))])
        verification = np.linspace(0.9, 0.1, len(T))
        T_world_camera = sphere.pose(sphere.position(np.radians(60.0 * number), np.radians(45.0)))
        color = np.full((120, 160, 3), 90, np.uint8)
        view = View(10**9 * (1 + number), color, np.full((120, 160), 2.0, np.float32), CAMERA, T_world_camera)
        last = number == len(OFFSETS) - 1
        steps.append(
            RecordedStep(
                view,
                Hypotheses.empty(120, 160),
                make_objects(T, verification),
                np.zeros((0, 3)),
                None,
                None if last else np.full(len(T), 1 / len(T)),
                None if last else len(T) - 1,
                None,
                {node: 100.0 + 10 * number, "hypothesis_fusion": 5.0},
            )
        )
    told = {"object": "mug", "scene": "mug/seed/7", "seed": "7", "policy": "lowest-score"} if info is None else info
    return EpisodeRecord(Path("bags/x"), told, steps, T_true if truth else None, "budget of 2 moves spent", "world")
