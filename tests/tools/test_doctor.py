"""The doctor finds what is missing, and says so in a form that scripts can read."""

import json
import sys

import pytest
from typer.testing import CliRunner

from active6d_tools import machine_doctor
from active6d_tools.cli import app
from active6d_tools.machine_doctor import Check, works


def test_this_machine_is_well(tmp_path):
    path = tmp_path / "doctor.json"
    result = CliRunner().invoke(app, ["doctor", "--json", str(path)], env={"COLUMNS": "200"})
    document = json.loads(path.read_text())
    assert result.exit_code == 0
    assert document["ok"] is True
    checks = {check["name"]: check for check in document["checks"]}
    for name in ("Python", "rclpy", "middleware", "pybullet", "open3d", "rosbags", "object models"):
        assert checks[name]["ok"], checks[name]
    self_tests = ("two nodes exchange a message", "ray casting a view", "loading the graph of an episode")
    for name in (*self_tests, "writing and reading a bag", "mcap", "zstandard", "opencv-contrib-python-headless"):
        assert checks[name]["ok"], checks[name]
        assert checks[name]["needed"]
    assert all(check["fix"] for check in checks.values() if not check["ok"])
    assert "The core path works." in result.stdout


def test_a_missing_needed_library_is_exit_code_1(monkeypatch, tmp_path):
    broken = [Check("A", "spoon", True, True, "1.0"), Check("A", "fork", False, True, "not there", "buy a fork")]
    monkeypatch.setattr(machine_doctor, "examine", lambda: iter(broken))
    result = CliRunner().invoke(app, ["doctor", "--json", str(tmp_path / "doctor.json")])
    assert result.exit_code == 1
    assert "buy a fork" in result.stdout
    assert "does not work: fork" in result.stdout
    assert json.loads((tmp_path / "doctor.json").read_text())["ok"] is False


@pytest.mark.parametrize(("needed", "expected"), [(True, False), (False, True)])
def test_only_what_is_needed_counts(needed, expected):
    assert works([Check("A", "a", True, True, ""), Check("A", "b", False, needed, "", "fix")]) is expected


def test_a_library_that_breaks_while_loading_is_a_finding(tmp_path, monkeypatch):
    (tmp_path / "brittle_library.py").write_text("raise OSError('libusb-1.0.so.0: cannot open\\nmore')\n")
    monkeypatch.syspath_prepend(tmp_path)
    check = machine_doctor._import_check("A", "brittle_library", "brittle", needed=True, fix="fix it")
    assert (check.ok, check.detail, check.fix) == (False, "libusb-1.0.so.0: cannot open", "fix it")


@pytest.mark.parametrize("module", ["active6d_bringup.graph.episode", "active6d_bringup.bags.writer"])
def test_what_the_recorder_cannot_load_fails_a_self_test(monkeypatch, module):
    """Whatever library it is: None in ``sys.modules`` makes an import fail."""
    monkeypatch.setitem(sys.modules, module, None)
    failed = {check.name for check in machine_doctor._self_tests() if not check.ok and check.needed}
    assert failed == {"loading the graph of an episode" if "graph" in module else "writing and reading a bag"}


def test_folders_and_a_domain_that_cannot_be_used_are_findings(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path / "file" / "log"))
    monkeypatch.setenv("ROS_DOMAIN_ID", "seven")
    checks = {check.name: check for check in machine_doctor._surroundings()}
    assert not any(check.ok for check in checks.values())
    assert "XDG_CACHE_HOME" in checks["cache folder"].fix
    assert "ROS_LOG_DIR" in checks["log folder"].fix
    assert "ROS_DOMAIN_ID is 'seven'" in checks["ROS domain"].detail
    with pytest.raises(ValueError, match="ROS_DOMAIN_ID is 'seven'"):
        machine_doctor._exchange_message()
    result = CliRunner().invoke(app, ["doctor", "--graph"])
    assert result.exit_code == 2
    assert result.stderr.startswith("active6d: ROS_DOMAIN_ID is 'seven', expected a number")
