"""A robot has neither simulator nor trainer: all that it needs of the agent imports and decides without them."""

import subprocess
import sys
from pathlib import Path

import active6d_agent

ROOT = Path(active6d_agent.__file__).parent
#: What trains, and measures training; all else must do without.
TRAINING = {
    "active6d_agent.environment.gym_environment",
    "active6d_agent.environment.throughput",
    "active6d_agent.evaluation.ablations",
    "active6d_agent.policies.attention.ppo",
    "active6d_agent.policies.sb3",
}
BLOCK = """
import importlib, sys

for name in ("gymnasium", "stable_baselines3", "pybullet"):
    sys.modules[name] = None
"""


def core_modules():
    for path in ROOT.rglob("*.py"):
        parts = path.relative_to(ROOT.parent).with_suffix("").parts
        if "nodes" not in parts:
            yield ".".join(part for part in parts if part != "__init__")


def run(code, *arguments):
    done = subprocess.run([sys.executable, "-c", BLOCK + code, *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_all_but_training_imports_without_trainer_and_simulator():
    modules = sorted(set(core_modules()) - TRAINING)
    assert len(modules) > 15
    assert set(core_modules()) > TRAINING
    run("for module in sys.argv[1:]: importlib.import_module(module)", *modules)


def test_the_papers_policy_decides_without_trainer():
    shown = run(
        """
import numpy as np, torch
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from active6d_agent.policies.attention.network import AttentionNetwork, save_network
from active6d_agent.policies.registry import Observation, create_policy
from active6d_core.hypotheses import SceneObjects
from active6d_core.view_sphere import ViewSphere

torch.manual_seed(0)
with TemporaryDirectory() as folder:
    save_network(AttentionNetwork(), Path(folder) / "weights.safetensors")
    policy = create_policy("attention", SimpleNamespace(name="ball"), weights=f"{folder}/weights.safetensors")
none = np.zeros(0)
objects = SceneObjects(np.zeros((0, 4, 4)), none, none, np.zeros((0, 4)), none, none, none, none, none)
sphere = ViewSphere()
decision = policy.decide(Observation(objects, sphere.positions[:1], sphere, np.ones(100, bool), 5))
print(decision.view)
"""
    )
    assert 1 <= int(shown) < 100
