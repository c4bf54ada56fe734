"""package.xml, setup.py and the requirements against what the sources really import."""

import ast
import re
import runpy
import sys
from functools import cache
from importlib import metadata
from operator import itemgetter
from pathlib import Path
from unittest import mock

import pytest
from catkin_pkg.package import parse_package

ROOT = Path(__file__).parents[2]
PACKAGES = sorted(path.name for path in (ROOT / "src").glob("active6d_*"))
ROS = set(
    "ament_index_python builtin_interfaces diagnostic_msgs geometry_msgs launch launch_ros lifecycle_msgs "
    "rcl_interfaces rclpy ros2launch rosgraph_msgs sensor_msgs std_msgs std_srvs visualization_msgs".split()
)
# import: (rosdep key, None where there is none that is new enough and without CUDA; name on PyPI)
LIBRARIES = {
    "PIL": ("python3-pil", "pillow"),
    "cv2": ("python3-opencv", "opencv-contrib-python-headless"),
    "contourpy": ("python3-matplotlib", "matplotlib"),
    "gymnasium": ("python3-gymnasium-pip", "gymnasium"),
    "jinja2": ("python3-jinja2", "jinja2"),
    "matplotlib": ("python3-matplotlib", "matplotlib"),
    "mcap": ("mcap-ros2-support", "mcap"),
    "mcap_ros2": ("mcap-ros2-support", "mcap-ros2-support"),
    "numba": (None, "numba"),
    "numpy": ("python3-numpy", "numpy"),
    "open3d": (None, "open3d-cpu"),
    "pybullet": ("python3-pybullet-pip", "pybullet"),
    "pybullet_data": ("python3-pybullet-pip", "pybullet"),
    "pybullet_utils": ("python3-pybullet-pip", "pybullet"),
    "rich": (None, "rich"),
    "rosbags": ("python3-rosbags-pip", "rosbags"),
    "safetensors": (None, "safetensors"),
    "scipy": (None, "scipy"),
    "stable_baselines3": ("python3-stable-baselines3-pip", "stable-baselines3"),
    "torch": (None, "torch"),
    "trimesh": ("python3-trimesh-pip", "trimesh"),
    "typer": (None, "typer"),
    "yaml": ("python3-yaml", "pyyaml"),
    "zstandard": (None, "zstandard"),
}
# How rosdep resolves each key on Ubuntu 24.04: (by apt or by pip, package), copied from rosdep/python.yaml of
# github.com/ros/rosdistro at 8468e88c (2026-08-22). Look a new key up there before it is added.
ROSDEP = {
    "mcap-ros2-support": ("pip", "mcap-ros2-support"),
    "python3-gymnasium-pip": ("pip", "gymnasium"),
    "python3-jinja2": ("apt", "python3-jinja2"),
    "python3-matplotlib": ("apt", "python3-matplotlib"),
    "python3-numpy": ("apt", "python3-numpy"),
    "python3-opencv": ("apt", "python3-opencv"),
    "python3-pil": ("apt", "python3-pil"),
    "python3-pybullet-pip": ("pip", "pybullet"),
    "python3-pytest": ("apt", "python3-pytest"),
    "python3-rosbags-pip": ("pip", "rosbags"),
    "python3-stable-baselines3-pip": ("pip", "stable-baselines3"),
    "python3-trimesh-pip": ("pip", "trimesh"),
    "python3-yaml": ("apt", "python3-yaml"),
}
# What a package needs and no import shows: `ros2 launch` itself, and the packages whose nodes bringup loads by name.
NOT_IMPORTED = {"active6d_bringup": {"active6d_agent", "active6d_perception", "ros2launch"}}
# Only training needs these. They are extras of the agent: the tools ask for them, a robot leaves them out.
TRAINING = {"gymnasium", "stable_baselines3"}
# The study that compares runtimes uses these where they are installed.
OPTIONAL = {"onnxruntime", "openvino"}


@cache
def imports(package: str) -> frozenset[str]:
    """Top-level names that a package's sources and launch files import, the standard library and itself left out."""
    names = set()
    for path in [*(ROOT / "src" / package / package).rglob("*.py"), *(ROOT / "src" / package).glob("launch/*.py")]:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                names |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                names.add(node.module.split(".")[0])
    return frozenset(names - set(sys.stdlib_module_names) - OPTIONAL - {package})


def dependencies(package: str) -> set[str]:
    """Import names that package.xml and setup.py must declare."""
    needed = imports(package) | NOT_IMPORTED.get(package, set())
    assert needed <= ROS | LIBRARIES.keys() | set(PACKAGES), "add new libraries to LIBRARIES"
    if package == "active6d_agent":
        return needed - TRAINING
    return needed | TRAINING if package == "active6d_tools" else needed


def setup_arguments(package: str) -> dict:
    """What a package's setup.py hands to setuptools."""
    with mock.patch("setuptools.setup") as setup, pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT / "src" / package)
        runpy.run_path("setup.py")
    return setup.call_args.kwargs


def pins(name: str) -> dict[str, str]:
    """Name and version of each requirement in a file."""
    lines = (ROOT / name).read_text().splitlines()
    return dict(re.fullmatch(r"([\w.-]+)==([\w.]+)", line).groups() for line in lines if line and line[0] not in "#-")


@pytest.mark.parametrize("package", PACKAGES)
def test_package_xml_declares_what_is_imported(package):
    warnings = []
    manifest = parse_package(ROOT / "src" / package / "package.xml", warnings=warnings)
    manifest.validate(warnings=warnings)
    assert not warnings
    assert manifest.package_format == 3
    assert manifest.get_build_type() == "ament_python"
    keys = {LIBRARIES[name][0] if name in LIBRARIES else name for name in dependencies(package)} - {None}
    assert {dependency.name for dependency in manifest.exec_depends} == keys


@pytest.mark.parametrize("package", PACKAGES)
def test_setup_py_agrees_with_package_xml(package):
    manifest = parse_package(ROOT / "src" / package / "package.xml")
    arguments = setup_arguments(package)
    assert arguments["name"] == manifest.name == package
    assert arguments["version"] == manifest.version
    assert arguments["description"] == manifest.description
    assert arguments["license"] == manifest.licenses[0]
    libraries = {LIBRARIES[name][1] if name in LIBRARIES else name for name in dependencies(package) - ROS}
    if package == "active6d_tools":  # the agent brings along what trains it
        libraries -= {LIBRARIES[name][1] for name in TRAINING}
        libraries = libraries - {"active6d_agent"} | {"active6d_agent[training]"}
    assert set(arguments["install_requires"]) == libraries


def test_the_agent_leaves_training_to_an_extra():
    extras = setup_arguments("active6d_agent")["extras_require"]
    assert {name: set(needed) for name, needed in extras.items()} == {"training": {LIBRARIES[n][1] for n in TRAINING}}
    assert imports("active6d_agent") >= TRAINING


def test_requirements_are_what_is_imported():
    imported = frozenset.union(*(imports(package) for package in PACKAGES)) & LIBRARIES.keys()
    pinned = {name for name in pins("requirements.txt") if not name.startswith("ros-jazzy-")}
    assert pinned == {LIBRARIES[name][1] for name in imported}


def test_no_version_is_pinned_twice():
    files = [pins(name) for name in ("requirements.txt", "requirements-dev.txt", "constraints.txt")]
    assert len(set().union(*files)) == sum(map(len, files))


def test_what_rosdep_has_no_key_for_is_in_the_docker_requirements():
    imported = frozenset.union(*(imports(package) for package in PACKAGES))
    without_key = {LIBRARIES[name][1] for name in imported & LIBRARIES.keys() if LIBRARIES[name][0] is None}
    lines = (ROOT / "docker/requirements.txt").read_text().splitlines()
    assert without_key == {re.split("[=<>]", line)[0] for line in lines if not line.startswith("#")}


@pytest.mark.parametrize("package", PACKAGES)
def test_rosdep_resolves_every_key(package):
    """So ``rosdep install`` needs no skipped keys."""
    manifest = parse_package(ROOT / "src" / package / "package.xml")
    keys = {dependency.name for dependency in [*manifest.exec_depends, *manifest.test_depends]}
    assert keys <= ROSDEP.keys() | ROS | set(PACKAGES)


def test_rosdep_installs_what_is_imported():
    """What a key installs by pip is the pinned library, or brings it along."""
    for key, library in filter(itemgetter(0), LIBRARIES.values()):
        installer, package = ROSDEP[key]
        if installer == "pip" and package != library:
            assert library in {re.split("[^a-z-]", name)[0] for name in metadata.requires(package)}, key


def test_only_the_simulator_asks_rosdep_for_pybullet():
    """rosdep has a key for pybullet, so nothing skips keys; a robot does not build the simulator."""
    needing = {path.parent.name for path in (ROOT / "src").glob("*/package.xml") if "pybullet" in path.read_text()}
    assert needing == {"active6d_sim"}
    for name in ("docker/Dockerfile", "docs/install.md"):
        text = (ROOT / name).read_text()
        assert "rosdep install" in text
        assert "--skip-keys" not in text, name
