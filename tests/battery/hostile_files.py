"""Hostile files for the reliability battery: random ones, each with the reader that must refuse or read it.

    echo 7 | python tests/battery/hostile_files.py

reads the file of seed 7 in a process of its own and prints what went wrong: a hang, a traceback, too much memory.
"""

import gc
import io
import json
import os
import signal
import struct
import sys
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

#: Seconds and megabytes for one file.
SLOWEST_FILE, MOST_MEGABYTES = 20.0, 2000

_BOX = {"name": "part", "instances": [1, 2], "color": [0.5, 0.5, 0.5]}
_PROFILE = "profile: [[0, 0], [0.03, 0], [0.04, 0.1], [0, 0.1]]\n"
_BASE = "name: part\ninstances: [1, 3]\ncolor: [0.1, 0.2, 0.3]\n"


def make(rng: np.random.Generator, folder: Path) -> tuple[str, Path]:
    """Write one hostile file; the name of its reader in :data:`READERS`, and its path."""
    makers: list[Callable[[np.random.Generator, Path], tuple[str, Path]]]
    makers = [_mesh, _mesh, _description, _description, _archive, _archive, _weights, _weights, _image, _json]
    return makers[rng.integers(len(makers))](rng, folder)


def _damaged(rng: np.random.Generator, content: bytes) -> bytes:
    """Content with flipped bytes, cut, repeated, or with a huge number in place of another."""
    data = bytearray(content)
    kind = rng.integers(4)
    if kind == 0:
        for position in rng.integers(0, len(data), int(rng.integers(1, 30))):
            data[position] = int(rng.integers(256))
    elif kind == 1:
        data = data[: int(rng.integers(len(data)))]
    elif kind == 2:
        data += data[int(rng.integers(len(data))) :] * int(rng.integers(1, 50))
    else:
        position = int(rng.integers(max(min(len(data), 400) - 8, 1)))
        data[position : position + 4] = [b"\xff\xff\xff\x7f", b"9999", b"-1  ", b"1e99"][rng.integers(4)]
    return bytes(data)


def _mesh(rng: np.random.Generator, folder: Path) -> tuple[str, Path]:
    import trimesh

    suffix = str(rng.choice(["ply", "obj", "stl", "off", "glb", "zip", "3mf", "dae", "gltf"]))
    np.seterr(all="ignore")
    mesh = trimesh.creation.icosphere(subdivisions=int(rng.integers(0, 4)), radius=0.05)
    kind = rng.integers(4)
    if kind == 0:  # scattered triangles
        count = int(rng.integers(1, 60_000))
        mesh = trimesh.Trimesh(rng.normal(size=(3 * count, 3)), np.arange(3 * count).reshape(-1, 3), process=False)
    elif kind == 1:
        mesh.vertices *= rng.choice([1e-300, 1e300, 0.0, np.nan])
    written = "stl" if suffix in ("zip", "3mf", "dae", "gltf") else suffix
    content = mesh.export(file_type=written)
    content = content.encode() if isinstance(content, str) else content
    path = folder / f"part.{suffix}"
    path.write_bytes(_damaged(rng, content) if kind > 1 else content)
    (folder / "part.yaml").write_text(json.dumps({**_BOX, "mesh": path.name}))
    return "description", folder / "part.yaml"


def _description(rng: np.random.Generator, folder: Path) -> tuple[str, Path]:
    doubling = "a0: &a0 [0, 0]\n" + "".join(f"a{k + 1}: &a{k + 1} [*a{k}, *a{k}]\n" for k in range(40))
    number = str(rng.choice(["1e999", ".nan", "-1", "9" * 5000, "99999999999", "'x'", "[]", "{}", "null"]))
    key = str(rng.choice(["scale", "instances", "color", "symmetry", "features", "mesh", "source", "name"]))
    texts = [
        _BASE + doubling,
        _BASE + "features: " + "[" * int(rng.integers(1, 100_000)),
        _BASE + _PROFILE + f"{key}: {number}\n",
        _BASE + _PROFILE + f"{key}: [{number}, {number}, {number}]\n",
        _BASE + "profile: [" + "[0.1, 0.1], " * int(rng.integers(1, 40_000)) + "]\n",
        _BASE
        + _PROFILE
        + "symmetry: {discrete_rotvec_degrees: ["
        + "[0, 0, 1], " * int(rng.integers(1, 20_000))
        + "]}\n",
        _BASE + "mesh: ../../../../etc/passwd\n",
    ]
    content = texts[rng.integers(len(texts))].encode()
    (folder / "part.yaml").write_bytes(_damaged(rng, content) if rng.random() < 0.3 else content)
    return "description", folder / "part.yaml"


def _archive(rng: np.random.Generator, folder: Path) -> tuple[str, Path]:
    reader = str(rng.choice(["bank", "scene"]))
    root = Path(__file__).parents[2] / "src"
    name = "active6d_agent/active6d_agent/bank/shipped/mug_test.npz"
    with np.load(root / name) as stored:
        data = dict(stored) if reader == "bank" else {"T_world_object": stored["T_world_object"], "seed": np.array(1)}
    if reader == "scene":
        data |= {"object_name": np.array("mug"), "name": np.array("mug/test/0"), "bin": np.ones(4)}
        data |= {"visible_fraction": np.ones((100, len(data["T_world_object"])), np.float32)}
        data |= {"T_world_hidden": np.zeros((0, 4, 4))}
    changed = str(rng.choice(list(data)))
    path, kind = folder / "a.npz", rng.integers(4)
    if kind == 0 and data[changed].dtype.kind in "if":
        with np.errstate(all="ignore"):
            data[changed] = data[changed] * np.array(rng.choice([1e6, -1, 1e15])).astype(data[changed].dtype)
    elif kind == 1:
        data[changed] = np.zeros((int(rng.integers(1, 2**27)), 4), np.uint8)
    if kind != 2:
        np.savez_compressed(path, **data)
        if kind == 3:
            path.write_bytes(_damaged(rng, path.read_bytes()))
        return reader, path
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for key, value in data.items():
            header, shape = io.BytesIO(), (int(rng.integers(1, 2**40)),) if key == changed else value.shape
            describe = {"descr": value.dtype.str, "fortran_order": False, "shape": shape}
            np.lib.format.write_array_header_1_0(header, describe)
            archive.writestr(f"{key}.npy", header.getvalue() + value.tobytes())
    return reader, path


def _weights(rng: np.random.Generator, folder: Path) -> tuple[str, Path]:
    root = Path(__file__).parents[2] / "src"
    places = {
        "network": "active6d_perception/active6d_perception/estimators/dense/weights/mug.safetensors",
        "policy": "active6d_agent/active6d_agent/policies/weights/view-attention_mug.safetensors",
    }
    reader = str(rng.choice(sorted(places)))
    original, path = root / places[reader], folder / "mug.safetensors"
    content, described = original.read_bytes(), original.with_suffix(".json").read_text()
    kind = rng.integers(5)
    if kind == 0:
        content = _damaged(rng, content)
    elif kind == 1:
        text = json.dumps({"a": {"dtype": "F32", "shape": [2**40], "data_offsets": [0, 2**42]}}).encode()
        content = struct.pack("<Q", len(text)) + text + bytes(100)
    elif kind == 2:
        content = struct.pack("<Q", int(rng.integers(2**62))) + content[8:]
    elif kind == 3:
        described = described.replace("[\n", "[\n1000000,", 1).replace("32", "99999999", 1)
    else:
        described = _damaged(rng, described.encode()).decode(errors="replace")
    path.write_bytes(content)
    path.with_suffix(".json").write_text(described)
    return reader, path


def _image(rng: np.random.Generator, folder: Path) -> tuple[str, Path]:
    from PIL import Image

    side = int(rng.choice([4, 300, 9000, 14_000]))
    path = folder / "a.png"
    image = Image.new(str(rng.choice(["1", "L", "RGB", "I;16"])), (side, side))
    image.save(path, str(rng.choice(["PNG", "TIFF"])))
    if rng.random() < 0.5:
        path.write_bytes(_damaged(rng, path.read_bytes()))
    return str(rng.choice(["color", "depth"])), path


def _json(rng: np.random.Generator, folder: Path) -> tuple[str, Path]:
    texts = ["[" * int(rng.integers(1, 10**6)), '{"K": [1e999]}', '{"1": ' * 50_000, "9" * 5000, "[]," * 10**6, "\0"]
    (folder / "a.json").write_text(texts[rng.integers(len(texts))])
    return "json", folder / "a.json"


def read(reader: str, path: Path) -> None:
    """Read a file as the project does.

    Raises:
        ValueError: the file is refused.
        OSError: the same.
    """
    if reader == "description":
        from active6d_core.object_model import read_description

        read_description(path)
    elif reader == "bank":
        from active6d_agent.bank.scene_bank import load_bank

        load_bank(path)
    elif reader == "scene":
        from active6d_sim.scenes.scene import Scene

        Scene.load(path)
    elif reader == "network":
        from active6d_core.object_model import load_object
        from active6d_perception.estimators.dense.trained_network import load_network

        load_network(path, load_object("mug"))
    elif reader == "policy":
        from active6d_agent.policies.view_attention.network import load_network as load_policy

        load_policy(path, "mug")
    elif reader in ("color", "depth"):
        from active6d_core.images import read_color, read_depth

        (read_color if reader == "color" else read_depth)(path)
    else:
        from active6d_core.structured_text import read_json

        read_json(path)


def measure(seed: int) -> str:
    """Make the file of a seed and read it in a forked process; what went wrong, empty if nothing did."""
    with TemporaryDirectory() as folder:
        reader, path = make(np.random.default_rng(seed), Path(folder))
        gc.collect()
        child = os.fork()
        if child == 0:
            os._exit(_read_alone(reader, path))
        deadline = time.monotonic() + SLOWEST_FILE
        while not (done := os.wait4(child, os.WNOHANG))[0]:
            if time.monotonic() > deadline:
                os.kill(child, signal.SIGKILL)
                os.wait4(child, 0)
                return f"{reader} of seed {seed} hangs"
            time.sleep(0.002)
    code, megabytes = os.waitstatus_to_exitcode(done[1]), done[2].ru_maxrss // 1024
    if code not in (0, 2):
        return f"{reader} of seed {seed} ended with {code}"
    return "" if megabytes < MOST_MEGABYTES else f"{reader} of seed {seed} took {megabytes} MB"


def _read_alone(reader: str, path: Path) -> int:
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    try:
        read(reader, path)
    except (ValueError, OSError):
        return 2
    except BaseException:
        return 1
    return 0


def main() -> None:
    """Measure one seed after the other."""
    from active6d_agent.bank import scene_bank  # noqa: F401  imported once, not for each file
    from active6d_agent.policies.view_attention import network  # noqa: F401
    from active6d_core.object_model import load_object
    from active6d_perception.estimators.dense import trained_network  # noqa: F401
    from active6d_sim.scenes import scene  # noqa: F401

    load_object("mug")
    print("ready", flush=True)
    for line in sys.stdin:
        print(measure(int(line)), flush=True)


if __name__ == "__main__":
    main()
