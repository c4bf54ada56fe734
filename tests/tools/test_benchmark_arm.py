"""Episodes on the arm: what is counted, and that all policies start from the same view."""

import json

import numpy as np
import pytest
from hand_made_scenes import store_mugs
from typer.testing import CliRunner

from active6d_core.camera import backproject
from active6d_core.hypotheses import Hypotheses
from active6d_core.se3 import invert
from active6d_perception.estimators.registry import register_estimator
from active6d_tools.benchmark.arm_episodes import TIMES, _summarise
from active6d_tools.cli import app

TRUTH = []


@register_estimator("one-more-each-view")
class OneMoreEachView:
    """Finds one mug in the first image, two in the second, and so on."""

    def __init__(self, model):
        self._calls = 0

    def estimate(self, view):
        self._calls += 1
        T = invert(view.T_world_camera) @ TRUTH[0][: self._calls]
        apart = np.linalg.norm(backproject(view.depth, view.camera)[..., None, :] - T[:, :3, 3], axis=-1)
        mask = np.where(apart.min(axis=-1) < 0.07, apart.argmin(axis=-1) + 1, 0).astype(np.uint16)
        return Hypotheses.from_masks(T, np.full(len(T), 0.9), np.arange(1, len(T) + 1), mask, view.depth)


def test_a_policy_that_makes_no_move_has_no_numbers_of_moves(tmp_path, monkeypatch):
    """All episodes without a move, and one of two."""
    scene = store_mugs(tmp_path, monkeypatch)
    TRUTH[:] = [scene.T_world_object]
    told = tmp_path / "arm.json"
    options = "--policies", "single-view", "--episodes", 1, "--steps", 1, "--estimator", "one-more-each-view"
    run = CliRunner().invoke(app, [str(each) for each in ("benchmark", "arm", *options, "--json", told)])
    assert run.exit_code == 0, run.output
    row = json.loads(told.read_text())["policies"]["single-view"]
    assert (row["moves"], row["seconds_per_move"], row["least_clearance_mm"]) == (0, None, None)
    assert (row["seconds_per_episode"], row["metres"], len(row["found"])) == (0.0, 0.0, 1)
    assert run.stdout.splitlines()[-1].split().count("-") == 3
    stayed = {"found": [0.5], "found_at": [0.5], "seconds": [], "clearances": [], "refused": [], "metres": 0.0}
    moved = {**stayed, "found": [0.5, 1.0], "seconds": [2.0], "clearances": [0.02]}
    both = _summarise([stayed, moved])
    assert (both["moves"], both["seconds_per_move"], both["least_clearance_mm"]) == (1, 2.0, pytest.approx(20.0))


def test_seconds_refusals_and_what_is_found_are_counted(tmp_path, monkeypatch):
    scene = store_mugs(tmp_path, monkeypatch)
    TRUTH[:] = [scene.T_world_object]
    told, png = tmp_path / "arm.json", tmp_path / "arm.png"
    options = "--policies", "max-distance", "--episodes", 1, "--steps", 2, "--estimator", "one-more-each-view"
    arguments = ["benchmark", "arm", "--object", "mug", *options, "--hand-eye", 0, 0, "--json", told, "--png", png]
    run = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert run.exit_code == 0, run.output
    row = json.loads(told.read_text())["policies"]["max-distance"]
    assert row["found"] == pytest.approx([1 / 3, 2 / 3, 1.0])
    assert row["moves"] == 2
    # At 0 s the first view is there, and the last one at the latest when all motions are done.
    assert row["found_at"][0] == pytest.approx(1 / 3)
    assert row["found_at"][TIMES.index(40)] == 1.0
    assert row["seconds_per_episode"] == pytest.approx(2 * row["seconds_per_move"])
    assert 1.0 < row["seconds_per_move"] < 20.0
    # From the first view, the policy asks for the farthest ones, which lie at 15 degrees.
    assert row["refused"] >= 2
    assert row["reasons"] == {"the arm cannot take the view goal: out of reach": row["refused"]}
    assert row["least_clearance_mm"] >= 10.0 - 0.1
    assert png.is_file()
