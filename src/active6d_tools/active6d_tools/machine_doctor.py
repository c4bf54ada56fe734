"""What this machine has of what active6d needs, what is missing, and how to fix it."""

import ctypes.util
import importlib
import importlib.metadata
import importlib.util
import os
import platform
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from active6d_core.files import cache_folder
from active6d_core.ros.network import domain_of

PIP = "pip install -r requirements.txt"
# Modules whose distribution has another name.
_DISTRIBUTIONS = {"PIL": "pillow", "cv2": "opencv-contrib-python-headless"}
APT_ROS = "only with an apt installation of ROS 2 Jazzy: apt install ros-jazzy-"


@dataclass(frozen=True)
class Check:
    """One finding.

    Attributes:
        group: heading that it belongs under.
        name: what was looked at.
        ok: whether it is there and works.
        needed: whether the core path (simulate, estimate, fuse, move, record, report) needs it.
        detail: version or finding, one line.
        fix: how to install or repair it, empty when ``ok``.
    """

    group: str
    name: str
    ok: bool
    needed: bool
    detail: str
    fix: str = ""


def examine() -> Iterator[Check]:
    """All checks, one by one as they are made (heavy libraries are really imported; takes some seconds)."""
    yield _python()
    yield from _libraries()
    yield from _ros()
    yield from _project()
    yield from _surroundings()
    yield from _self_tests()


def works(checks: list[Check]) -> bool:
    """Whether everything that the core path needs is there."""
    return all(check.ok for check in checks if check.needed)


def _python() -> Check:
    version = platform.python_version()
    ok = (3, 11) <= sys.version_info[:2] <= (3, 13)
    detail = f"{version} at {sys.executable}"
    return Check("Python", "Python", ok, True, detail, "" if ok else "use Python 3.11, 3.12 or 3.13")


def _libraries() -> Iterator[Check]:
    system = "usb-1.0:libusb-1.0-0 GL:libgl1 EGL:libegl1 X11:libx11-6 idn2:libidn2-0 udev:libudev1"
    for file, package in (item.split(":") for item in system.split()):
        found = ctypes.util.find_library(file)
        fix = "" if found else f"apt install {package} (as root); Open3D loads it"
        yield Check("System libraries", f"lib{file}", bool(found), False, found or "not found", fix)
    for module in "numba numpy scipy trimesh open3d cv2 rosbags mcap zstandard jinja2 matplotlib PIL".split():
        distribution = _DISTRIBUTIONS.get(module, module)
        yield _import_check("Python libraries", module, distribution, needed=True, fix=PIP)
    optional = {
        # The wrapper, since pybullet itself prints a banner.
        "active6d_sim.physics.bullet": ("pybullet", "simulating new piles; a robot does not need it"),
        "torch": ("torch", "learned estimator, policies and training"),
        "safetensors": ("safetensors", "weights"),
        "gymnasium": ("gymnasium", "training policies"),
        "stable_baselines3": ("stable-baselines3", "training policies"),
    }
    for module, (distribution, purpose) in optional.items():
        yield _import_check("Python libraries", module, distribution, needed=False, fix=f"{PIP} ({purpose})")


def _import_check(group: str, module: str, distribution: str, *, needed: bool, fix: str) -> Check:
    try:
        imported = importlib.import_module(module)
    except Exception as error:  # a broken native library raises more than ImportError, and that is what we look for
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        return Check(group, distribution, False, needed, reason, fix)
    try:
        version = importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        version = getattr(imported, "__version__", "installed")
    return Check(group, distribution, True, needed, version)


def _ros() -> Iterator[Check]:
    pip_ros = f"{PIP}, or source /opt/ros/jazzy/setup.bash where ROS 2 Jazzy is installed"
    yield _import_check("ROS 2", "rclpy", "rclpy", needed=True, fix=pip_ros)
    try:
        from rclpy.utilities import get_rmw_implementation_identifier

        yield Check("ROS 2", "middleware", True, True, get_rmw_implementation_identifier())
    except Exception as error:  # a missing middleware is a RuntimeError or an ImportError
        yield Check("ROS 2", "middleware", False, True, str(error).splitlines()[0], pip_ros)
    distribution = os.environ.get("ROS_DISTRO")
    yield Check(
        "ROS 2",
        "distribution",
        distribution in (None, "jazzy"),
        False,
        f"{distribution or 'jazzy'} ({'apt' if distribution else 'PyPI wheels'})",
        "" if distribution in (None, "jazzy") else "active6d is built for jazzy: source /opt/ros/jazzy/setup.bash",
    )
    for package in "sensor_msgs geometry_msgs std_srvs visualization_msgs diagnostic_msgs lifecycle_msgs".split():
        module = f"{package}.{'srv' if package == 'std_srvs' else 'msg'}"
        yield _import_check("ROS 2", module, package, needed=True, fix=pip_ros)
    optional = {"vision_msgs": "Detection3DArray output", "tf2_msgs": "/tf output", "launch_ros": "launch files"}
    for module, purpose in optional.items():
        fix = f"{APT_ROS}{module.replace('_', '-')} ({purpose})"
        if module == "tf2_msgs":
            fix = f"make transforms, or {fix}"
        yield _import_check("ROS 2, optional", module, module, needed=False, fix=fix)
    for program, package in (("ros2", "ros-jazzy-ros2cli"), ("colcon", "python3-colcon-common-extensions")):
        path = shutil.which(program) or shutil.which(str(Path(sys.executable).parent / program))
        fix = "" if path else f"apt install {package} (to run the nodes one by one, or to build the workspace)"
        yield Check("ROS 2, optional", program, bool(path), False, path or "not found", fix)


def _project() -> Iterator[Check]:
    for package in (f"active6d_{name}" for name in "core sim perception agent bringup tools".split()):
        needed = package != "active6d_sim"  # a robot has its own camera
        yield _import_check("active6d", package, package, needed=needed, fix="pip install -e src/" + package)
    fix = "fix the description it names, or ACTIVE6D_OBJECT_PATH, which adds folders"
    yield _attempt("active6d", "object models", _load_objects, fix)
    yield _weights()


def _weights() -> Check:
    spec = importlib.util.find_spec("active6d_perception")
    folder = Path(spec.origin).parent / "estimators/dense/weights" if spec and spec.origin else Path("weights")
    found = sorted(path.stem for path in folder.glob("*.safetensors"))
    fix = "" if found else "active6d works without (the geometric estimator needs none)"
    return Check("active6d", "estimator weights", bool(found), False, ", ".join(found) or f"none in {folder}", fix)


def _surroundings() -> Iterator[Check]:
    """The folders that are written to, and the ROS domain that the user set."""
    logs = os.environ.get("ROS_LOG_DIR") or Path(os.environ.get("ROS_HOME") or Path.home() / ".ros") / "log"
    folders = (("cache folder", cache_folder(""), "XDG_CACHE_HOME"), ("log folder", Path(logs), "ROS_LOG_DIR"))
    for name, folder, variable in folders:
        fix = f"set {variable} to a folder that can be written"
        yield _attempt("active6d", name, partial(_write_into, folder), fix)
    yield _attempt("active6d", "ROS domain", _read_domain, "unset ROS_DOMAIN_ID, or set it to a number from 0 to 101")


def _write_into(folder: Path) -> str:
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=folder):
        return str(folder)


def _read_domain() -> str:
    domain = domain_of()
    return "a free one for each command" if domain is None else str(domain)


def _self_tests() -> Iterator[Check]:
    network = (
        "repair the log folder and the ROS domain first; then allow UDP on the loopback interface, or try "
        "ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST"
    )
    yield _attempt("Self test", "two nodes exchange a message", _exchange_message, network)
    yield _attempt("Self test", "ray casting a view", _cast_rays, "reinstall open3d, check libusb-1.0-0 and libgl1")
    yield _attempt("Self test", "loading the graph of an episode", _load_episode, PIP)
    yield _attempt("Self test", "writing and reading a bag", _write_bag, PIP)


def _attempt(group: str, name: str, action: Callable[[], str], fix: str) -> Check:
    try:
        return Check(group, name, True, True, action())
    except Exception as error:  # whatever goes wrong is the finding
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        return Check(group, name, False, True, reason, fix)


def _load_objects() -> str:
    from active6d_core.object_model import list_objects, load_object

    names = list_objects()
    for name in names:
        load_object(name)
    if not names:
        raise ValueError("no object description found")
    return ", ".join(names)


def _exchange_message() -> str:
    import rclpy
    from rclpy.context import Context
    from rclpy.executors import SingleThreadedExecutor
    from std_msgs.msg import String

    domain_of()  # the middleware would end this process
    context = Context()
    rclpy.init(context=context)
    executor = SingleThreadedExecutor(context=context)
    received: list[str] = []
    nodes = [rclpy.create_node(f"doctor_{name}", context=context, start_parameter_services=False) for name in "ab"]
    try:
        nodes[0].create_subscription(String, "~/echo", lambda message: received.append(message.data), 1)
        publisher = nodes[1].create_publisher(String, "/doctor_a/echo", 1)
        for node in nodes:
            executor.add_node(node)
        for _ in range(100):
            publisher.publish(String(data="hello"))
            executor.spin_once(timeout_sec=0.1)
            if received:
                return "received on this machine"
        raise TimeoutError("nothing arrived within 10 s")
    finally:
        executor.shutdown()
        for node in nodes:
            node.destroy_node()
        rclpy.shutdown(context=context)


def _cast_rays() -> str:
    import numpy as np

    from active6d_core.camera import DEFAULT_CAMERA
    from active6d_core.object_model import list_objects, load_object
    from active6d_core.se3 import make_transform
    from active6d_tools.report.silhouette import SilhouetteDrawer

    model = load_object(list_objects()[0])
    _, depth = SilhouetteDrawer(model).depth(make_transform(np.eye(3), (0.0, 0.0, 0.8)), DEFAULT_CAMERA)
    hits = int(np.isfinite(depth).sum())
    if not hits:
        raise RuntimeError("no ray hit the model")
    return f"{hits} rays hit {model.name}"


def _load_episode() -> str:
    """Import what ``active6d episode`` imports, whatever libraries that needs."""
    return importlib.import_module("active6d_bringup.graph.episode").__name__


def _write_bag() -> str:
    """A bag of one message by the recorder's writer, read by another library."""
    from rclpy.serialization import serialize_message
    from rosbags.rosbag2 import Reader

    from active6d_bringup.bags.writer import TYPESTORE, EpisodeWriter
    from active6d_core.ros.topics import CONTRACT, EPISODE_START

    sent = EPISODE_START.message_type()
    sent.header.frame_id = "hello"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bag"
        writer = EpisodeWriter(path, {topic.name: f"/{topic.name.lstrip('/')}" for topic in CONTRACT})
        writer.write(EPISODE_START.name, serialize_message(sent), 1)
        writer.close()
        with Reader(path) as reader:
            [(_, _, raw)] = reader.messages()
            message: Any = TYPESTORE.deserialize_cdr(raw, EPISODE_START.type)
    if message.header.frame_id != sent.header.frame_id:
        raise ValueError("the bag gave back another message")
    return "MCAP with zstd chunks"
