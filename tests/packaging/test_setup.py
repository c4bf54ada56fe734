"""The set-up script's messages, where a machine lacks something; nothing is installed here."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def checkout(tmp_path) -> Path:
    """What the script reads, in a folder without .venv."""
    for name in ("requirements.txt", "requirements-dev.txt", "constraints.txt", "scripts/setup.sh"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    return tmp_path


def set_up(checkout: Path, commands: dict[str, str], **environment: str) -> subprocess.CompletedProcess:
    """Run the script with stand-ins for some system commands, given as shell scripts."""
    stand_ins = checkout / "stand_ins"
    stand_ins.mkdir()
    for name, script in commands.items():
        (stand_ins / name).write_text(f"#!/bin/sh\n{script}\n")
        (stand_ins / name).chmod(0o755)
    path = f"{stand_ins}{os.pathsep}{os.environ['PATH']}"
    return subprocess.run(
        ["bash", checkout / "scripts/setup.sh"],
        env={**os.environ, "PATH": path, **environment},
        capture_output=True,
        text=True,
        timeout=60,
    )


def test_another_python_is_refused_by_name(checkout):
    run = set_up(checkout, {}, PYTHON="/bin/false")
    assert run.returncode == 1
    assert run.stderr == "setup: PYTHON=/bin/false is not Python 3.11\n"


def test_without_any_python_it_says_what_to_install(checkout):
    old = {"python3.11": "exit 1", "python3": "exit 1", "apt-cache": "exit 0"}
    run = set_up(checkout, old, PYENV_ROOT=str(checkout))
    assert run.returncode == 1
    assert "Python 3.11 is needed and none was found" in run.stderr


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
