"""The command's manners: help with examples, one clear line and exit code 2 on bad input, a quick start."""

import ast
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
import typer
from PIL import Image
from typer.testing import CliRunner

import active6d_tools.cli
from active6d_core.se3 import make_transform
from active6d_sim.scenes.scene import Bin, Scene
from active6d_tools.cli import app
from active6d_tools.cli.options import parse_overrides
from active6d_tools.cli.output import write_json


def run(*arguments: str):
    return CliRunner().invoke(app, list(arguments), env={"COLUMNS": "200", "TERM": "dumb"})


def commands(group: typer.core.TyperGroup, path: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    found = []
    for name, command in group.commands.items():
        found += commands(command, (*path, name)) if hasattr(command, "commands") else [(*path, name)]
    return found


NO_ROS = """
class NoRos:
    def find_spec(self, name, path=None, target=None):
        top = name.partition(".")[0]
        if top in ("rclpy", "rcl_interfaces", "builtin_interfaces", "rosbags") or top.endswith(("_msgs", "_srvs")):
            raise ModuleNotFoundError(f"no ROS here, and {name} was imported")

sys.meta_path.insert(0, NoRos())
"""
COMMANDS = commands(typer.main.get_command(app))


@pytest.mark.parametrize("path", COMMANDS, ids=" ".join)
def test_every_command_has_help_with_an_example(path):
    result = run(*path, "--help")
    assert result.exit_code == 0
    assert f"Example: active6d {' '.join(path)}" in result.stdout
    assert not any(kind in result.stdout for kind in ("{policies}", "{estimators}", "{sensors}"))


def test_without_a_command_the_help_is_shown():
    result = run()
    assert result.exit_code == 0
    assert "episode" in result.stdout


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nonsense"], "No such command 'nonsense'"),
        (["object"], "Missing command"),
        (["train"], "Missing command"),
        (["episode", "--steps", "-1"], "--steps"),
        (["episode", "--steps", "many"], "--steps"),
        (["episode", "--sede", "3"], "--sede"),
        (["episode", "--object", "teapot"], "unknown object 'teapot'; known: bunny"),
        (["episode", "--policy", "clever"], "--policy 'clever' is not among"),
        (["episode", "--estimator", "magic"], "--estimator 'magic' is not among"),
        (["episode", "--report", "x.html"], "--report needs --bag"),
        (["episode", "--figure", "x.png"], "--figure needs --bag"),
        (["episode", "--set", "fusion"], "--set fusion: expected NODE.NAME=VALUE"),
        (["episode", "--set", "hypothesis_fusion.epsilon=[1"], "not YAML"),
        (["episode", "--params-file", "/nowhere.yaml"], "/nowhere.yaml does not exist"),
        (["replay", "/nowhere"], "/nowhere: no such folder"),
        (["replay", "/nowhere", "--rate", "2", "--as-fast"], "exclude each other"),
        (["replay", "/nowhere", "--rate", "0"], "--rate"),
        (["report", "/nowhere"], "/nowhere: no such folder"),
        (["report"], "Missing argument 'BAG'"),
        (["object", "show", "teapot"], "unknown object 'teapot'"),
        (["object", "add", "/nowhere.ply", "--name", "x"], "mesh /nowhere.ply does not exist"),
        (["object", "add", "/nowhere.ply", "--name", "../x"], "--name '../x'"),
        (["object", "list", "--json", "/proc/nowhere/x.json"], "/proc/nowhere"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(arguments, words):
    result = run(*arguments)
    assert result.exit_code == 2
    lines = result.stderr.strip().splitlines()
    assert lines[-1].startswith("active6d: ")
    assert words in lines[-1]
    assert "Traceback" not in result.stderr


def test_the_command_starts_without_heavy_libraries():
    heavy = "numpy scipy rclpy open3d torch pybullet matplotlib jinja2 trimesh rosbags"
    code = f"import sys, active6d_tools.cli; print([name for name in '{heavy}'.split() if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.strip() == "[]"


def test_it_runs_as_a_module():
    done = subprocess.run(
        [sys.executable, "-m", "active6d_tools", "object", "show", "teapot"],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 2
    assert done.stderr.startswith("active6d: unknown object 'teapot'")


def test_object_list_and_show_as_json(tmp_path):
    assert run("object", "list", "--json", str(tmp_path / "list.json")).exit_code == 0
    listed = {item["name"]: item for item in json.loads((tmp_path / "list.json").read_text())["objects"]}
    assert {"bunny", "coffee_cup", "mug"} <= listed.keys()
    # 120 mm high, 90 mm across the lid, 60 mm across the base: the longest way is from lid to base across the cup.
    assert listed["coffee_cup"]["diameter_mm"] == pytest.approx(np.hypot(120.0, 75.0), abs=1.0)
    shown = run("object", "show", "mug", "--png", str(tmp_path / "mug.png"))
    assert shown.exit_code == 0
    assert "handle" in shown.stdout
    picture = np.asarray(Image.open(tmp_path / "mug.png"), float)
    assert picture.shape == (420, 1680, 3)
    red = (picture[..., 0] > 1.5 * picture[..., 1]) & (picture[..., 0] > 1.5 * picture[..., 2])
    assert all(0.1 < part.mean() < 0.6 for part in np.split(red, 4, axis=1))


def test_one_bad_description_does_not_end_the_listing(tmp_path, monkeypatch):
    (tmp_path / "bad.yaml").write_text("a: &x [1]\nb: [*x, *x]\n")
    (tmp_path / "worse.yaml").write_bytes(b"\xff\xfe\x00")
    monkeypatch.setenv("ACTIVE6D_OBJECT_PATH", str(tmp_path))
    result = run("object", "list", "--json", str(tmp_path / "list.json"))
    assert result.exit_code == 0
    listed = json.loads((tmp_path / "list.json").read_text())
    assert {"bunny", "coffee_cup", "mug"} <= {item["name"] for item in listed["objects"]}
    assert listed["left_out"].keys() == {"bad", "worse"}
    assert "left out: bad" in result.stderr


def test_one_bad_module_does_not_end_the_listing(tmp_path, monkeypatch):
    (tmp_path / "broken_module.py").write_text("raise RuntimeError('no')\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("ACTIVE6D_IMPORT", "broken_module,missing_module")
    result = run("list", "--json", str(tmp_path / "list.json"))
    assert result.exit_code == 0
    assert "dense" in json.loads((tmp_path / "list.json").read_text())["estimator"]
    assert [line.split(":")[0] for line in result.stderr.splitlines()].count("left out") == 2


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("hypothesis_fusion.epsilom=0.01", "has no parameter 'epsilom', did you mean 'epsilon'?"),
        ("hypothesis_fusion.epsilon=abc", "must be a float such as 0.01, got 'abc'"),
        ("hypothesis_fusion.epsilon=", "the value is empty"),
        ("hypothesis_fuson.epsilon=0.01", "did you mean 'hypothesis_fusion'?"),
        ("hypothesis_fusion.epsilon=[[[", "the value is not YAML"),
    ],
)
def test_a_wrong_parameter_is_one_line_with_the_nearest_name(override, words):
    result = run("episode", "--object", "mug", "--set", override)
    assert result.exit_code == 2
    assert words in " ".join(result.stderr.split())


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("hypothesis_fusion:\n  ros__parameters: {epsilom: 0.1}\n", "did you mean 'epsilon'?"),
        ("hypothesis_fuson:\n  ros__parameters: {epsilon: 0.1}\n", "did you mean 'hypothesis_fusion'?"),
        ("/**/camera_simulatr:\n  ros__parameters: {seed: 1}\n", "no node 'camera_simulatr', did you mean"),
        ("- 1\n", "it must hold NODE"),
        ("a: &x {}\nb: *x\n", "alias"),
    ],
)
def test_a_wrong_parameter_file_is_one_line(tmp_path, text, words):
    (tmp_path / "params.yaml").write_text(text)
    result = run("episode", "--object", "mug", "--params-file", str(tmp_path / "params.yaml"))
    assert result.exit_code == 2
    assert words in " ".join(result.stderr.split())


def test_an_added_object_is_found_and_measured(tmp_path, monkeypatch):
    mesh = tmp_path / "brick.stl"
    trimesh.creation.box((30.0, 40.0, 120.0)).export(mesh)
    added = run("object", "add", str(mesh), "--name", "brick", "--scale", "0.001", "--into", str(tmp_path / "objects"))
    assert added.exit_code == 0
    assert "130.0 mm" in added.stdout
    assert f"ACTIVE6D_OBJECT_PATH={tmp_path / 'objects'}" in added.stdout.replace("\n", "")
    monkeypatch.setenv("ACTIVE6D_OBJECT_PATH", str(tmp_path / "objects"))
    assert "130.0 mm" in run("object", "list").stdout
    again = run("object", "add", str(mesh), "--name", "brick", "--into", str(tmp_path / "objects"))
    assert again.exit_code == 2
    assert "exists already" in again.stderr


@pytest.fixture
def add_bolt(tmp_path):
    """Adds a bolt along x with a hexagonal head, 35 mm long, by the arguments given."""
    head, shaft = trimesh.creation.cylinder(7.5, 5.0, sections=6), trimesh.creation.cylinder(4.0, 30.0)
    shaft.apply_translation((0.0, 0.0, 17.5))
    bolt = trimesh.util.concatenate([head, shaft])
    bolt.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (0.0, 1.0, 0.0)))
    bolt.export(tmp_path / "bolt.stl")
    into = tmp_path / "objects"
    command = ["object", "add", str(tmp_path / "bolt.stl"), "--name", "bolt", "--scale", "0.001", "--into", str(into)]
    return lambda *arguments: run(*command, *arguments)


def test_the_offset_to_the_mesh_file_is_said(tmp_path, monkeypatch):
    mesh = trimesh.creation.box((30.0, 40.0, 120.0))
    mesh.apply_translation((100.0, -20.0, 60.0))
    mesh.export(tmp_path / "plate.stl")
    into = str(tmp_path / "objects")
    added = run("object", "add", str(tmp_path / "plate.stl"), "--name", "plate", "--scale", "0.001", "--into", into)
    assert "origin_mm 100.00 -20.00 60.00:" in " ".join(added.stdout.split())
    monkeypatch.setenv("ACTIVE6D_OBJECT_PATH", into)
    shown = run("object", "show", "plate", "--json", str(tmp_path / "plate.json"))
    assert "origin mm" in shown.stdout
    assert json.loads((tmp_path / "plate.json").read_text())["origin_mm"] == pytest.approx([100.0, -20.0, 60.0])


def test_an_axis_that_the_mesh_does_not_have_is_refused(tmp_path, add_bolt):
    refused = add_bolt("--axis", "0", "0", "1")
    words = " ".join(refused.stderr.split())
    assert refused.exit_code == 2
    assert "bolt.stl cannot be added: --axis is no axis of symmetry" in words
    # The end of the shaft is 15 mm or more from everything when it stands across.
    deviation = float(re.search(r"surface move by ([\d.]+) mm or more", words)[1])
    assert 12.0 < deviation < 35.0
    assert words.endswith("--axis can be x (1 0 0)")
    assert not [path for path in (tmp_path / "objects").rglob("*") if path.is_file()]


def test_an_object_that_looks_round_is_said_to(tmp_path, add_bolt, monkeypatch):
    added = add_bolt()
    words = " ".join(added.stdout.split())
    assert "it looks the same after a sixth of a turn about x; if this does not matter, " in words
    assert "add it again with another --name and --symmetry x:6" in words
    assert "it looks nearly round about x (1 0 0); if no turn about it matters, add --axis" in words
    assert f"to use it: export ACTIVE6D_OBJECT_PATH={tmp_path / 'objects'}" in words
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("ACTIVE6D_OBJECT_PATH", raising=False)
    unknown = " ".join(run("object", "show", "bolt").stderr.split())
    assert f"to use {tmp_path / 'objects'}: export ACTIVE6D_OBJECT_PATH=" in unknown


def test_the_axis_that_the_mesh_has_is_taken(add_bolt):
    assert add_bolt("--axis", "-2", "0", "0").exit_code == 0


def test_an_axis_that_only_a_detail_does_not_have_is_taken(tmp_path):
    """A lid with a peg, 1.4 % of its surface; meshes of real lids have drinking holes."""
    lid, peg = trimesh.creation.cylinder(45.0, 20.0), trimesh.creation.cylinder(3.0, 12.0)
    peg.apply_translation((30.0, 0.0, 16.0))
    trimesh.util.concatenate([lid, peg]).export(tmp_path / "lid.stl")
    into = str(tmp_path / "objects")
    command = ("object", "add", str(tmp_path / "lid.stl"), "--name", "lid", "--scale", "0.001", "--into", into)
    assert "--axis can be z (0 0 1)" in " ".join(run(*command, "--axis", "1", "0", "0").stderr.split())
    assert run(*command, "--axis", "0", "0", "1").exit_code == 0


def test_a_mesh_without_an_axis_names_none(tmp_path):
    trimesh.creation.box((0.03, 0.03, 0.04)).export(tmp_path / "box.stl")
    into = str(tmp_path / "objects")
    refused = run("object", "add", str(tmp_path / "box.stl"), "--name", "box", "--axis", "0", "0", "1", "--into", into)
    # A corner is 21.2 mm from the axis, a side 15 mm: corners move by up to 6.2 mm.
    words = " ".join(refused.stderr.split())
    assert 4.5 < float(re.search(r"2% of the surface move by ([\d.]+) mm or more", words)[1]) < 6.2
    assert "none of x, y and z is one" in words


def test_a_mesh_that_stays_open_is_said_to_be(tmp_path):
    mesh = trimesh.creation.icosphere(2, 0.04)
    mesh.update_faces(np.random.default_rng(0).random(len(mesh.faces)) > 0.3)
    mesh.export(tmp_path / "scan.ply")
    added = run("object", "add", str(tmp_path / "scan.ply"), "--name", "scan", "--into", str(tmp_path / "objects"))
    assert added.exit_code == 0, added.output
    assert "edges and is used as it is" in " ".join(added.stdout.split())


def test_a_mesh_that_is_none_leaves_nothing_behind(tmp_path):
    mesh = tmp_path / "empty.ply"
    mesh.write_text("ply\n")
    result = run("object", "add", str(mesh), "--name", "empty", "--into", str(tmp_path / "objects"))
    assert result.exit_code == 2
    assert [path for path in (tmp_path / "objects").rglob("*") if path.is_file()] == []


def test_overrides_are_read_as_yaml():
    texts = ["camera_simulator.noise=0.5", "camera_simulator.snap=false", "pose_estimator.name=a=b"]
    assert parse_overrides(texts) == {
        "camera_simulator": {"noise": 0.5, "snap": False},
        "pose_estimator": {"name": "a=b"},
    }


def test_files_are_written_whole_or_not_at_all(tmp_path):
    path = tmp_path / "deep" / "result.json"
    write_json(path, {"rate": 0.5})
    document = json.loads(path.read_text())
    assert document["rate"] == 0.5
    assert "numpy" in document["versions"]
    with pytest.raises(ValueError, match="JSON"):
        write_json(path, {"rate": float("nan")})
    assert json.loads(path.read_text()) == document
    assert [item.name for item in path.parent.iterdir()] == ["result.json"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["scenes", "show", "mug/test"], "not of the form mug/test/3"),
        (["scenes", "show", "mug/test/99"], "no scene 'mug/test/99'"),
        (["scenes", "show", "teapot/seed/1"], "unknown object 'teapot'"),
        (["scenes", "show", "mug/seed/7", "--view", "100"], "the grid has views 0 to 99"),
        (["scenes", "report", "--split", "exam"], "no scene 'mug/exam/0'"),
        (["scenes", "generate", "--split", "exam"], "unknown split 'exam'"),
        (["benchmark", "graph", "--object", "teapot"], "unknown object 'teapot'"),
        (["benchmark", "estimator", "--split", "exam"], "unknown split 'exam'"),
        (["benchmark", "estimator", "--estimator", "magic"], "unknown estimator 'magic'"),
    ],
)
def test_bad_scene_or_benchmark_is_one_line_and_exit_code_2(arguments, words):
    result = run(*arguments)
    assert result.exit_code == 2
    assert words in result.stderr.strip().splitlines()[-1]


def make_stored_scenes(folder: Path, visible_fraction: np.ndarray) -> None:
    """Ten test scenes of one mug lying alone, with made-up visible fractions for its several objects."""
    n = visible_fraction.shape[1]
    poses = make_transform(np.eye(3), np.c_[0.2 * np.arange(n), np.zeros(n), np.full(n, 0.05)])
    (folder / "mug").mkdir(parents=True)
    for index in range(10):
        scene = Scene("mug", f"mug/test/{index}", index, poses, Bin(0.4, 0.4, 0.05), visible_fraction)
        scene.save(folder / "mug" / f"test_{index:02d}.npz")


def test_scenes_report_counts_objects_that_are_half_visible(tmp_path, monkeypatch):
    # Seen from everywhere; from half the views of every elevation; from one view only; from nowhere.
    fraction = np.zeros((100, 4))
    fraction[:, 0] = 0.9
    fraction[np.arange(100) % 20 < 10, 1] = 0.5
    fraction[17, 2] = 0.6
    fraction[:, 3] = 0.49
    make_stored_scenes(tmp_path, fraction)
    monkeypatch.setenv("ACTIVE6D_SCENE_PATH", str(tmp_path))
    result = run("scenes", "report", "--json", str(tmp_path / "report.json"))
    assert result.exit_code == 0
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["counts"] == [4] * 10
    assert report["all_views"] == 0.75
    assert report["oracle"] == 0.75
    assert report["revolution"] == 0.5
    assert report["one_view"] == pytest.approx((1 + 0.5 + 0.01) / 4, abs=0.05)


def test_scenes_show_draws_the_views(tmp_path):
    result = run("scenes", "show", "bunny/seed/3", "--view", "45", "--view", "90", "--png", str(tmp_path / "scene.png"))
    assert result.exit_code == 0
    assert "azimuth  90°   elevation 45°" in result.stdout
    assert Image.open(tmp_path / "scene.png").size == (1280, 960)


def test_commands_import_no_other_command():
    folder = Path(active6d_tools.cli.__file__).parent
    shared = {"options", "output", "progress", "terminal"}
    for path in folder.glob("*.py"):
        imported = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module == "active6d_tools.cli":
                imported |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module.startswith("active6d_tools.cli."):
                imported.add(node.module.split(".")[2])
            elif isinstance(node, ast.Import):
                names = [alias.name.split(".") for alias in node.names]
                imported |= {name[2] for name in names if name[:2] == ["active6d_tools", "cli"] and len(name) > 2}
        assert path.stem == "__init__" or imported <= shared, f"{path.name} imports {sorted(imported - shared)}"


@pytest.mark.parametrize(
    "arguments",
    [
        ["train", "policy", "--banks", "/nowhere"],
        ["train", "estimator", "--object", "teapot"],
        ["bank", "--estimator", "psychic"],
        ["evaluate", "--policies", "psychic"],
        ["ablate", "steps", "--policies", "psychic"],
        ["benchmark", "environment", "--banks", "/nowhere"],
    ],
    ids=lambda arguments: " ".join(arguments[:2]),
)
def test_training_needs_no_ros(arguments):
    """Everything is imported and runs until the wrong argument is found, with rclpy and its messages blocked."""
    code = f"import sys\n{NO_ROS}\nfrom active6d_tools.cli import main\nsys.argv = ['active6d', *{arguments}]\nmain()"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=100)
    assert done.returncode == 2, done.stderr
    assert arguments[-1] in done.stderr
    assert "no ROS here" not in done.stderr


def test_work_is_done_outside_the_commands():
    """What commands share and what other packages could use is importable without Typer."""
    code = "import sys; sys.modules['typer'] = None; import " + ", ".join(
        f"active6d_tools.{name}" for name in ("bank_building", "policy_training", "training_data", "threads", "report")
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=100)
