"""Selection between the poses that one instance could have, by what the depth image says for and against each.

The same linear function of the evidence serves every object. Its weights are those of a conditional logit, fitted on
validation views of the shipped objects by ``active6d_tools.studies.fit_pose_selection``.
"""

import json
from pathlib import Path

import numpy as np

from active6d_core.object_model import ObjectModel
from active6d_perception.estimators.measured_image import MeasuredImage
from active6d_perception.estimators.pose_evidence import (
    EVIDENCE,
    FITTING,
    NEAR,
    VIOLATED,
    Judge,
    comparable_share,
    explained_shares,
    weigh_poses,
)
from active6d_perception.estimators.score_model import ScoreModel
from active6d_perception.model.length_scale import length_scale
from active6d_perception.model.model_views import model_views
from active6d_perception.model.outline import outline_of
from active6d_perception.model.surface_grid import SurfaceGrid, surface_grid
from active6d_perception.model.visible_samples import visible_samples

#: What poses are compared by: the evidence of the depth image, three of its shares also of the surface that is neither
#: occluded nor unknown, and the share of the instance's points that fit.
FEATURES = (*EVIDENCE, "fitting_comparable", "violated_comparable", "near_comparable", "explained")
#: Weights of the features.
SELECTION_FILE = Path(__file__).parent / "pose_selection.json"

_TOLERANCE = 0.006  # metres
_ALIKE = 0.7
_BEYOND = 0.03  # diameters
_SAMPLES = 256


def judge_of(
    model: ObjectModel,
    part: np.ndarray | None = None,
    samples: int = _SAMPLES,
    tolerance: float = _TOLERANCE,
    alike: float = _ALIKE,
) -> Judge:
    """What poses of an object are judged by.

    Args:
        model: the object.
        part: (s,) bool, the samples of :func:`.model_views` to judge by; None for all.
        samples: largest number for each view direction.
        tolerance: metres, for an object of 0.14 m; see :class:`.Judge`.
        alike: least cosine between normals of a fitting sample.
    """
    views = model_views(model)
    part = np.ones(len(views.points), bool) if part is None else part
    chosen = visible_samples(views, part, samples, model.mesh.area)
    return Judge(chosen, outline_of(model), tolerance * length_scale(model), alike, _BEYOND * model.diameter)


class PoseSelection:
    """Compares poses of an object.

    Args:
        model: the object.
        part: (s,) bool, the samples of :func:`.model_views` to judge by; None for all.
    """

    def __init__(self, model: ObjectModel, part: np.ndarray | None = None) -> None:
        self._judge = judge_of(model, part)
        self._grid = surface_grid(model)
        self._weights = ScoreModel.from_dict(json.loads(SELECTION_FILE.read_text()), FEATURES)

    def value(
        self, T_camera_object: np.ndarray, image: MeasuredImage, of_instances: tuple[np.ndarray, np.ndarray, np.ndarray]
    ) -> np.ndarray:
        """Values to compare poses of one instance by; higher is better.

        Args:
            T_camera_object: (n, c, 4, 4) poses, c for each instance, metres.
            image: what was measured.
            of_instances: points, normals and number of points of the n instances, see :func:`.explained_shares`.

        Returns:
            (n, c).
        """
        return self._weights.margin(self.features(T_camera_object, image, of_instances))

    def features(
        self, T_camera_object: np.ndarray, image: MeasuredImage, of_instances: tuple[np.ndarray, np.ndarray, np.ndarray]
    ) -> np.ndarray:
        """(n, c, f) :data:`FEATURES` of the poses; arguments as for :meth:`value`."""
        return pose_features(T_camera_object, self._judge, self._grid, image, of_instances)


def pose_features(
    T_camera_object: np.ndarray,
    judge: Judge,
    grid: SurfaceGrid,
    image: MeasuredImage,
    of_instances: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> np.ndarray:
    """(n, c, f) :data:`FEATURES`; arguments as for :meth:`PoseSelection.value`, judge and grid are the object's."""
    T = np.ascontiguousarray(T_camera_object)
    evidence = weigh_poses(T.reshape(-1, 4, 4), judge, image).reshape(*T.shape[:2], len(EVIDENCE))
    shares = evidence[..., [FITTING, VIOLATED, NEAR]] / comparable_share(evidence)[..., None]
    explained = explained_shares(T, *of_instances, grid, judge.tolerance)
    return np.concatenate([evidence, shares, explained[..., None]], axis=-1)
