"""Pose estimation as a library call, without ROS: images in, hypotheses out."""

from dataclasses import replace
from typing import Any

import numpy as np

from active6d_core.camera import PinholeCamera
from active6d_core.depth_cameras import depth_camera, without_flying_pixels
from active6d_core.hypotheses import Hypotheses
from active6d_core.object_model import ObjectModel, load_object
from active6d_core.registry import AUTOMATIC
from active6d_core.rgbd import crop_depth, make_view
from active6d_perception.estimators.registry import create_estimator

# Pixels that an object spans at least, and images that it spans at most, to be worth looking for.
_SMALLEST = 6
_LARGEST = 4


class Active6D:
    """Finds every instance of one object in an RGB-D image.

    >>> from active6d_perception import Active6D
    >>> estimate = Active6D("coffee_cup")
    >>> hypotheses = estimate(rgb, depth, K)  # doctest: +SKIP

    Args:
        object_name: of a description, see ``active6d object list``.
        estimator: its name; ``auto`` is the learned one where the object has weights.
        parameters: of the estimator.

    Attributes:
        model: the object; ``model.T_camera_mesh`` converts poses to the frame of its mesh file.

    Raises:
        ValueError: unknown object, estimator or parameter; the message names it.
    """

    def __init__(self, object_name: str, estimator: str = AUTOMATIC, **parameters: Any) -> None:
        self.model = load_object(object_name)
        self._estimator = create_estimator(estimator, self.model, **parameters)

    def __call__(
        self,
        rgb: np.ndarray,
        depth: np.ndarray,
        camera: PinholeCamera | np.ndarray,
        *,
        depth_scale: float | None = None,
        depth_range: tuple[float, float] | None = None,
        region: tuple[np.ndarray, np.ndarray] | None = None,
        sensor: str | None = None,
        T_world_camera: np.ndarray | None = None,
    ) -> Hypotheses:
        """Estimate poses.

        Args:
            rgb: (H, W, 3) uint8 RGB, registered to the depth image.
            depth: (H, W) metres along the optical axis, or integer millimetres; zeros and infinities are invalid.
            camera: intrinsics, or their (3, 3) matrix K in pixels.
            depth_scale: metres per unit of ``depth``, where the default of :func:`.rgbd.make_view` is wrong.
            depth_range: nearest and farthest distance to use, metres.
            region: lowest and highest corner of the box to use, metres; in the world where ``T_world_camera`` is given,
                else in the camera's optical frame.
            sensor: kind of depth camera, a name of :data:`.DEPTH_CAMERAS`. It sets ``depth_range`` where that is not
                given, and removes flying pixels of time-of-flight cameras.
            T_world_camera: (4, 4) camera pose.

        Returns:
            Hypotheses with poses in the optical frame, metres, best score first.

        Raises:
            ValueError: the images or the intrinsics cannot be meant; the message says which and why.
        """
        kind = None if sensor is None else depth_camera(sensor)
        view = make_view(rgb, depth, camera, depth_scale=depth_scale, T_world_camera=T_world_camera)
        if kind is not None:
            depth_range = depth_range or kind.depth_range
            if kind.flying_pixels:
                view = replace(view, depth=without_flying_pixels(view.depth))
        view = crop_depth(view, depth_range, region, region_in_world=T_world_camera is not None)
        check_span(self.model, view.depth, view.camera)
        return self._estimator.estimate(view).ranked()


def check_span(model: ObjectModel, depth: np.ndarray, camera: PinholeCamera) -> None:
    """Check that an object at the distance that most of an image shows is no speck and not far larger than the image.

    Args:
        model: the object.
        depth: (H, W) metres, NaN where invalid.
        camera: intrinsics.

    Raises:
        ValueError: it is; the message has the numbers.
    """
    distance = float(np.nanmedian(depth))
    pixels = model.diameter * camera.fx / distance
    if not _SMALLEST < pixels < _LARGEST * max(camera.width, camera.height):
        raise ValueError(
            f"at {distance:.3g} m, {model.name} ({1e3 * model.diameter:.0f} mm) would span {pixels:.0f} "
            f"pixels of {camera.width}; check depth_scale, K and the unit of the mesh"
        )
