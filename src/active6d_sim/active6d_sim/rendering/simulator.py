"""The simulated camera without ROS: its views, the goals that it accepts, and its travel times."""

import numpy as np

from active6d_core.camera import DEFAULT_CAMERA, PinholeCamera, View
from active6d_core.object_model import ObjectModel
from active6d_core.se3 import is_rigid
from active6d_core.view_sphere import ViewSphere
from active6d_sim.rendering.active_stereo import ActiveStereo
from active6d_sim.rendering.renderer import RenderedView, SceneRenderer
from active6d_sim.rendering.sensor_registry import Sensor
from active6d_sim.scenes.scene import Scene

NANOSECONDS = 1_000_000_000


class GoalError(ValueError):
    """The camera cannot reach a view goal; the text says why."""


class Simulator:
    """An RGB-D camera that can take a view from any pose in a scene."""

    def __init__(
        self,
        scene: Scene,
        camera: PinholeCamera = DEFAULT_CAMERA,
        noise: Sensor = ActiveStereo(),
        seed: int = 0,
        model: ObjectModel | None = None,
    ) -> None:
        """
        Args:
            scene: the scene.
            camera: intrinsics of both images.
            noise: of the sensor.
            seed: seed of the sensor's noise and of the scene's appearance.
            model: the objects as they look; those of the scene when None.
        """
        self.scene, self.camera, self.noise, self.seed = scene, camera, noise, seed
        self.renderer = SceneRenderer(scene, model=model, appearance_seed=seed)

    def capture(self, T_world_camera: np.ndarray, stamp: int) -> View:
        """Take a view from (4, 4) ``T_world_camera``; its noise depends on seed and ``stamp`` (nanoseconds) only."""
        return self.sense(self.renderer.render(T_world_camera, self.camera), T_world_camera, stamp, self.noise)

    def sense(self, rendered: RenderedView, T_world_camera: np.ndarray, stamp: int, noise: Sensor) -> View:
        """Simulate the measurement of a view that was rendered from (4, 4) ``T_world_camera``, by the given sensor."""
        rng = np.random.default_rng([self.seed, stamp])
        color, depth = noise.measure(rendered, self.camera, rng)
        return View(stamp, color, depth, self.camera, np.array(T_world_camera, float))


def admit_goal(T_world_goal: np.ndarray, sphere: ViewSphere, *, snap: bool, tolerance: float) -> np.ndarray:
    """Check a view goal, and compute the pose that the camera moves to.

    Args:
        T_world_goal: (4, 4) pose of the optical frame.
        sphere: the hemisphere of views.
        snap: whether the camera moves to the nearest view of the grid instead of the exact goal.
        tolerance: largest distance of a goal from the hemisphere, metres.

    Returns:
        (4, 4) ``T_world_camera``.

    Raises:
        GoalError: the pose is not rigid, not above the table, or off the hemisphere.
    """
    if not is_rigid(T_world_goal):
        raise GoalError("view goal is not a rigid pose")
    position = np.asarray(T_world_goal, float)[:3, 3]
    if position[2] <= 0:
        raise GoalError(f"view goal is below the table (z = {position[2]:.3f} m)")
    radius = float(np.linalg.norm(position))
    if abs(radius - sphere.radius) > tolerance:
        raise GoalError(
            f"view goal is {radius:.3f} m from the bin's centre, "
            f"more than {tolerance} m off the hemisphere of {sphere.radius} m"
        )
    return sphere.pose(sphere.positions[sphere.nearest(position)]) if snap else np.array(T_world_goal, float)


def arrival(stamp: int, seconds: float) -> int:
    """Stamp (ns) of the view after a move that takes so many seconds, at least 0.1 s later."""
    return stamp + max(round(seconds * NANOSECONDS), NANOSECONDS // 10)
