"""An RGB-D camera above a simulated heap: a goal moves it, and every move is one view on the camera's topics."""

from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseArray, PoseStamped
from sensor_msgs.msg import CameraInfo, Image
from std_srvs.srv import Trigger

from active6d_core.camera import PinholeCamera
from active6d_core.conversions import (
    MessageError,
    camera_to_info,
    color_to_image,
    depth_to_image,
    make_header,
    pose_stamped_to_transform,
    poses_to_array,
    stamp_to_ns,
    transform_to_pose_stamped,
)
from active6d_core.node import GraphNode, run_node
from active6d_core.optional_outputs import TransformOutput
from active6d_core.view_sphere import ViewSphere
from active6d_sim.scene_store import SPLITS, find_scene
from active6d_sim.sensor import SensorNoise
from active6d_sim.simulator import NANOSECONDS, GoalError, Simulator, admit_goal, arrival


class CameraSimulatorNode(GraphNode):
    """``view_goal`` in; the camera's topics, ``episode/start`` and, for scoring only, ``ground_truth/poses`` out.

    The first view comes by itself. All topics are latched, so that a node that starts late gets the last view.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__("camera_simulator", **options)
        self._object = self.declare("object", "mug", "name of the object that fills the bin")
        self._scene_name = self.declare("scene", "", "a stored scene such as mug/test/3; empty drops a new heap by seed")
        self._seed = self.declare("seed", 0, "of the heap, the first view, the looks and the noise", minimum=0)
        self._start_view = self.declare("start_view", -1, "number of the grid's view to start from, -1 draws it by seed")
        self._snap = self.declare("snap_to_grid", True, "go to the grid's view nearest to a goal, not exactly there")
        self._tolerance = self.declare(
            "goal_tolerance", 0.05, "metres that a goal may be off the hemisphere", minimum=0.0
        )
        self._speed = self.declare("camera_speed", 0.25, "metres per second of simulated time", minimum=1e-3)
        noise = self.declare("noise_scale", 1.0, "strength of the sensor's noise; 0 is a perfect sensor", minimum=0.0)
        self._noise = SensorNoise().scaled(noise)
        self._camera = PinholeCamera.from_field_of_view(
            self.declare("width", 640, "of the images, pixels", minimum=16, maximum=4096),
            self.declare("height", 480, "of the images, pixels", minimum=16, maximum=4096),
            self.declare("field_of_view", 60.0, "across the image, degrees", minimum=5.0, maximum=150.0),
        )
        self._sphere = ViewSphere(self.declare("radius", 0.8, "of the hemisphere of views, metres", minimum=0.1))
        if not -1 <= self._start_view < len(self._sphere):
            raise ValueError(f"{self.get_name()}: parameter 'start_view' must be within -1 and {len(self._sphere) - 1}")
        self._stamp = 0
        self._color = self.output(Image, "camera/color/image_raw", latched=True)
        self._depth = self.output(Image, "camera/depth/image_raw", latched=True)
        self._info = self.output(CameraInfo, "camera/color/camera_info", latched=True)
        self._pose = self.output(PoseStamped, "camera/pose", latched=True)
        self._truth = self.output(PoseArray, "ground_truth/poses", latched=True)
        self._start = self.output(DiagnosticArray, "episode/start", latched=True)
        self._transforms = TransformOutput(self)
        self.input(PoseStamped, "view_goal", self._on_goal)
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_service(Trigger, "~/next_scene", self._on_next_scene)

    def setup(self) -> None:
        """Drop or load the scene."""
        self._load(self._scene_name, self._seed)

    def begin(self) -> None:
        """Start an episode."""
        self._begin_episode()

    def _load(self, scene_name: str, seed: int) -> None:
        scene = find_scene(self._object, scene_name, seed)
        self._simulator = Simulator(scene, self._camera, self._noise, self._seed)

    def _begin_episode(self) -> None:
        scene = self._simulator.scene
        start = self._start_view
        if start < 0:
            start = int(np.random.default_rng([self._seed, scene.seed]).integers(len(self._sphere)))
        self._stamp = arrival(self._stamp, 0.0, self._speed) if self._stamp else NANOSECONDS
        values = {"object": self._object, "scene": scene.name, "seed": str(self._seed), "start_view": str(start)}
        status = DiagnosticStatus(level=DiagnosticStatus.OK, name="episode", message=f"episode in {scene.name}")
        status.values = [KeyValue(key=key, value=value) for key, value in values.items()]
        self._start.publish(DiagnosticArray(header=make_header(self._stamp, self.world_frame), status=[status]))
        self._truth.publish(poses_to_array(scene.T_world_object, self._stamp, self.world_frame))
        self._move_to(self._sphere.pose(self._sphere.positions[start]))

    def _move_to(self, T_world_camera: np.ndarray) -> None:
        """Publish the view from there, with the current stamp."""
        stamp = self._stamp
        self._T_world_camera = T_world_camera
        with self.measure(stamp):
            view = self._simulator.capture(T_world_camera, stamp)
            self._transforms.publish({self.camera_frame: T_world_camera}, stamp, self.world_frame)
            self._pose.publish(transform_to_pose_stamped(T_world_camera, stamp, self.world_frame))
            self._info.publish(camera_to_info(view.camera, stamp, self.camera_frame))
            self._color.publish(color_to_image(view.color, stamp, self.camera_frame))
            self._depth.publish(depth_to_image(view.depth, stamp, self.camera_frame))

    def _on_goal(self, message: PoseStamped) -> None:
        decided_at = stamp_to_ns(message.header.stamp)
        if 0 < decided_at < self._stamp:
            raise MessageError(f"stale goal, decided at {decided_at * 1e-9:.3f} s, now it is {self._stamp * 1e-9:.3f} s")
        T_world_goal = pose_stamped_to_transform(message, self.world_frame)
        try:
            T_world_camera = admit_goal(T_world_goal, self._sphere, snap=self._snap, tolerance=self._tolerance)
        except GoalError as error:
            raise MessageError(str(error)) from error
        arc = self._sphere.arc(self._T_world_camera[:3, 3], T_world_camera[:3, 3])
        self._stamp = arrival(self._stamp, float(arc), self._speed)
        self._move_to(T_world_camera)

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """A new episode in the same scene."""
        return self._answer(response, lambda: None)

    def _on_next_scene(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """A new episode in the next stored scene of the split, or in a heap dropped by the next seed."""
        return self._answer(response, self._load_next)

    def _load_next(self) -> None:
        scene = self._simulator.scene
        if not self._scene_name:
            self._load("", scene.seed + 1)
            return
        split, index = scene.name.split("/")[-2:]
        self._load(f"{split}/{(int(index) + 1) % SPLITS[split]}", self._seed)

    def _answer(self, response: Trigger.Response, prepare) -> Trigger.Response:
        if not self._active:
            response.message = "the camera is not active"
            return response
        try:
            prepare()
        except ValueError as error:
            response.message = str(error)
            return response
        self._begin_episode()
        response.success = True
        response.message = f"episode in {self._simulator.scene.name}"
        return response


def main() -> None:
    """Entry point of ``ros2 run active6d_sim camera_simulator``."""
    run_node(CameraSimulatorNode)


if __name__ == "__main__":
    main()
