"""Evidence for and against each candidate, from all views and from overlaps of solids: the input of the belief."""

from dataclasses import dataclass

import numpy as np

from active6d_perception.scene.body_candidates import BodyCandidates
from active6d_perception.scene.measured_cases import (
    CASES,
    FACING_ELSEWHERE,
    FITTING,
    HIDDEN,
    LOOKED_THROUGH,
    PER_PIXEL,
    WHAT,
    WHOSE,
)

#: Millimetres off are errors of poses, not of the hypothesis: depths count up to these, metres.
DEEPEST_IN_CONTAINER, DEEPEST_IN_NEIGHBOUR = 0.03, 0.005
#: Distances within which two surfaces touch, metres.
TOUCHES_FLOOR, TOUCHES_NEIGHBOUR = 0.003, 0.0015

#: Names of the columns of :meth:`SceneEvidence.columns`.
ROTATION_COLUMNS = (
    *(f"case {case}" for case in range(CASES)),
    "share below the floor",
    "share in neighbours",
    "share beyond a wall",
    "depth below the floor",
    "depth in a neighbour",
    "depth beyond a wall",
    "touches the floor",
    "touches a neighbour",
    "height",
)
#: Names of the columns of :meth:`BodyEvidence.columns`.
BODY_COLUMNS = (
    *(f"case {case}" for case in range(CASES)),
    *(f"case {case} of the part that tells twins apart" for case in range(CASES)),
    "share fitting",
    "share looked through",
    "fitting",
    "looked through",
    "facing elsewhere",
    "hidden",
    "evidence",
    "root of evidence",
    "only a twin",
    "share below the floor",
    "share in neighbours",
    "depth below the floor",
    "depth in a neighbour",
)


@dataclass(frozen=True, eq=False)
class BodyEvidence:
    """Evidence on K bodies, independent of their rotations.

    Attributes:
        candidates: the bodies.
        body: (K, CASES) counts of the surface that looks the same at all rotations, see :mod:`.measured_cases`.
        twin: (K, CASES) counts of the part of it that distinguishes twins.
        container: (K, 5) of that surface, see :func:`.against_container`.
        neighbours: (K, 2) of that surface, see :func:`.against_neighbour`; shares are summed over the neighbours, of
            the distances it is the least.
    """

    candidates: BodyCandidates
    body: np.ndarray
    twin: np.ndarray
    container: np.ndarray
    neighbours: np.ndarray

    def columns(self) -> np.ndarray:
        """(K, columns) float32, about one in size; see :data:`BODY_COLUMNS`."""
        fitting, through, elsewhere, hidden = self.pixels()
        seen = np.maximum(fitting + through + elsewhere, 1)
        columns = [
            10 * fitting / seen,
            10 * through / seen,
            fitting / 300,
            through / 100,
            elsewhere / 300,
            hidden / 300,
            self.candidates.evidence,
            np.sqrt(self.candidates.evidence),
            self.candidates.twin,
            10 * self.container[:, 0],
            10 * self.neighbours[:, 0],
            *_depths(self.container[:, 1], self.neighbours[:, 1]),
        ]
        roots = _roots(self.body), _roots(self.twin)
        return np.concatenate([*roots, np.stack(columns, axis=-1)], axis=-1).astype(np.float32)

    def pixels(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Four (K,) numbers of pixels of the body: fitting, looked through, facing elsewhere, hidden."""
        pixels = self.body.reshape(-1, WHAT, WHOSE).sum(axis=2) / PER_PIXEL
        return pixels[:, FITTING], pixels[:, LOOKED_THROUGH], pixels[:, FACING_ELSEWHERE], pixels[:, HIDDEN]

    def take(self, index: np.ndarray) -> "BodyEvidence":
        """The evidence on the candidates at ``index``, in that order."""
        return BodyEvidence(
            self.candidates.take(index),
            self.body[index],
            self.twin[index],
            self.container[index],
            self.neighbours[index],
        )


@dataclass(frozen=True, eq=False)
class SceneEvidence:
    """Evidence on K candidates with r rotations each.

    Attributes:
        bodies: what does not depend on the rotations.
        telling: (K, r, CASES) counts of the surface that tells rotations apart.
        container: (K, r, 5) of that surface, as in :class:`BodyEvidence`.
        neighbours: (K, r, 2) of that surface, likewise.
        diameter: of the object, metres divided by :attr:`.Ambiguity.scale`, as all lengths here.
    """

    bodies: BodyEvidence
    telling: np.ndarray
    container: np.ndarray
    neighbours: np.ndarray
    diameter: float

    @property
    def candidates(self) -> BodyCandidates:
        """The bodies."""
        return self.bodies.candidates

    def columns(self) -> np.ndarray:
        """(K, r, columns) float32, about one in size; see :data:`ROTATION_COLUMNS`."""
        floor, wall, near = self.container[..., 1], self.container[..., 3], self.neighbours[..., 1]
        height = self.container[..., 4] - self.container[..., 4].mean(axis=1, keepdims=True)
        columns = [
            10 * self.container[..., 0],
            10 * self.neighbours[..., 0],
            10 * self.container[..., 2],
            *_depths(floor, near),
            np.clip(wall, 0, DEEPEST_IN_CONTAINER) / 0.01,
            np.abs(floor) < TOUCHES_FLOOR,
            np.abs(near) < TOUCHES_NEIGHBOUR,
            height / (0.4 * self.diameter),
        ]
        return np.concatenate([_roots(self.telling), np.stack(columns, axis=-1)], axis=-1).astype(np.float32)


def _roots(counts: np.ndarray) -> np.ndarray:
    """Neighbouring pixels and views of the same surface are not independent: evidence grows like a root of pixels."""
    return 0.3 * np.sqrt(counts.astype(np.float32) / PER_PIXEL)


def _depths(lowest: np.ndarray, nearest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How deep an object reaches below the floor, in centimetres, and into a neighbour, in millimetres."""
    below = np.clip(-lowest, 0, DEEPEST_IN_CONTAINER) / 0.01
    return below, np.clip(-nearest, 0, DEEPEST_IN_NEIGHBOUR) / 0.001
