"""Transforms recorded on /tf and /tf_static, looked up at the stamps of images."""

from bisect import bisect_left
from collections import defaultdict
from typing import Any

import numpy as np

from active6d_core.ros.conversions import MessageError, stamp_to_ns
from active6d_core.se3 import invert, transform_from_quaternion

_LARGEST_TREE = 1000


class TransformTree:
    """The frames of a recording; each has one parent."""

    def __init__(self) -> None:
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
            position = bisect_left(self._stamps[child], stamp := stamp_to_ns(each.header.stamp))
            self._stamps[child].insert(position, stamp)
            self._transforms[child].insert(position, transform_from_quaternion(numbers[3:], numbers[:3]))

    def root(self, frame: str) -> str:
        """The frame at the root of a frame's tree."""
        return self._chain(frame)[-1]

    def has(self, frame: str) -> bool:
        """Whether a transform names the frame."""
        return frame in self._parents or frame in self._parents.values()

    def lookup(self, target: str, source: str, stamp: int, tolerance: int) -> np.ndarray:
        """(4, 4) ``T_target_source`` from the transforms nearest to a stamp (ns).

        Raises:
            MessageError: the frames are not connected, or a transform is further than ``tolerance`` (ns) away.
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

    def _compose(self, chain: list[str], stamp: int, tolerance: int) -> np.ndarray:
        T = np.eye(4)
        for child in chain:
            stamps = self._stamps[child]
            nearest = min(range(len(stamps)), key=lambda index: abs(stamps[index] - stamp))
            late = abs(stamps[nearest] - stamp)
            if child not in self._static and late > tolerance:
                raise MessageError(f"the nearest transform of {child} is {late * 1e-6:.0f} ms from the image")
            T = self._transforms[child][nearest] @ T
        return T
