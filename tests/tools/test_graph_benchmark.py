"""The benchmark of the graph measures what it says it measures."""

import time

import numpy as np
import pytest

from active6d_tools.benchmark import graph_overhead as benchmark


@pytest.fixture
def prepared(monkeypatch):
    """Three views with random hypotheses, without the physics."""
    from stub_episode import StubEpisode

    from active6d_core.object_model import load_object

    steps = StubEpisode(moves=2).steps
    return benchmark.PreparedViews(
        load_object("mug"), [step.view for step in steps], {step.view.stamp: step.hypotheses for step in steps}
    )


def test_overhead_is_graph_minus_direct(prepared, monkeypatch):
    monkeypatch.setattr(benchmark, "prepare_views", lambda *arguments: prepared)
    direct, fusion = np.array([0.001, 0.002, 0.003]), np.array([0.001, 0.001, 0.002])
    slower = iter([0.004, 0.010, 0.006, 0.020])
    monkeypatch.setattr(benchmark, "_direct", lambda views: (direct, fusion))
    monkeypatch.setattr(benchmark, "_through_graph", lambda views, bag: direct + next(slower))
    result = benchmark.measure_graph("mug", repeats=2)
    assert result["overhead_ms"] == pytest.approx(5.0)
    assert result["overhead_recorded_ms"] == pytest.approx(15.0)
    assert result["direct_ms"] == pytest.approx(2.0)
    assert result["fusion_hz"] == pytest.approx(500.0)


def test_every_view_goes_through_the_graph(prepared, tmp_path, monkeypatch):
    """The times of the graph hold what each node takes: the estimator, who answers at once otherwise, takes 50 ms."""
    from active6d_bringup.bags.reader import read_episode

    at_once = benchmark.PreparedEstimator.estimate

    def estimate(self, view):
        time.sleep(0.05)
        return at_once(self, view)

    monkeypatch.setattr(benchmark.PreparedEstimator, "estimate", estimate)
    benchmark._prepared.update(prepared.hypotheses)
    seconds = benchmark._through_graph(prepared, tmp_path / "bag")
    direct, fusion = benchmark._direct(prepared)
    assert seconds.shape == direct.shape == fusion.shape == (3,)
    assert (direct >= fusion).all()
    assert (seconds >= 0.05).all()
    assert (fusion > 0).all()
    steps = read_episode(tmp_path / "bag").steps
    for step, view in zip(steps, prepared.views, strict=True):
        np.testing.assert_array_equal(step.view.color, view.color)
        assert len(step.hypotheses) == len(prepared.hypotheses[view.stamp])
