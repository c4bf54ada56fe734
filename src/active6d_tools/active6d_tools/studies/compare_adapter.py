#!/usr/bin/env python3
"""Compare episodes of an ideal camera with those of a free-running driver behind the node camera_adapter.

The driver publishes 15 images a second while the camera moves and stands, distorted by a lens, depth in 16-bit
millimetres and 5 ms later than colour. Both cameras take the same views in the test scenes.

Example: python -m active6d_tools.studies.compare_adapter coffee_cup --episodes 10
"""

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from geometry_msgs.msg import PoseStamped
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image

from active6d_agent.policies.episode_state import Limits
from active6d_agent.policies.registry import create_policy
from active6d_bringup.nodes.camera_adapter import CameraAdapterNode
from active6d_core.camera import DEFAULT_CAMERA, PinholeCamera, View
from active6d_core.metrics import evaluate_scene
from active6d_core.object_model import load_object
from active6d_core.registry import AUTOMATIC
from active6d_core.ros import topics
from active6d_core.ros.conversions import (
    camera_to_info,
    color_to_image,
    image_to_color,
    image_to_depth,
    info_to_camera,
    make_header,
    pose_stamped_to_transform,
    stamp_to_ns,
    transform_to_pose_stamped,
)
from active6d_core.ros.network import DomainClaim, keep_on_this_machine
from active6d_core.ros.node import qos_of
from active6d_core.view_sphere import ViewSphere
from active6d_sim.rendering.random_sensor import sensor_of
from active6d_sim.rendering.simulator import NANOSECONDS, Simulator
from active6d_sim.scenes.scene_store import load_scene
from active6d_tools.direct_episode import DirectRunner, PerceivedView, Perception
from active6d_tools.studies.arguments import study_parser

PERIOD, SKEW = NANOSECONDS // 15, 5_000_000
#: plumb_bob, as of a lens of 70 degrees.
DISTORTION = np.array([-0.12, 0.05, 0.002, -0.001, 0.01])
FRAME = "camera_color_optical_frame"
_MOVING_FRAMES, _MOST_FRAMES = 6, 60


class IdealCamera:
    """Takes the views of the grid without a driver."""

    def __init__(self, simulator: Simulator, perception: Perception, start: int) -> None:
        self._simulator, self._perception, self._sphere = simulator, perception, ViewSphere()
        self._start, self._stamp = start, 0

    def begin(self) -> PerceivedView:
        """The first view."""
        return self.go_to(self._sphere.pose(self._sphere.positions[self._start]))

    def go_to(self, T_world_goal: np.ndarray) -> PerceivedView:
        """The view of the goal."""
        self._stamp += NANOSECONDS
        return self._perception(self._simulator.capture(T_world_goal, self._stamp))


class DrivenCamera:
    """A simulated driver, and the adapter that makes views of its stream."""

    def __init__(self, simulator: Simulator, perception: Perception, start: int) -> None:
        self._simulator, self._perception, self._sphere = simulator, perception, ViewSphere()
        self._start, self._stamp = start, 100 * NANOSECONDS
        self._views: dict[str, list[Any]] = {"color": [], "depth": [], "info": [], "pose": []}
        self._claim = DomainClaim()
        self._context = Context()
        self._context.init(args=[], domain_id=self._claim.domain)
        self._node = Node("driver", context=self._context, start_parameter_services=False, enable_rosout=False)
        names = {"color_topic": "driver/color", "depth_topic": "driver/depth", "info_topic": "driver/info"}
        self._adapter = CameraAdapterNode(context=self._context, overrides={**names, "pose_topic": "driver/pose"})
        self._executor = SingleThreadedExecutor(context=self._context)
        for node in (self._node, self._adapter):
            self._executor.add_node(node)
        self._outputs = [
            self._node.create_publisher(kind, f"driver/{name}", 10)
            for name, kind in {"color": Image, "depth": Image, "info": CameraInfo, "pose": PoseStamped}.items()
        ]
        self._goal = self._node.create_publisher(PoseStamped, topics.VIEW_GOAL.name, qos_of(topics.VIEW_GOAL, 10))
        for name, topic in (
            ("color", topics.CAMERA_COLOR),
            ("depth", topics.CAMERA_DEPTH),
            ("info", topics.CAMERA_INFO),
            ("pose", topics.CAMERA_POSE),
        ):
            box: Callable[[Any], None] = self._views[name].append
            self._node.create_subscription(topic.message_type, topic.name, box, qos_of(topic, 10))
        self._adapter.start()
        self._spin(lambda: all(each.get_subscription_count() for each in [*self._outputs, self._goal]))

    def close(self) -> None:
        """End both nodes."""
        self._executor.shutdown()
        for node in (self._adapter, self._node):
            node.destroy_node()
        self._context.try_shutdown()
        self._claim.release()

    def begin(self) -> PerceivedView:
        """Stream from the first place until the adapter has made a view."""
        self._stand(self._sphere.pose(self._sphere.positions[self._start]))
        return self._stream()

    def go_to(self, T_world_goal: np.ndarray) -> PerceivedView:
        """Publish the goal, and stream on the way and from there."""
        last = stamp_to_ns(self._views["pose"][-1].header.stamp)
        before = self._T_world_camera
        self._goal.publish(transform_to_pose_stamped(T_world_goal, last, "world"))
        for share in np.linspace(0.0, 1.0, _MOVING_FRAMES, endpoint=False):
            middle = (1 - share) * before[:3, 3] + share * T_world_goal[:3, 3]
            # Images on the way show the last place: the adapter must not take them.
            self._publish(self._sphere.pose(middle / np.linalg.norm(middle) * self._sphere.radius))
        self._stand(T_world_goal)
        return self._stream()

    def _stand(self, T_world_camera: np.ndarray) -> None:
        self._T_world_camera = T_world_camera
        self._color, self._depth = distort(self._simulator, T_world_camera, self._stamp)

    def _stream(self) -> PerceivedView:
        count = len(self._views["pose"])
        for _ in range(_MOST_FRAMES):
            self._publish(self._T_world_camera)
            if self._spin(lambda: all(len(box) > count for box in self._views.values()), seconds=0.05):
                return self._perception(self._last())
        raise RuntimeError(f"the adapter made no view of {_MOST_FRAMES} images")

    def _publish(self, T_world_camera: np.ndarray) -> None:
        self._stamp += PERIOD
        info = camera_to_info(DEFAULT_CAMERA, self._stamp, FRAME)
        info.d = DISTORTION.tolist()
        depth = Image(header=make_header(self._stamp + SKEW, FRAME), encoding="16UC1", step=2 * DEFAULT_CAMERA.width)
        depth.height, depth.width, depth.data = *self._depth.shape, self._depth.tobytes()
        pose = transform_to_pose_stamped(T_world_camera, self._stamp, "world")
        messages = color_to_image(self._color, self._stamp, FRAME), depth, info, pose
        for publisher, message in zip(self._outputs, messages, strict=True):
            publisher.publish(message)
        self._spin(lambda: False, seconds=0.02)

    def _spin(self, done: Callable[[], bool], seconds: float = 20.0) -> bool:
        for _ in range(max(1, round(seconds / 0.005))):
            if done():
                return True
            self._executor.spin_once(timeout_sec=0.005)
        return done()

    def _last(self) -> View:
        color, depth, info, pose = (box[-1] for box in self._views.values())
        stamps = {stamp_to_ns(message.header.stamp) for message in (color, depth, info, pose)}
        if len(stamps) != 1:
            raise RuntimeError(f"the adapter's messages have different stamps: {stamps}")
        T = pose_stamped_to_transform(pose, "world")
        return View(stamps.pop(), image_to_color(color), image_to_depth(depth), info_to_camera(info), T)


def distort(simulator: Simulator, T_world_camera: np.ndarray, stamp: int) -> tuple[np.ndarray, np.ndarray]:
    """What a camera with this lens measures: (H, W, 3) uint8, and (H, W) uint16 millimetres, 0 without depth."""
    camera = DEFAULT_CAMERA
    # Wider than the lens sees, with its resolution in the middle.
    wide = PinholeCamera(camera.width + 240, camera.height + 180, camera.fx, camera.fy, camera.cx + 120, camera.cy + 90)
    seen = Simulator(simulator.scene, wide, simulator.noise, simulator.seed).capture(T_world_camera, stamp)
    v, u = np.indices((camera.height, camera.width), dtype=np.float32)
    pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    rays = cv2.undistortPoints(pixels, camera.matrix, DISTORTION).reshape(camera.height, camera.width, 2)
    x = (rays[..., 0] * wide.fx + wide.cx).astype(np.float32)
    y = (rays[..., 1] * wide.fy + wide.cy).astype(np.float32)
    steps = np.rint(1e3 * np.nan_to_num(seen.depth)).astype(np.uint16)
    return cv2.remap(seen.color, x, y, cv2.INTER_LINEAR), cv2.remap(steps, x, y, cv2.INTER_NEAREST)


def compare(object_name: str, episodes: int, steps: int, policy: str) -> dict[str, list[float]]:
    """Share of the objects found in each episode, by camera."""
    model, sphere = load_object(object_name), ViewSphere()
    runner = DirectRunner(model, Limits(sphere, np.ones(len(sphere), bool), steps))
    perception = Perception(model)
    found: dict[str, list[float]] = {"ideal": [], "driven": []}
    for number in range(episodes):
        scene = load_scene(object_name, "test", number)
        simulator = Simulator(scene, noise=sensor_of(AUTOMATIC, model, scene), seed=number)
        start = int(np.random.default_rng(number).integers(len(sphere)))
        driven = DrivenCamera(simulator, perception, start)
        try:
            for name, camera in (("ideal", IdealCamera(simulator, perception, start)), ("driven", driven)):
                done = runner.run(create_policy(policy, model), camera, np.random.default_rng(number))
                score = evaluate_scene(model, done.objects[-1].T_world_object, scene.T_world_object)
                found[name].append(score.detection_rate)
        finally:
            driven.close()
        ideal, adapted = (np.mean(found[name]) for name in found)
        print(f"{scene.name}: ideal {found['ideal'][-1]:.3f}, driven {found['driven'][-1]:.3f}", flush=True)
    print(f"{object_name}, {episodes} episodes: found {ideal:.3f} ideal, {adapted:.3f} driven, {adapted - ideal:+.3f}")
    return found


def main() -> None:
    parser = study_parser(__doc__)
    parser.add_argument("--episodes", type=int, default=10, help="number of test scenes (default: %(default)s)")
    parser.add_argument("--steps", type=int, default=5, help="moves in each episode (default: %(default)s)")
    parser.add_argument("--policy", default="unidirectional", help="policy of both (default: %(default)s)")
    arguments = parser.parse_args()
    keep_on_this_machine()
    compare(arguments.object, arguments.episodes, arguments.steps, arguments.policy)


if __name__ == "__main__":
    main()
