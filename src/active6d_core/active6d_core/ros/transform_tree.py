"""Transforms of /tf and /tf_static, live or recorded, looked up at the stamps of images."""

from bisect import bisect_left
from collections import defaultdict
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from active6d_core.nearest_stamp import nearest_position
from active6d_core.ros.conversions import MessageError, stamp_to_ns
from active6d_core.se3 import invert, make_transform, transform_from_quaternion

_LARGEST_TREE = 1000


class TransformTree:
    """The frames that transforms connect; each has one parent.

    Args:
        kept: nanoseconds before the newest transform of a moving frame of which its transforms are kept; None for all.
            A frame whose stamps go back by more begins again, as when a bag is played from its beginning.
    """

    def __init__(self, kept: int | None = None) -> None:
        self._kept = kept
        self._parents: dict[str, str] = {}
        self._stamps: dict[str, list[int]] = defaultdict(list)
        self._transforms: dict[str, list[np.ndarray]] = defaultdict(list)
        self._static: set[str] = set()

    def add(self, message: Any, static: bool) -> None:
        """Take a TFMessage of ``/tf``, or of ``/tf_static``."""
        for each in message.transforms:
            child, parent = each.child_frame_id.lstrip("/"), each.header.frame_id.lstrip("/")
            t, q = each.transform.translation, each.transform.rotation
            numbers = np.array([t.x, t.y, t.z, q.x, q.y, q.z, q.w], float)
            if not np.isfinite(numbers).all() or abs(np.linalg.norm(numbers[3:]) - 1.0) > 1e-2:
                raise MessageError(f"the transform from {parent} to {child} is not rigid")
            self._parents[child] = parent
            if static:
                self._static.add(child)
            self._insert(child, stamp_to_ns(each.header.stamp), transform_from_quaternion(numbers[3:], numbers[:3]))

    def _insert(self, child: str, stamp: int, T_parent_child: np.ndarray) -> None:
        stamps, transforms = self._stamps[child], self._transforms[child]
        kept = None if child in self._static else self._kept
        if kept is not None and stamps and stamp < stamps[-1] - kept:
            stamps.clear()
            transforms.clear()
        position = bisect_left(stamps, stamp)
        if stamps[position : position + 1] == [stamp]:
            transforms[position] = T_parent_child
            return
        stamps.insert(position, stamp)
        transforms.insert(position, T_parent_child)
        if kept is not None:
            old = bisect_left(stamps, stamps[-1] - kept)
            del stamps[:old], transforms[:old]

    def root(self, frame: str) -> str:
        """The frame at the root of a frame's tree."""
        return self._chain(frame)[-1]

    def has(self, frame: str) -> bool:
        """Whether a transform names the frame."""
        return frame in self._parents or frame in self._parents.values()

    def moves(self, frame: str) -> bool:
        """Whether a frame is carried by something that moves: a transform on its way to the root is not static."""
        return any(child not in self._static for child in self._chain(frame)[:-1])

    def lookup(self, target: str, source: str, stamp: int, tolerance: int | None) -> np.ndarray:
        """(4, 4) ``T_target_source`` at a stamp (ns).

        Args:
            target: frame.
            source: frame.
            stamp: nanoseconds.
            tolerance: how far (ns) the nearest transforms, which are taken, may be away; None to interpolate between
                the transforms before and after the stamp instead.

        Raises:
            MessageError: the frames are not connected, or there is no such transform.
        """
        up, other = self._chain(source.lstrip("/")), self._chain(target.lstrip("/"))
        shared = next((frame for frame in up if frame in other), None)
        if shared is None:
            raise MessageError(f"no transform from {target} to {source}")
        T_shared_source = self._compose(up[: up.index(shared)], stamp, tolerance)
        T_shared_target = self._compose(other[: other.index(shared)], stamp, tolerance)
        return invert(T_shared_target) @ T_shared_source

    def _chain(self, frame: str) -> list[str]:
        chain = [frame.lstrip("/")]
        while chain[-1] in self._parents and len(chain) < _LARGEST_TREE:
            chain.append(self._parents[chain[-1]])
        return chain

    def _compose(self, chain: list[str], stamp: int, tolerance: int | None) -> np.ndarray:
        T = np.eye(4)
        for child in chain:
            T = self._at(child, stamp, tolerance) @ T
        return T

    def _at(self, child: str, stamp: int, tolerance: int | None) -> np.ndarray:
        stamps, transforms = self._stamps[child], self._transforms[child]
        nearest, after = nearest_position(stamps, stamp), bisect_left(stamps, stamp)
        if nearest is None:
            raise MessageError(f"there is no transform of {child}")
        late = abs(stamps[nearest] - stamp)
        if child in self._static or late <= (tolerance or 0):
            return transforms[nearest]
        if tolerance is not None or after in (0, len(stamps)):
            raise MessageError(f"the nearest transform of {child} is {late * 1e-6:.0f} ms from the image")
        share = (stamp - stamps[after - 1]) / (stamps[after] - stamps[after - 1])
        a, b = transforms[after - 1], transforms[after]
        turn = Rotation.from_matrix(a[:3, :3].T @ b[:3, :3]).as_rotvec()
        R = a[:3, :3] @ Rotation.from_rotvec(share * turn).as_matrix()
        return make_transform(R, (1 - share) * a[:3, 3] + share * b[:3, 3])
