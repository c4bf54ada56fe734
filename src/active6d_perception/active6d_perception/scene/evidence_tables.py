"""Evidence of every view on fixed candidates of a scene, so that fusing any of its views is a look-up.

:class:`.AllViewsFusion` refines its candidates with the views that it has. A table needs candidates that do not depend
on the choice of views: those of all views of the scene. What each view measured at each of them is stored.
"""

from dataclasses import dataclass

import numpy as np

from active6d_perception.scene.all_views_fusion import OWN_PLACE, WHOLE_GATES, AllViewsFusion, scaled_gates
from active6d_perception.scene.body_refinement import refine_poses
from active6d_perception.scene.measured_cases import CASES, count_cases

# Whole objects are refined with about as many views: an episode has few, and there are many poses.
_REFINING_VIEWS = 6

# Places with less evidence are left out. A grid of views has many that one improbable hypothesis proposes.
_LEAST_EVIDENCE = 0.1


@dataclass(frozen=True, eq=False)
class EvidenceTables:
    """K candidates with R rotations each, and what each of M views says of them.

    Counts are stored as rounded square roots, which is as precise as they are used.

    Attributes:
        T_world_body: (K, 4, 4) metres; the rotation about an axis of near symmetry is arbitrary.
        place: (K,) number of each candidate's place, from 0.
        T_world_object: (K, R, 4, 4) poses with each rotation, refined as whole objects, metres.
        body: (M, K, CASES) uint8 roots of the counts of the surface that looks the same at all rotations.
        twin: (M, K, CASES) uint8 likewise of the part of it that distinguishes twins.
        telling: (M, K, R, CASES) uint8 likewise of the surface that distinguishes rotations.

    Raises:
        ValueError: shapes disagree, or a pose is not finite.
    """

    T_world_body: np.ndarray
    place: np.ndarray
    T_world_object: np.ndarray
    body: np.ndarray
    twin: np.ndarray
    telling: np.ndarray

    def __post_init__(self) -> None:
        K, R, M = len(self.place), self.T_world_object.shape[1], len(self.body)
        shapes = {
            "T_world_body": (K, 4, 4),
            "T_world_object": (K, R, 4, 4),
            "body": (M, K, CASES),
            "twin": (M, K, CASES),
            "telling": (M, K, R, CASES),
        }
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"evidence: {name} has shape {getattr(self, name).shape}, expected {shape}")
        if not (np.isfinite(self.T_world_body).all() and np.isfinite(self.T_world_object).all()):
            raise ValueError("evidence: a pose is not finite")

    def take(self, index: np.ndarray) -> "EvidenceTables":
        """The candidates at ``index``, in that order; places are numbered again."""
        return EvidenceTables(
            self.T_world_body[index],
            np.unique(self.place[index], return_inverse=True)[1],
            self.T_world_object[index],
            *(np.ascontiguousarray(table[:, index]) for table in (self.body, self.twin, self.telling)),
        )


def tabulate(fusion: AllViewsFusion) -> EvidenceTables:
    """The tables of all views of ``fusion``, in the order of their stamps."""
    ambiguity, candidates = fusion.ambiguity, fusion.candidates()
    gathered = np.bincount(candidates.place, candidates.evidence)
    candidates = candidates.take(np.flatnonzero(gathered[candidates.place] >= _LEAST_EVIDENCE))
    views = [fusion.views[stamp] for stamp in sorted(fusion.views)]
    T, count = candidates.T_world_object, len(ambiguity.rotations)
    turned = (T[:, None] @ ambiguity.rotations).reshape(-1, 4, 4)
    few = views[:: max(1, len(views) // _REFINING_VIEWS)]
    whole = refine_poses(turned, ambiguity.all_samples, few, scaled_gates(WHOLE_GATES, ambiguity.scale), search=False)
    same = np.eye(4)[None]
    parts = {
        "body": (same, ambiguity.body_samples),
        "twin": (same, ambiguity.twin_samples),
        "telling": (ambiguity.rotations, ambiguity.telling_samples),
    }
    roots = {name: np.zeros((len(views), len(T), len(R), CASES), np.uint8) for name, (R, _) in parts.items()}
    near = OWN_PLACE * ambiguity.spacing
    for name, (rotations, samples) in parts.items():
        for row, view in zip(roots[name], views, strict=True):
            if samples.number.any():
                counts = count_cases(T, rotations, ambiguity.middle, near, samples, view, ambiguity.scale)
                row[:] = np.minimum(np.rint(np.sqrt(counts)), 255)
    return EvidenceTables(
        T,
        np.unique(candidates.place, return_inverse=True)[1],
        whole.reshape(-1, count, 4, 4),
        roots["body"][:, :, 0],
        roots["twin"][:, :, 0],
        roots["telling"],
    )
