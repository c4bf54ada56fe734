"""Simulation of heaps: identical objects fall into a bin by rigid-body physics until they are at rest."""

import hashlib
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from active6d_core.files import atomic_file, cache_folder
from active6d_core.object_model import ObjectModel
from active6d_core.se3 import transform_from_quaternion
from active6d_sim.physics.bullet import BulletClient, connect, decompose, pybullet
from active6d_sim.rendering.renderer import visible_fractions
from active6d_sim.scenes.scene import Bin, Scene

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
    T_world_all = _simulate(model, bin, count, rng)
    name = name or f"{model.name}/seed/{seed}"
    everything = Scene(model.name, name, seed, T_world_all, bin, np.zeros((0, len(T_world_all))))
    fractions = visible_fractions(everything, model)
    seen = fractions.max(axis=0, initial=0.0) >= VISIBILITY_THRESHOLD
    return Scene(model.name, name, seed, T_world_all[seen], bin, fractions[:, seen], T_world_all[~seen])


def _simulate(model: ObjectModel, bin: Bin, count: int, rng: np.random.Generator) -> np.ndarray:
    """(k, 4, 4) ``T_world_object`` of the objects at rest in the bin; k is ``count`` unless some fall out twice."""
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
        table = _add_bin(client, bin)
        bodies: list[int] = []
        for _ in range(_ROUNDS):
            guides = _add_walls(client, bin, bottom=bin.wall_height, top=bin.wall_height + 2.0)
            bodies += _drop(client, model, bin, count - len(bodies), bodies, rng)
            _settle(client, bodies)
            for guide in guides:
                client.removeBody(guide)
            _settle(client, bodies)
            bodies = _remove_fallen(client, bodies, table)
            if len(bodies) == count:
                break
            _settle(client, bodies)
        poses = [client.getBasePositionAndOrientation(body) for body in _remove_fallen(client, bodies, table)]
    finally:
        client.disconnect()
    positions, quaternions = np.array([p for p, _ in poses]), np.array([q for _, q in poses])
    return transform_from_quaternion(quaternions.reshape(-1, 4), positions.reshape(-1, 3))


def _drop(
    client: BulletClient, model: ObjectModel, bin: Bin, count: int, present: list[int], rng: np.random.Generator
) -> list[int]:
    """Release ``count`` instances one after another just above those ``present``, so that all arrive slowly."""
    shape = client.createCollisionShape(pybullet.GEOM_MESH, fileName=str(collision_file(model)))
    reach = np.maximum(np.array([bin.inner_width, bin.inner_depth]) / 2 - model.diameter / 2, 0.0)
    bodies: list[int] = []
    for _ in range(count):
        tops = [client.getAABB(body)[1][2] for body in present + bodies]
        height = max([bin.wall_height, *tops]) + 0.6 * model.diameter
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


def _add_bin(client: BulletClient, bin: Bin) -> int:
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


def _add_box(client: BulletClient, centre: tuple, half_extents: tuple) -> int:
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
