"""The workspace as colcon builds it: executables and ament hooks must be where `ros2 run` and `ros2 launch` look."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PREFIX = Path(sys.prefix)
PACKAGES = [
    "active6d_agent",
    "active6d_bringup",
    "active6d_core",
    "active6d_perception",
    "active6d_sim",
    "active6d_tools",
]
NODES = {
    "active6d_sim": ["camera_simulator", "dataset_camera"],
    "active6d_perception": ["pose_estimator", "hypothesis_fusion"],
    "active6d_agent": ["attention_policy"],
    "active6d_bringup": ["episode_recorder", "bag_player"],
}
EXECUTABLES = [(package, name) for package, names in NODES.items() for name in names]


@pytest.fixture(scope="module")
def install(tmp_path_factory) -> Path:
    """An install space built from ros2_ws/ by colcon against the environment that runs the tests."""
    space = tmp_path_factory.mktemp("colcon")
    command = [PREFIX / "bin/colcon", "--log-base", space / "log", "build", "--base-paths", ROOT / "ros2_ws"]
    command += ["--build-base", space / "build", "--install-base", space / "install"]
    environment = {**os.environ, "AMENT_PREFIX_PATH": str(PREFIX), "PYTHONPATH": ""}
    run = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=110)
    assert run.returncode == 0, run.stdout + run.stderr
    assert "6 packages finished" in run.stdout
    return space / "install"


@pytest.fixture(scope="module")
def environment(install) -> dict[str, str]:
    """What a shell holds after `. install/local_setup.sh`; without the tests' own path to the sources."""
    keep = {key: os.environ[key] for key in ("HOME", "PATH") if key in os.environ}
    script = f". {install}/local_setup.sh && env -0"
    sourced = subprocess.run(
        ["sh", "-c", script], env={**keep, "COLCON_PYTHON_EXECUTABLE": sys.executable}, capture_output=True, check=True
    )
    return dict(entry.split("=", 1) for entry in sourced.stdout.decode().split("\0") if "=" in entry)


def test_the_workspace_lists_the_six_packages_as_ament_python():
    run = subprocess.run(
        [PREFIX / "bin/colcon", "--log-base", os.devnull, "list", "--base-paths", ROOT / "ros2_ws"],
        capture_output=True,
        text=True,
        check=True,
    )
    listed = [line.split("\t") for line in run.stdout.splitlines()]
    assert [(name, kind) for name, _, kind in listed] == [(name, "(ros.ament_python)") for name in PACKAGES]


@pytest.mark.parametrize("package", PACKAGES)
def test_markers_and_hooks(install, package):
    """An invalid package.xml makes colcon fall back to plain Python without a word; the hooks are then missing."""
    prefix = install / package
    share = prefix / "share" / package
    assert (prefix / "share/ament_index/resource_index/packages" / package).is_file()
    assert (share / "package.xml").read_bytes() == (ROOT / "src" / package / "package.xml").read_bytes()
    sourced = (share / "package.dsv").read_text().splitlines()
    assert f"source;share/{package}/hook/ament_prefix_path.dsv" in sourced
    assert f"source;share/{package}/hook/pythonpath.dsv" in sourced
    hook = (share / "hook/ament_prefix_path.dsv").read_text().strip()
    assert hook == "prepend-non-duplicate;AMENT_PREFIX_PATH;"


def test_the_setup_file_puts_every_prefix_on_the_ament_path(install, environment):
    prefixes = environment["AMENT_PREFIX_PATH"].split(os.pathsep)
    assert {str(install / package) for package in PACKAGES} <= set(prefixes)


@pytest.mark.parametrize(("package", "name"), EXECUTABLES)
def test_executables_start(install, environment, package, name):
    """Each executable starts, declares its parameters and refuses a bad one by name."""
    executable = install / package / "lib" / package / name
    assert os.access(executable, os.X_OK)
    command = [executable, "--ros-args", "-p", "world_frame:=7"]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
    assert run.returncode == 2, run.stderr
    assert "parameter 'world_frame'" in run.stderr


def test_command(install, environment):
    executable = install / "active6d_tools/lib/active6d_tools/active6d"
    run = subprocess.run([executable, "--help"], env=environment, capture_output=True, text=True, timeout=60)
    assert run.returncode == 0, run.stderr
    assert "episode" in run.stdout


@pytest.mark.parametrize("folder", ["launch", "config", "rviz", "foxglove"])
def test_shared_files(install, folder):
    source = ROOT / "src/active6d_bringup" / folder
    installed = install / "active6d_bringup/share/active6d_bringup" / folder
    names = sorted(path.name for path in source.iterdir())
    assert names
    assert sorted(path.name for path in installed.iterdir()) == names


@pytest.mark.parametrize("package", PACKAGES)
def test_every_file_is_installed(install, package):
    """Modules, object descriptions, meshes, scenes, weights, templates: all that lies in the package."""
    source = ROOT / "src" / package / package
    files = {path.relative_to(source) for path in source.rglob("*") if path.is_file()}
    files = {path for path in files if "__pycache__" not in path.parts}
    site = next((install / package).glob("lib/python*/site-packages")) / package
    assert not sorted(str(path) for path in files if not (site / path).is_file())


@pytest.mark.parametrize("package", PACKAGES)
def test_every_module_is_in_a_package(package):
    """setuptools leaves out folders without __init__.py."""
    source = ROOT / "src" / package / package
    folders = {path.parent for path in source.rglob("*.py")}
    assert not [folder for folder in folders if not (folder / "__init__.py").is_file()]
