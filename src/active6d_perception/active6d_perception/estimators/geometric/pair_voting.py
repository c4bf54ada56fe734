"""Pose candidates from pairs of oriented points, by voting.

The method is that of Drost et al., "Model globally, match locally" (2010), which the paper cites for handcrafted
features. A scene point forms pairs with its neighbours within the object's diameter. Distance and angles of a pair
select similar pairs of the model. Each of these votes for a model point and for a rotation about its normal.
The method tolerates occlusion, and does not need a segmentation of touching identical objects.
"""

from typing import NamedTuple

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from active6d_core.object_model import ObjectModel
from active6d_core.se3 import invert, make_transform
from active6d_perception.compiled import compiled
from active6d_perception.model.model_views import visible_from

_MODEL_POINTS = 400
_NEAREST = 0.05  # diameters between the points of a pair
_DISTANCE_BINS = 20  # of the diameter
_ANGLE_BINS = 15  # of pi
_ROTATION_BINS = 30  # of 2 pi
#: Votes for one reference point. A heap of mugs casts about ten thousand; noise would cast a million.
_MOST_VOTES = 40_000


class PairTable(NamedTuple):
    """The point pairs of a model, sorted by their feature."""

    starts: np.ndarray
    """(f + 1,) first pair of each feature"""
    reference: np.ndarray
    """(p,) int32 reference point of each pair"""
    rotation: np.ndarray
    """(p,) float32 angle of the second point about the first one's normal, radians"""
    references: int
    """number of reference points"""
    diameter: float
    """of the model, metres"""


class PairVoting:
    """Voting for poses with the point pairs of a model, which are indexed by their features."""

    def __init__(self, model: ObjectModel) -> None:
        points, faces = trimesh.sample.sample_surface_even(model.mesh, _MODEL_POINTS, seed=0)
        points, normals = np.asarray(points), np.asarray(model.mesh.face_normals[faces])
        eyes = 6 * model.diameter * np.asarray(trimesh.creation.icosphere(2).vertices)
        visible = visible_from(model.mesh, eyes, points, normals)
        first, second = np.nonzero((visible.T.astype(np.float32) @ visible.astype(np.float32)) > 0)
        if model.symmetry.axis is not None:
            # Points on one circle about the axis are equivalent reference points: keep a narrow wedge of them.
            first, second = _keep_wedge(points, model.symmetry.axis, first, second)
        frames = _frames(points, normals)
        references = np.unique(first)
        self._reference_frames = frames[references]
        feature = _model_features(points, normals, first, second, model.diameter)
        kept = np.flatnonzero(feature >= 0)
        order = kept[np.argsort(feature[kept], kind="stable")]
        self._table = PairTable(
            np.searchsorted(feature[order], np.arange(_DISTANCE_BINS * _ANGLE_BINS**3 + 1)),
            np.searchsorted(references, first[order]).astype(np.int32),
            _angle_about_normal(frames[first[order]], points[second[order]]).astype(np.float32),
            len(references),
            model.diameter,
        )

    def candidates(self, points: np.ndarray, normals: np.ndarray, references: np.ndarray, peaks: int) -> np.ndarray:
        """The poses with the most votes at each reference point.

        Args:
            points: (n, 3) scene points in the optical frame, metres, about a twentieth of the diameter apart.
            normals: (n, 3) unit normals facing the camera.
            references: (r,) indices of the reference points.
            peaks: number of poses per reference point.

        Returns:
            (r * peaks, 4, 4) ``T_camera_object``, metres.
        """
        frames = _frames(points[references], normals[references])
        best = _vote(points, normals, references, frames, self._table, peaks)
        reference, rotation_bin = np.divmod(best.ravel(), _ROTATION_BINS)
        angle = (rotation_bin + 0.5) * (2 * np.pi / _ROTATION_BINS)
        about_normal = make_transform(Rotation.from_rotvec(angle[:, None] * [1.0, 0.0, 0.0]).as_matrix(), np.zeros(3))
        return np.repeat(invert(frames), peaks, axis=0) @ about_normal @ self._reference_frames[reference]


@compiled
def _pair_feature(p: np.ndarray, m: np.ndarray, q: np.ndarray, n: np.ndarray, diameter: float) -> int:
    """Quantised distance and angles of two (3,) points with (3,) normals; -1 if they are too near or too far apart."""
    x, y, z = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    distance = np.sqrt(x * x + y * y + z * z)
    if not _NEAREST * diameter < distance < diameter:
        return -1
    feature = int(distance * (_DISTANCE_BINS / diameter))
    cosines = (
        (m[0] * x + m[1] * y + m[2] * z) / distance,
        (n[0] * x + n[1] * y + n[2] * z) / distance,
        m[0] * n[0] + m[1] * n[1] + m[2] * n[2],
    )
    for cosine in cosines:
        angle = np.arccos(min(max(cosine, -1.0), 1.0))
        feature = feature * _ANGLE_BINS + min(int(angle * (_ANGLE_BINS / np.pi)), _ANGLE_BINS - 1)
    return feature


@compiled
def _model_features(
    points: np.ndarray, normals: np.ndarray, first: np.ndarray, second: np.ndarray, diameter: float
) -> np.ndarray:
    """(k,) features of k pairs of points."""
    result = np.empty(len(first), np.int64)
    for index in range(len(first)):
        i, j = first[index], second[index]
        result[index] = _pair_feature(points[i], normals[i], points[j], normals[j], diameter)
    return result


@compiled
def _vote(
    points: np.ndarray, normals: np.ndarray, references: np.ndarray, frames: np.ndarray, table: PairTable, peaks: int
) -> np.ndarray:
    """(r, peaks) cells with the most votes of each reference point: its number in the model, and a bin of rotation."""
    best = np.empty((len(references), peaks), np.int64)
    votes = np.empty((table.references, _ROTATION_BINS), np.int32)
    features, rotations = np.empty(len(points), np.int64), np.empty(len(points))
    for row in range(len(references)):
        own, P = references[row], frames[row]
        pairs, total = 0, 0
        for other in range(len(points)):
            q = points[other]
            feature = _pair_feature(points[own], normals[own], q, normals[other], table.diameter)
            if feature < 0 or table.starts[feature + 1] == table.starts[feature]:
                continue
            features[pairs] = feature
            rotations[pairs] = np.arctan2(
                P[2, 0] * q[0] + P[2, 1] * q[1] + P[2, 2] * q[2] + P[2, 3],
                P[1, 0] * q[0] + P[1, 1] * q[1] + P[1, 2] * q[2] + P[1, 3],
            )
            pairs += 1
            total += table.starts[feature + 1] - table.starts[feature]
        votes[:] = 0
        for pair in range(0, pairs, total // _MOST_VOTES + 1):
            for match in range(table.starts[features[pair]], table.starts[features[pair] + 1]):
                difference = rotations[pair] - table.rotation[match]
                turn = int(np.floor(difference * (_ROTATION_BINS / (2 * np.pi)))) % _ROTATION_BINS
                votes[table.reference[match], turn] += 1
        _find_peaks(votes, best[row])
    return best


@compiled
def _find_peaks(votes: np.ndarray, best: np.ndarray) -> None:
    """Write into ``best`` the cells with the most votes, where neighbouring rotations count half."""
    height = np.full(len(best), -1.0)
    for reference in range(len(votes)):
        for turn in range(_ROTATION_BINS):
            beside = votes[reference, turn - 1] + votes[reference, (turn + 1) % _ROTATION_BINS]
            value = votes[reference, turn] + 0.5 * beside
            place = len(best)
            while place > 0 and value > height[place - 1]:
                place -= 1
            if place == len(best):
                continue
            for lower in range(len(best) - 1, place, -1):
                best[lower], height[lower] = best[lower - 1], height[lower - 1]
            best[place], height[place] = reference * _ROTATION_BINS + turn, value


def _keep_wedge(
    points: np.ndarray, axis: np.ndarray, first: np.ndarray, second: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    side = np.cross(axis, [1.0, 0.0, 0.0] if abs(axis[0]) < 0.9 else [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    azimuth = np.arctan2(points @ np.cross(axis, side), points @ side)
    kept = np.abs(azimuth)[first] < np.pi / 8
    return first[kept], second[kept]


def _frames(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(n, 4, 4) transforms that move each point to the origin and its normal onto +x."""
    helper = np.where((np.abs(normals[:, :1]) < 0.9), [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    y = np.cross(normals, helper)
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    R = np.stack([normals, y, np.cross(normals, y)], axis=1)
    return make_transform(R, -np.einsum("nij,nj->ni", R, points))


def _angle_about_normal(frames: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(n,) angles about +x, radians, of (n, 3) points in (n, 4, 4) frames."""
    local = np.einsum("nij,nj->ni", frames[:, :3, :3], points) + frames[:, :3, 3]
    return np.arctan2(local[:, 2], local[:, 1])
