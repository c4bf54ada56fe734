"""A small episode of random numbers as the messages that the graph would send, for tests without the real nodes."""

from dataclasses import dataclass

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from scipy.spatial.transform import Rotation

from active6d_core.camera import PinholeCamera, View
from active6d_core.hypotheses import Hypotheses, SceneObjects
from active6d_core.ros import conversions
from active6d_core.se3 import make_transform
from active6d_core.view_sphere import ViewSphere

CAMERA = PinholeCamera.from_field_of_view(32, 24, 60.0)
FIRST = 1_000_000_000
LATCHED = ("camera/", "ground_truth/", "episode/", "hypotheses", "objects")


@dataclass(frozen=True, eq=False)
class StubStep:
    """What one view of the stub episode holds; see ``active6d_bringup.bags.reader.RecordedStep``."""

    view: View
    hypotheses: Hypotheses
    objects: SceneObjects
    unexplained: np.ndarray
    T_world_corrected: np.ndarray
    attention: np.ndarray
    attended: int
    goal: np.ndarray


class StubEpisode:
    """``moves + 1`` views, three hypotheses each, one more object with every view."""

    def __init__(self, seed: int = 0, moves: int = 2, first: int = FIRST, world: str = "world") -> None:
        rng = np.random.default_rng(seed)
        sphere = ViewSphere()
        self.world = world
        self.ground_truth = _poses(rng, 4)
        route = rng.choice(len(sphere), moves + 2, replace=False)
        poses = [sphere.pose(sphere.positions[index]) for index in route]
        self.steps = [
            _step(rng, first + 500_000_000 * index, poses[index], poses[index + 1]) for index in range(moves + 1)
        ]

    def messages(self) -> list[tuple[str, object]]:
        """(topic, message) in the order in which the graph would send them."""
        first, last = self.steps[0].view.stamp, self.steps[-1].view.stamp
        sent = [("episode/start", _status(first, "started", object="mug", scene="mug/seed/3", seed="3", split="seed"))]
        sent.append(("ground_truth/poses", conversions.poses_to_array(self.ground_truth, first, self.world)))
        for step in self.steps:
            sent += self.view_messages(step)
            if step is not self.steps[-1]:
                stamp = step.view.stamp
                positions = step.objects.T_world_object[:, :3, 3]
                attention = conversions.attention_to_cloud(positions, step.attention, step.attended, stamp, self.world)
                sent.append(("attention", attention))
                sent.append(("view_goal", conversions.transform_to_pose_stamped(step.goal, stamp, self.world)))
        return [*sent, ("episode/end", _status(last, "budget of 2 moves spent", policy="random"))]

    def view_messages(self, step: StubStep) -> list[tuple[str, object]]:
        """What camera, estimator and fusion send of one view."""
        view, frame = step.view, "camera_optical_frame"
        stamp = view.stamp
        return [
            ("camera/color/image_raw", conversions.color_to_image(view.color, stamp, frame)),
            ("camera/depth/image_raw", conversions.depth_to_image(view.depth, stamp, frame)),
            ("camera/color/camera_info", conversions.camera_to_info(view.camera, stamp, frame)),
            ("camera/pose", conversions.transform_to_pose_stamped(view.T_world_camera, stamp, self.world)),
            ("hypotheses", conversions.hypotheses_to_cloud(step.hypotheses, stamp, frame)),
            ("hypotheses/poses", conversions.poses_to_array(step.hypotheses.T_camera_object, stamp, frame)),
            (
                "hypotheses/segmentation",
                conversions.segmentation_to_image(step.hypotheses.segmentation, stamp, frame),
            ),
            ("objects", conversions.objects_to_cloud(step.objects, stamp, self.world)),
            ("objects/poses", conversions.poses_to_array(step.objects.T_world_object, stamp, self.world)),
            ("objects/markers", conversions.objects_to_markers(step.objects, "package://x/mug.obj", stamp, self.world)),
            ("objects/unexplained", conversions.points_to_cloud(step.unexplained, stamp, self.world)),
            ("objects/camera_poses", conversions.poses_to_array(step.T_world_corrected[None], stamp, self.world)),
            ("/diagnostics", _status(stamp, "view processed", latency_ms="12.500", views="1")),
        ]


def is_latched(topic: str) -> bool:
    """Whether the contract says transient-local."""
    return topic.startswith(LATCHED)


def _step(rng: np.random.Generator, stamp: int, T_world_camera: np.ndarray, goal: np.ndarray) -> StubStep:
    depth = rng.uniform(0.5, 1.0, (CAMERA.height, CAMERA.width)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.1] = np.nan
    segmentation = rng.integers(0, 4, depth.shape).astype(np.uint16)
    T_camera_object = _poses(rng, 3) + np.pad([[0.7]], ((2, 1), (3, 0)))  # in front of the camera
    hypotheses = Hypotheses.from_masks(T_camera_object, rng.random(3), np.array([1, 2, 3]), segmentation, depth)
    count = 1 + stamp // 500_000_000 % 5
    objects = SceneObjects(
        T_world_object=_poses(rng, count),
        verification=rng.random(count),
        score=rng.random(count),
        box=rng.random((count, 4)),
        depth=rng.uniform(0.5, 1.0, count),
        support=rng.integers(1, 6, count),
        spread=rng.random(count) * 0.01,
        probability=rng.random(count),
        entropy=rng.random(count),
    )
    color = rng.integers(0, 256, (*depth.shape, 3)).astype(np.uint8)
    view = View(stamp, color, depth, CAMERA, T_world_camera)
    attention, attended = rng.random(count), int(rng.integers(count))
    corrected = T_world_camera.copy()
    corrected[:3, 3] += 0.005
    unexplained = rng.uniform(-0.2, 0.2, (7, 3))
    return StubStep(view, hypotheses, objects, unexplained, corrected, attention, attended, goal)


def _poses(rng: np.random.Generator, count: int) -> np.ndarray:
    return make_transform(Rotation.random(count, random_state=rng).as_matrix(), rng.uniform(-0.2, 0.2, (count, 3)))


def _status(stamp: int, message: str, **values: str) -> DiagnosticArray:
    status = DiagnosticStatus(name="/pose_estimator", message=message, hardware_id="active6d")
    status.values = [KeyValue(key=key, value=value) for key, value in values.items()]
    report = DiagnosticArray(status=[status])
    report.header.stamp = conversions.ns_to_stamp(stamp)
    return report
