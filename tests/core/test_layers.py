"""The layers of the design: mathematics without ROS, and packages that import only what they may."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

SRC = Path(__file__).parents[2] / "src"
#: What each package may import of the others (the design's table).
MAY_IMPORT = {
    "core": set(),
    "sim": {"core"},
    "perception": {"core"},
    "agent": {"core", "perception"},
    "bringup": {"core", "perception", "agent"},
    "tools": {"core", "sim", "perception", "agent", "bringup"},
}
#: Folders of the conversion and node layers.
ROS_FOLDERS = {"ros", "nodes"}
IMPORT_WITHOUT_ROS = """
import importlib, sys

class NoRos:
    def find_spec(self, name, path=None, target=None):
        top = name.partition(".")[0]
        if top in ("rclpy", "rcl_interfaces", "builtin_interfaces") or top.endswith(("_msgs", "_srvs")):
            raise ModuleNotFoundError(f"no ROS here, and {name} was imported")

sys.meta_path.insert(0, NoRos())
failures = 0
for module in sys.argv[1:]:
    try:
        importlib.import_module(module)
    except ImportError as error:
        failures += 1
        print(f"{module}: {error}")
sys.exit(failures > 0)
"""


def package_folder(package):
    return SRC / f"active6d_{package}" / f"active6d_{package}"


def core_modules(package):
    root = package_folder(package)
    for path in sorted(root.rglob("*.py")):
        parts = path.relative_to(root).with_suffix("").parts
        if parts[0] not in ROS_FOLDERS:
            yield ".".join([root.name, *(part for part in parts if part != "__init__")])


def imports_of(path):
    for node in ast.walk(ast.parse(path.read_text(), str(path))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            yield node.module


@pytest.mark.parametrize("package", ["core", "sim", "perception", "agent"])
def test_core_modules_import_without_ros(package):
    modules = list(core_modules(package))
    run = subprocess.run(
        [sys.executable, "-c", IMPORT_WITHOUT_ROS, *modules], capture_output=True, text=True, timeout=100, check=False
    )
    assert run.returncode == 0, run.stdout + run.stderr


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_packages_import_only_what_they_may(package):
    allowed = {f"active6d_{name}" for name in MAY_IMPORT[package] | {package}}
    for path in package_folder(package).rglob("*.py"):
        tops = {name.partition(".")[0] for name in imports_of(path)}
        ours = {top for top in tops if top.startswith("active6d_")}
        assert ours <= allowed, f"{path} imports {sorted(ours - allowed)}"


@pytest.mark.parametrize("package", ["core", "perception", "agent", "bringup"])
def test_a_robot_needs_no_physics(package):
    for path in package_folder(package).rglob("*.py"):
        assert not any(name.partition(".")[0] == "pybullet" for name in imports_of(path)), f"{path} imports pybullet"
