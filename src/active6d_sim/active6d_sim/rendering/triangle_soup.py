"""All triangles of a scene: table, bin, objects and other things, with their materials."""

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import ArrayLike

from active6d_core.se3 import transform_points
from active6d_sim.scenes.scene import Bin, Scene

#: Materials; those of the objects follow, and after them those of the other things.
BACKDROP, TABLE, TRAY, FIRST_OBJECT = range(4)
#: Half of the side of the table of a scene without surroundings, metres.
TABLE_HALF_WIDTH = 2.5

_SHARP_EDGE = np.radians(40.0)
#: Vertices, unit normals and faces.
_Part = tuple[np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class TriangleSoup:
    """All triangles of a scene.

    Attributes:
        vertices: (v, 3) float32, world, metres.
        normals: (v, 3) float32 unit normals, world.
        faces: (f, 3) uint32.
        material: (f,) int16: ``TABLE``, ``TRAY``, ``FIRST_OBJECT`` + object, or ``FIRST_OBJECT`` + number of objects +
            thing.
    """

    vertices: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    material: np.ndarray


def build_soup(mesh: trimesh.Trimesh, scene: Scene) -> TriangleSoup:
    """Put a scene together; ``mesh`` is that of its objects."""
    around = scene.surroundings
    tray = _tray(scene.bin) if around is None or around.tray else []
    sides = (2 * TABLE_HALF_WIDTH, 2 * TABLE_HALF_WIDTH) if around is None else around.table_size
    parts = [_table(scene.bin, sides, -scene.bin.wall_thickness if tray else 0.0), *tray]
    materials = [TABLE] + [TRAY] * len(tray)
    things = [] if around is None else [(around.mesh(index), T) for index, T in enumerate(around.T_world_thing)]
    smooth = _smooth(mesh)
    for number, T in enumerate(scene.T_world_all):
        parts.append(_moved(smooth, T))
        materials.append(FIRST_OBJECT + number)
    for thing, T in things:
        parts.append(_moved(_smooth(thing), T))
        materials.append(materials[-1] + 1 if materials[-1] >= FIRST_OBJECT else FIRST_OBJECT)
    offsets = np.cumsum([0] + [len(part[0]) for part in parts])
    return TriangleSoup(
        np.concatenate([part[0] for part in parts]).astype(np.float32),
        np.concatenate([part[1] for part in parts]).astype(np.float32),
        np.concatenate([part[2] + offset for part, offset in zip(parts, offsets[:-1], strict=True)]).astype(np.uint32),
        np.repeat(np.array(materials, np.int16), [len(part[2]) for part in parts]),
    )


def _smooth(mesh: trimesh.Trimesh) -> _Part:
    smooth = trimesh.graph.smooth_shade(mesh, angle=_SHARP_EDGE)
    return np.asarray(smooth.vertices), np.asarray(smooth.vertex_normals), np.asarray(smooth.faces)


def _moved(part: _Part, T: np.ndarray) -> _Part:
    vertices, normals, faces = part
    return transform_points(T, vertices), normals @ T[:3, :3].T, faces


def _patch(origin: ArrayLike, along_u: ArrayLike, along_v: ArrayLike, rows: np.ndarray, columns: np.ndarray) -> _Part:
    """A rectangle of quads at fractions ``rows`` and ``columns`` of its sides; its normal is u x v."""
    origin, along_u, along_v = (np.array(value, float) for value in (origin, along_u, along_v))
    v, u = np.meshgrid(rows, columns, indexing="ij")
    vertices = origin + u.reshape(-1, 1) * along_u + v.reshape(-1, 1) * along_v
    corner = (np.arange(len(rows) - 1)[:, None] * len(columns) + np.arange(len(columns) - 1)).ravel()
    right, above, across = corner + 1, corner + len(columns), corner + len(columns) + 1
    faces = np.concatenate([np.stack([corner, right, across], 1), np.stack([corner, across, above], 1)])
    normal = np.cross(along_u, along_v)
    return vertices, np.broadcast_to(normal / np.linalg.norm(normal), vertices.shape), faces


def _table(bin: Bin, sides: tuple[float, float], height: float) -> _Part:
    """The table; its mesh is fine near the bin, where ambient occlusion changes."""
    lines = []
    for side in sides:
        reach = min(3 * max(bin.inner_width, bin.inner_depth) / side, 0.9)
        lines.append(np.concatenate([[0.0], 0.5 + 0.5 * reach * np.linspace(-1, 1, 64), [1.0]]))
    width, depth = sides
    return _patch((-width / 2, -depth / 2, height), (width, 0, 0), (0, depth, 0), lines[1], lines[0])


def _tray(bin: Bin) -> list[_Part]:
    """The bin's floor, and the inside, outside and rim of each of its four walls."""
    half_x, half_y, thick, top = bin.inner_width / 2, bin.inner_depth / 2, bin.wall_thickness, bin.wall_height
    fine, coarse, single = np.linspace(0, 1, 48), np.linspace(0, 1, 10), np.linspace(0, 1, 2)
    patches = [_patch((-half_x, -half_y, 0), (2 * half_x, 0, 0), (0, 2 * half_y, 0), fine, fine)]
    corners = np.array([[-half_x, -half_y], [half_x, -half_y], [half_x, half_y], [-half_x, half_y]])
    outward = np.sign(corners) * thick
    for start, end in ((0, 1), (1, 2), (2, 3), (3, 0)):
        inner_a, inner_b = corners[start], corners[end]
        outer_a, outer_b = inner_a + outward[start], inner_b + outward[end]
        inside, outside = np.append(inner_b - inner_a, 0), np.append(outer_b - outer_a, 0)
        if top > 0:
            patches.append(_patch((*inner_b, 0), -inside, (0, 0, top), coarse, fine))
        patches.append(_patch((*outer_a, -thick), outside, (0, 0, top + thick), coarse, fine))
        rim_width = np.append(np.sign(inner_a + inner_b) * thick, 0)
        patches.append(_patch((*outer_a, top), outside, -rim_width, single, fine))
    return patches
