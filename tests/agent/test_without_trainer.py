"""A robot has no trainer: the paper's policy decides without it. tests/core/test_layers.py imports all modules so."""

import subprocess
import sys

BLOCK = """
import sys

for name in ("gymnasium", "stable_baselines3", "pybullet"):
    sys.modules[name] = None
"""


def run(code):
    done = subprocess.run([sys.executable, "-c", BLOCK + code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


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
