"""The set-up script on machines that lack something, with stand-ins for system commands; nothing is installed here."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
# An interpreter that makes an environment out of stand-ins. Its pip finds no wheel of pybullet but a compiled one.
PYTHON_STAND_IN = """
case "$1" in
-V) echo "Python {version}.4" ;;
-m) mkdir -p .venv/bin && cp "$0" .venv/bin/python && cp "$(dirname "$0")/pip" .venv/bin/pip ;;
esac
"""
PIP_STAND_IN = """
echo "$*" >>calls
wheel="$XDG_CACHE_HOME/active6d/wheels/pybullet.whl"
case "$*" in
*--only-binary*pybullet*) [ -f "$wheel" ] ;;
"wheel "*) touch "$wheel" ;;
esac
"""
# Every library that Open3D links to is there.
FRESH = {"ldconfig": "echo libusb-1.0.so.0 libGL.so.1 libEGL.so.1 libX11.so.6 libidn2.so.0 libudev.so.1 x"}


@pytest.fixture
def checkout(tmp_path) -> Path:
    """What the script reads, in a folder without .venv."""
    for name in ("requirements.txt", "requirements-dev.txt", "constraints.txt", "scripts/setup.sh"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    package = tmp_path / "src/active6d_core"
    package.mkdir(parents=True)
    (package / "setup.py").touch()
    return tmp_path


def set_up(checkout: Path, commands: dict[str, str], **environment: str) -> subprocess.CompletedProcess:
    """Run the script with stand-ins for some system commands, given as shell scripts."""
    stand_ins = checkout / "stand_ins"
    stand_ins.mkdir(exist_ok=True)
    for name, script in commands.items():
        (stand_ins / name).write_text(f"#!/bin/sh\n{script}\n")
        (stand_ins / name).chmod(0o755)
    cleared = {name: value for name, value in os.environ.items() if name not in ("PYTHON", "TORCH_INDEX")}
    path = f"{stand_ins}{os.pathsep}{os.environ['PATH']}"
    return subprocess.run(
        ["bash", checkout / "scripts/setup.sh"],
        env={**cleared, "PATH": path, "PYENV_ROOT": str(checkout), "XDG_CACHE_HOME": str(checkout), **environment},
        capture_output=True,
        text=True,
        timeout=60,
    )


def interpreters(**versions: str) -> dict[str, str]:
    """Stand-ins by name, such as python3 of version 3.12; the other names are not installed."""
    names = ("python3.11", "python3.12", "python3.13", "python3")
    found = {name.replace(".", "_"): name for name in names}
    scripts = {
        name: PYTHON_STAND_IN.format(version=versions[key]) if key in versions else "exit 127"
        for key, name in found.items()
    }
    return {**scripts, "pip": PIP_STAND_IN}


def pip_calls(checkout: Path) -> list[str]:
    return (checkout / "calls").read_text().splitlines()


def test_another_python_is_refused_by_name(checkout):
    run = set_up(checkout, {}, PYTHON="/bin/false")
    assert run.returncode == 1
    assert run.stderr == "setup: PYTHON=/bin/false is not Python 3.11, 3.12 or 3.13\n"


@pytest.mark.parametrize("version", ["3.1", "3.10", "3.14", "2.7"])
def test_without_a_supported_python_it_says_what_to_install(checkout, version):
    run = set_up(checkout, {**interpreters(python3=version), "apt-cache": "exit 0"})
    assert run.returncode == 1
    assert "Python 3.11, 3.12 or 3.13 is needed and none was found" in run.stderr
    assert not (checkout / ".venv").exists()


@pytest.mark.parametrize(
    ("installed", "taken"),
    [
        ({"python3_11": "3.11", "python3_12": "3.12", "python3": "3.13"}, "3.11"),
        ({"python3_12": "3.12", "python3": "3.13"}, "3.12"),
        ({"python3": "3.12"}, "3.12"),
        ({"python3": "3.9", "python3_13": "3.13"}, "3.13"),
    ],
)
def test_the_first_supported_python_is_taken(checkout, installed, taken):
    run = set_up(checkout, {**FRESH, **interpreters(**installed)})
    assert run.returncode == 0, run.stderr
    assert f"making .venv with Python {taken}.4 " in run.stdout


def test_pybullet_is_compiled_once_and_its_wheel_is_kept(checkout):
    commands = {**FRESH, **interpreters(python3_12="3.12")}
    first = set_up(checkout, commands)
    assert first.returncode == 0, first.stderr
    assert f"compiling it once (about ten minutes); the wheel is kept in {checkout}/active6d/wheels" in first.stdout
    compiled = [call for call in pip_calls(checkout) if call.startswith("wheel ")]
    pin = next(line for line in (ROOT / "requirements.txt").read_text().splitlines() if line.startswith("pybullet=="))
    assert [call.split()[-1] for call in compiled] == [pin]
    shutil.rmtree(checkout / ".venv")
    second = set_up(checkout, commands)
    assert second.returncode == 0, second.stderr
    assert "compiling" not in second.stdout
    assert [call for call in pip_calls(checkout) if call.startswith("wheel ")] == compiled


def test_what_compiling_needs_is_named(checkout):
    bare = {"g++": "exit 127", "id": "echo 1000", "apt-get": "exit 99"}
    run = set_up(checkout, {**FRESH, **interpreters(python3_12="3.12"), **bare})
    assert run.returncode == 1
    assert run.stderr == "setup: missing system packages; please run: sudo apt-get install g++\n"


def test_nothing_is_done_twice_but_for_another_python(checkout):
    commands = {**FRESH, **interpreters(python3_11="3.11", python3_12="3.12")}
    assert set_up(checkout, commands).returncode == 0
    calls = pip_calls(checkout)
    again = set_up(checkout, commands)
    assert (again.returncode, again.stdout, pip_calls(checkout)) == (0, "", calls)
    other = set_up(checkout, commands, PYTHON="python3.12")
    assert "making .venv with Python 3.12.4" in other.stdout
    assert pip_calls(checkout) != calls


def test_missing_libraries_without_root_are_named(checkout):
    bare = {"ldconfig": "exit 0", "id": "echo 1000", "apt-get": "exit 99"}
    run = set_up(checkout, bare, PYTHON=sys._base_executable)
    assert run.returncode == 1
    packages = "libusb-1.0-0 libgl1 libegl1 libx11-6 libidn2-0 libudev1"
    assert run.stderr == f"setup: missing system packages; please run: sudo apt-get install {packages}\n"


def test_another_processor_is_refused(checkout):
    run = set_up(checkout, {"uname": '[ "$1" = -s ] && echo Linux || echo aarch64'})
    assert run.returncode == 1
    assert "Linux on x86-64 only" in run.stderr
