"""A simulated arm with the camera at its wrist: which views it reaches, how it gets there, and how long that takes.

The arm is KUKA's LBR iiwa of pybullet_data. It hangs above the bin, and a bracket turns the camera against the flange.
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pybullet_data
from scipy.spatial.transform import Rotation

from active6d_core.object_model import load_object
from active6d_core.se3 import invert, make_transform, quaternion_from_transform, transform_points
from active6d_sim.physics.bullet import BulletClient, connect, pybullet
from active6d_sim.physics.heap import add_bin, collision_file
from active6d_sim.rendering.simulator import GoalError
from active6d_sim.robot.kinematics import SerialArm
from active6d_sim.robot.motion import SPACING, find_way, sample_way, seconds_of
from active6d_sim.scenes.scene import Scene

#: What carries the simulated camera: nothing, or this arm.
CARRIERS = ["flying", "arm"]
ARM_MODEL = Path(pybullet_data.getDataPath()) / "kuka_iiwa" / "model.urdf"
#: Largest speeds of the joints of an LBR iiwa 14 R820 from its data sheet, radians per second.
_SPEEDS = np.radians([85.0, 85.0, 100.0, 75.0, 130.0, 135.0, 135.0])
_SECONDS_TO_FULL_SPEED = 0.5
#: The flange's face along z of the last link, and the radius of the flange; metres.
_FLANGE, _FLANGE_RADIUS = 0.045, 0.03
#: Of the camera: width and height, and depth behind the optical centre; metres.
_HOUSING, _HOUSING_DEPTH = (0.09, 0.025), 0.025
#: No part of a link is farther from the frame of its joint, metres.
_LINK_RADIUS = 0.25
#: Index of the distance in a contact of pybullet.
_DISTANCE = 8
_READY = np.array([0.0, 0.5, 0.0, -1.5, 0.0, 0.8, 0.0])
#: Inverse kinematics starts this often, and stops after so many solutions without collision.
_STARTS, _SOLUTIONS = 20, 4
_SEED = 5


def _hanging() -> np.ndarray:
    return make_transform(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 1.05])


def _bracket() -> np.ndarray:
    turn = Rotation.from_euler("x", 45.0, degrees=True).as_matrix()
    return make_transform(turn, np.array([0.0, 0.0, _FLANGE]) + turn @ [0.0, 0.0, 0.08])


@dataclass(frozen=True, eq=False)
class ArmSettings:
    """Where the arm stands, how the camera is mounted, and how fast and how near to things it moves.

    Attributes:
        T_world_base: (4, 4) pose of the base; by default it hangs 1.05 m above the centre of the bin's floor.
        T_flange_camera: (4, 4) pose of the optical frame in the last link, as a calibration would give it.
        speed: fraction of the largest joint speeds, in (0, 1].
        clearance: least distance of arm and camera from everything else, metres.
        pause: seconds from standing still to the image.

    Raises:
        ValueError: speed or clearance is out of range.
    """

    T_world_base: np.ndarray = field(default_factory=_hanging)
    T_flange_camera: np.ndarray = field(default_factory=_bracket)
    speed: float = 0.5
    clearance: float = 0.01
    pause: float = 0.3

    def __post_init__(self) -> None:
        if not 0 < self.speed <= 1 or not 0 <= self.clearance <= 0.1 or not 0 <= self.pause < np.inf:
            raise ValueError(f"arm: speed must be in (0, 1], clearance in [0, 0.1] m, got {self}")


@dataclass(frozen=True, eq=False)
class Motion:
    """A motion of the arm.

    Attributes:
        way: (k, n) joint angles in radians, connected by straight lines; the arm stops at each.
        seconds: from the start to the image at the end.
        T_world_camera: (4, 4) pose of the optical frame at the end, by the joint angles and the calibration.
    """

    way: np.ndarray
    seconds: float
    T_world_camera: np.ndarray


def hand_eye_error(millimetres: float, degrees: float, seed: int) -> np.ndarray:
    """(4, 4) ``T_calibrated_true`` of an optical frame that a calibration gave with errors of this size.

    Their directions are drawn by the seed.
    """
    shift, axis = np.random.default_rng([_SEED, seed]).normal(size=(2, 3))
    turn = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis))
    return make_transform(turn.as_matrix(), 1e-3 * millimetres * shift / np.linalg.norm(shift))


class CameraArm:
    """Plans motions of the arm in one scene. The same goals in the same order give the same motions.

    Args:
        scene: whose bin, table and objects the arm must not touch.
        settings: of the arm.

    Attributes:
        joints: (n,) current angles in radians.
    """

    def __init__(self, scene: Scene, settings: ArmSettings | None = None) -> None:
        self.settings = settings or ArmSettings()
        self.arm = SerialArm.from_urdf(ARM_MODEL)
        self.joints = _READY
        self._cell = _Cell(scene, self.arm, ARM_MODEL, self.settings)

    def pose(self, joints: np.ndarray) -> np.ndarray:
        """``T_world_camera`` (4, 4) at (n,) joint angles, by the calibration."""
        return self.arm.links(self.settings.T_world_base, joints)[-1] @ self.settings.T_flange_camera

    def plan(self, T_world_camera: np.ndarray) -> Motion:
        """The quickest way found from the current joints to a view.

        Raises:
            GoalError: it is out of reach, or the arm would touch something or stand in the picture.
        """
        rng = np.random.default_rng(_SEED)
        solutions = self._solutions(T_world_camera, rng)
        limits, free = self.arm.limits, self._cell.is_free
        for joints in sorted(solutions, key=lambda end: self._seconds(np.stack([self.joints, end]))):
            way = find_way(self.joints, joints, limits, free, rng)
            if way is not None:
                return Motion(way, self._seconds(way) + self.settings.pause, self.pose(joints))
        raise GoalError("the arm finds no way to the view goal without collision")

    def place(self, T_world_camera: np.ndarray) -> np.ndarray:
        """Be at a view without a motion; ``T_world_camera`` (4, 4) by the joint angles.

        Raises:
            GoalError: it is out of reach, or the arm would touch something or stand in the picture.
        """
        self.joints = self._solutions(T_world_camera, np.random.default_rng(_SEED), enough=1)[0]
        return self.pose(self.joints)

    def follow(self, motion: Motion) -> None:
        """Be at the end of a motion."""
        self.joints = motion.way[-1]

    def clearance(self, motion: Motion) -> float:
        """Least distance of arm and camera from everything else along a motion, at most 0.1 m; sampled densely."""
        return min(self._cell.distance(joints) for joints in sample_way(motion.way, SPACING / 2))

    def reaches(self, T_world_camera: np.ndarray) -> bool:
        """Whether some configuration without collision has this view; the way there may still be blocked."""
        try:
            return bool(self._solutions(T_world_camera, np.random.default_rng(_SEED), enough=1))
        except GoalError:
            return False

    def _solutions(
        self, T_world_camera: np.ndarray, rng: np.random.Generator, enough: int = _SOLUTIONS
    ) -> list[np.ndarray]:
        flange = invert(self.settings.T_world_base) @ T_world_camera @ invert(self.settings.T_flange_camera)
        found: list[np.ndarray] = []
        blocked = ""
        for count in range(_STARTS):
            start = (self.joints, _READY)[count] if count < 2 else rng.uniform(*self.arm.limits.T)
            joints = self.arm.solve(flange, start)
            if joints is None:
                continue
            obstacle = self._cell.obstacle(joints)
            if not obstacle and self._cell.hides_bin(joints, T_world_camera):
                obstacle = "the arm would stand between the camera and the bin"
            if obstacle:
                blocked = obstacle
            elif not any(np.abs(joints - other).max() < 1e-2 for other in found):
                found.append(joints)
            if len(found) == enough:
                break
        if not found:
            raise GoalError(f"the arm cannot take the view goal: {blocked or 'out of reach'}")
        return found

    def _seconds(self, way: np.ndarray) -> float:
        speeds = self.settings.speed * _SPEEDS
        return seconds_of(way, speeds, speeds / _SECONDS_TO_FULL_SPEED)


class _Cell:
    """The arm, the camera and all obstacles as collision shapes of one physics server."""

    def __init__(self, scene: Scene, arm: SerialArm, path: Path, settings: ArmSettings) -> None:
        self._client: BulletClient = connect()
        self._arm, self._settings = arm, settings
        base = settings.T_world_base
        position, turn = base[:3, 3].tolist(), quaternion_from_transform(base).tolist()
        self._robot = self._client.loadURDF(str(path), position, turn, useFixedBase=True)
        self._corners = _camera_corners(settings.T_flange_camera)
        self._camera = self._add_hull(self._corners)
        table = add_bin(self._client, scene.bin)
        self._obstacles = dict.fromkeys(range(self._camera + 1, table), "the bin") | {table: "the table"}
        shape = self._client.createCollisionShape(
            pybullet.GEOM_MESH, fileName=str(collision_file(load_object(scene.object_name)))
        )
        for T in scene.T_world_all:
            turn = quaternion_from_transform(T).tolist()
            body = self._client.createMultiBody(0, shape, basePosition=T[:3, 3].tolist(), baseOrientation=turn)
            self._obstacles[body] = "the heap"
        self._top = max(self._client.getAABB(body)[1][2] for body in self._obstacles)
        self._bin = _box(scene.bin.inner_width, scene.bin.inner_depth, (0.0, scene.bin.wall_height))

    def __del__(self) -> None:
        self._client.disconnect()

    def is_free(self, joints: np.ndarray) -> bool:
        """Whether arm and camera keep their clearance."""
        return not self.obstacle(joints)

    def obstacle(self, joints: np.ndarray) -> str:
        """What comes nearer than the clearance at these joint angles, in words; empty if nothing does."""
        links = self._place(joints)
        least = self._settings.clearance
        for body, name in self._obstacles.items() if self._is_low(links, least) else ():
            for mover, what in ((self._camera, "camera"), (self._robot, "arm")):
                if self._client.getClosestPoints(mover, body, least):
                    return f"the {what} would touch {name}"
        return "the arm would touch itself" if self._own_distances(least) else ""

    def distance(self, joints: np.ndarray, most: float = 0.1) -> float:
        """Least distance between arm or camera and everything else, metres, at most ``most``."""
        links = self._place(joints)
        distances = self._own_distances(most)
        for body in self._obstacles if self._is_low(links, most) else ():
            for mover in (self._camera, self._robot):
                distances += [contact[_DISTANCE] for contact in self._client.getClosestPoints(mover, body, most)]
        return min([most, *distances])

    def hides_bin(self, joints: np.ndarray, T_world_camera: np.ndarray) -> bool:
        """Whether the arm stands between the camera and the bin."""
        self._place(joints)
        sight = self._add_hull(np.concatenate([T_world_camera[None, :3, 3], self._bin]))
        links = range(-1, self._flange - 1)
        hidden = any(self._client.getClosestPoints(sight, self._robot, 0.0, -1, link) for link in links)
        self._client.removeBody(sight)
        return hidden

    @property
    def _flange(self) -> int:
        return len(self._arm.limits) - 1

    def _own_distances(self, most: float) -> list[float]:
        """Distances below ``most`` between links that could touch, and between them and the camera.

        The joint limits keep links apart that are near each other in the chain.
        """
        contacts = []
        for link in range(-1, self._flange - 1):
            contacts += self._client.getClosestPoints(self._camera, self._robot, most, -1, link)
            for other in range(link + 3, self._flange + 1):
                contacts += self._client.getClosestPoints(self._robot, self._robot, most, link, other)
        return [contact[_DISTANCE] for contact in contacts]

    def _is_low(self, links: np.ndarray, most: float) -> bool:
        """Whether a link or the camera may be nearer than ``most`` to the heap, the bin or the table."""
        camera = transform_points(links[-1], self._corners)[:, 2].min()
        return bool(min(camera, links[:, 2, 3].min() - _LINK_RADIUS) < self._top + most)

    def _place(self, joints: np.ndarray) -> np.ndarray:
        """Move the bodies there; (n, 4, 4) ``T_world_link``."""
        for link, angle in enumerate(joints):
            self._client.resetJointState(self._robot, link, angle)
        links = self._arm.links(self._settings.T_world_base, joints)
        turn = quaternion_from_transform(links[-1]).tolist()
        self._client.resetBasePositionAndOrientation(self._camera, links[-1, :3, 3].tolist(), turn)
        return links

    def _add_hull(self, corners: np.ndarray) -> int:
        shape = self._client.createCollisionShape(pybullet.GEOM_MESH, vertices=corners.tolist())
        return self._client.createMultiBody(0, shape)


def _box(width: float, depth: float, heights: tuple[float, float]) -> np.ndarray:
    """(8, 3) corners of a box about the z axis, metres."""
    x, y, z = np.meshgrid([-width / 2, width / 2], [-depth / 2, depth / 2], heights)
    return np.column_stack([x.ravel(), y.ravel(), z.ravel()])


def _camera_corners(T_flange_camera: np.ndarray) -> np.ndarray:
    """Corners of the camera's housing and of the flange, whose hull is taken for camera and bracket; metres."""
    housing = transform_points(T_flange_camera, _box(*_HOUSING, (-_HOUSING_DEPTH, 0.0)))
    flange = _box(2 * _FLANGE_RADIUS, 2 * _FLANGE_RADIUS, (_FLANGE, _FLANGE + 0.01))
    return np.concatenate([housing, flange])
