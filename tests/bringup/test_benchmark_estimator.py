"""The estimator benchmark's table against counts by hand, and a run with an estimator that knows the answer."""

import numpy as np
import pytest

from active6d_bringup.benchmark import estimator as benchmark
from active6d_core.hypotheses import Hypotheses
from active6d_core.object_model import load_object
from active6d_core.se3 import invert, make_transform
from active6d_perception.estimator import register_estimator
from active6d_perception.evaluation import EstimatorResult
from active6d_sim.scene import Bin, Scene

POSES = make_transform(np.eye(3), np.array([(-0.1, 0.0, 0.06), (0.1, 0.0, 0.06)]))


@register_estimator("half-blind")
class HalfBlind:
    """Finds the first true object and nothing else."""

    def __init__(self, model) -> None:
        self._model = model

    def estimate(self, view):
        segmentation = np.zeros(view.depth.shape, np.uint16)
        segmentation[200:280, 280:360] = 1
        pose = invert(view.T_world_camera) @ POSES[:1]
        return Hypotheses.from_masks(pose, np.ones(1), np.ones(1, np.uint16), segmentation, view.depth)


def test_summary_counts_by_visible_fraction():
    result = EstimatorResult(
        visible_fraction=np.array([0.9, 0.6, 0.3, 0.05]),
        found_add=np.array([True, False, False, True]),
        found_adds=np.array([True, True, False, True]),
        right_add=np.array([True, False, True, False]),
        right_adds=np.array([True, True, True, False]),
        score=np.ones(4),
        verification=np.ones(4),
        seconds=np.array([0.1, 0.3]),
    )
    row = benchmark.summarise(load_object("bunny"), result)
    assert row["add"] == {"0.5": 0.5, "0.1": pytest.approx(1 / 3)}
    assert row["adds"] == {"0.5": 1.0, "0.1": pytest.approx(2 / 3)}
    assert row["precision"] == 0.5
    assert row["ms_median"] == pytest.approx(200.0)
    assert row["hypotheses_per_view"] == 2.0
    # A mug's handle may hide, so that its precision is by ADD-S.
    assert benchmark.summarise(load_object("mug"), result)["precision"] == 0.75


def test_every_estimator_sees_the_same_views(monkeypatch):
    scene = Scene("bunny", "bunny/test/0", 0, POSES, Bin(0.4, 0.3, 0.05), np.full((100, 2), 0.8))
    monkeypatch.setattr(benchmark, "SPLITS", {"test": 2})
    monkeypatch.setattr(benchmark, "load_scene", lambda *name: scene)
    told = []
    result = benchmark.measure_estimators(
        "bunny", "test", ["half-blind"], sample=3, moves=1, on_progress=lambda *what: told.append(what)
    )
    row = result["estimators"]["half-blind"]
    assert result["views"] == 3
    assert row["add"] == {"0.5": 0.5, "0.1": 0.5}
    assert row["precision"] == 1.0
    assert row["fused"] == [0.5, 0.5]
    assert told[0] == ("half-blind", 1, 3)
    assert told[-1] == ("half-blind, fused", 4, 4)
