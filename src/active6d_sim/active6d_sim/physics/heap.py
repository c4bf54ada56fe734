"""Simulation of heaps: identical objects fall into a bin by rigid-body physics until they are at rest."""

import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from active6d_core.files import atomic_file, cache_folder
from active6d_core.object_model import ObjectModel
from active6d_core.se3 import transform_from_quaternion
from active6d_sim.physics.bullet import BulletClient, connect, decompose, pybullet
from active6d_sim.rendering.renderer import visible_fractions
from active6d_sim.scenes.scene import Bin, Scene
from active6d_sim.scenes.surroundings import Surroundings

#: An object belongs to the ground truth if some view of the grid shows at least this share of its silhouette.
VISIBILITY_THRESHOLD = 0.1

_STEPS_PER_SECOND = 240
_SECONDS_BETWEEN_DROPS = 0.25
_MASS = 0.2
_CONTACT = {"lateralFriction": 0.5, "rollingFriction": 2e-4, "restitution": 0.05}
#: Objects that fall out of the bin in the first round are released once more in a second one.
_ROUNDS = 2


def simulate_heap(
    model: ObjectModel, seed: int, *, count: int | None = None, bin: Bin | None = None, name: str | None = None
) -> Scene:
    """Simulate a heap: ``count`` instances fall from random poses into ``bin`` and come to rest.

    Guides above the bin's walls keep the falling objects inside and are removed afterwards. Objects that then fall out
    of the bin are released once more. The same seed gives the same scene.

    Args:
        model: the object; the origin of its mesh is its centre of mass.
        seed: seed of the number of instances and of their initial poses.
        count: number of instances; drawn from ``model.instances`` when None.
        bin: the bin; :meth:`Bin.for_model` when None.
        name: name of the scene; ``<object>/seed/<seed>`` when None.

    Raises:
        ValueError: ``count`` is below 1.
    """
    rng = np.random.default_rng(seed)
    drawn = int(rng.integers(model.instances[0], model.instances[1] + 1))
    count = drawn if count is None else count
    if count < 1:
        raise ValueError(f"a heap needs at least one object, got count={count}")
    bin = bin or Bin.for_model(model)
    T_world_all, _ = settle(model, bin, count, rng)
    return labelled_scene(model, name or f"{model.name}/seed/{seed}", seed, T_world_all, bin)


def labelled_scene(
    model: ObjectModel,
    name: str,
    seed: int,
    T_world_all: np.ndarray,
    bin: Bin,
    surroundings: Surroundings | None = None,
) -> Scene:
    """A scene whose ground truth are those of the objects that some view of the grid shows enough of.

    Args:
        model: the object.
        name: of the scene.
        seed: of its simulation.
        T_world_all: (n, 4, 4) poses of all objects, metres.
        bin: that they lie in.
        surroundings: other things.
    """
    everything = Scene(
        model.name, name, seed, T_world_all, bin, np.zeros((0, len(T_world_all))), surroundings=surroundings
    )
    fractions = visible_fractions(everything, model)
    seen = fractions.max(axis=0, initial=0.0) >= VISIBILITY_THRESHOLD
    return Scene(model.name, name, seed, T_world_all[seen], bin, fractions[:, seen], T_world_all[~seen], surroundings)


def settle(
    model: ObjectModel, bin: Bin, count: int, rng: np.random.Generator, others: Sequence[trimesh.Trimesh] = ()
) -> tuple[np.ndarray, dict[int, np.ndarray]]:
    """Let objects and other things fall into a bin, and wait until they are at rest.

    Args:
        model: the object.
        bin: that they fall into.
        count: number of objects.
        rng: random generator of poses and order.
        others: meshes of other things, metres; their convex hulls collide.

    Returns:
        (k, 4, 4) ``T_world_object`` of the objects that stayed in the bin, all but those that fell out twice, and
        (4, 4) ``T_world_thing`` by index of the others that stayed.
    """
    client = connect()
    try:
        client.setGravity(0, 0, -9.81)
        client.setPhysicsEngineParameter(
            fixedTimeStep=1 / _STEPS_PER_SECOND,
            numSolverIterations=50,
            contactBreakingThreshold=0.002,
            erp=0.1,
            contactERP=0.1,
            deterministicOverlappingPairs=1,
        )
        table = add_bin(client, bin)
        shape = client.createCollisionShape(pybullet.GEOM_MESH, fileName=str(collision_file(model)))
        falling = [(shape, model.diameter)] * count + [_hull(client, mesh) for mesh in others]
        order = [int(i) for i in rng.permutation(len(falling))] if others else list(range(count))
        number: dict[int, int] = {}  # in ``falling``, by body
        bodies: list[int] = []
        for _ in range(_ROUNDS):
            guides = _add_walls(client, bin, bottom=bin.wall_height, top=bin.wall_height + 2.0)
            present = {number[body] for body in bodies}
            missing = [i for i in order if i not in present]
            dropped = _drop(client, [falling[i] for i in missing], bin, bodies, rng)
            number |= dict(zip(dropped, missing, strict=True))
            bodies += dropped
            _settle(client, bodies)
            for guide in guides:
                client.removeBody(guide)
            _settle(client, bodies)
            bodies = _remove_fallen(client, bodies, table)
            if len(bodies) == len(falling):
                break
            _settle(client, bodies)
        poses = {number[b]: client.getBasePositionAndOrientation(b) for b in _remove_fallen(client, bodies, table)}
    finally:
        client.disconnect()
    T = {i: transform_from_quaternion(np.array(turn), np.array(position)) for i, (position, turn) in poses.items()}
    objects = [T[i] for i in T if i < count]
    return np.array(objects).reshape(-1, 4, 4), {i - count: T[i] for i in T if i >= count}


def _hull(client: BulletClient, mesh: trimesh.Trimesh) -> tuple[int, float]:
    """The collision shape of a thing's convex hull, and the diameter of its bounding sphere, metres."""
    vertices = mesh.convex_hull.vertices
    shape = client.createCollisionShape(pybullet.GEOM_MESH, vertices=vertices.tolist())
    return shape, float(2 * np.linalg.norm(vertices, axis=1).max())


def _drop(
    client: BulletClient, falling: Sequence[tuple[int, float]], bin: Bin, present: list[int], rng: np.random.Generator
) -> list[int]:
    """Release bodies one after another just above those ``present``, so that all arrive slowly.

    ``falling`` has the collision shape and the diameter of each.
    """
    bodies: list[int] = []
    for shape, diameter in falling:
        reach = np.maximum(np.array([bin.inner_width, bin.inner_depth]) / 2 - diameter / 2, 0.0)
        tops = [client.getAABB(body)[1][2] for body in present + bodies]
        height = max([bin.wall_height, *tops]) + 0.6 * diameter
        position, quaternion = [*rng.uniform(-reach, reach), height], Rotation.random(rng=rng).as_quat()
        body = client.createMultiBody(_MASS, shape, basePosition=position, baseOrientation=quaternion)
        client.changeDynamics(body, -1, spinningFriction=2e-4, angularDamping=0.1, **_CONTACT)
        bodies.append(body)
        for _ in range(round(_SECONDS_BETWEEN_DROPS * _STEPS_PER_SECOND)):
            client.stepSimulation()
    return bodies


def _settle(client: BulletClient, bodies: list[int], seconds: float = 4.0) -> None:
    """Step until nothing has moved for a quarter of a second; damping grows, so that rolling objects stop too."""
    block = _STEPS_PER_SECOND // 8
    still = 0
    for damping in np.linspace(0.5, 0.99, round(seconds * 8)):
        for body in bodies:
            client.changeDynamics(body, -1, linearDamping=0.04 + 0.5 * damping, angularDamping=damping)
        for _ in range(block):
            client.stepSimulation()
        speeds = np.array([client.getBaseVelocity(body) for body in bodies]).reshape(-1, 2, 3)
        linear, angular = np.linalg.norm(speeds, axis=-1).T
        still = still + 1 if (linear < 0.004).all() and (angular < 0.05).all() else 0
        if still == 2:
            return


def _remove_fallen(client: BulletClient, bodies: list[int], table: int) -> list[int]:
    """Remove bodies that touch the table, even if they lean on the bin; returns the others."""
    kept = [body for body in bodies if not client.getContactPoints(body, table)]
    for body in set(bodies) - set(kept):
        client.removeBody(body)
    return kept


def add_bin(client: BulletClient, bin: Bin) -> int:
    """Add the bin and its table; returns the table's body."""
    outer = np.array([bin.inner_width, bin.inner_depth]) / 2 + bin.wall_thickness
    _add_box(client, (0, 0, -bin.wall_thickness / 2), (*outer, bin.wall_thickness / 2))
    if bin.wall_height > 0:
        _add_walls(client, bin, bottom=0.0, top=bin.wall_height)
    return _add_box(client, (0, 0, -bin.wall_thickness - 0.5), (3.0, 3.0, 0.5))


def _add_walls(client: BulletClient, bin: Bin, bottom: float, top: float) -> list[int]:
    """Add four walls around the inside of the bin; returns their bodies."""
    half_x, half_y, thick = bin.inner_width / 2, bin.inner_depth / 2, bin.wall_thickness / 2
    middle, half_z = (bottom + top) / 2, (top - bottom) / 2
    walls = []
    for sign in (-1, 1):
        walls.append(_add_box(client, (sign * (half_x + thick), 0, middle), (thick, half_y + 2 * thick, half_z)))
        walls.append(_add_box(client, (0, sign * (half_y + thick), middle), (half_x + 2 * thick, thick, half_z)))
    return walls


def _add_box(client: BulletClient, centre: tuple[float, float, float], half_extents: tuple[float, float, float]) -> int:
    shape = client.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half_extents)
    body = client.createMultiBody(0, shape, basePosition=centre)
    client.changeDynamics(body, -1, **_CONTACT)
    return body


def collision_file(model: ObjectModel) -> Path:
    """Path of the object's approximate convex decomposition, an ``.obj`` file with one group per part.

    Hollow objects stay hollow (V-HACD). The result is cached under ``$XDG_CACHE_HOME/active6d`` by the mesh's contents.
    """
    vertices = np.asarray(model.mesh.vertices)
    digest = hashlib.sha256(vertices.tobytes() + np.asarray(model.mesh.faces).tobytes()).hexdigest()[:16]
    path = cache_folder("collision") / f"{model.name}-{digest}.obj"
    if not path.is_file():
        with atomic_file(path) as parts:
            source, log = (str(parts.with_name(name)) for name in ("mesh.obj", "log.txt"))
            model.mesh.export(source)
            decompose(source, str(parts), log)
    return path
