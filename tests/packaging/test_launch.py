"""The launch file, as far as it can be tested where `launch` is not installed: its tables against the nodes."""

import ast
import runpy
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest
import yaml
from ament_index_python.packages import PackageNotFoundError

from active6d_core.ros.graph_nodes import BAD_PARAMETERS, NODES

ROOT = Path(__file__).parents[2]
LAUNCH = ROOT / "src/active6d_bringup/launch/active6d.launch.py"
SYNTAX = ast.parse(LAUNCH.read_text())


def table(name: str) -> ast.Dict:
    """A dict at the top level of the launch file."""
    return next(s.value for s in SYNTAX.body if isinstance(s, ast.Assign) and s.targets[0].id == name)


def items(name: str) -> list[tuple[str, ast.expr]]:
    """Key and unevaluated value of each entry."""
    found = table(name)
    return [(key.value, value) for key, value in zip(found.keys, found.values, strict=True)]


def test_every_argument_has_a_description():
    descriptions = {name: entry.elts[2].value for name, entry in items("ARGUMENTS")}
    wanted = (
        "object policy seed scene steps metres estimator camera record bag rviz namespace params_file"
        " autostart use_sim_time play rate network defaults_file"
    )
    assert set(descriptions) == set(wanted.split())
    assert all(len(description) > 10 for description in descriptions.values())


def test_nodes_take_what_the_launch_file_gives(node):
    entry = NODES[node.get_name()]
    given = entry.launch_parameters
    assert (type(node).__module__, type(node).__name__) == (entry.module, entry.type_name)
    types = {name: value.id for name, value in items("TYPES")}
    for name in [*given, "autostart", "use_sim_time"]:
        assert type(node.get_parameter(name).value).__name__ == types.get(name, "str"), name


def test_every_argument_reaches_every_node_that_has_it(node):
    """But for what is one node's own: the first view's seed is the camera's, the policy's budget the policy's."""
    given = NODES[node.get_name()].launch_parameters
    shared = {"object", "metres", "steps"}
    assert {name for name in shared if node.has_parameter(name)} == shared & set(given)


def test_every_executable_exists():
    for executable, entry in NODES.items():
        line = f'"{executable} = {entry.module}:main"'
        assert line in (ROOT / "src" / entry.package / "setup.py").read_text()
    cameras = ast.literal_eval(table("CAMERAS"))
    assert {name for names in cameras.values() for name in names} <= NODES.keys()


def test_it_loads_where_launch_is_installed():
    pytest.importorskip("launch_ros.actions", reason="launch comes with an apt installation of ROS 2")
    names = runpy.run_path(str(LAUNCH))
    arguments = names["generate_launch_description"]().get_launch_arguments()
    assert {argument.name for argument in arguments} == set(names["ARGUMENTS"])


@pytest.fixture
def names(monkeypatch):
    """The launch file's functions; ``launch`` itself is replaced, since it need not be installed."""
    parts = ["actions", "event_handlers", "events", "events.process", "substitutions"]
    for name in ["launch", *(f"launch.{part}" for part in parts)]:
        monkeypatch.setitem(sys.modules, name, MagicMock())
    for name in ("launch_ros", "launch_ros.actions", "launch_ros.parameter_descriptions"):
        monkeypatch.setitem(sys.modules, name, MagicMock())
    installed = {"active6d_bringup": str(LAUNCH.parents[1])}

    def share(package: str) -> str:
        if package not in installed:
            raise PackageNotFoundError(package)
        return installed[package]

    monkeypatch.setattr("ament_index_python.packages.get_package_share_directory", share)
    return runpy.run_path(str(LAUNCH))


@pytest.fixture
def refuse(names):
    """The launch file's check before anything starts."""
    defaults = {name: default for name, (default, _, _) in names["ARGUMENTS"].items()}
    return lambda **given: names["_refuse_what_cannot_work"]({**defaults, **given})


@pytest.mark.parametrize(
    ("given", "cause"),
    [
        ({"rviz": "true"}, "rviz:=true needs rviz2"),
        ({"object": "teapot"}, "object:=teapot: unknown object 'teapot'"),
        ({"camera": "bag"}, "camera:=bag needs play:=FOLDER"),
        ({"params_file": "nowhere.yaml"}, "params_file:=nowhere.yaml does not exist"),
    ],
)
def test_what_cannot_work_is_refused_before_anything_starts(refuse, given, cause):
    refuse(object="mug", camera="bag", play="bags/mine")
    with pytest.raises(RuntimeError, match=cause):
        refuse(**given)


@pytest.mark.parametrize(
    ("given", "started"),
    [
        ({"camera": "simulator"}, {"camera_simulator", "attention_policy"}),
        ({"camera": "none", "record": "true"}, {"episode_recorder", "attention_policy"}),
        ({"camera": "bag"}, {"bag_player"}),
    ],
)
def test_the_nodes_that_a_camera_needs_are_started(names, given, started):
    defaults = {name: default for name, (default, _, _) in names["ARGUMENTS"].items()}
    assert names["_wanted"]({**defaults, **given}) == {"pose_estimator", "hypothesis_fusion"} | started


def test_a_parameter_file_is_overridden_by_what_is_given_alone(names):
    """In ROS the last value of a parameter counts, so the order is defaults, the user's file, arguments."""
    made = sys.modules["launch_ros.actions"].Node
    defaults = {name: default for name, (default, _, _) in names["ARGUMENTS"].items()}
    for executable, own in {"attention_policy": [], "episode_recorder": [{"resume": True}]}.items():
        names["_node"](executable, {**defaults, "params_file": "mine.yaml"})
        assert made.call_args.kwargs["parameters"] == ["mine.yaml", *own]
    given = {"params_file": "mine.yaml", "defaults_file": "cell.yaml", "autostart": "false", "steps": "3"}
    names["_node"]("attention_policy", {**defaults, **given})
    *files, parameters = made.call_args.kwargs["parameters"]
    assert files == ["cell.yaml", "mine.yaml"]
    assert parameters.keys() == {"autostart", "steps"}


@pytest.mark.parametrize(("code", "ends"), [(BAD_PARAMETERS, True), (0, False), (1, False), (-9, False)])
def test_a_node_that_refuses_its_parameters_ends_the_launch(names, code, ends):
    event = SimpleNamespace(returncode=code, process_name="pose_estimator-1")
    assert bool(names["_end_on_bad_parameters"](event, None)) is ends


def test_a_cell_is_the_graph_with_the_adapter_and_a_recorder(monkeypatch):
    """Its arguments are the graph's, all described; what has no default must be given."""
    included = MagicMock()
    modules = ("launch", "launch.actions", "launch.launch_description_sources", "launch.substitutions")
    for module in modules:
        monkeypatch.setitem(sys.modules, module, MagicMock())
    sys.modules["launch.actions"].IncludeLaunchDescription = included
    monkeypatch.setattr(
        "ament_index_python.packages.get_package_share_directory", lambda package: str(LAUNCH.parents[1])
    )
    cell = runpy.run_path(str(LAUNCH.with_name("cell.launch.py")))
    cell["generate_launch_description"]()
    given = dict(included.call_args.kwargs["launch_arguments"])
    graph = {name for name, _ in items("ARGUMENTS")}
    assert (given["camera"], given["record"]) == ("adapter", "true")
    assert given.keys() == cell["ARGUMENTS"].keys() | {"camera", "record", "defaults_file"}
    assert given.keys() <= graph
    assert cell["ARGUMENTS"]["network"][0] == "false"
    assert {cell["ARGUMENTS"][name][0] for name in ("policy", "estimator", "steps", "metres")} == {""}
    defaults = yaml.safe_load(Path(given["defaults_file"]).read_text())
    assert defaults == {"/**/pose_estimator": {"ros__parameters": {"estimator": "geometric"}}}
    needed = {name for name, (default, _) in cell["ARGUMENTS"].items() if default is None}
    assert needed == {"object", "params_file", "bag"}
    assert all(len(description) > 10 for _, description in cell["ARGUMENTS"].values())
