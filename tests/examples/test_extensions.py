"""The example packages, installed as a user would, and modules given by --import."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from synthetic_bank import synthetic_bank

from active6d_agent.bank.scene_bank import bank_path

EXAMPLES = Path(__file__).parents[2] / "examples"
MODULE = """
from active6d_agent.policies.baselines import MaxDistancePolicy
from active6d_agent.policies.registry import register_policy

@register_policy("from-module")
class Mine(MaxDistancePolicy):
    pass
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """A folder with both packages, beside nothing else."""
    target = tmp_path_factory.mktemp("site")
    install = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-build-isolation", "--no-index"]
    # setuptools leaves its build folder beside the sources.
    sources = [target / "sources" / name for name in ("example_estimator", "example_policy")]
    for source in sources:
        source.mkdir(parents=True)
        for path in (EXAMPLES / source.name).glob("*.*"):
            (source / path.name).write_bytes(path.read_bytes())
    subprocess.run([*install, "--target", target / "packages", *sources], check=True)
    return target / "packages"


@pytest.fixture(scope="module")
def bank(tmp_path_factory):
    folder = tmp_path_factory.mktemp("banks")
    synthetic_bank("mug", scenes=1, objects=6).save(bank_path(folder, "mug", "test"))
    return folder


def run(code, *arguments, paths=(), cwd=None, **variables):
    """Run the command, or code, where the paths are installed."""
    start = ["-c", code] if code else ["-m", "active6d_tools"]
    path = os.pathsep.join([*map(str, paths), os.environ["PYTHONPATH"]])
    return subprocess.run(
        [sys.executable, *start, *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": path, "COLUMNS": "200", **variables},
    )


@pytest.mark.parametrize("name", ["example_estimator", "example_policy"])
def test_an_example_is_short(name):
    assert len((EXAMPLES / name / f"{name}.py").read_text().splitlines()) < 60


def test_installed_parts_are_listed_with_their_package(installed, tmp_path):
    done = run("", "list", "--json", tmp_path / "parts.json", paths=[installed])
    assert done.returncode == 0, done.stderr
    parts = json.loads((tmp_path / "parts.json").read_text())
    assert parts["estimator"]["highest-point"] == "active6d-example-estimator 0.1.0"
    assert parts["policy"]["least-supported"] == "active6d-example-policy 0.1.0"
    assert parts["estimator"]["dense"] == parts["policy"]["random"] == "built in"
    assert "least-supported" in run("", "evaluate", "--help", paths=[installed]).stdout
    assert "highest-point" in run("", "estimate", "--help", paths=[installed]).stdout


def test_an_installed_policy_is_evaluated(installed, bank, tmp_path):
    options = ["--sample", "6", "--steps", "3", "--banks", bank, "--json", tmp_path / "table.json"]
    chosen = ["--policies", "least-supported,random", "--set", "least-supported.steepness=2"]
    done = run("", "evaluate", *chosen, *options, paths=[installed])
    assert done.returncode == 0, done.stderr
    table = json.loads((tmp_path / "table.json").read_text())["policies"]
    assert list(table) == ["least-supported", "random"]
    assert 0 < table["least-supported"]["detection_rate"] <= 1
    assert table["least-supported"]["distance_m"] != table["random"]["distance_m"]


def test_an_installed_estimator_finds_something(installed):
    code = """
import numpy as np
from active6d_core.camera import DEFAULT_CAMERA
from active6d_core.view_sphere import ViewSphere
from active6d_perception.active6d import Active6D
from active6d_sim.rendering.simulator import Simulator
from active6d_sim.scenes.scene_store import load_scene

sphere = ViewSphere()
view = Simulator(load_scene("mug", "test", 1), seed=0).capture(sphere.pose(sphere.positions[70]), 1)
estimate = Active6D("mug", "highest-point", count=4)
found = estimate(view.color, view.depth, view.camera, T_world_camera=view.T_world_camera)
highest = (view.T_world_camera @ found.T_camera_object)[:, 2, 3]
assert len(found) == 4 and (np.diff(highest) <= 0).all(), highest
"""
    done = run(code, paths=[installed])
    assert done.returncode == 0, done.stderr


def test_an_imported_module_adds_a_policy(bank, tmp_path):
    package = tmp_path / "mine"
    package.mkdir()
    (package / "policies.py").write_text(MODULE)
    options = ["--sample", "4", "--steps", "2", "--banks", bank, "--json", "table.json"]
    command = ["evaluate", "--policies", "from-module,max-distance", *options]
    done = run("", *command, "--import", "mine.policies", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    table = json.loads((tmp_path / "table.json").read_text())["policies"]
    assert table["from-module"]["distance_m"] == table["max-distance"]["distance_m"] > 0
    listed = run("", "list", cwd=tmp_path, ACTIVE6D_IMPORT="mine.policies")
    assert any(line.split() == ["policy", "from-module", "mine.policies"] for line in listed.stdout.splitlines())
    refused = run("", *command, cwd=tmp_path)
    assert refused.returncode == 2
    assert "unknown policy 'from-module'" in refused.stderr
    refused = run("", "list", "--import", "no.such.module", cwd=tmp_path)
    assert refused.returncode == 2
    assert refused.stderr.startswith("active6d: module no.such.module (--import or ACTIVE6D_IMPORT)")


def test_children_import_what_the_command_was_given(tmp_path):
    """As the nodes of --processes do: by the environment, from any working folder."""
    (tmp_path / "mine.py").write_text(MODULE)
    code = """
import os, subprocess, sys
from active6d_core.registry import request_imports

request_imports(["mine"])
os.chdir("/")
child = "from active6d_agent.policies.registry import list_policies; print('from-module' in list_policies())"
sys.path[:] = [path for path in sys.path if path]
print(subprocess.run([sys.executable, "-c", child], capture_output=True, text=True, check=True).stdout)
"""
    done = run(code, cwd=tmp_path)
    assert done.stdout.strip() == "True", done.stderr
