"""From instances to poses of their bodies: many candidates, registered to the depth image, which then selects one.

The network proposes a pose, which may be upside down or wrong altogether where the object or the camera differs from
what it was trained on. So its near-symmetric twins and the best orientations of a coarse search compete with it. This
is the same for every object. The *body* is what a rotation about an axis of near symmetry leaves as it is: a mug
without its handle.
"""

import numpy as np

from active6d_core.object_model import ObjectModel
from active6d_perception.estimators.dense.canonical_frame import (
    AXIS_ANGLES,
    AxisRotation,
    CanonicalFrame,
    rotation_about_z,
)
from active6d_perception.estimators.dense.decoding import Instances, axis_rotation_probability
from active6d_perception.estimators.dense.measured_surface import MeasuredSurface
from active6d_perception.estimators.dense.orientation_search import OrientationSearch
from active6d_perception.estimators.image_registration import register
from active6d_perception.estimators.measured_image import MeasuredImage
from active6d_perception.estimators.pose_selection import PoseSelection
from active6d_perception.model.ambiguity import ambiguity_of
from active6d_perception.model.length_scale import length_scale
from active6d_perception.model.model_views import model_views
from active6d_perception.model.visible_samples import VisibleSamples, visible_samples

# Orientations of the coarse search per instance. Where the whole surface shows the orientation, there are more of them.
_SEARCHED, _SEARCHED_ALL = 6, 16
# Candidates per instance that are registered with many samples, the best after a first registration with few.
_KEPT = 3
_FEW, _MANY, _MOST = 64, 192, 384
# Largest distances of pairs in the stages of both, metres. Votes for centres of slivers are 20 mm off.
_ROUGH, _FINE, _FINEST = (0.02, 0.008), (0.008, 0.004), (0.004,)
_ITERATIONS = 3  # for each distance; more change nothing on the validation views


class PoseSearch:
    """Proposes, registers and selects poses of one object's instances."""

    def __init__(self, model: ObjectModel, canonical_frame: CanonicalFrame) -> None:
        views, ambiguity = model_views(model), ambiguity_of(model)
        self._canonical_frame, self._twins = canonical_frame, ambiguity.twins
        self._search = OrientationSearch(model, canonical_frame)
        self._searched = _SEARCHED_ALL if canonical_frame.axis_rotation is AxisRotation.VISIBLE else _SEARCHED
        # At an arbitrary rotation about the axis, the part that shows the rotation would be in the wrong place.
        body = ~ambiguity.telling
        self._selection = PoseSelection(model, body)
        self._few, self._many = (visible_samples(views, body, count, model.mesh.area) for count in (_FEW, _MANY))
        self._whole = visible_samples(views, np.ones(len(body), bool), _MOST, model.mesh.area)
        self._scale = length_scale(model)

    def poses(self, instances: Instances, surface: MeasuredSurface) -> np.ndarray:
        """(n, 4, 4) ``T_camera_object`` of the instances' bodies, metres; the rotation about an axis is arbitrary."""
        measured, points = surface.of_instances, surface.compared_points
        candidates = self._candidates(instances, surface, measured)
        value = self._selection.value(candidates, surface.detail, points)
        best = np.argsort(-value, axis=1, kind="stable")[:, :_KEPT]
        kept = np.take_along_axis(candidates, best[..., None, None], axis=1)
        kept = self._register(kept, measured, self._many, _FINE)
        chosen = self._selection.value(kept, surface.detail, points).argmax(axis=1)
        return kept[np.arange(len(kept)), chosen]

    def compare(self, instances: Instances, surface: MeasuredSurface) -> tuple[np.ndarray, np.ndarray]:
        """All candidates, registered in full, and what they are compared by; for fitting the selection.

        Returns:
            (n, c, 4, 4) ``T_camera_object``, metres, the network's own first; and (n, c, f) their :data:`.FEATURES`.
        """
        measured = surface.of_instances
        T = self._register(self._candidates(instances, surface, measured), measured, self._many, _FINE)
        return T, self._selection.features(T, surface.detail, surface.compared_points)

    def _candidates(self, instances: Instances, surface: MeasuredSurface, measured: MeasuredImage) -> np.ndarray:
        """(n, c, 4, 4) ``T_camera_object`` after the first registration, metres, the network's own first."""
        searched = self._search.candidates(instances, surface, self._searched)
        T_camera_axis = instances.T_camera_axis
        if self._canonical_frame.axis_rotation is AxisRotation.SHOWN_BY_FEATURE:
            # A part at a wrong rotation would hide the body, or be registered to it.
            probability = axis_rotation_probability(T_camera_axis, instances.direction)
            T_camera_axis = T_camera_axis @ rotation_about_z(AXIS_ANGLES[probability.argmax(axis=1)])
        predicted = self._canonical_frame.object_pose(T_camera_axis)[:, None] @ self._twins
        T = np.concatenate([predicted, self._canonical_frame.object_pose(searched)], axis=1)
        return self._register(T, measured, self._few, _ROUGH)

    def refine(self, T_camera_object: np.ndarray, surface: MeasuredSurface) -> np.ndarray:
        """(k, 4, 4) poses that are right within millimetres, registered with all samples."""
        return self._register(T_camera_object, surface.of_instances, self._whole, _FINEST)

    def _register(
        self, T: np.ndarray, measured: MeasuredImage, samples: VisibleSamples, gates: tuple[float, ...]
    ) -> np.ndarray:
        flat = np.ascontiguousarray(T.reshape(-1, 4, 4))
        scaled = self._scale * np.array(gates)
        return register(flat, samples, measured, scaled, _ITERATIONS).reshape(T.shape)
