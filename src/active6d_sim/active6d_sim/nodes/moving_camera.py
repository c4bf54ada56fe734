"""What a simulated and a recorded camera share: a goal moves them, and every move publishes one view."""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from std_srvs.srv import Trigger

from active6d_core.camera import View
from active6d_core.ros import topics
from active6d_core.ros.clock_output import ClockOutput
from active6d_core.ros.conversions import (
    MessageError,
    OutdatedError,
    camera_to_info,
    color_to_image,
    depth_to_image,
    pose_stamped_to_transform,
    poses_to_array,
    stamp_to_ns,
    transform_to_pose_stamped,
)
from active6d_core.ros.episode_messages import EpisodeStart, GoalState, GoalStatus
from active6d_core.ros.heartbeat import Awaited
from active6d_core.ros.node import GraphNode
from active6d_core.ros.optional_outputs import TransformOutput
from active6d_core.view_sphere import ViewSphere
from active6d_sim.rendering.simulator import NANOSECONDS, GoalError, arrival


class MovingCameraNode(GraphNode):
    """Subscribes to ``view_goal`` and answers each goal on ``view_goal/status``.

    It publishes the camera's topics, ``episode/start`` and, for scoring only, ``ground_truth/poses``. The first view
    needs no goal. All topics are transient local, so that a node that starts late gets the last view.
    """

    def __init__(self, name: str, **options: Any) -> None:
        super().__init__(name, **options)
        self.declare("object", "mug", "name of the object that fills the bin")
        self.declare("seed", 0, "seed of the random generator (pile, appearance, sensor noise, start view)", minimum=0)
        self.declare("start_view", -1, "number of the view to start from, -1: drawn by the seed", minimum=-1)
        self.declare(
            "goal_tolerance",
            0.05,
            "largest distance in metres of an accepted goal from the hemisphere of views",
            minimum=0.0,
        )
        self.declare("camera_speed", 0.25, "speed of the camera in metres per second of simulated time", minimum=1e-3)
        self.declare("radius", 0.8, "radius of the hemisphere of views in metres", minimum=0.1)
        self._stamp, self._episode = 0, ""
        self._goal: PoseStamped | None = None
        self._clock_output = ClockOutput(self)
        self._color = self.output(topics.CAMERA_COLOR)
        self._depth = self.output(topics.CAMERA_DEPTH)
        self._info = self.output(topics.CAMERA_INFO)
        self._pose = self.output(topics.CAMERA_POSE)
        self._truth = self.output(topics.GROUND_TRUTH)
        self._start = self.output(topics.EPISODE_START)
        self._status = self.output(topics.GOAL_STATUS)
        self._transforms = TransformOutput(self)
        self.input(topics.VIEW_GOAL, self._on_goal)
        self.create_service(Trigger, "~/reset", self._on_reset)

    # What a subclass provides

    @property
    @abstractmethod
    def scene_name(self) -> str:
        """Name of the scene that is loaded."""

    @abstractmethod
    def start_pose(self, view: int) -> np.ndarray:
        """(4, 4) ``T_world_camera`` of the numbered view."""

    @abstractmethod
    def draw_start(self) -> int:
        """Number of the view that the seed begins with."""

    @abstractmethod
    def truth(self, view: int) -> np.ndarray | None:
        """(n, 4, 4) ``T_world_object`` when an episode begins at the numbered view, None where it is not known."""

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

    def travel(self, T_world_camera: np.ndarray) -> float:
        """Go to what :meth:`destination` gave last; the seconds of simulated time that this takes."""
        arc = self.sphere.arc(self._T_world_camera[:3, 3], T_world_camera[:3, 3])
        return float(arc) / self._speed

    # Views

    def setup(self) -> None:
        """Read the parameters."""
        self.object_name, self.seed = self.value("object"), self.value("seed")
        self.sphere, self.tolerance = ViewSphere(self.value("radius")), self.value("goal_tolerance")
        self._speed = self.value("camera_speed")

    def check_start_view(self, views: int) -> None:
        """Raise ValueError unless there is a view of the number to start from."""
        start = self.value("start_view")
        if start >= views:
            raise ValueError(f"{self.get_name()}: parameter 'start_view' is {start}, the last is {views - 1}")

    def awaited(self) -> Awaited:
        """The next goal."""
        return Awaited(("view_goal",))

    def begin(self) -> None:
        """Start an episode: announce it and publish its first view."""
        start = self.value("start_view")
        if start < 0:
            start = self.draw_start()
        stamp = arrival(self._stamp, 0.0) if self._stamp else NANOSECONDS
        self._photograph(self.start_pose(start), stamp, start)

    def _photograph(self, T_world_camera: np.ndarray, stamp: int, start: int | None = None) -> None:
        """Go there and publish the view; ``start`` is the number of an episode's first one."""
        with self.measure(stamp):
            view = self.capture(T_world_camera, stamp)
            self._stamp, self._T_world_camera = stamp, T_world_camera
            self._clock_output.set(stamp)
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
        # No random number: the same seed gives the same messages.
        self._episode = f"{self.scene_name}, view {start}, seed {self.seed}, {self._stamp * 1e-9:.3f} s"
        values["id"] = self._episode
        self._start.publish(EpisodeStart(self._stamp, self.world_frame, values).to_message())
        T_world_object = self.truth(start)
        if T_world_object is not None:
            self._truth.publish(poses_to_array(T_world_object, self._stamp, self.world_frame))

    def _on_goal(self, message: PoseStamped) -> None:
        stamp = stamp_to_ns(message.header.stamp)
        # A policy that sees no answer publishes its goal again. A second refusal would count for the next goal.
        if stamp and message == self._goal:
            return
        self._goal = message
        try:
            T_world_camera = self._admit(message)
            self._answer(stamp, GoalState.ACCEPTED)
            self._photograph(T_world_camera, arrival(self._stamp, self.travel(T_world_camera)))
        except MessageError as error:
            self._answer(stamp, GoalState.REFUSED, str(error))
            raise
        self._answer(stamp, GoalState.REACHED)

    def _admit(self, message: PoseStamped) -> np.ndarray:
        """Where the camera goes for a goal; a goal that was decided on an older view raises OutdatedError."""
        decided_at, now = stamp_to_ns(message.header.stamp), self._stamp
        if 0 < decided_at < now:
            raise OutdatedError(f"stale goal, decided at {decided_at * 1e-9:.3f} s, now it is {now * 1e-9:.3f} s")
        try:
            return self.destination(pose_stamped_to_transform(message, self.world_frame))
        except GoalError as error:
            raise MessageError(str(error)) from error

    def _answer(self, stamp: int, state: GoalState, reason: str = "") -> None:
        self._status.publish(GoalStatus(stamp, self.world_frame, state, reason, self._episode).to_message())

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
