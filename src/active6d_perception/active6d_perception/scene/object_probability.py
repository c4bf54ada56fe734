"""The probability that a fused object is right, from its belief, its evidence and its hypotheses."""

import numpy as np

from active6d_perception.scene.measured_cases import FITTING, LOOKED_THROUGH, PER_PIXEL, WHAT, WHOSE
from active6d_perception.scene.rotation_belief import PlaceBeliefs
from active6d_perception.scene.scene_evidence import SceneEvidence

#: Names of the columns of :func:`describe_objects`.
OBJECT_COLUMNS = (
    "offset",
    "log-odds of the pose",
    "entropy",
    "best score",
    "mean score",
    "root of evidence",
    "support",
    "share of views",
    "share fitting",
    "share looked through",
    "share of others",
    "log of fitting",
    "log of hidden",
    "share in neighbours",
    "share below the floor",
    "telling part fitting",
    "telling part looked through",
)


def describe_objects(
    evidence: SceneEvidence, beliefs: PlaceBeliefs, members: np.ndarray, score: np.ndarray, stamp: np.ndarray
) -> np.ndarray:
    """Describe fused objects by the evidence on them.

    Args:
        evidence: of all candidates.
        beliefs: n chosen poses.
        members: (n, h) bool, which hypotheses are of this body.
        score: (h,) the estimator's scores.
        stamp: (h,) of the hypotheses' views.

    Returns:
        (n, columns) float, about one in size; see :data:`OBJECT_COLUMNS`.
    """
    chosen = beliefs.candidate
    fitting, through, elsewhere, hidden = (pixels[chosen] for pixels in evidence.bodies.pixels())
    seen = np.maximum(fitting + through + elsewhere, 1)
    cases = evidence.bodies.body[chosen].reshape(-1, WHAT, WHOSE) / PER_PIXEL
    telling = evidence.telling[chosen, beliefs.rotation].reshape(-1, WHAT, WHOSE).sum(axis=2) / PER_PIXEL
    views = np.unique(stamp)
    support = np.array([len(np.unique(stamp[own])) for own in members], float)
    count = np.maximum(members.sum(axis=1), 1)
    mass = np.clip(beliefs.mass, 1e-3, 1 - 1e-3)
    columns = [
        np.ones(len(chosen)),
        np.log(mass / (1 - mass)),
        beliefs.entropy,
        np.where(members, score, 0.0).max(axis=1, initial=0.0),
        np.where(members, score, 0.0).sum(axis=1) / count,
        np.sqrt(evidence.candidates.evidence[chosen]),
        np.log1p(support),
        support / max(len(views), 1),
        fitting / seen,
        through / seen,
        cases[:, FITTING, 1] / np.maximum(fitting, 1),
        np.log1p(fitting),
        np.log1p(hidden),
        evidence.bodies.neighbours[chosen, 0],
        evidence.bodies.container[chosen, 0],
        0.3 * np.sqrt(telling[:, FITTING]),
        0.3 * np.sqrt(telling[:, LOOKED_THROUGH]),
    ]
    return np.stack(columns, axis=1)
