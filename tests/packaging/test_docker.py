"""The Docker files, without an engine: paths that are copied exist, services start what exists."""

import re
from itertools import pairwise
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[2]
DOCKERFILE = (ROOT / "docker/Dockerfile").read_text().replace("\\\n", " ")
#: What .dockerignore leaves in the context.
CONTEXT = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
SERVICES = yaml.safe_load((ROOT / "docker/compose.yaml").read_text())["services"]
PARAMETERS = yaml.safe_load((ROOT / "src/active6d_bringup/config/active6d.yaml").read_text())


def test_copied_paths_exist():
    copies = re.findall(r"^COPY (?!--from)(.+)$", DOCKERFILE, re.MULTILINE)
    assert copies
    for copy in copies:
        *sources, _ = copy.split()
        for source in sources:
            assert (ROOT / source).exists(), source
            assert source.partition("/")[0] in CONTEXT, f".dockerignore leaves out {source}"


def test_stages_that_are_referred_to_exist():
    stages = re.findall(r"^FROM (\S+) AS (\S+)$", DOCKERFILE, re.MULTILINE)
    assert stages[0][0] == "ros:jazzy"
    names = {name for _, name in stages}
    assert {base for base, _ in stages[1:]} <= names
    assert set(re.findall(r"--from=(\S+)", DOCKERFILE)) <= names
    assert {service["build"]["target"] for service in SERVICES.values()} <= names


def assignments(arguments: list[str]) -> list[tuple[str, str]]:
    """Parameter and value of each ``-p name:=value``."""
    return [tuple(value.split(":=", 1)) for flag, value in pairwise(arguments) if flag == "-p"]


@pytest.mark.parametrize("name", SERVICES)
def test_service(name):
    service = SERVICES[name]
    assert (ROOT / "docker" / service["build"]["context"]).resolve() == ROOT
    assert (ROOT / service["build"]["dockerfile"]).is_file()
    run, package, executable, *rest = service["command"][1:]
    assert run == "run"
    entry = f'"{executable} = {package}.nodes.{executable}:main"'
    assert entry in (ROOT / "src" / package / "setup.py").read_text()
    given = {argument.split(":=")[0] for flag, argument in pairwise(rest) if flag == "-p"}
    assert given <= PARAMETERS[f"/**/{executable}"]["ros__parameters"].keys()
    defaults = {name: re.search(r":-([^}]*)", value) for name, value in assignments(rest)}
    for name, default in defaults.items():
        if default is not None and name != "bag":
            declared = PARAMETERS[f"/**/{executable}"]["ros__parameters"][name]
            assert default[1] == str(declared), f"{name}: compose starts {default[1]}, the node {declared}"
    assert set(service.get("depends_on", [])) <= SERVICES.keys()


def test_only_the_simulator_has_pybullet():
    assert [name for name, service in SERVICES.items() if service["build"]["target"] == "simulator"] == ["camera"]
    robot = re.search(r"^FROM base AS robot$(.+?)^FROM", DOCKERFILE, re.MULTILINE | re.DOTALL)[1]
    assert re.findall(r"^COPY src/(\w+) ", robot, re.MULTILINE) == [
        "active6d_core",
        "active6d_perception",
        "active6d_agent",
        "active6d_bringup",
    ]
    assert "pybullet" not in robot
