"""The layers of the design: mathematics without ROS, a robot without simulator and trainer, packages in order."""

import ast
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
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
#: What a robot installs.
ROBOT = ("core", "perception", "agent", "bringup")
#: Libraries that a robot does not have, and the package that it leaves out.
NOT_ON_A_ROBOT = {"pybullet", "pybullet_data", "pybullet_utils", "gymnasium", "stable_baselines3", "active6d_sim"}
#: Modules of the robot's packages that only training uses.
TRAINING = {
    "active6d_agent.environment.gym_environment",
    "active6d_agent.environment.throughput",
    "active6d_agent.evaluation.ablations",
    "active6d_agent.policies.attention.ppo",
    "active6d_agent.policies.attention.ppo_policy",
    "active6d_agent.policies.sb3",
}
#: Registers the environment where Gymnasium is installed, and must import where it is not.
REGISTRATION = "active6d_agent.environment.gym_registration"
MOST_LINES_OF_A_NODE, MOST_LINES_OF_A_FUNCTION = 300, 60
#: Folders of the conversion and node layers.
ROS_FOLDERS = {"ros", "nodes"}
#: Modules that need ROS and lie in no such folder.
ON_ROS = {
    "active6d_bringup.bags.replay",
    "active6d_bringup.graph.composition",
    "active6d_bringup.graph.liveness",
    "active6d_bringup.graph.episode",
    "active6d_bringup.graph.processes",
    "active6d_tools.benchmark.graph_overhead",
    "active6d_tools.benchmark.pipeline",
    "active6d_tools.describe_nodes",
    "active6d_tools.graph_doctor",
    "active6d_tools.studies.compare_adapter",
}
IMPORT_BLOCKED = """
import importlib, sys

blocked, modules = sys.argv[1].split(), sys.argv[2:]

class Blocker:
    def find_spec(self, name, path=None, target=None):
        top = name.partition(".")[0]
        if top in blocked or "ros" in blocked and top.endswith(("_msgs", "_srvs", "_interfaces")):
            raise ModuleNotFoundError(f"{name} was imported")

sys.meta_path.insert(0, Blocker())
failures = []
for module in modules:
    try:
        importlib.import_module(module)
    except ImportError as error:
        failures.append(f"{module}: {error}")
print("\\n".join(failures))
sys.exit(len(failures) > 0)
"""


def modules_of(package: str) -> Iterator[tuple[str, Path]]:
    """Name and file of each module of a package; what runs when it is imported is left out."""
    root = SRC / f"active6d_{package}" / f"active6d_{package}"
    for path in sorted(root.rglob("*.py")):
        parts = path.relative_to(root.parent).with_suffix("").parts
        if parts[-1] != "__main__":
            yield ".".join(part for part in parts if part != "__init__"), path


def is_core(module: str) -> bool:
    return not ROS_FOLDERS & set(module.split(".")) and module not in ON_ROS


def imports_of(path: Path) -> set[str]:
    """Top-level names that a file imports, anywhere in it."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(), str(path))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names.add(node.module)
    return {name.partition(".")[0] for name in names}


def import_blocked(blocked: str, modules: list[str]) -> subprocess.CompletedProcess:
    command = [sys.executable, "-c", IMPORT_BLOCKED, blocked, *modules]
    return subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)


@pytest.mark.parametrize(
    ("packages", "blocked"),
    # bags are read and reported on with the message classes, but without a ROS client
    [("core sim perception agent", "rclpy ros"), ("bringup tools", "rclpy")],
)
def test_core_modules_import_without_ros(packages, blocked):
    modules = [module for package in packages.split() for module, _ in modules_of(package) if is_core(module)]
    assert {module.split(".")[0] for module in modules} == {f"active6d_{package}" for package in packages.split()}
    run = import_blocked(blocked, modules)
    assert run.returncode == 0, run.stdout + run.stderr


def test_a_robot_imports_without_simulator_and_trainer():
    """Each module of its packages, the nodes too; what they import in turn counts."""
    modules = [module for package in ROBOT for module, _ in modules_of(package) if module not in TRAINING]
    assert REGISTRATION in modules
    assert {module.rpartition(".")[2] for module in modules} >= {"pose_estimator", "attention_policy", "bag_player"}
    run = import_blocked(" ".join(sorted(NOT_ON_A_ROBOT)), modules)
    assert run.returncode == 0, run.stdout + run.stderr


@pytest.mark.parametrize("blocked", ["rclpy", "ros", " ".join(sorted(NOT_ON_A_ROBOT))])
def test_blocking_works(blocked):
    """The two tests above would otherwise pass whatever is imported."""
    run = import_blocked(blocked, ["active6d_sim.nodes.camera_simulator"])
    assert run.returncode == 1
    assert "was imported" in run.stdout


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_packages_import_only_what_they_may(package):
    allowed = {f"active6d_{name}" for name in MAY_IMPORT[package] | {package}}
    for _, path in modules_of(package):
        ours = {name for name in imports_of(path) if name.startswith("active6d_")}
        assert ours <= allowed, f"{path} imports {sorted(ours - allowed)}"


@pytest.mark.parametrize("package", ROBOT)
def test_a_robot_needs_neither_simulator_nor_trainer(package):
    """Not even inside of a function, but for what only training uses."""
    for module, path in modules_of(package):
        needed = imports_of(path) & NOT_ON_A_ROBOT
        assert not needed or module in TRAINING | {REGISTRATION}, f"{path} imports {sorted(needed)}"


def test_nodes_and_functions_are_short():
    """Nodes are thin, and a function does one thing."""
    long = []
    for module, path in (found for package in MAY_IMPORT for found in modules_of(package)):
        text = path.read_text()
        if "nodes" in module.split(".") and len(text.splitlines()) > MOST_LINES_OF_A_NODE:
            long.append(module)
        functions = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.FunctionDef)]
        lengths = {f"{module}.{f.name}": (f.end_lineno or 0) - f.lineno + 1 for f in functions}
        long += [name for name, length in lengths.items() if length > MOST_LINES_OF_A_FUNCTION]
    assert not long


def test_a_name_of_a_module_says_which_one():
    """Networks and registries are named alike in every package, and a command like what it runs."""
    paths = [path for package in MAY_IMPORT for _, path in modules_of(package) if path.parent.name != "cli"]
    names = Counter(path.stem for path in paths if path.stem != "__init__") - Counter(network=3, registry=2)
    assert {name for name, count in names.items() if count > 1} == set()


def test_lists_of_modules_are_current():
    modules = {module: path for package in MAY_IMPORT for module, path in modules_of(package)}
    assert modules.keys() >= TRAINING | ON_ROS
