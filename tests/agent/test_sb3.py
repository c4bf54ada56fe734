"""Models of Stable-Baselines3 as policies: exported, loaded without pickle, and evaluated."""

import json

import numpy as np
import pytest
import torch
from stable_baselines3 import A2C, PPO, SAC
from synthetic_bank import synthetic_bank

from active6d_agent.bank.best_view_lookup import BestViewLookup
from active6d_agent.environment.gym_environment import Active6DEnv
from active6d_agent.evaluation.policy_evaluation import run_named
from active6d_agent.policies.registry import create_policy
from active6d_agent.policies.sb3 import export_model
from active6d_core.object_model import load_object


@pytest.fixture(scope="module")
def lookup():
    return BestViewLookup(synthetic_bank("mug", scenes=1))


@pytest.mark.parametrize(
    ("algorithm", "settings"),
    [
        (PPO, {"policy_kwargs": {"net_arch": {"pi": [16], "vf": [8]}, "activation_fn": torch.nn.ReLU}}),
        (A2C, {}),
        (SAC, {"policy_kwargs": {"net_arch": [16, 16]}, "buffer_size": 10}),
    ],
)
def test_the_exported_model_makes_the_models_moves(lookup, tmp_path, algorithm, settings):
    env = Active6DEnv(lookup, steps=3)
    model = algorithm("MultiInputPolicy", env, seed=4, device="cpu", **settings)
    export_model(model, tmp_path / "mine.safetensors")
    parameters = {"weights": str(tmp_path / "mine.safetensors")}
    results = run_named(lookup, "sb3", np.array([[0, 17], [0, 80]]), 3, parameters=parameters)
    for episode, start in enumerate((17, 80)):
        observation, _ = env.reset(options={"scene": 0, "view": start})
        for step in range(1, 4):
            observation, _, _, _, info = env.step(model.predict(observation, deterministic=True)[0])
            assert results.views[episode, step] == info["view"]
    assert info["distance_m"] == pytest.approx(results.distance_m[1])


def test_what_cannot_be_exported_is_refused(lookup, tmp_path):
    env = Active6DEnv(lookup)
    other = PPO("MultiInputPolicy", env, device="cpu", policy_kwargs={"activation_fn": torch.nn.GELU})
    with pytest.raises(ValueError, match="'GELU' cannot be exported"):
        export_model(other, tmp_path / "mine.safetensors")
    other = SAC("MultiInputPolicy", env, device="cpu", buffer_size=10, policy_kwargs={"n_critics": 3})
    with pytest.raises(ValueError, match="policy_kwargs other than"):
        export_model(other, tmp_path / "mine.safetensors")
    assert not list(tmp_path.iterdir())


def test_stable_baselines_own_file_is_not_loaded(lookup, tmp_path):
    model = PPO("MultiInputPolicy", Active6DEnv(lookup), device="cpu")
    model.save(tmp_path / "mine.zip")
    (tmp_path / "mine.json").write_text(
        json.dumps({"policy": "sb3", "algorithm": "PPO", "steps": 5, "net_arch": [], "activation": "Tanh"})
    )
    with pytest.raises(ValueError, match=r"write them with active6d_agent\.policies\.sb3\.export_model"):
        create_policy("sb3", lookup.model, weights=str(tmp_path / "mine.zip"))


def test_a_network_that_would_fill_the_memory_is_refused(tmp_path):
    (tmp_path / "a.safetensors").write_bytes(bytes(16))
    config = {"policy": "sb3", "algorithm": "PPO", "steps": 5, "net_arch": [10**6, 10**6], "activation": "Tanh"}
    (tmp_path / "a.json").write_text(json.dumps(config))
    with pytest.raises(ValueError, match="net_arch needs at most"):
        create_policy("sb3", load_object("mug"), weights=str(tmp_path / "a.safetensors"))
