"""What all views and the laws of solid bodies say for and against each candidate, as numbers that weights turn into a
belief."""

from dataclasses import dataclass

import numpy as np

from active6d_perception.scene.body_candidates import BodyCandidates
from active6d_perception.scene.measured_cases import CASES, FITTING, HIDDEN, LOOKED_THROUGH, PER_PIXEL, WHAT, WHOSE

# Millimetres off are errors of poses, not of the hypothesis: depths count up to these, metres.
_DEEPEST_IN_CONTAINER, _DEEPEST_IN_NEIGHBOUR = 0.03, 0.005
_TOUCHES_FLOOR, _TOUCHES_NEIGHBOUR = 0.003, 0.0015

#: Names of the columns of :meth:`SceneEvidence.of_rotations`.
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
#: Names of the columns of :meth:`SceneEvidence.of_bodies`.
BODY_COLUMNS = (
    *(f"case {case}" for case in range(CASES)),
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
class SceneEvidence:
    """Evidence on K candidates with r rotations each.

    Attributes:
        candidates: the bodies.
        telling: (K, r, CASES) counts of the surface that tells rotations apart, see :mod:`.measured_cases`.
        body: (K, CASES) counts of the other surface.
        container: (K, r, 5) of the surface that tells rotations apart, see :func:`.against_container`.
        body_container: (K, 5) of the other surface.
        neighbours: (K, r, 2) likewise, see :func:`.against_neighbour`; shares are summed over the neighbours, of the
            distances it is the least.
        body_neighbours: (K, 2).
        diameter: of the object, metres.
    """

    candidates: BodyCandidates
    telling: np.ndarray
    body: np.ndarray
    container: np.ndarray
    body_container: np.ndarray
    neighbours: np.ndarray
    body_neighbours: np.ndarray
    diameter: float

    def of_rotations(self) -> np.ndarray:
        """(K, r, columns) float32, about one in size; see :data:`ROTATION_COLUMNS`."""
        floor, wall, near = self.container[..., 1], self.container[..., 3], self.neighbours[..., 1]
        height = self.container[..., 4] - self.container[..., 4].mean(axis=1, keepdims=True)
        columns = [
            10 * self.container[..., 0],
            10 * self.neighbours[..., 0],
            10 * self.container[..., 2],
            *_depths(floor, near),
            np.clip(wall, 0, _DEEPEST_IN_CONTAINER) / 0.01,
            np.abs(floor) < _TOUCHES_FLOOR,
            np.abs(near) < _TOUCHES_NEIGHBOUR,
            height / (0.4 * self.diameter),
        ]
        return np.concatenate([_roots(self.telling), np.stack(columns, axis=-1)], axis=-1).astype(np.float32)

    def of_bodies(self) -> np.ndarray:
        """(K, columns) float32, about one in size; see :data:`BODY_COLUMNS`."""
        fitting, through, elsewhere, hidden = self.body_pixels()
        seen = np.maximum(fitting + through + elsewhere, 1)
        floor, near = self.body_container[:, 1], self.body_neighbours[:, 1]
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
            10 * self.body_container[:, 0],
            10 * self.body_neighbours[:, 0],
            *_depths(floor, near),
        ]
        return np.concatenate([_roots(self.body), np.stack(columns, axis=-1)], axis=-1).astype(np.float32)

    def body_pixels(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Four (K,) numbers of pixels: fitting, looked through, facing elsewhere, hidden."""
        pixels = self.body.reshape(-1, WHAT, WHOSE).sum(axis=2) / PER_PIXEL
        return pixels[:, FITTING], pixels[:, LOOKED_THROUGH], pixels[:, 2], pixels[:, HIDDEN]


def _roots(counts: np.ndarray) -> np.ndarray:
    """Neighbouring pixels and views of the same surface are not independent: evidence grows like a root of pixels."""
    return 0.3 * np.sqrt(counts.astype(np.float32) / PER_PIXEL)


def _depths(lowest: np.ndarray, nearest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How deep an object reaches below the floor, in centimetres, and into a neighbour, in millimetres."""
    below = np.clip(-lowest, 0, _DEEPEST_IN_CONTAINER) / 0.01
    return below, np.clip(-nearest, 0, _DEEPEST_IN_NEIGHBOUR) / 0.001
