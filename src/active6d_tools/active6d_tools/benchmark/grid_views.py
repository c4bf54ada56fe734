"""Views of stored scenes from the default grid, with what is true of them; each is rendered once."""

from collections.abc import Sequence

import numpy as np

from active6d_core.camera import DEFAULT_CAMERA, project
from active6d_core.object_model import ObjectModel
from active6d_core.registry import AUTOMATIC
from active6d_core.se3 import invert, transform_points
from active6d_core.view_sphere import ViewSphere
from active6d_perception.estimators.single_view_evaluation import LabelledView
from active6d_sim.rendering.random_sensor import sensor_of
from active6d_sim.rendering.renderer import RenderedView, SceneRenderer
from active6d_sim.rendering.simulator import NANOSECONDS, Simulator
from active6d_sim.scenes.scene import Scene

_FEATURE_SAMPLES = 400


class GridViews:
    """Captures what :class:`.Simulator` would; holds one scene's triangles at a time."""

    def __init__(self, model: ObjectModel, scenes: Sequence[Scene], seed: int, sensor: str = AUTOMATIC) -> None:
        """
        Args:
            model: the scenes' object.
            scenes: by index.
            seed: of sensor noise and appearance.
            sensor: name of the sensor; ``auto`` is the default one, and in a wild scene another one in each view.
        """
        self.model, self.scenes, self._seed, self._sensor = model, scenes, seed, sensor
        self._sphere = ViewSphere()
        self._simulator: Simulator | None = None
        self._rendered: tuple[tuple[int, int], RenderedView, np.ndarray] | None = None
        self._part = feature_surface(model, _FEATURE_SAMPLES)

    def capture(self, index: int, number: int, noise: float) -> LabelledView:
        """View ``number`` of the grid of scene ``index``, with that factor on the sensor noise."""
        scene = self.scenes[index]
        T_world_camera = self._sphere.pose(self._sphere.positions[number])
        if self._simulator is None or self._simulator.scene is not scene:
            self._simulator = Simulator(scene, seed=self._seed)
        if self._rendered is None or self._rendered[0] != (index, number):
            rendered = self._simulator.renderer.render(T_world_camera, DEFAULT_CAMERA)
            seen = feature_seen(self._simulator.renderer, self._part, T_world_camera)
            self._rendered = (index, number), rendered, seen
        _, rendered, seen = self._rendered
        sensor = sensor_of(self._sensor, self.model, scene, number).scaled(noise)
        view = self._simulator.sense(rendered, T_world_camera, (number + 1) * NANOSECONDS, sensor)
        return LabelledView(view, scene.T_world_object, scene.visible_fraction[number], seen)


def feature_surface(model: ObjectModel, count: int) -> tuple[np.ndarray, np.ndarray]:
    """At most ``count`` points, evenly taken, on the model's named parts, and their normals; none without a part."""
    points, normals = model.surface
    masks = [model.feature_mask(feature, points) for feature in model.features]
    part = np.flatnonzero(np.any(masks, axis=0)) if masks else np.zeros(0, int)
    part = part[:: max(1, len(part) // count)]
    return points[part], normals[part]


def feature_seen(
    renderer: SceneRenderer, part: tuple[np.ndarray, np.ndarray], T_world_camera: np.ndarray
) -> np.ndarray:
    """Share of the surface of each true object's named parts that a camera sees.

    Args:
        renderer: of the scene with n true objects.
        part: as from :func:`feature_surface`, s points and their normals.
        T_world_camera: (4, 4) of a camera with the default intrinsics.

    Returns:
        (n,) shares in [0, 1], NaN for an object without such parts.
    """
    T_world_object = renderer.scene.T_world_object
    if not len(part[0]):
        return np.full(len(T_world_object), np.nan)
    eye = T_world_camera[:3, 3]
    points = transform_points(T_world_object, part[0])
    normals = part[1] @ np.swapaxes(T_world_object[:, :3, :3], 1, 2)
    facing = np.einsum("nsi,nsi->ns", points - eye, normals) < 0
    uv = project(transform_points(invert(T_world_camera), points.reshape(-1, 3)), DEFAULT_CAMERA)
    size = (DEFAULT_CAMERA.width, DEFAULT_CAMERA.height)
    inside = ((uv > -0.5) & (uv < np.subtract(size, 0.5))).all(axis=1)
    unhidden = renderer.sees(eye, points.reshape(-1, 3))
    return (facing & (inside & unhidden).reshape(facing.shape)).mean(axis=1)
