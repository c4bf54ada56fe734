"""What a simulated and a recorded camera share: a goal moves them, and every move is one view on their topics."""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseArray, PoseStamped
from sensor_msgs.msg import CameraInfo, Image
from std_srvs.srv import Trigger

from active6d_core.camera import View
from active6d_core.ros.conversions import (
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
from active6d_core.ros.node import GraphNode
from active6d_core.ros.optional_outputs import TransformOutput
from active6d_core.view_sphere import ViewSphere
from active6d_sim.rendering.simulator import NANOSECONDS, GoalError, arrival


class MovingCameraNode(GraphNode):
    """``view_goal`` in; the camera's topics, ``episode/start`` and, for scoring only, ``ground_truth/poses`` out.

    The first view comes by itself. All topics are latched, so that a node that starts late gets the last view.
    """

    def __init__(self, name: str, **options: Any) -> None:
        super().__init__(name, **options)
        self.object_name = self.declare("object", "mug", "name of the object that fills the bin")
        self.seed = self.declare("seed", 0, "of all that is drawn: a heap, its looks, noise, the first view", minimum=0)
        self.start_view = self.declare(
            "start_view", -1, "number of the view to start from, -1 draws it by seed", minimum=-1
        )
        self.tolerance = self.declare(
            "goal_tolerance", 0.05, "metres that a goal may be off the hemisphere", minimum=0.0
        )
        self._speed = self.declare("camera_speed", 0.25, "metres per second of simulated time", minimum=1e-3)
        self.sphere = ViewSphere(self.declare("radius", 0.8, "of the hemisphere of views, metres", minimum=0.1))
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

    # What a subclass provides

    @property
    @abstractmethod
    def scene_name(self) -> str:
        """Of the scene that is loaded."""

    @abstractmethod
    def start_pose(self, view: int) -> np.ndarray:
        """(4, 4) ``T_world_camera`` of the numbered view."""

    @abstractmethod
    def draw_start(self) -> int:
        """Number of the view that the seed begins with."""

    @abstractmethod
    def truth(self, view: int) -> np.ndarray | None:
        """(n, 4, 4) ``T_world_object`` when an episode begins at the numbered view, None where nobody knows."""

    @abstractmethod
    def destination(self, T_world_goal: np.ndarray) -> np.ndarray:
        """(4, 4) ``T_world_camera`` that the camera takes for a goal.

        Raises:
            GoalError: the camera cannot go there.
        """

    @abstractmethod
    def capture(self, T_world_camera: np.ndarray, stamp: int) -> View:
        """The view from a pose that :meth:`start_pose` or :meth:`destination` gave.

        Raises:
            MessageError: there is none, now.
        """

    # Views

    def check_start_view(self, views: int) -> None:
        """Raise ValueError unless there is a view of the number to start from."""
        if self.start_view >= views:
            raise ValueError(f"{self.get_name()}: parameter 'start_view' is {self.start_view}, the last is {views - 1}")

    def begin(self) -> None:
        """Start an episode: announce it and publish its first view."""
        start = self.draw_start() if self.start_view < 0 else self.start_view
        stamp = arrival(self._stamp, 0.0, self._speed) if self._stamp else NANOSECONDS
        self._photograph(self.start_pose(start), stamp, start)

    def _photograph(self, T_world_camera: np.ndarray, stamp: int, start: int | None = None) -> None:
        """Go there and publish the view; ``start`` is the number of an episode's first one."""
        with self.measure(stamp):
            view = self.capture(T_world_camera, stamp)
            self._stamp, self._T_world_camera = stamp, T_world_camera
            if start is not None:
                self._announce(start)
            self._transforms.publish({self.camera_frame: T_world_camera}, stamp, self.world_frame)
            self._pose.publish(transform_to_pose_stamped(T_world_camera, stamp, self.world_frame))
            self._info.publish(camera_to_info(view.camera, stamp, self.camera_frame))
            self._color.publish(color_to_image(view.color, stamp, self.camera_frame))
            self._depth.publish(depth_to_image(view.depth, stamp, self.camera_frame))

    def _announce(self, start: int) -> None:
        values = {"object": self.object_name, "scene": self.scene_name}
        values |= {"seed": str(self.seed), "start_view": str(start)}
        status = DiagnosticStatus(level=DiagnosticStatus.OK, name="episode", message=f"episode in {self.scene_name}")
        status.values = [KeyValue(key=key, value=value) for key, value in values.items()]
        self._start.publish(DiagnosticArray(header=make_header(self._stamp, self.world_frame), status=[status]))
        T_world_object = self.truth(start)
        if T_world_object is not None:
            self._truth.publish(poses_to_array(T_world_object, self._stamp, self.world_frame))

    def _on_goal(self, message: PoseStamped) -> None:
        decided_at, now = stamp_to_ns(message.header.stamp), self._stamp
        if 0 < decided_at < now:
            raise MessageError(f"stale goal, decided at {decided_at * 1e-9:.3f} s, now it is {now * 1e-9:.3f} s")
        T_world_goal = pose_stamped_to_transform(message, self.world_frame)
        try:
            T_world_camera = self.destination(T_world_goal)
        except GoalError as error:
            raise MessageError(str(error)) from error
        arc = self.sphere.arc(self._T_world_camera[:3, 3], T_world_camera[:3, 3])
        self._photograph(T_world_camera, arrival(now, float(arc), self._speed))

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """A new episode in the same scene."""
        return self.restart(response, lambda: None)

    def restart(self, response: Trigger.Response, prepare: Callable[[], None]) -> Trigger.Response:
        """Answer a service: prepare, then begin an episode. A ValueError in either becomes the response's message."""
        if not self._active:
            response.message = f"{self.get_name()} is not active"
            return response
        try:
            prepare()
            self.begin()
        except ValueError as error:
            response.message = str(error)
            return response
        response.success = True
        response.message = f"episode in {self.scene_name}"
        return response
