"""A camera driver as robots have it, in place of the simulator: a free-running stream with a driver's traits."""

from dataclasses import dataclass, field
from functools import partial

import cv2
import numpy as np
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from active6d_core.camera import PinholeCamera, View
from active6d_core.ros.conversions import (
    camera_to_info,
    color_to_image,
    depth_to_image,
    make_header,
    transform_to_pose,
    transform_to_pose_stamped,
)

FRAME = "camera_color_optical_frame"
TOPICS = {"color_topic": "driver/color", "depth_topic": "driver/depth", "info_topic": "driver/info"}
SECOND = 1_000_000_000


@dataclass
class Traits:
    """What distinguishes a driver from the graph's own camera."""

    best_effort: bool = False
    compressed: bool = False
    unit: float | None = None  # metres per unit of 16UC1 depth, None for 32FC1
    skew: int = 0  # nanoseconds that depth is late
    pose_lag: int = 0
    depth_frame: str = FRAME
    pose_frame: str = "world"
    covariance: bool = False
    info: CameraInfo | None = None
    info_once: bool = False
    rate_hz: float = 15.0
    unstamped: tuple[str, ...] = ()
    depth_info: CameraInfo | None = None
    parameters: dict = field(default_factory=dict)


class SimulatedDriver:
    """Publishes whatever view it is given, frame after frame, on simulated time."""

    def __init__(self, graph, view: View, traits: Traits) -> None:
        self.graph, self.view, self.traits, self.stamp = graph, view, traits, 100 * SECOND
        qos = QoSProfile(
            depth=10,
            reliability=ReliabilityPolicy.BEST_EFFORT if traits.best_effort else ReliabilityPolicy.RELIABLE,
            durability=DurabilityPolicy.VOLATILE,
        )
        image = CompressedImage if traits.compressed else Image
        pose = PoseWithCovarianceStamped if traits.covariance else PoseStamped
        make = partial(graph.node.create_publisher, qos_profile=qos)
        self.color, self.depth = make(image, "driver/color"), make(image, "driver/depth")
        self.info, self.pose = make(CameraInfo, "driver/info"), make(pose, "driver/pose")
        self.depth_info = make(CameraInfo, "driver/depth_info") if traits.depth_info else None
        self.frames = 0

    @property
    def publishers(self):
        return [each for each in (self.color, self.depth, self.info, self.pose, self.depth_info) if each is not None]

    def frame(self) -> None:
        """The next frame of the stream."""
        traits, view = self.traits, self.view
        self.stamp += round(SECOND / traits.rate_hz)
        self.frames += 1
        if self.frames == 1 or not traits.info_once:
            info = traits.info or camera_to_info(view.camera, self.stamp, FRAME)
            self.info.publish(info)
            if self.depth_info is not None:
                self.depth_info.publish(traits.depth_info)
        T = transform_to_pose_stamped(view.T_world_camera, self.stamp + traits.pose_lag, traits.pose_frame)
        if traits.covariance:
            T = PoseWithCovarianceStamped(header=T.header)
            T.pose.pose = transform_to_pose(view.T_world_camera)
        messages = {"color": self._color(), "depth": self._depth(), "pose": T}
        for name, message in messages.items():
            if name in traits.unstamped:
                message.header.stamp.sec = message.header.stamp.nanosec = 0
            getattr(self, name).publish(message)

    def run_until(self, predicate, frames: int = 200) -> None:
        """Publish frames until the predicate holds."""
        self.wait_for_subscribers(self.publishers)
        for _ in range(frames):
            self.frame()
            for _ in range(20):
                self.graph.executor.spin_once(timeout_sec=0.005)
                if predicate():
                    return
        raise AssertionError(f"not within {frames} frames")

    def wait_for_subscribers(self, publishers) -> None:
        """Spin until somebody listens to every one of ``publishers``: a message before that is lost."""
        for publisher in publishers:
            self.graph.spin_until(publisher.get_subscription_count, 5.0, f"a subscriber of {publisher.topic_name}")

    def run(self, frames: int) -> None:
        """Publish some frames, whether anybody listens or not."""
        for _ in range(frames):
            self.frame()
            self.graph.spin_for(0.02)

    def _color(self):
        if not self.traits.compressed:
            return color_to_image(self.view.color, self.stamp, FRAME)
        _, data = cv2.imencode(".jpg", self.view.color[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
        message = CompressedImage(header=make_header(self.stamp, FRAME), format="rgb8; jpeg compressed bgr8")
        message.data = data.tobytes()
        return message

    def _depth(self):
        stamp, traits = self.stamp + self.traits.skew, self.traits
        if traits.unit is None:
            return depth_to_image(self.view.depth, stamp, traits.depth_frame)
        steps = np.rint(np.nan_to_num(self.view.depth) / traits.unit).astype("<u2")
        if traits.compressed:
            _, data = cv2.imencode(".png", steps)
            message = CompressedImage(
                header=make_header(stamp, traits.depth_frame), format="16UC1; compressedDepth png"
            )
            message.data = bytes(12) + data.tobytes()
            return message
        message = Image(header=make_header(stamp, traits.depth_frame), height=steps.shape[0], width=steps.shape[1])
        message.encoding, message.step, message.data = "16UC1", steps.shape[1] * 2, steps.tobytes()
        return message


def plane_view(camera: PinholeCamera, T_world_camera: np.ndarray) -> View:
    """A view of the floor, with a smooth pattern in world coordinates, exact to the pixel."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    return View(0, *look(rays, T_world_camera), camera, T_world_camera)


def look(rays: np.ndarray, T_world_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colour and depth (along z) of the floor, seen along (H, W, 3) rays with z = 1."""
    directions = rays @ T_world_camera[:3, :3].T
    depth = -T_world_camera[2, 3] / directions[..., 2]
    floor = T_world_camera[:3, 3] + directions * depth[..., None]
    waves = np.stack([np.sin(20 * floor[..., 0]), np.sin(20 * floor[..., 1]), np.cos(15 * floor[..., 0])], axis=-1)
    return (127 + 100 * waves).astype(np.uint8), depth.astype(np.float32)
