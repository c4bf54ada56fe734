"""One view with ground truth that a pose estimator learns from."""

from dataclasses import dataclass

import numpy as np

from active6d_core.camera import View


@dataclass(frozen=True, eq=False)
class TrainingView:
    """What a sensor sees, and the truth, which may have a lower resolution.

    Attributes:
        view: noisy colour and depth.
        surface_depth: (h, w) float32 true depth, metres along z, NaN where there is no surface.
        instance: (h, w) int16 index of the pixel's object in ``T_camera_object``, -1 where there is none.
        T_camera_object: (n, 4, 4) true poses in the optical frame, metres.
        visible_fraction: (n,) share in [0, 1] of each object's silhouette in the image that nothing covers.
    """

    view: View
    surface_depth: np.ndarray
    instance: np.ndarray
    T_camera_object: np.ndarray
    visible_fraction: np.ndarray
