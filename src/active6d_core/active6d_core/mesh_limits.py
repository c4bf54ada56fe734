"""Limits on mesh files, checked on what a file announces before a reader allocates memory for it."""

import json
import math
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

#: Formats that are read. Others can hold archives, scripts or links to other files.
SUFFIXES = (".glb", ".obj", ".off", ".ply", ".stl")
#: Bytes of a file.
MOST_BYTES = 2**26
#: Triangles of a mesh.
MOST_FACES = 300_000
#: Vertices of a file; STL has three for each triangle.
MOST_VERTICES = 3 * MOST_FACES
_STL_HEADER, _STL_FACE = 84, 50
_GLB_HEADER, _MOST_GLB_TEXT = 20, 2**22
_TEXT_HEADER = 2**16


def read_limited(path: Path) -> bytes:
    """The content of a mesh file that is within the limits.

    Raises:
        ValueError: no such file, another format, or too large; the message names the file and the limit.
    """
    if not path.is_file():
        raise ValueError(f"mesh {path} does not exist")
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f"mesh {path.name} is of no known format; use one of {', '.join(SUFFIXES)}")
    size = path.stat().st_size
    if size > MOST_BYTES:
        raise ValueError(f"mesh {path.name} has {size >> 20} MB, at most {MOST_BYTES >> 20} are read; simplify it")
    content = path.read_bytes()
    try:
        vertices, faces = _ANNOUNCED[suffix](content)
    except (ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError, struct.error) as error:
        raise ValueError(f"mesh {path.name} cannot be read ({error})") from error
    check_counts(path.name, vertices, faces)
    return content


def check_counts(name: str, vertices: int, faces: int) -> None:
    """Check the size of a mesh.

    Raises:
        ValueError: it has too many vertices or faces; the message names it.
    """
    if not (0 <= vertices <= MOST_VERTICES and 0 <= faces <= MOST_FACES):
        raise ValueError(
            f"mesh {name} announces {vertices} vertices and {faces} faces; at most {MOST_VERTICES} and {MOST_FACES} "
            "are read; simplify it in a mesh editor, such as MeshLab"
        )


def _glb(content: bytes) -> tuple[int, int]:
    length = struct.unpack_from("<I", content, 12)[0]
    if length > _MOST_GLB_TEXT:
        raise ValueError("its description is too long")
    scene = json.loads(content[_GLB_HEADER : _GLB_HEADER + length])
    counts = [int(accessor["count"]) for accessor in scene.get("accessors", [])]
    if min(counts, default=0) < 0 or max(counts, default=0) > 3 * MOST_FACES:
        raise ValueError("an accessor is too long")
    if any("uri" in buffer for buffer in scene.get("buffers", [])):
        raise ValueError("it has data outside of the file")
    nodes: list[dict[str, Any]] = scene.get("nodes", [])
    children = [child for node in nodes for child in node.get("children", [])]
    if len(children) != len(set(children)):
        raise ValueError("a node has two parents")
    vertices = faces = 0
    # A mesh is read once for each node that shows it.
    for node in nodes:
        for primitive in scene["meshes"][node["mesh"]]["primitives"] if "mesh" in node else []:
            count = counts[primitive["attributes"]["POSITION"]]
            vertices += count
            faces += (counts[primitive["indices"]] if "indices" in primitive else count) // 3
    return vertices, faces


def _obj(content: bytes) -> tuple[int, int]:
    # A polygon of k corners becomes k - 2 triangles; without counting them, at most one for each three characters.
    corners = sum(line.count(b" ") for line in re.findall(rb"^\s*f\s[^\n]*", content, re.MULTILINE))
    return len(re.findall(rb"^\s*v\s", content, re.MULTILINE)), corners // 3


def _off(content: bytes) -> tuple[int, int]:
    words = [word for line in content[:_TEXT_HEADER].splitlines() for word in line.partition(b"#")[0].split()]
    vertices, faces = [int(word) for word in words if word.isdigit()][:2]
    return vertices, faces


def _ply(content: bytes) -> tuple[int, int]:
    header = content[:_TEXT_HEADER].partition(b"end_header")
    if not header[1]:
        raise ValueError("its header has no end")
    elements = re.findall(rb"^\s*element\s+(\S+)\s+(\S+)", header[0], re.MULTILINE)
    counts = [(name, int(count)) for name, count in elements]
    if any(count < 0 for _, count in counts):
        raise ValueError("a count is negative")
    faces = sum(count for name, count in counts if name == b"face")
    return sum(count for name, count in counts if name != b"face"), faces


def _stl(content: bytes) -> tuple[int, int]:
    if len(content) >= _STL_HEADER:
        faces = struct.unpack_from("<I", content, _STL_HEADER - 4)[0]
        if len(content) == _STL_HEADER + _STL_FACE * faces:
            return 3 * faces, faces
    vertices = len(re.findall(rb"\bvertex\b", content, re.IGNORECASE))
    return vertices, math.ceil(vertices / 3)


_ANNOUNCED: dict[str, Callable[[bytes], tuple[int, int]]] = {
    ".glb": _glb,
    ".obj": _obj,
    ".off": _off,
    ".ply": _ply,
    ".stl": _stl,
}
