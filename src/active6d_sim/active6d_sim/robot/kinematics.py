"""Kinematics of a serial arm: poses of its links, and joint angles for a pose within the joint limits."""

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from active6d_core.se3 import make_transform

#: Metres that a radian of orientation counts for in the error that inverse kinematics minimises.
_METRES_PER_RADIAN = 0.3
#: Largest remaining error of an accepted solution, metres.
_ACCURACY = 1e-5
_ITERATIONS, _DAMPING = 40, 0.3


@dataclass(frozen=True, eq=False)
class SerialArm:
    """n revolute joints, each turning about its own z axis.

    Attributes:
        T_link_joint: (n, 4, 4) frame of each joint at angle 0 in the link before it, metres.
        limits: (n, 2) lowest and highest angle, radians.
        names: of the n joints.
    """

    T_link_joint: np.ndarray
    limits: np.ndarray
    names: tuple[str, ...] = ()

    @classmethod
    def from_urdf(cls, path: Path) -> "SerialArm":
        """Read the revolute joints of a robot description, which must form one chain in the order of the file.

        Raises:
            ValueError: a joint turns about another axis than z, or does not follow the one before.
        """
        frames, limits, names, last = [], [], [], None
        for joint in ElementTree.parse(path).getroot().iterfind("joint[@type='revolute']"):
            parts = {part.tag: part.attrib for part in joint}
            if last not in (None, parts["parent"]["link"]) or _floats(parts["axis"]["xyz"]) != [0.0, 0.0, 1.0]:
                raise ValueError(
                    f"{path}: joint {joint.get('name')} must follow the last one and turn about its z axis"
                )
            rotation = Rotation.from_euler("xyz", _floats(parts["origin"]["rpy"]))
            frames.append(make_transform(rotation.as_matrix(), _floats(parts["origin"]["xyz"])))
            limits.append([float(parts["limit"][end]) for end in ("lower", "upper")])
            names.append(joint.get("name", ""))
            last = parts["child"]["link"]
        return cls(np.array(frames), np.array(limits), tuple(names))

    def links(self, T_world_base: np.ndarray, joints: np.ndarray) -> np.ndarray:
        """(n, 4, 4) ``T_world_link`` of the link after each joint at (n,) angles in radians; the last is the flange."""
        T, links = T_world_base, []
        for fixed, angle in zip(self.T_link_joint, joints, strict=True):
            turn = np.eye(4)
            turn[0, 0] = turn[1, 1] = np.cos(angle)
            turn[1, 0] = np.sin(angle)
            turn[0, 1] = -turn[1, 0]
            T = T @ fixed @ turn
            links.append(T)
        return np.array(links)

    def solve(self, T_base_flange: np.ndarray, start: np.ndarray) -> np.ndarray | None:
        """(n,) angles in radians within the limits that bring the flange to a pose, found from ``start``.

        None if the search does not end there: the pose is out of reach, or another start is needed. Damped least
        squares; angles beyond a limit are set to the limit in every iteration.
        """
        joints = np.array(start, float)
        for _ in range(_ITERATIONS):
            links = self.links(np.eye(4), joints)
            turn = Rotation.from_matrix(T_base_flange[:3, :3] @ links[-1, :3, :3].T).as_rotvec()
            error = np.concatenate([T_base_flange[:3, 3] - links[-1, :3, 3], _METRES_PER_RADIAN * turn])
            if np.abs(error).max() < _ACCURACY:
                return joints
            axes = links[:, :3, 2]
            moved = np.cross(axes, links[-1, :3, 3] - links[:, :3, 3])
            jacobian = np.concatenate([moved.T, _METRES_PER_RADIAN * axes.T])
            # Damping that fades with the error: steady far away, quadratic convergence at the end.
            damped = jacobian @ jacobian.T + _DAMPING * (error @ error) * np.eye(6)
            joints = np.clip(joints + jacobian.T @ np.linalg.solve(damped + 1e-9 * np.eye(6), error), *self.limits.T)
        return None


def _floats(text: str) -> list[float]:
    return [float(part) for part in text.split()]
