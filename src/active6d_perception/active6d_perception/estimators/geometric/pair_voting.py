"""Pose candidates from pairs of oriented points, by voting.

The method is that of Drost et al., "Model globally, match locally" (2010), which the paper cites for handcrafted
features. A scene point forms pairs with its neighbours within the object's diameter. Distance and angles of a pair
select similar pairs of the model. Each of these votes for a model point and for a rotation about its normal.
The method tolerates occlusion, and does not need a segmentation of touching identical objects.
"""

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from active6d_core.object_model import ObjectModel
from active6d_core.se3 import invert, make_transform
from active6d_perception.model.model_views import visible_from

_MODEL_POINTS = 400
_DISTANCE_BINS = 20  # of the diameter
_ANGLE_BINS = 15  # of pi
_ROTATION_BINS = 30  # of 2 pi
#: Votes in one view. A heap of mugs casts under six million; noise would cast hundreds of millions.
_MOST_VOTES = 8_000_000


class PairVoting:
    """Voting for poses with the point pairs of a model, which are indexed by their features."""

    def __init__(self, model: ObjectModel) -> None:
        points, faces = trimesh.sample.sample_surface_even(model.mesh, _MODEL_POINTS, seed=0)
        points, normals = np.asarray(points), np.asarray(model.mesh.face_normals[faces])
        self._diameter = model.diameter
        eyes = 6 * model.diameter * np.asarray(trimesh.creation.icosphere(2).vertices)
        visible = visible_from(model.mesh, eyes, points, normals)
        first, second = np.nonzero((visible.T.astype(np.float32) @ visible.astype(np.float32)) > 0)
        if model.symmetry.axis is not None:
            # Points on one circle about the axis are equivalent reference points: keep a narrow wedge of them.
            first, second = _keep_wedge(points, model.symmetry.axis, first, second)
        self._frames = _frames(points, normals)
        references = np.unique(first)
        self._reference_frames = self._frames[references]
        feature, kept = self._features(points[first], normals[first], points[second], normals[second])
        first, second = first[kept], second[kept]
        order = np.argsort(feature, kind="stable")
        rotation = _angle_about_normal(self._frames[first], points[second])
        self._pair_reference = np.searchsorted(references, first[order]).astype(np.int32)
        self._pair_rotation = rotation[order].astype(np.float32)
        self._starts = np.searchsorted(feature[order], np.arange(_DISTANCE_BINS * _ANGLE_BINS**3 + 1))

    def candidates(
        self, points: np.ndarray, normals: np.ndarray, references: np.ndarray, peaks: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """The poses with the most votes at each reference point.

        Args:
            points: (n, 3) scene points in the optical frame, metres, about a twentieth of the diameter apart.
            normals: (n, 3) unit normals facing the camera.
            references: (r,) indices of the reference points.
            peaks: number of poses per reference point.

        Returns:
            (r * peaks, 4, 4) ``T_camera_object``, metres, and (r * peaks,) their votes.
        """
        gap = np.linalg.norm(points[references][:, None] - points[None], axis=-1)
        row, column = np.nonzero((gap < self._diameter) & (gap > 0.05 * self._diameter))
        first = references[row]
        feature, kept = self._features(points[first], normals[first], points[column], normals[column])
        row, column = row[kept], column[kept]
        frames = _frames(points[references], normals[references])
        rotation = _angle_about_normal(frames[row], points[column])
        matches = self._starts[feature + 1] - self._starts[feature]
        if (total := int(matches.sum())) > _MOST_VOTES:
            every = slice(None, None, -(-total // _MOST_VOTES))
            row, column, rotation, matches, feature = (
                each[every] for each in (row, column, rotation, matches, feature)
            )
        pair = np.repeat(np.arange(len(row)), matches)
        offset = np.arange(len(pair)) - np.repeat(np.cumsum(matches) - matches, matches)
        model_pair = self._starts[feature][pair] + offset
        difference = rotation[pair] - self._pair_rotation[model_pair]
        rotation_bin = np.floor(difference * (_ROTATION_BINS / (2 * np.pi))).astype(np.int32) % _ROTATION_BINS
        cells = len(self._reference_frames) * _ROTATION_BINS
        index = (row[pair] * cells).astype(np.int64) + self._pair_reference[model_pair] * _ROTATION_BINS + rotation_bin
        votes = np.bincount(index, minlength=len(references) * cells).reshape(len(references), -1, _ROTATION_BINS)
        smooth = (votes + 0.5 * (np.roll(votes, 1, axis=2) + np.roll(votes, -1, axis=2))).reshape(len(references), -1)
        best = np.argpartition(smooth, -peaks, axis=1)[:, -peaks:]
        reference, rotation_bin = np.divmod(best.ravel(), _ROTATION_BINS)
        angle = (rotation_bin + 0.5) * (2 * np.pi / _ROTATION_BINS)
        about_normal = make_transform(Rotation.from_rotvec(angle[:, None] * [1.0, 0.0, 0.0]).as_matrix(), np.zeros(3))
        poses = np.repeat(invert(frames), peaks, axis=0) @ about_normal @ self._reference_frames[reference]
        return poses, np.take_along_axis(smooth, best, axis=1).ravel()

    def _features(
        self, p1: np.ndarray, n1: np.ndarray, p2: np.ndarray, n2: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """(m,) quantised features of the pairs with a usable distance, and (n,) bool, which these are."""
        d = p2 - p1
        distance = np.linalg.norm(d, axis=1)
        kept = (distance > 0.05 * self._diameter) & (distance < self._diameter)
        d, distance, n1, n2 = d[kept] / distance[kept, None], distance[kept], n1[kept], n2[kept]
        feature = (distance * (_DISTANCE_BINS / self._diameter)).astype(np.intp)
        for a, b in ((n1, d), (n2, d), (n1, n2)):
            angle = np.arccos(np.clip(np.einsum("ni,ni->n", a, b), -1, 1))
            feature = feature * _ANGLE_BINS + np.minimum(
                (angle * (_ANGLE_BINS / np.pi)).astype(np.intp), _ANGLE_BINS - 1
            )
        return feature, kept


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
