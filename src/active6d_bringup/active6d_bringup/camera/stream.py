"""One view for every goal out of a free-running stream: frames matched, camera arrived, still, and fresh."""

from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, auto
from typing import Any

import numpy as np

from active6d_core.nearest_stamp import nearest_position
from active6d_core.se3 import rotation_angle

SECOND = 1_000_000_000
#: Images and nanoseconds of poses kept: more than any driver's streams are apart.
_KEPT_FRAMES = 8
_KEPT_POSES = 10 * SECOND


class FrameMatcher:
    """Pairs colour and depth images whose stamps are near.

    Args:
        tolerance: largest difference of stamps, nanoseconds.
        on_pair: called with the colour image's stamp (ns), the colour and the depth image.
    """

    def __init__(self, tolerance: int, on_pair: Callable[[int, Any, Any], None]) -> None:
        self._tolerance, self._on_pair = tolerance, on_pair
        self._waiting: dict[str, deque[tuple[int, Any]]] = {
            name: deque(maxlen=_KEPT_FRAMES) for name in ("color", "depth")
        }
        #: Pairs so far, and images that found no partner.
        self.pairs = self.unmatched = 0
        #: Smallest difference (ns) of stamps among images that found no partner since the last pair; None before any.
        self.skew: int | None = None

    def add(self, name: str, stamp: int, image: Any) -> None:
        """Take an image of ``color`` or ``depth``."""
        other = "depth" if name == "color" else "color"
        best = min(self._waiting[other], key=lambda entry: abs(entry[0] - stamp), default=None)
        if best is None or abs(best[0] - stamp) > self._tolerance:
            if best is not None:
                difference = abs(best[0] - stamp)
                self.skew = difference if self.skew is None else min(self.skew, difference)
            self.unmatched += len(self._waiting[name]) == _KEPT_FRAMES
            self._waiting[name].append((stamp, image))
            return
        partners = self._waiting[other]
        self.unmatched += sum(earlier < best[0] for earlier, _ in partners)
        self._waiting[other] = deque((entry for entry in partners if entry[0] > best[0]), maxlen=_KEPT_FRAMES)
        self.pairs += 1
        self.skew = None
        color, depth = ((stamp, image), best) if name == "color" else (best, (stamp, image))
        self._on_pair(color[0], color[1], depth[1])


class PoseHistory:
    """The camera's poses of the last seconds.

    Args:
        keep: nanoseconds before the newest one, None for all.
    """

    def __init__(self, keep: int | None = _KEPT_POSES) -> None:
        self._keep = keep
        # Two lists in order of stamps: a recording has many poses, and all its images look for theirs.
        self._stamps: list[int] = []
        self._poses: list[np.ndarray] = []

    def add(self, stamp: int, T_world_camera: np.ndarray) -> None:
        """Take (4, 4) ``T_world_camera`` at a stamp (ns); a clock that goes back begins a new history."""
        if self._stamps and stamp < self._stamps[-1]:
            self._stamps.clear()
            self._poses.clear()
        self._stamps.append(stamp)
        self._poses.append(T_world_camera)
        if self._keep is not None:
            old = bisect_left(self._stamps, stamp - self._keep)
            del self._stamps[:old], self._poses[:old]

    def __len__(self) -> int:
        return len(self._poses)

    @property
    def oldest(self) -> int | None:
        """Stamp (ns) of the first pose that is kept."""
        return self._stamps[0] if self._stamps else None

    @property
    def newest(self) -> int | None:
        """Stamp (ns) of the last pose."""
        return self._stamps[-1] if self._stamps else None

    @property
    def last(self) -> np.ndarray | None:
        """(4, 4) the last pose."""
        return self._poses[-1] if self._poses else None

    def nearest(self, stamp: int) -> tuple[int, np.ndarray] | None:
        """Stamp (ns) and pose nearest to a stamp."""
        position = nearest_position(self._stamps, stamp)
        return None if position is None else (self._stamps[position], self._poses[position])

    def between(self, start: int, end: int) -> list[np.ndarray]:
        """Poses at stamps (ns) in [start, end]."""
        return self._poses[bisect_left(self._stamps, start) : bisect_right(self._stamps, end)]


@dataclass(frozen=True)
class GateLimits:
    """When a camera counts as still, arrived or lost.

    Attributes:
        still_seconds: how long it must not have moved before an image is used.
        still_metres: movement that counts as none.
        still_degrees: rotation that counts as none.
        arrival_metres: distance to the goal at which it has arrived.
        arrival_degrees: angle to the goal at which it has arrived.
        settle_seconds: how long it may stand elsewhere before the goal counts as not reachable.
        goal_seconds: how long it may take to a goal, 0 for any time.
    """

    still_seconds: float = 0.3
    still_metres: float = 0.001
    still_degrees: float = 0.1
    arrival_metres: float = 0.02
    arrival_degrees: float = 3.0
    settle_seconds: float = 2.0
    goal_seconds: float = 25.0


class Verdict(Enum):
    """What an image is for."""

    WAIT = auto()
    TAKE = auto()
    REFUSE = auto()


class ArrivalGate:
    """Chooses from a stream the one image that answers a goal.

    All times are the stamps of the stream, so a recorded stream gives the same choice.

    Args:
        limits: when a camera counts as still, arrived or lost.
        poses: of the camera, kept up to date by the caller.
    """

    def __init__(self, limits: GateLimits, poses: PoseHistory) -> None:
        self._limits, self._poses = limits, poses
        self._goal: np.ndarray | None = None
        self._since: int | None = None
        self._asked_from: np.ndarray | None = None
        self._stands_since: int | None = None
        self._moved = False
        self.waiting = True

    def ask(self, T_world_goal: np.ndarray | None) -> None:
        """Wait for a goal's view; None for a view from wherever the camera stands."""
        # Poses come also between the images of a camera that takes one on request.
        self._goal, self._since, self._stands_since = T_world_goal, self._poses.newest, None
        self._asked_from, self._moved, self.waiting = self._poses.last, False, True

    def judge(self, stamp: int) -> tuple[Verdict, str]:
        """What the image at a stamp (ns) is for, with the reason of a refusal; a verdict but WAIT ends the waiting."""
        if not self.waiting:
            return Verdict.WAIT, ""
        limits, window = self._limits, round(self._limits.still_seconds * SECOND)
        found = self._poses.nearest(stamp)
        if found is None:
            return Verdict.WAIT, ""
        self._since = since = self._waiting_since(stamp)
        T_now = found[1]
        if self._asked_from is None:
            self._asked_from = T_now
        recent = self._poses.between(stamp - window, stamp)
        # An image of before the goal is none of its view, even if the camera need not move.
        # A single pose says nothing of movement.
        still = stamp - since >= window and len(recent) > 1 and all(self._same_place(T, T_now) for T in recent)
        self._moved |= not self._same_place(self._asked_from, T_now)
        metres, degrees = (0.0, 0.0) if self._goal is None else pose_difference(T_now, self._goal)
        if still and metres <= limits.arrival_metres and degrees <= limits.arrival_degrees:
            self.waiting = False
            return Verdict.TAKE, ""
        if not still:
            self._stands_since = None
        elif self._stands_since is None:
            self._stands_since = stamp
        where = f"{metres:.3f} m and {degrees:.1f} degrees from the goal"
        stands = self._stands_since is not None and stamp - self._stands_since >= limits.settle_seconds * SECOND
        if self._goal is not None and self._moved and stands:
            self.waiting = False
            return Verdict.REFUSE, f"the camera stopped {where}"
        if self._goal is not None and 0 < limits.goal_seconds * SECOND <= stamp - since:
            self.waiting = False
            state = "is still on its way" if self._moved else "has not moved"
            return Verdict.REFUSE, f"the camera {state} after {limits.goal_seconds:g} s, {where}"
        return Verdict.WAIT, ""

    def _waiting_since(self, stamp: int) -> int:
        """Stamp (ns) since which a view is awaited: of the goal or the first pose, or now if the clock went back."""
        oldest, newest = self._poses.oldest, self._poses.newest
        if oldest is None or newest is None:
            return stamp
        if self._since is None:
            return oldest
        return stamp if newest < self._since else self._since

    def _same_place(self, T_a: np.ndarray, T_b: np.ndarray) -> bool:
        metres, degrees = pose_difference(T_a, T_b)
        return metres <= self._limits.still_metres and degrees <= self._limits.still_degrees


def pose_difference(T_a: np.ndarray, T_b: np.ndarray) -> tuple[float, float]:
    """Metres and degrees between two (4, 4) poses."""
    degrees = float(np.degrees(rotation_angle(T_a[:3, :3], T_b[:3, :3])))
    return float(np.linalg.norm(T_a[:3, 3] - T_b[:3, 3])), degrees
