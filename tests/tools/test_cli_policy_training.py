"""``active6d train policy`` and the agent's benchmarks, on made-up banks."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from active6d_agent.bank.scene_bank import bank_path
from active6d_agent.environment import throughput
from active6d_tools.benchmark import pipeline
from active6d_tools.cli import app


def run(*arguments: str):
    return CliRunner().invoke(app, list(arguments), env={"COLUMNS": "200", "TERM": "dumb"})


SMALL = {
    "view-attention": ("episodes=2", "updates=2", "starts=5", "batch=8", "longest=3", "evaluate_every=1"),
    "attention": ("environments=4", "evaluate_every=40", "batch=20"),
}


@pytest.mark.parametrize(("name", "length", "longer"), [("view-attention", 2, 3), ("attention", 80, 120)])
def test_what_is_trained_is_exported_and_evaluated(banks, tmp_path, name, length, longer):
    settings = [part for one in SMALL[name] for part in ("--set", f"training.{one}")]
    common = (
        "train",
        "policy",
        "--policy",
        name,
        "--steps",
        "2",
        "--banks",
        str(banks),
        "--out",
        str(tmp_path / "run"),
    )
    report = tmp_path / "training.json"
    result = run(*common, *settings, "--length", str(length), "--export", str(tmp_path), "--json", str(report))
    assert result.exit_code == 0, result.stderr
    curve = json.loads(report.read_text())["curve"]
    assert len(curve) == 2
    assert (tmp_path / "run" / "curve.png").stat().st_size > 1000
    result = run(*common, *settings, "--length", str(longer), "--resume", "--json", str(report))
    assert result.exit_code == 0, result.stderr
    assert len(json.loads(report.read_text())["curve"]) == 3
    weights = tmp_path / f"{name}_mug.safetensors"
    result = run("evaluate", "--policies", name, "--steps", "2", "--banks", str(banks),
                 "--set", f"{name}.weights={weights}", "--json", str(tmp_path / "table.json"))  # fmt: skip
    assert result.exit_code == 0, result.stderr
    measured = json.loads((tmp_path / "table.json").read_text())["policies"][name]
    if name == "attention":  # validation took every start, as evaluation does
        assert measured["detection_rate"] == pytest.approx(max(row["detection_rate"] for row in curve))


@pytest.mark.parametrize("flag", [None, "--resume", "--again"])
def test_a_training_that_is_there_goes_on_or_is_replaced_only_when_asked(banks, tmp_path, monkeypatch, flag):
    from active6d_agent.policies.view_attention import dagger

    asked = []

    def train(train, val, folder, parameters, weighing, *, resume, again):
        asked.append({"--resume": resume, "--again": again})
        yield from ()

    monkeypatch.setattr(dagger, "train_dagger", train)
    for name in ("latest.json", "curve.jsonl"):
        (tmp_path / name).write_text("{}\n")
    result = run("train", "policy", "--banks", str(banks), "--out", str(tmp_path), *([flag] if flag else []))
    if flag:
        assert result.exit_code == 0, result.stderr
        assert asked == [{"--resume": flag == "--resume", "--again": flag == "--again"}]
    else:
        assert (result.exit_code, asked) == (2, [])
        told = " ".join(result.stderr.split())
        assert all(word in told for word in ("already holds a training", tmp_path.name, "--resume", "--again"))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--policy", "random"], "--policy 'random' is not among view-attention, attention"),
        (["--banks", "/nowhere"], "active6d bank --object mug --split train --banks /nowhere"),
        (["--set", "training.magic=1"], "--set training.magic: known are steps"),
        (["--set", "training.magic=1", "--banks", "/nowhere"], "--set training.magic: known are steps"),
        (["--set", "reward.alpha=1"], "--set reward: known are training, weighing"),
        (["--policy", "attention", "--set", "reward.alpha=3"], "alpha and beta must be in [0, 1]"),
        (["--set", "weighing.lookahead=2"], "lookahead is 2"),
        (["--resume", "--again"], "--resume continues the training that is there and --again replaces it"),
        (["--set", "training.learning_rate=fast"], "--set training.learning_rate must be a number, got 'fast'"),
        (["--set", "training.rounds=1.5"], "--set training.rounds must be a whole number, got 1.5"),
        (["--set", "training.rounds=true"], "--set training.rounds must be a whole number, got True"),
        (["--set", "training.inputs=3"], "--set training.inputs must be a text, got 3"),
        (
            ["--policy", "attention", "--set", "training.credit=1"],
            "--set training.credit must be true or false, got 1",
        ),
    ],
)
def test_bad_input_is_one_clear_line(banks, arguments, words):
    given = arguments if "--banks" in arguments else [*arguments, "--banks", str(banks)]
    result = run("train", "policy", *given)
    assert result.exit_code == 2
    assert words in result.stderr.strip().splitlines()[-1]


def test_the_environments_speed_is_that_of_all_processes(banks, tmp_path, monkeypatch):
    asked = {}

    def measure(bank, **keywords):
        asked.update(keywords, bank=bank)
        return 12345.0

    monkeypatch.setattr(throughput, "measure_steps_per_second", measure)
    result = run(
        "benchmark", "environment", "--banks", str(banks), "--workers", "3", "--json", str(tmp_path / "x.json")
    )
    assert result.exit_code == 0, result.stderr
    assert json.loads((tmp_path / "x.json").read_text())["steps_per_second"] == 12345.0
    assert asked["workers"] == 3
    assert asked["bank"] == bank_path(banks, "mug", "test")
    missing = run("benchmark", "environment", "--banks", "/nowhere")
    assert missing.exit_code == 2
    assert "active6d bank --object mug" in missing.stderr


@pytest.fixture
def prepared(monkeypatch):
    """Six views with the stub's hypotheses, without the physics."""
    from stub_episode import StubEpisode

    from active6d_core.object_model import load_object
    from active6d_tools.benchmark.graph_overhead import PreparedViews

    steps = StubEpisode(moves=5).steps
    views = PreparedViews(
        load_object("mug"), [step.view for step in steps], {step.view.stamp: step.hypotheses for step in steps}
    )
    monkeypatch.setattr(pipeline, "prepare_views", lambda *arguments, **keywords: views)
    return views


def test_the_pipelines_rates_are_its_times(prepared, tmp_path, monkeypatch):
    def times(prepared, found, verifier, policy, repeats):
        count = sum(len(each) for each in found)
        each = np.full(repeats, 1e-3)
        return pipeline.LastViewTimes(each, 2 * each, np.linspace(0, 2e-3, repeats), count)

    monkeypatch.setattr(pipeline, "time_last_view", times)
    result = pipeline.measure_pipeline("mug", policy="lowest-score", repeats=100, counts=(10, 100))
    assert result["fusion_hz"] == pytest.approx(1000 / 3)
    assert result["policy_ms_p99"] == pytest.approx(1.98)
    assert result["hz_total"] == pytest.approx(250.0)
    assert [(row["hypotheses"], row["objects"]) for row in result["cost"]] == [(10, 10), (100, 100)]


def test_every_repeat_sees_the_same_views(prepared, tmp_path):
    """The command, end to end, on prepared views; fusion makes of them what it makes of them once."""
    from active6d_perception.scene.all_views_fusion import AllViewsFusion
    from active6d_perception.scene.verification import Verifier

    verifier, fusion = Verifier(prepared.model), AllViewsFusion(prepared.model)
    for view in prepared.views:
        found = prepared.hypotheses[view.stamp]
        verification = verifier.score(view.depth, view.camera, found)
        fusion.add_view(view.stamp, view.T_world_camera, found, verification, view.depth, view.camera)
    expected = len(fusion.objects(view.stamp, view.T_world_camera, view.camera))
    file, png = tmp_path / "pipeline.json", tmp_path / "pipeline.png"
    result = run("benchmark", "pipeline", "--repeats", "2", "--json", str(file), "--png", str(png))
    assert result.exit_code == 0, result.stderr
    measured = json.loads(file.read_text())
    assert measured["objects"] == expected
    assert [row["hypotheses"] for row in measured["cost"]] == list(pipeline.COUNTS)
    assert png.stat().st_size > 1000
