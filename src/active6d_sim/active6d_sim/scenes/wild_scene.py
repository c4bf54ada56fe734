"""Random scenes of a wilder world: other things in and around the pile, several kinds of containers, a room.

They train and test estimators for real images: what a simulator lacks becomes a false alarm.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter1d, maximum_filter1d
from scipy.spatial.transform import Rotation

from active6d_core.object_model import ObjectModel, list_objects
from active6d_core.se3 import make_transform
from active6d_sim.physics.heap import labelled_scene, settle
from active6d_sim.rendering.renderer import SceneRenderer
from active6d_sim.rendering.surface_print import random_colors
from active6d_sim.scenes.scene import Bin, Scene
from active6d_sim.scenes.surroundings import FILE_KIND, OBJECT_KIND, Surroundings, extents_of

_CONTAINERS = ("tray", "carton", "tote", "none")
_CONTAINER_SHARES = (0.25, 0.3, 0.2, 0.25)
_FLOOR_DEPTH = (0.4, 1.0)  # metres below the table
_DAMAGED_FILE = 168  # of pybullet_data's random_urdfs: its vertices are NaN
#: Kind, (3,) size and (4, 4) pose of a thing.
_Plate = tuple[str, np.ndarray, np.ndarray]
_CARDBOARD = (0.42, 0.27, 0.14)


def wild_scene(model: ObjectModel, seed: int, name: str) -> Scene:
    """Simulate a pile with other things in it, in a random container, and put a room around it.

    Args:
        model: the object.
        seed: of everything.
        name: of the scene.
    """
    T_objects, bin, around = wild_pile(model, seed)
    return labelled_scene(model, name, seed, T_objects, bin, around)


def wild_pile(model: ObjectModel, seed: int) -> tuple[np.ndarray, Bin, Surroundings]:
    """As :func:`wild_scene`, without the visibility from the grid of views: poses of the objects, bin, surroundings."""
    rng = np.random.default_rng([seed, 7])
    container = str(rng.choice(_CONTAINERS, p=_CONTAINER_SHARES))
    bin = _random_bin(model, container, rng)
    mixed = _things_in_the_pile(model, rng)
    meshes = [mixed.mesh(index) for index in range(len(mixed))]
    T_objects, T_things = settle(model, bin, _count(model, rng), rng, meshes)
    table = (rng.uniform(0.8, 2.6), rng.uniform(0.7, 2.0))
    around = Surroundings(table_size=table, tray=container in ("tray", "carton"))
    around += _chosen(mixed, T_things)
    if container == "carton":
        around += _flaps(bin, rng)
    if container == "tote":
        around += _tote(bin, rng)
    around += _on_the_table(model, bin, table, rng) + _room(rng)
    around += _far_clutter(model, np.random.default_rng([seed, 9]))
    partial = Scene(model.name, "partial", seed, T_objects, bin, np.zeros((0, len(T_objects))), surroundings=around)
    return T_objects, bin, around + _cables(SceneRenderer(partial, model=model, threads=1), bin, rng)


def _count(model: ObjectModel, rng: np.random.Generator) -> int:
    """Mostly a pile as usual, sometimes a few objects only."""
    most = model.instances[1]
    return int(rng.integers(model.instances[0], most + 3) if rng.random() < 0.6 else rng.integers(1, most))


def _random_bin(model: ObjectModel, container: str, rng: np.random.Generator) -> Bin:
    usual = Bin.for_model(model)
    width, depth = usual.inner_width * rng.uniform(0.85, 1.5, 2)
    height = 0.0 if container == "none" else usual.wall_height * rng.uniform(0.4, 2.0)
    return Bin(width, depth, height)


def _things(
    kind: Sequence[str], size: np.ndarray, T_world_thing: np.ndarray, color: np.ndarray | None = None
) -> Surroundings:
    count = len(kind)
    color = np.zeros((count, 3)) if color is None else np.broadcast_to(color, (count, 3))
    return Surroundings(
        tuple(kind), np.reshape(size, (count, 3)), np.reshape(T_world_thing, (count, 4, 4)), np.array(color, float)
    )


def _chosen(things: Surroundings, T_world_thing: dict[int, np.ndarray]) -> Surroundings:
    """The things that stayed in the bin, at their poses."""
    kept = sorted(T_world_thing)
    return _things(
        [things.kind[i] for i in kept],
        things.size[kept],
        np.array([T_world_thing[i] for i in kept]),
        things.color[kept],
    )


def _random_things(count: int, diameter: float, exclude: str, rng: np.random.Generator) -> Surroundings:
    """Primitives, cartons, rods, other objects of this project and shapes of pybullet_data, with random colours.

    Args:
        count: number of things.
        diameter: of the object in the pile, metres; sizes are near it.
        exclude: name of that object.
        rng: random generator.
    """
    kinds, sizes = [], []
    others = [f"{OBJECT_KIND}{name}" for name in list_objects() if name != exclude]
    for _ in range(count):
        draw = rng.random()
        if draw < 0.45:
            kind = str(rng.choice(["box", "box", "cylinder", "cylinder", "cone", "sphere"]))
            size = diameter * rng.uniform(0.2, 1.3, 3)
            if rng.random() < 0.3:
                size[2] = diameter * rng.uniform(0.8, 2.0)
            if kind != "box":
                size[1] = size[0]
            if kind == "sphere":
                size[2] = size[0]
        elif draw < 0.75 or not others:
            number = int(rng.integers(1000))
            number -= number == _DAMAGED_FILE
            kind = f"{FILE_KIND}random_urdfs/{number:03d}/{number:03d}.obj"
            extents = extents_of(kind)
            size = extents / extents.max() * diameter * rng.uniform(0.4, 1.6)
        else:
            kind = str(rng.choice(others))
            size = extents_of(kind) * rng.uniform(0.7, 1.3)
        kinds.append(kind)
        sizes.append(size)
    T = np.broadcast_to(np.eye(4), (count, 4, 4))
    return _things(kinds, np.array(sizes).reshape(count, 3), T, random_colors(rng, count))


def _things_in_the_pile(model: ObjectModel, rng: np.random.Generator) -> Surroundings:
    count = int(rng.choice([0, 2, 4, 7, 10], p=(0.3, 0.2, 0.2, 0.2, 0.1)))
    return _random_things(count, model.diameter, model.name, rng)


def _on_the_table(model: ObjectModel, bin: Bin, table: tuple[float, float], rng: np.random.Generator) -> Surroundings:
    """Things that stand on the table beside the container."""
    things = _random_things(int(rng.integers(0, 9)), model.diameter * rng.uniform(0.7, 2.0), model.name, rng)
    outer = np.hypot(bin.inner_width, bin.inner_depth) / 2
    T = np.empty((len(things), 4, 4))
    for index, size in enumerate(things.size):
        distance = outer + np.linalg.norm(size[:2]) / 2 + rng.uniform(0.02, 0.5)
        angle, yaw = rng.uniform(0, 2 * np.pi, 2)
        ground = 0.0 if max(np.abs(distance * np.array([np.cos(angle), np.sin(angle)]) / table)) < 0.5 else -0.4
        position = (distance * np.cos(angle), distance * np.sin(angle), ground + size[2] / 2)
        T[index] = make_transform(Rotation.from_euler("z", yaw).as_matrix(), np.array(position))
    return _things(things.kind, things.size, T, things.color)


def _plate(centre: ArrayLike, size: ArrayLike, R: np.ndarray | None = None) -> _Plate:
    return "box", np.array(size, float), make_transform(np.eye(3) if R is None else R, np.array(centre, float))


def _plates(plates: Sequence[_Plate], color: np.ndarray) -> Surroundings:
    kinds, sizes, poses = zip(*plates, strict=True) if plates else ((), np.zeros((0, 3)), np.zeros((0, 4, 4)))
    return _things(kinds, np.array(sizes), np.array(poses), color)


def _sides(bin: Bin) -> list[tuple[float, float, float]]:
    """Angle about z, distance from the centre and length of each of the four walls."""
    x, y = bin.inner_width / 2, bin.inner_depth / 2
    return [(0.0, x, 2 * y), (np.pi / 2, y, 2 * x), (np.pi, x, 2 * y), (-np.pi / 2, y, 2 * x)]


def _flaps(bin: Bin, rng: np.random.Generator) -> Surroundings:
    """Flaps of a carton, hinged at the tops of its walls; some are torn off."""
    plates = []
    for angle, distance, length in _sides(bin):
        if rng.random() < 0.2:
            continue
        reach, opening = rng.uniform(0.25, 0.6) * length, rng.uniform(np.radians(15), np.radians(160))
        turn = Rotation.from_euler("z", angle) * Rotation.from_euler("y", opening)
        hinge = Rotation.from_euler("z", angle).apply((distance + bin.wall_thickness, 0, bin.wall_height))
        plates.append(_plate(hinge + turn.apply((0, 0, reach / 2)), (0.004, length, reach), turn.as_matrix()))
    color = np.array(_CARDBOARD) * rng.uniform(0.6, 1.6) if rng.random() < 0.7 else random_colors(rng, 1)[0]
    return _plates(plates, np.clip(color, 0, 1))


def _tote(bin: Bin, rng: np.random.Generator) -> Surroundings:
    """A plastic box with walls that lean outward, and a rim."""
    lean, rim = rng.uniform(0.0, np.radians(15)), rng.uniform(0.0, 0.04)
    height, thick = bin.wall_height, 0.004
    plates = []
    for angle, distance, length in _sides(bin):
        about = Rotation.from_euler("z", angle)
        turn = about * Rotation.from_euler("y", lean)
        width = length + 2 * height * np.tan(lean) + thick
        middle = about.apply((distance + thick / 2, 0, 0)) + turn.apply((0, 0, height / np.cos(lean) / 2))
        plates.append(_plate(middle, (thick, width, height / np.cos(lean)), turn.as_matrix()))
        if rim > 0.01:
            out = distance + height * np.tan(lean) + rim / 2
            plates.append(_plate(about.apply((out, 0, height)), (rim, width + 2 * rim, 0.006), about.as_matrix()))
    return _plates(plates, random_colors(rng, 1)[0])


def _room(rng: np.random.Generator) -> Surroundings:
    """A floor, walls, and boxes and cylinders the size of furniture; each may be missing."""
    ground = -rng.uniform(*_FLOOR_DEPTH)
    plates = []
    if rng.random() < 0.85:
        plates.append(_plate((0, 0, ground - 0.02), (12, 12, 0.04)))
    for angle in rng.uniform(0, 2 * np.pi) + np.arange(4) * np.pi / 2:
        if rng.random() < 0.5:
            turn = Rotation.from_euler("z", angle)
            plates.append(_plate(turn.apply((rng.uniform(1.7, 4.0), 0, 1.0)), (0.1, 12, 5), turn.as_matrix()))
    for _ in range(int(rng.integers(0, 7))):
        angle, distance = rng.uniform(0, 2 * np.pi), rng.uniform(1.0, 3.0)
        # Near furniture stays below the table's height, where no camera is.
        top = rng.uniform(-0.3, 0.0) if distance < 1.9 else rng.uniform(-0.3, 1.2)
        size = np.array([*rng.uniform(0.15, 0.9, 2), max(top - ground, 0.05)])
        centre = (distance * np.cos(angle), distance * np.sin(angle), ground + size[2] / 2)
        plates.append(_plate(centre, size, Rotation.from_euler("z", rng.uniform(0, np.pi)).as_matrix()))
    room = _plates(plates, np.zeros(3))
    return _things(room.kind, room.size, room.T_world_thing, random_colors(rng, len(room)))


def _far_clutter(model: ObjectModel, rng: np.random.Generator) -> Surroundings:
    """Small things of all shapes behind the table, where depth is noisy: what stands on desks and shelves."""
    count = int(rng.integers(0, 50))
    things = _random_things(count, model.diameter, model.name, rng)
    size = things.size * np.exp(rng.uniform(np.log(0.3), np.log(3.0), (count, 1)))
    angle, distance = rng.uniform(0, 2 * np.pi, count), rng.uniform(1.3, 3.5, count)
    T = np.broadcast_to(np.eye(4), (count, 4, 4)).copy()
    T[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix() if count else np.zeros((0, 3, 3))
    T[:, :3, 3] = np.column_stack([distance * np.cos(angle), distance * np.sin(angle), rng.uniform(-0.8, 0.5, count)])
    return _things(things.kind, size, T, things.color)


def _cables(renderer: SceneRenderer, bin: Bin, rng: np.random.Generator) -> Surroundings:
    """Tubes that lie over whatever is below them, as chains of short cylinders."""
    cables = Surroundings()
    outer = np.hypot(bin.inner_width, bin.inner_depth) / 2
    for _ in range(int(rng.choice([0, 1, 2, 4], p=(0.5, 0.2, 0.2, 0.1)))):
        thickness = rng.uniform(0.004, 0.014)
        start, end = rng.uniform(0, 2 * np.pi, 2)
        ends = outer * rng.uniform(0.7, 2.0, (2, 1)) * np.array([[np.cos(a), np.sin(a)] for a in (start, end)])
        along = np.linspace(0, 1, 28)
        bend = gaussian_filter1d(rng.normal(0, 0.25, (28, 2)), 4, axis=0)
        xy = ends[0] + along[:, None] * (ends[1] - ends[0]) + bend * np.sin(np.pi * along)[:, None]
        height = np.maximum(renderer.surface_height(xy), -0.4)
        z = gaussian_filter1d(maximum_filter1d(height, 3), 1.0) + thickness / 2
        cables += _tube(np.column_stack([xy, z]), thickness, random_colors(rng, 1)[0])
    return cables


def _tube(path: np.ndarray, thickness: float, color: np.ndarray) -> Surroundings:
    """Cylinders along the segments of a (k, 3) path, metres."""
    step = np.diff(path, axis=0)
    length = np.linalg.norm(step, axis=1)
    T = np.empty((len(step), 4, 4))
    for index, direction in enumerate(step / length[:, None]):
        R = Rotation.align_vectors(direction[None], [[0.0, 0.0, 1.0]])[0].as_matrix()
        T[index] = make_transform(R, (path[index] + path[index + 1]) / 2)
    size = np.column_stack([np.full((len(step), 2), thickness), length + thickness / 2])
    return _things(["cylinder"] * len(step), size, T, color)
