"""Node ``camera_adapter``: one view for every goal out of a camera driver's free-running stream."""

from collections import deque
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from std_srvs.srv import Trigger

from active6d_bringup.camera.preflight import check_pose_lag, check_pose_rate, check_pose_stamp, check_skew
from active6d_bringup.camera.rectification import RECTIFIED, are_rectified
from active6d_bringup.camera.stream import SECOND, ArrivalGate, FrameMatcher, GateLimits, PoseHistory, Verdict
from active6d_bringup.camera.view_maker import ViewMaker
from active6d_bringup.nodes.driver_inputs import DriverInputs
from active6d_core.camera import View
from active6d_core.ros import topics
from active6d_core.ros.conversions import (
    MessageError,
    OutdatedError,
    camera_to_info,
    color_to_image,
    depth_to_image,
    pose_stamped_to_transform,
    pose_to_transform,
    stamp_to_ns,
    transform_to_pose_stamped,
)
from active6d_core.ros.episode_messages import EpisodeStart, GoalState, GoalStatus
from active6d_core.ros.heartbeat import Awaited
from active6d_core.ros.node import GraphNode
from active6d_core.ros.runner import run_node
from active6d_core.ros.transform_input import TransformInput

_NOT_SET = [0.0] * 7
_PENDING = 16
_CHECK_SECONDS = 3.0


class CameraAdapterNode(GraphNode):
    """Takes what a driver publishes, and publishes the camera's topics of the graph.

    A view is published when the camera stands still where ``view_goal`` asked it to be. The first view is taken where
    the camera stands when the node starts. What is wrong is said once, in words.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__("camera_adapter", **options)
        self._declare_inputs()
        self._declare_gate()
        self._color = self.output(topics.CAMERA_COLOR)
        self._depth = self.output(topics.CAMERA_DEPTH)
        self._info = self.output(topics.CAMERA_INFO)
        self._pose = self.output(topics.CAMERA_POSE)
        self._start = self.output(topics.EPISODE_START)
        self._status = self.output(topics.GOAL_STATUS)
        self.input(topics.VIEW_GOAL, self._on_goal)
        self.create_service(Trigger, "~/reset", self._on_reset)
        self._transforms: TransformInput | None = None
        self.wall_timer(_CHECK_SECONDS, self._check_streams)

    def _declare_inputs(self) -> None:
        self._driver = DriverInputs(self, self._accept)
        self.declare(
            "hand_eye",
            [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0],
            "x y z qx qy qz qw of the colour camera's optical frame in the frame whose pose pose_topic gives",
        )
        self.declare(
            "depth_to_color",
            _NOT_SET,
            "x y z qx qy qz qw of the depth camera in the colour camera's optical frame; all zero: from /tf",
        )
        self.declare(
            "depth_scale", 0.0, "metres per unit of depth, 0: 0.001 for integers, 1 for floating point", minimum=0.0
        )
        self.declare(
            "rectified",
            "auto",
            "whether images are rectified already; auto: if rect is a word of color_topic",
            choices=tuple(RECTIFIED),
        )
        self.declare("stamp_tolerance", 0.02, "seconds by which stamps of colour and depth may differ", minimum=0.0)
        self.declare("pose_tolerance", 0.05, "seconds by which the nearest pose may differ from the image", minimum=0.0)
        self.declare("object", "mug", "name of the object in the bin, for the record")

    def _declare_gate(self) -> None:
        limits = GateLimits()
        for name, description in {
            "still_seconds": "seconds that the camera must stand still before an image is used",
            "still_metres": "metres of movement that count as none",
            "still_degrees": "degrees of rotation that count as none",
            "arrival_metres": "distance to the goal in metres at which the camera has arrived",
            "arrival_degrees": "angle to the goal in degrees at which the camera has arrived",
            "settle_seconds": "seconds of standing elsewhere after which a goal counts as out of reach",
            "goal_seconds": "seconds after which a goal counts as out of reach, 0: no limit",
        }.items():
            self.declare(name, getattr(limits, name), description, minimum=0.0)

    def setup(self) -> None:
        """Read the parameters."""
        rectified = are_rectified(RECTIFIED[self.value("rectified")], self.value("color_topic"))
        self._maker = ViewMaker(self.value("depth_scale"), rectified)
        self._T_pose_camera = self.rigid_transform("hand_eye")
        extrinsics = self.value("depth_to_color")
        self._T_color_depth = None if extrinsics == _NOT_SET else self.rigid_transform("depth_to_color")
        self._asks_extrinsics = bool(self.value("depth_info_topic")) and self._T_color_depth is None
        if self._transforms is None and (not self.value("pose_topic") or self._asks_extrinsics):
            self._transforms = TransformInput(self)
        self._limits = GateLimits(**{name: self.value(name) for name in GateLimits.__dataclass_fields__})
        self._tolerance = round(self.value("stamp_tolerance") * SECOND)
        self._pose_tolerance = round(self.value("pose_tolerance") * SECOND)
        self._matcher = FrameMatcher(self._tolerance, self._on_pair)
        self._poses = PoseHistory()
        self._gate = ArrivalGate(self._limits, self._poses)
        self._pending: deque[tuple[int, Any, Any]] = deque(maxlen=_PENDING)
        self._infos: dict[str, Any] = {}
        self._goal_stamp: int | None = None
        self._goal: PoseStamped | None = None
        self._begins, self._last_stamp, self._unmatched, self._color_frame = True, -1, 0, ""
        self._asked_until = -1

    def awaited(self) -> Awaited:
        """The stream while a view is due, else the next goal."""
        return Awaited(tuple(self._driver.topics.values()) if self._gate.waiting else (topics.VIEW_GOAL.name,))

    def _accept(self, name: str, message: Any) -> None:
        if name in ("info", "depth_info"):
            self._infos[name] = message
        elif stamp_to_ns(message.header.stamp) == 0:
            self.say_once(f"stamps on {self._driver.topics[name]} are 0: the driver must set header.stamp")
        elif name == "pose":
            if message.header.frame_id != self.world_frame:
                own = f"poses on {self._driver.topics[name]} are in the frame '{message.header.frame_id}'"
                self.say_once(f"{own}, not in '{self.world_frame}': set world_frame if its origin is the bin's centre")
                return
            pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
            self._add_pose(stamp_to_ns(message.header.stamp), pose_to_transform(pose) @ self._T_pose_camera)
        else:
            self._matcher.add(name, stamp_to_ns(message.header.stamp), message)

    def _on_pair(self, stamp: int, color: Any, depth: Any) -> None:
        if not self._gate.waiting:
            return
        self._pending.append((stamp, color, depth))
        self._color_frame = color.header.frame_id
        if self._transforms is not None and self._asks_extrinsics:
            self._asks_extrinsics = False
            self._transforms.request(0, self._on_extrinsics, depth.header.frame_id, self._color_frame)
        if self._transforms is not None and not self.value("pose_topic"):
            self._request_poses(stamp)
        self._advance()

    def _request_poses(self, stamp: int) -> None:
        """Ask /tf for the poses at an image and before it: those at the images of a slow camera show no standing."""
        assert self._transforms is not None
        window = round(self._limits.still_seconds * SECOND)
        if stamp < self._asked_until:
            self._asked_until = -1  # the clock went back
        for at in (stamp - window, stamp - window // 2, stamp):
            if at > self._asked_until:
                self._asked_until = at
                self._transforms.request(at, partial(self._add_pose, at), self._color_frame)

    def _on_extrinsics(self, T_color_depth: np.ndarray) -> None:
        self._T_color_depth = T_color_depth

    def _add_pose(self, stamp: int, T_world_camera: np.ndarray) -> None:
        self._poses.add(stamp, T_world_camera)
        self._advance()

    # Views

    def _advance(self) -> None:
        """Judge the images whose camera pose is known by now."""
        while self._pending and (self._poses.newest or 0) >= self._pending[0][0]:
            stamp, color, depth = self._pending.popleft()
            nearest = self._poses.nearest(stamp)
            if nearest is None or self.say_once(check_pose_stamp(nearest[0], stamp, self._pose_tolerance)):
                continue
            verdict, reason = self._gate.judge(stamp)
            if verdict is Verdict.TAKE:
                self._photograph(stamp, color, depth, nearest[1])
            elif verdict is Verdict.REFUSE:
                self._answer(GoalState.REFUSED, reason)
                self.get_logger().warning(f"goal refused: {reason}")

    def _photograph(self, stamp: int, color: Any, depth: Any, T_world_camera: np.ndarray) -> None:
        if stamp <= self._last_stamp and not self._begins:
            self._gate.waiting = True
            raise MessageError(
                f"stamp {stamp * 1e-9:.3f} s is not after the last view's {self._last_stamp * 1e-9:.3f} s; "
                "if the driver was restarted, call ~/reset"
            )
        if "info" not in self._infos:
            self._gate.waiting = True
            return
        try:
            info, depth_info = self._infos["info"], self._infos.get("depth_info")
            view = self._maker.make(stamp, color, depth, info, T_world_camera, depth_info, self._T_color_depth)
        except ValueError as error:
            # The next image may be better; until then, what is wrong is on record.
            self._gate.waiting = True
            self.say_once(str(error))
            return
        for text in self._maker.warnings:
            self.say_once(text)
        with self.measure(stamp):
            self._publish(view)
        self._answer(GoalState.REACHED)

    def _publish(self, view: View) -> None:
        if self._begins:
            info = {"object": self.value("object"), "scene": "camera"}
            self._start.publish(EpisodeStart(view.stamp, self.world_frame, info).to_message())
        self._begins, self._last_stamp = False, view.stamp
        self._pose.publish(transform_to_pose_stamped(view.T_world_camera, view.stamp, self.world_frame))
        self._info.publish(camera_to_info(view.camera, view.stamp, self.camera_frame))
        self._color.publish(color_to_image(view.color, view.stamp, self.camera_frame))
        self._depth.publish(depth_to_image(view.depth, view.stamp, self.camera_frame))

    def _on_goal(self, message: PoseStamped) -> None:
        T_world_goal = pose_stamped_to_transform(message, self.world_frame)
        stamp = stamp_to_ns(message.header.stamp)
        # A policy that sees no answer publishes its goal again.
        if stamp and message == self._goal:
            return
        if 0 < stamp < self._last_stamp:
            raise OutdatedError(
                f"stale goal, decided at {stamp * 1e-9:.3f} s, now it is {self._last_stamp * 1e-9:.3f} s"
            )
        self._goal, self._goal_stamp = message, stamp
        self._pending.clear()
        self._gate.ask(T_world_goal)
        self._answer(GoalState.ACCEPTED)

    def _answer(self, state: GoalState, reason: str = "") -> None:
        if self._goal_stamp is not None:
            self._status.publish(GoalStatus(self._goal_stamp, self.world_frame, state, reason).to_message())

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """A new episode, from where the camera stands."""
        if not self._active:
            response.message = "camera_adapter is not active"
            return response
        self._begins, self._goal_stamp = True, None
        self._gate.ask(None)
        response.success, response.message = True, "a new episode begins with the next view"
        return response

    # What is wrong

    def _check_streams(self) -> None:
        """Report what keeps a due view away; it changes nothing else."""
        if not (self._active and self._gate.waiting):
            return
        self.say_once(check_skew(self._matcher.skew, self._tolerance))
        if self._matcher.unmatched > self._unmatched:
            self.lose(f"{self._matcher.unmatched - self._unmatched} images of colour or depth without a partner")
            self._unmatched = self._matcher.unmatched
        if not self._matcher.pairs:
            return
        if "info" not in self._infos:
            self.say_once(f"no camera_info comes on {self.value('info_topic')}: set info_topic")
        if self._poses.newest is None:
            self.say_once(f"images come, but no camera pose: {self._why_no_pose()}")
        else:
            window = round(self._limits.still_seconds * SECOND)
            recent = self._poses.between(self._poses.newest - window, self._poses.newest)
            self.say_once(check_pose_rate(len(recent), self._limits.still_seconds))
            if self._pending:
                lag = self._pending[-1][0] - self._poses.newest
                self.say_once(check_pose_lag(lag, self._pose_tolerance, len(self._pending) == _PENDING))

    def _why_no_pose(self) -> str:
        topic = self.value("pose_topic")
        if topic or self._transforms is None:
            return f"nothing on {topic}"
        # There may be transforms, but none of the time of the images.
        stamp = self._pending[-1][0] if self._pending else 0
        return self._transforms.problem(0, self._color_frame) or self._transforms.problem(stamp, self._color_frame)


def main() -> None:
    """Entry point of ``ros2 run active6d_bringup camera_adapter``."""
    run_node(CameraAdapterNode)


if __name__ == "__main__":
    main()
