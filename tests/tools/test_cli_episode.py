"""episode, report and replay as a user types them one after the other, with stubs for camera and estimator."""

import json
import os
import subprocess
import sys
from dataclasses import dataclass

import numpy as np
import pytest

from active6d_bringup.bags.reader import read_episode
from active6d_bringup.graph import episode as episode_module
from active6d_bringup.graph.episode import EpisodeError, EpisodeInterrupted
from active6d_bringup.graph.processes import ProcessError
from active6d_core.metrics import evaluate_scene
from active6d_core.object_model import load_object
from active6d_core.ros.graph_nodes import NODES, NodeEntry
from active6d_tools.cli import app


@pytest.fixture(autouse=True)
def stub_camera(monkeypatch):
    monkeypatch.setitem(
        NODES,
        "camera_simulator",
        NodeEntry("stub_camera", "StubCameraNode"),
    )
    import stub_camera  # noqa: F401  registers the estimator


@dataclass(frozen=True)
class Result:
    exit_code: int
    stdout: str
    stderr: str


@pytest.fixture
def run(capfd, monkeypatch):
    """Runs the command on real file descriptors, which rclpy's executor needs."""
    monkeypatch.setenv("COLUMNS", "200")

    def run_command(*arguments) -> Result:
        capfd.readouterr()
        with pytest.raises(SystemExit) as exit_info:
            app([str(argument) for argument in arguments], prog_name="active6d")
        return Result(exit_info.value.code, *capfd.readouterr())

    return run_command


def test_episode_report_and_replay(tmp_path, run):
    bag, page, picture = tmp_path / "bag", tmp_path / "page.html", tmp_path / "picture.png"
    told, figure = tmp_path / "episode.json", tmp_path / "figure.png"
    stub = ("--object", "mug", "--seed", 4, "--policy", "random", "--steps", 2, "--estimator", "stub")
    result = run("episode", *stub, "--bag", bag, "--report", page, "--figure", figure, "--json", told)
    assert result.exit_code == 0, result.stderr
    record = read_episode(bag)
    summary = json.loads(told.read_text())
    assert summary["moves"] == 2
    score = evaluate_scene(load_object("mug"), record.steps[-1].objects.T_world_object, record.ground_truth)
    assert summary["detection_rate"] == pytest.approx(score.detection_rate)
    assert summary["e_add_mm"] == pytest.approx(score.mean_e_add_mm)
    chords = np.linalg.norm(np.diff(record.positions, axis=0), axis=1)
    assert summary["distance_m"] == pytest.approx((2 * 0.8 * np.arcsin(chords / 1.6)).sum(), abs=1e-9)
    said = " ".join(result.stdout.split())
    assert f"found {score.detected.sum()} of {len(score.detected)}" in said
    assert "budget of 2 moves spent" in result.stdout
    assert [line for line in result.stderr.splitlines() if line.startswith("view  2 at")]
    assert page.read_text().startswith("<!doctype html>")

    assert figure.read_bytes().startswith(b"\x89PNG")

    again = run("report", bag, "--png", picture, "--figure", tmp_path / "again.png", "--json", tmp_path / "report.json")
    assert again.exit_code == 0, again.stderr
    assert (bag / "report.html").read_text() == page.read_text()
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "again.png").read_bytes() == figure.read_bytes()
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["distance_m"] == pytest.approx(summary["distance_m"])
    assert f"found {score.detected.sum()} of {len(score.detected)} objects" in again.stdout
    last = report["steps"][-1]
    assert (summary["confirmed"], summary["wrong"]) == (last["confirmed"], last["wrong"])
    probable = record.steps[-1].objects.probability >= 0.5
    assert f"confirmed {probable.sum()}, of which {last['wrong']} wrong" in said
    assert run("report", bag, "--episode", 1).exit_code == 2

    replayed = run("replay", bag, "--as-fast", "--compare", "--json", tmp_path / "replay.json")
    assert replayed.exit_code == 0, replayed.stderr
    assert json.loads((tmp_path / "replay.json").read_text())["equal"] is True

    refused = run("episode", *stub, "--bag", bag)
    assert refused.exit_code == 2
    assert "exists already" in refused.stderr


def test_what_the_file_says_is_run_scored_and_printed(tmp_path, run):
    file = tmp_path / "params.yaml"
    file.write_text(
        "camera_simulator: {ros__parameters: {object: bunny, seed: 3}}\n"
        "pose_estimator: {ros__parameters: {estimator: stub}}\n"
        "attention_policy: {ros__parameters: {object: bunny, policy: random, steps: 4}}\n"
    )
    result = run("episode", "--params-file", file, "--steps", 1, "--bag", tmp_path / "bag", "--json", tmp_path / "out")
    assert result.exit_code == 0, result.stderr
    assert "bunny/seed/3, random: 1 moves" in result.stdout
    record, summary = read_episode(tmp_path / "bag"), json.loads((tmp_path / "out").read_text())
    assert (record.object, record.seed, record.policy, len(record.steps)) == ("bunny", 3, "random", 2)
    assert [summary[key] for key in ("object", "seed", "policy", "moves")] == ["bunny", 3, "random", 1]
    score = evaluate_scene(load_object("bunny"), record.steps[-1].objects.T_world_object, record.ground_truth)
    assert summary["e_add_mm"] == pytest.approx(score.mean_e_add_mm)
    assert run("episode", "--params-file", file, "--steps", 1, "--policy", "max-distance").stdout.count("max-distance")


def test_help_says_where_a_default_comes_from(run):
    words = " ".join(run("episode", "--help").stdout.replace("│", " ").split())
    for last in ("mug", "0", "auto", "5", "none", "flying"):
        assert f"by default that of the params file, else {last}." in words


@pytest.mark.parametrize(
    ("error", "options", "code", "line"),
    [
        (EpisodeError("no answer from pose_estimator"), [], 1, "active6d: no answer from pose_estimator"),
        (ProcessError("camera_simulator died"), [], 1, "active6d: camera_simulator died"),
        (EpisodeInterrupted(), [], 130, "active6d: interrupted"),
        (
            EpisodeInterrupted(),
            ["--bag", "/nowhere/bag"],
            130,
            "active6d: interrupted; /nowhere/bag holds what was recorded",
        ),
    ],
)
def test_an_episode_that_fails_is_one_line(monkeypatch, run, error, options, code, line):
    def fail(*arguments):
        raise error

    monkeypatch.setattr(episode_module, "run_episode", fail)
    result = run("episode", "--estimator", "stub", *options)
    assert result.exit_code == code
    assert result.stderr.splitlines()[-1] == line
    assert result.stdout == ""
    assert "Traceback" not in result.stderr


def test_a_log_folder_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    environment = {**os.environ, "ROS_LOG_DIR": str(tmp_path / "file" / "log")}
    command = [sys.executable, "-m", "active6d_tools", "episode", "--object", "mug", "--steps", "0"]
    result = subprocess.run(command, capture_output=True, text=True, timeout=120, env=environment)
    assert result.returncode == 2
    assert "the log folder cannot be written; set ROS_LOG_DIR" in result.stderr
    assert "Traceback" not in result.stderr
