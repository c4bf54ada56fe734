"""``active6d bank`` and ``active6d evaluate``: a bank of two views, and Table 1 on a made-up bank."""

import json
from dataclasses import replace

import numpy as np
import pytest
from synthetic_bank import synthetic_bank
from typer.testing import CliRunner

from active6d_agent.bank.best_view_lookup import BestViewLookup
from active6d_agent.bank.scene_bank import bank_path, find_bank, load_bank
from active6d_agent.evaluation.noise_resampling import join_banks, search_unforeseen
from active6d_agent.evaluation.policy_evaluation import all_starts, measure, run_named
from active6d_perception.scene.fusion_parameters import RANKINGS, FusionParameters
from active6d_tools import bank_building
from active6d_tools.cli import app
from active6d_tools.cli.options import LEARNED


def run(*arguments: str):
    return CliRunner().invoke(app, list(arguments), env={"COLUMNS": "200", "TERM": "dumb"})


def test_table_1_is_the_policies_episodes(banks, tmp_path):
    file = tmp_path / "mug.json"
    names = "single-view,random,oracle,all-views"
    result = run("evaluate", "--object", "mug", "--policies", names, "--steps", "2", "--sample", "9",
                 "--banks", str(banks), "--json", str(file), "--seed", "3")  # fmt: skip
    assert result.exit_code == 0, result.stderr
    measured = json.loads(file.read_text())
    assert (measured["object"], measured["steps"], measured["episodes"]) == ("mug", 2, 9)
    lookup = BestViewLookup(load_bank(bank_path(banks, "mug", "test")))
    starts = all_starts(lookup, 9, 3)
    for name in names.split(","):
        row, expected = measured["policies"][name], run_named(lookup, name, starts, 2, seed=3)
        assert row["detection_rate"] == pytest.approx(expected.detection_rate.mean())
        assert row["e_add_mm"] == pytest.approx(expected.e_add_mm.mean())
        assert row["distance_m"] == pytest.approx(expected.distance_m.mean())
        # The interval of the mean as by the central limit theorem; the command resamples episodes.
        deviation = expected.detection_rate.std() / np.sqrt(len(starts))
        interval = expected.detection_rate.mean() + 1.96 * deviation * np.array([-1.0, 1.0])
        assert row["detection_rate_ci95"] == pytest.approx(interval, abs=0.4 * deviation + 1e-9)
        assert f"{row['detection_rate']:.3f}" in result.stdout
    assert measured["policies"]["random"]["gap_closed"] == 0.0
    assert measured["policies"]["oracle"]["gap_closed"] == 1.0


def test_a_policys_parameter_can_be_set(banks, tmp_path):
    file = tmp_path / "mug.json"
    common = ("evaluate", "--policies", "unidirectional", "--steps", "1", "--sample", "5", "--banks", str(banks))
    assert run(*common, "--set", "unidirectional.elevation_degrees=75", "--json", str(file)).exit_code == 0
    steep = json.loads(file.read_text())["policies"]["unidirectional"]["distance_m"]
    assert run(*common, "--json", str(file)).exit_code == 0
    assert json.loads(file.read_text())["policies"]["unidirectional"]["distance_m"] != steep


def test_a_bank_is_what_the_estimator_says_and_is_only_extended(monkeypatch, tmp_path):
    """Two scenes from synthetic eyes; the second run makes only the third scene, and the next ones remove none."""
    from functools import partial

    from synthetic_bank import observe_synthetic

    from active6d_agent.bank import scene_bank as bank_module

    log = tmp_path / "log"
    real = bank_module.build_bank

    def build(path, object_name, names, observe, **keywords):
        assert observe.keywords == {"estimator": "dense", "noise": 1.0, "seed": 0}
        return real(path, object_name, names, partial(observe_synthetic, log=str(log)), **keywords)

    monkeypatch.setattr(bank_building, "observe_scene_by_name", len)
    monkeypatch.setattr(bank_module, "build_bank", build)
    arguments = ("bank", "--object", "mug", "--split", "val", "--workers", "1", "--banks", str(tmp_path))
    result = run(*arguments, "--scenes", "2", "--json", str(tmp_path / "bank.json"))
    assert result.exit_code == 0, result.stderr
    assert sorted(log.read_text().split()) == ["mug/val/0", "mug/val/1"]
    assert run(*arguments, "--scenes", "3").exit_code == 0
    assert log.read_text().split()[2:] == ["mug/val/2"]
    fewer = run(*arguments, "--scenes", "1", "--json", str(tmp_path / "fewer.json"))
    assert "also keeps 2 scenes from before" in fewer.stderr
    assert json.loads((tmp_path / "fewer.json").read_text())["scenes"] == 1, "the summary is of what was asked for"
    made = load_bank(find_bank("mug", "val", tmp_path))
    assert len(made.scenes) == 3
    measured = json.loads((tmp_path / "bank.json").read_text())
    assert measured["scenes"] == 2
    found = []
    for scene in made.scenes[:2]:
        right = scene.errors < 0.1 * made.model.diameter
        found += [right[scene.view == view].any(axis=0).mean() for view in range(100)]
    assert measured["found_in_one_view"] == pytest.approx(np.mean(found))


def test_scenes_that_a_bank_loses_are_named(monkeypatch, tmp_path):
    from active6d_agent.bank import scene_bank as bank_module

    def build(path, object_name, names, observe, *, on_drop, **keywords):
        on_drop(["mug/val/1", "mug/val/2"])
        synthetic_bank("mug", scenes=1, objects=2).save(path)
        yield from names

    monkeypatch.setattr(bank_module, "build_bank", build)
    result = run("bank", "--object", "mug", "--split", "val", "--scenes", "1", "--banks", str(tmp_path))
    assert result.exit_code == 0, result.stderr
    told = "".join(result.stderr.split())  # lines are broken anywhere in a path
    assert f"{bank_path(tmp_path, 'mug', 'val')}wasmadewithanotherestimator" in told
    assert "dropped:mug/val/1,mug/val/2." in told
    assert "alsokeeps" not in told


def test_no_heap_is_in_two_splits():
    from active6d_sim.scenes.scene_store import FIRST_STORED_SEED

    train, validation = (bank_building.scene_names("mug", split, None, 200, 100) for split in ("train", "val"))
    assert (len(train), len(validation)) == (324, 306)
    assert not set(train) & set(validation)
    simulated = [int(name.split("/")[-1]) for name in train + validation if name.split("/")[1] in ("seed", "wild")]
    assert len(simulated) == 600
    assert max(simulated) < FIRST_STORED_SEED


def test_a_scene_is_seen_as_the_graph_sees_it(monkeypatch):
    """Simulator, estimator and verification from two views; float32 tables of what they say."""
    from active6d_core.object_model import load_object
    from active6d_core.view_sphere import ViewSphere
    from active6d_perception.estimators.registry import create_estimator
    from active6d_perception.scene.verification import Verifier
    from active6d_sim.rendering.simulator import Simulator
    from active6d_sim.scenes.scene_store import load_scene

    sphere = ViewSphere(elevations_degrees=(60.0,), azimuths=2)
    monkeypatch.setattr(bank_building, "ViewSphere", lambda: sphere)
    made = bank_building.observe_scene_by_name("bunny/test/0", estimator="geometric", noise=1.0, seed=5)
    scene, model = load_scene("bunny", "test", 0), load_object("bunny")
    view = Simulator(scene, seed=5).capture(sphere.pose(sphere.positions[1]), 2_000_000_000)
    found = create_estimator("geometric", model).estimate(view)
    own = made.table[made.view == 1]
    assert made.name == "bunny/test/0"
    assert len(found) > 0
    np.testing.assert_array_equal(made.T_world_object, scene.T_world_object)
    np.testing.assert_allclose(own[:, :3], found.T_camera_object[:, :3, 3], atol=1e-6)
    np.testing.assert_allclose(own[:, 7], Verifier(model).score(view.depth, view.camera, found), atol=1e-6)
    np.testing.assert_allclose(own[:, 8], found.score, atol=1e-6)


def test_a_wild_scene_is_simulated_by_its_seed(monkeypatch):
    from active6d_core.view_sphere import ViewSphere
    from active6d_sim.scenes.scene_store import load_scene

    scene, asked = load_scene("bunny", "wild_val", 0), []

    def simulate(model, seed, name):
        asked.append((model.name, seed, name))
        return scene

    monkeypatch.setattr(bank_building, "wild_scene", simulate)
    monkeypatch.setattr(bank_building, "ViewSphere", lambda: ViewSphere(elevations_degrees=(60.0,), azimuths=2))
    made = bank_building.observe_scene_by_name("bunny/wild/50003", estimator="geometric", noise=1.0, seed=5)
    assert asked == [("bunny", 50_003, "bunny/wild/50003")]
    np.testing.assert_array_equal(made.T_world_object, scene.T_world_object)


@pytest.fixture(scope="module")
def untrained(tmp_path_factory):
    """A folder of trainings with weights that nobody trained."""
    import torch

    from active6d_agent.policies.attention import network as attention
    from active6d_agent.policies.view_attention import network as view_attention

    folder = tmp_path_factory.mktemp("policies")
    for seed in range(3):
        torch.manual_seed(seed)
        for name in ("view-attention", "attention"):
            own = folder / "mug" / name / f"seed{seed}"
            if name == "attention":
                attention.save_network(attention.AttentionNetwork(2), own / "best.safetensors")
            else:
                network = view_attention.ViewAttention()
                view_attention.save_network(network, own / "best.safetensors", "mug")
            done = {"round": 30} if name == "view-attention" else {"steps": 1_000_000}
            (own / "curve.jsonl").write_text(json.dumps({**done, "seconds": 90.0}) + "\n")
    return folder


def expected_rates(banks, folder, part) -> list[float]:
    """Mean detection rates of an ablation with 6 starts of 2 moves, from single calls of the evaluation."""
    bank = load_bank(bank_path(banks, "mug", "test"))
    own, other = BestViewLookup(bank), BestViewLookup(load_bank(bank_path(banks, "mug", "test", 1)))
    starts = all_starts(own, 6, 0)
    scene, views = starts[:, 0], run_named(own, "random", starts, 2).views

    def rate(lookup, *views):
        return float(np.mean([measure(lookup, scene, each).detection_rate for each in views]))

    def trained(*names):
        weights = [folder / "mug" / name / "best.safetensors" for name in names]
        ran = [run_named(own, "attention", starts, 2, parameters={"weights": str(path)}) for path in weights]
        return [run.detection_rate.mean() for run in ran]

    if part == "steps":
        return [run_named(own, "random", starts, budget).detection_rate.mean() for budget in (0, 2)]
    if part == "fusion":
        alone = FusionParameters(exclusion=0.0)
        fusions = [own, BestViewLookup(bank, alone), BestViewLookup(bank, replace(alone, cut=1e-9))]
        return [rate(fusion, views) for fusion in fusions]
    if part == "verification":
        return [rate(BestViewLookup(bank, FusionParameters(rank_by=each)), views) for each in RANKINGS]
    if part == "attention":
        return trained("learned_alpha0.3", "lowest-score_alpha0.3")
    if part == "signs":
        return trained("learned_alpha0.3", "learned_alpha0.3_as_printed")
    random = run_named(other, "random", starts, 2).views
    oracle, again = (run_named(lookup, "oracle", starts, 2).views for lookup in (own, other))
    joined = (join_banks(bank, other.bank), join_banks(other.bank, bank))
    unforeseen = [search_unforeseen(each, starts, 2) for each in joined]

    def both(first, second):
        return (rate(own, first) + rate(other, second)) / 2

    return [both(views, random), both(random, views), both(oracle, again), both(*unforeseen), both(again, oracle)]


@pytest.mark.parametrize("part", ["steps", "fusion", "verification", "noise-resampling", "attention", "signs"])
def test_ablations_give_numbers_and_a_figure(banks, tmp_path, part, monkeypatch):
    monkeypatch.setattr("active6d_agent.evaluation.ablations.STEPS", (0, 2))
    file, png = tmp_path / "x.json", tmp_path / "x.png"
    result = run("ablate", part, "--sample", "6", "--steps", "2", "--banks", str(banks), "--policies", "random",
                 "--length", "8", "--out", str(tmp_path), "--json", str(file), "--png", str(png))  # fmt: skip
    assert result.exit_code == 0, result.stderr
    rows = json.loads(file.read_text())["rows"]
    variants = {
        "steps": ["random", "random"],
        "fusion": ["clustering and exclusion", "clustering alone", "no clustering"],
        "verification": list(RANKINGS),
        "noise-resampling": [
            *("random, own noise", "random, other noise"),
            *(f"oracle, {noise} noise" for noise in ("own", "unforeseen", "other")),
        ],
        "attention": ["learned", "lowest-score"],
        "signs": ["inverted", "as printed"],
    }
    assert [row["variant"] for row in rows] == variants[part]
    for row, expected in zip(rows, expected_rates(banks, tmp_path, part), strict=True):
        assert row["detection_rate"] == pytest.approx(expected), row["variant"]
    assert png.read_bytes().startswith(b"\x89PNG")


def test_planning_trades_metres_and_moves(banks, tmp_path, untrained, monkeypatch):
    monkeypatch.setattr(
        "active6d_agent.evaluation.ablations.PLANNING", {"metres_weight": (0.0, 9.0), "stop_below": (1e9,)}
    )
    file, png = tmp_path / "x.json", tmp_path / "x.png"
    weights = untrained / "mug/view-attention/seed1/best.safetensors"
    common = ("--sample", "6", "--steps", "2", "--banks", str(banks), "--set", f"view-attention.weights={weights}")
    result = run("ablate", "planning", *common, "--json", str(file), "--png", str(png))
    assert result.exit_code == 0, result.stderr
    rows = {row["variant"]: row for row in json.loads(file.read_text())["rows"]}
    assert list(rows) == ["as shipped", "metres_weight 0", "metres_weight 9", "stop_below 1e+09", "random"]
    assert rows["metres_weight 9"]["distance_m"] < rows["metres_weight 0"]["distance_m"]
    assert rows["stop_below 1e+09"]["moves"] == 0.0
    assert png.stat().st_size > 1000
    result = run("evaluate", *common, "--policies", "random,view-attention", "--json", str(file))
    assert result.exit_code == 0, result.stderr
    against = json.loads(file.read_text())["policies"]["view-attention"]["against"]["random"]
    assert f"{against['detection_rate']['mean']:+.3f}" in result.stdout
    assert rows["random"]["against_first"]["e_add_mm"]["mean"] == pytest.approx(-against["e_add_mm"]["mean"])


def test_luck_needs_a_second_bank(banks, tmp_path):
    from shutil import copy

    copy(bank_path(banks, "mug", "test"), tmp_path)
    result = run("ablate", "noise-resampling", "--banks", str(tmp_path))
    assert result.exit_code == 2
    assert f"active6d bank --object mug --split test --seed 1 --banks {tmp_path}" in result.stderr


def test_seeds_are_told_apart_on_validation_scenes(banks, tmp_path, untrained, monkeypatch):
    from shutil import copyfile

    monkeypatch.setattr("active6d_agent.policies.registry.SHIPPED_WEIGHTS", tmp_path)
    copyfile(untrained / "mug/attention/seed2/best.safetensors", tmp_path / "attention_mug.safetensors")
    file = tmp_path / "x.json"
    common = ("--steps", "2", "--banks", str(banks))
    result = run("ablate", "seeds", *common, "--out", str(untrained), "--json", str(file), "--sample", "7")
    assert result.exit_code == 0, result.stderr
    rows = json.loads(file.read_text())["rows"]
    assert [(row["policy"], row["training_seed"]) for row in rows if row["shipped"]] == [("attention", 2)]
    for policy in ("attention", "view-attention"):
        own = [row for row in rows if row["policy"] == policy]
        assert [row["training_seed"] for row in own] == [0, 1, 2]
        most = max(row["validation_detection_rate"] for row in own)
        assert [row["validation_detection_rate"] for row in own if row["best_on_validation"]] == [most]
    # The made-up banks of all splits are the same, so test figures are validation figures.
    assert rows[4]["detection_rate"] == pytest.approx(rows[4]["validation_detection_rate"])
    assert rows[0]["training_minutes"] == 1.5


def test_missing_seeds_are_trained(banks, tmp_path, monkeypatch):
    from active6d_tools import policy_training
    from active6d_tools.cli import ablate

    asked = []
    monkeypatch.setattr(
        ablate, "follow_training", lambda training, lookups, title: asked.append((training.folder, lookups, title))
    )
    folder = tmp_path / "mug"
    there = folder / "attention" / "seed1" / policy_training.BEST
    for seed, steps in ((1, 1_000_000), (2, 950_000)):
        own = folder / "attention" / f"seed{seed}"
        own.mkdir(parents=True)
        (own / "curve.jsonl").write_text(json.dumps({"steps": 50_000}) + "\n" + json.dumps({"steps": steps}) + "\n")
    validation = BestViewLookup(load_bank(bank_path(banks, "mug", "val")))
    found = ablate._train_seeds(LEARNED, 3, validation, folder, 5, banks)
    assert found["attention", 1] == there
    every = [folder / name / f"seed{seed}" for name in ("view-attention", "attention") for seed in range(3)]
    assert [path for path, _, _ in asked] == [path for path in every if path != there.parent]
    assert asked[0][2] == "view-attention, mug, seed 0"
    train, same = asked[0][1]
    assert len(train.bank.scenes) == 2
    assert same is validation


def test_the_papers_policy_is_trained_in_full_and_begun_trainings_go_on(banks, tmp_path, monkeypatch):
    """Ten million steps at 1e-4, three seeds; the one that was interrupted is resumed."""
    from active6d_agent.policies.attention import ppo
    from active6d_tools.cli import ablate

    asked = []

    def train(train, val, folder, parameters, reward, *, resume, again):
        assert not again
        asked.append((folder.name, parameters, resume))
        yield from ()

    monkeypatch.setattr(ppo, "train_ppo", train)
    begun = tmp_path / "mug" / "attention-paper" / "seed1"
    begun.mkdir(parents=True)
    (begun / "latest.json").write_text("{}")
    validation = BestViewLookup(load_bank(bank_path(banks, "mug", "val")))
    found = ablate._train_seeds(("attention-paper",), 3, validation, tmp_path / "mug", 5, banks)
    assert [(name, resume) for name, _, resume in asked] == [("seed0", False), ("seed1", True), ("seed2", False)]
    for _, parameters, _ in asked:
        assert (parameters.total, parameters.learning_rate) == (10_000_000, 1e-4)
        assert (parameters.batch, parameters.gamma) == (128, 0.995)
    assert found["attention-paper", 1] == begun / "best.safetensors"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["evaluate", "--banks", "/nowhere"], "active6d bank --object mug --split test --banks /nowhere"),
        (["ablate", "alpha", "--banks", "/nowhere"], "active6d bank --object mug --split train --banks /nowhere"),
        (["ablate", "steps", "--policies", "psychic"], "unknown policy 'psychic'"),
        (["ablate", "gravity"], "'gravity' is not one of 'alpha'"),
        (["evaluate", "--policies", "psychic"], "unknown policy 'psychic'"),
        (["evaluate", "--steps", "100"], "--steps 100"),
        (["evaluate", "--policies", "random", "--set", "random.gain=1"], "has no parameter 'gain'"),
        (["evaluate", "--policies", "random", "--set", "entropy.gain=1"], "--set entropy"),
        (["bank", "--split", "holdout"], "--split 'holdout'"),
        (["bank", "--estimator", "psychic"], "unknown estimator 'psychic'"),
        (["bank", "--object", "teapot"], "unknown object 'teapot'"),
        (["bank", "--split", "wild_test", "--heaps", "3"], "--heaps adds to the scenes of train, val, test"),
        (["bank", "--split", "wild_val", "--wild", "3"], "--wild adds to the scenes of train, val, test"),
    ],
)
def test_bad_input_is_one_clear_line(banks, arguments, words):
    if arguments[0] in ("evaluate", "ablate") and "--banks" not in arguments:
        arguments = [*arguments, "--banks", str(banks)]
    result = run(*arguments)
    assert result.exit_code == 2
    assert words in result.stderr.strip().splitlines()[-1]
