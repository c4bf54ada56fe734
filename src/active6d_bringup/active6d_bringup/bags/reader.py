"""Reading a recorded episode back into the core's types. Needs the message classes of ROS, but no rclpy.

The bag may be this project's own or any rosbag2 folder with the topics of the contract, under any one namespace.
"""

from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from active6d_bringup.bags.camera_topics import CameraOptions, with_options
from active6d_bringup.bags.index import BagIndex, read_bag
from active6d_bringup.bags.source import BagError
from active6d_bringup.bags.writer import TYPESTORE
from active6d_bringup.camera.preflight import check_depth_unit
from active6d_core.camera import View
from active6d_core.hypotheses import Hypotheses, SceneObjects
from active6d_core.ros.conversions import (
    MessageError,
    attention_from_cloud,
    hypotheses_from_cloud,
    image_to_color,
    image_to_depth,
    image_to_segmentation,
    info_to_camera,
    latencies_from_diagnostics,
    objects_from_cloud,
    points_from_cloud,
    pose_stamped_to_transform,
    poses_from_array,
    refusing,
    stamp_to_ns,
)
from active6d_core.ros.episode_messages import EpisodeEnd, EpisodeStart, episode_info
from active6d_core.ros.topics import (
    CAMERA_POSE,
    CAMERA_POSES,
    CAMERA_TOPICS,
    DIAGNOSTICS,
    EPISODE_END,
    EPISODE_START,
    GROUND_TRUTH,
    OBJECTS_MARKERS,
)


@dataclass(frozen=True, eq=False)
class RecordedStep:
    """One view of an episode and what the graph made of it. What was not recorded is None.

    Attributes:
        view: the images, intrinsics and camera pose; ``view.stamp`` names the step.
        hypotheses: of this view, in the camera's frame, with ``hypotheses.segmentation``.
        objects: everything accumulated up to this view, in the world.
        unexplained: (k, 3) places of the surface that is of none of the objects, in the world, metres.
        T_world_corrected: (4, 4) pose of the camera as fusion corrected it after this view.
        attention: (n,) weight per object.
        attended: index of the attended object.
        goal: ``T_world_camera`` (4, 4) that the policy asked for next.
        latency_ms: node name to the milliseconds it worked on this view.
    """

    view: View
    hypotheses: Hypotheses | None = None
    objects: SceneObjects | None = None
    unexplained: np.ndarray | None = None
    T_world_corrected: np.ndarray | None = None
    attention: np.ndarray | None = None
    attended: int | None = None
    goal: np.ndarray | None = None
    latency_ms: dict[str, float] = field(default_factory=dict)

    @property
    def stamp(self) -> int:
        """Nanoseconds."""
        return self.view.stamp

    @property
    def T_world_camera(self) -> np.ndarray:
        """(4, 4) pose of the camera that the objects are consistent with: the corrected one, else the given one."""
        return self.view.T_world_camera if self.T_world_corrected is None else self.T_world_corrected


@dataclass(frozen=True, eq=False)
class EpisodeRecord:
    """A recorded episode.

    Attributes:
        folder: of the bag.
        info: what the camera and the policy said of the episode (object, scene, split, seed, policy, ...).
        steps: one per view, in order.
        ground_truth: (n, 4, 4) ``T_world_object`` of the scene, None where the bag has none (a real camera).
        end_reason: why the policy stopped, None if the recording was cut off before.
        world_frame: name of the world's frame.
        damage: what is missing or damaged in the bag, in words.
        settings: node name to its parameters when recording; empty where the bag does not have them.
    """

    folder: Path
    info: dict[str, str]
    steps: list[RecordedStep]
    ground_truth: np.ndarray | None
    end_reason: str | None
    world_frame: str
    damage: tuple[str, ...] = ()
    settings: dict[str, dict[str, Any]] = field(default_factory=dict)

    @property
    def object(self) -> str | None:
        """Name of the object."""
        return self.info.get("object")

    @property
    def scene(self) -> str | None:
        """Name of the scene."""
        return self.info.get("scene")

    @property
    def seed(self) -> int | None:
        """Seed of scene and sensor noise."""
        text = self.info.get("seed", "")
        return int(text) if text.lstrip("-").isdigit() else None

    @property
    def policy(self) -> str | None:
        """Name of the policy."""
        return self.info.get("policy")

    @property
    def positions(self) -> np.ndarray:
        """(t, 3) camera positions in the world, metres."""
        return np.array([step.view.T_world_camera[:3, 3] for step in self.steps]).reshape(-1, 3)


def read_episodes(bag: Path | str | BagIndex, options: CameraOptions = CameraOptions()) -> list[EpisodeRecord]:
    """Every episode of a bag or of its index, in order; a bag without ``episode/start`` is one episode.

    Raises:
        BagError: no bag, a broken one, or one without a complete view.
    """
    index = bag if isinstance(bag, BagIndex) else read_bag(Path(bag), options)
    try:
        messages, latencies = _read_messages(index)
        return _episodes(index, messages, latencies)
    except MessageError as error:
        raise BagError(f"{index.folder}: {error}") from error


def read_episode(folder: Path | str) -> EpisodeRecord:
    """The first episode of a bag.

    Raises:
        BagError: no bag, a broken one, or one without a complete view.
    """
    return read_episodes(folder)[0]


def _read_messages(index: BagIndex) -> tuple[dict[str, dict[int, Any]], dict[int, dict[str, float]]]:
    """Topic and stamp to message, and stamp and node to milliseconds."""
    messages: dict[str, dict[int, Any]] = defaultdict(dict)
    messages |= {topic: index.messages(topic) for topic in index.payloads if topic != OBJECTS_MARKERS.name}
    latencies: dict[int, dict[str, float]] = defaultdict(dict)
    for payload in index.diagnostics:
        try:
            message: Any = TYPESTORE.deserialize_cdr(payload, DIAGNOSTICS.type)
        except Exception as error:
            raise BagError(f"{index.folder}: damaged message of {DIAGNOSTICS.name} ({error})") from error
        latencies[stamp_to_ns(message.header.stamp)].update(latencies_from_diagnostics(message))
    return messages, latencies


def _episodes(
    index: BagIndex, messages: dict[str, dict[int, Any]], latencies: dict[int, dict[str, float]]
) -> list[EpisodeRecord]:
    views = sorted(set.intersection(*(set(messages[topic.name]) for topic in CAMERA_TOPICS)))
    if not views:
        what = "holds no complete view (color, depth, camera_info and pose of one stamp)"
        raise BagError("; ".join([f"{index.folder}: {what}", *index.damage]))
    starts = [views[0], *(start for start in sorted(messages[EPISODE_START.name]) if views[0] < start <= views[-1])]
    limits = [*starts[1:], views[-1] + 1]
    return [_episode(index, messages, latencies, *span, views) for span in zip(starts, limits, strict=True)]


def _episode(
    index: BagIndex,
    messages: dict[str, dict[int, Any]],
    latencies: dict[int, dict[str, float]],
    start: int,
    limit: int,
    views: list[int],
) -> EpisodeRecord:
    """The episode whose views have stamps in [start, limit)."""

    def within(topic: str) -> list[Any]:
        return [message for stamp, message in sorted(messages[topic].items()) if start <= stamp < limit]

    world = messages[CAMERA_POSE.name][start].header.frame_id
    truth = within(GROUND_TRUTH.name)
    begun = [EpisodeStart.from_message(message) for message in within(EPISODE_START.name)]
    ended = [EpisodeEnd.from_message(message) for message in within(EPISODE_END.name)]
    # The recording of a replayed foreign bag has no episode/start that names the object.
    named = index.settings.get("pose_estimator", {}).get("object")
    return EpisodeRecord(
        folder=index.folder,
        info=({"object": str(named)} if named else {}) | episode_info(begun, ended),
        steps=[_step(messages, latencies.get(view, {}), view, world) for view in views if start <= view < limit],
        ground_truth=poses_from_array(truth[-1], world) if truth else None,
        end_reason=ended[-1].reason if ended else None,
        world_frame=world,
        damage=index.damage,
        settings=index.settings,
    )


def _step(messages: dict[str, dict[int, Any]], latency_ms: dict[str, float], stamp: int, world: str) -> RecordedStep:
    at = {topic: by_stamp[stamp] for topic, by_stamp in messages.items() if stamp in by_stamp}
    message = at["camera/depth/image_raw"]
    depth = image_to_depth(message)
    T_world_camera = pose_stamped_to_transform(at[CAMERA_POSE.name], world)
    problem = check_depth_unit(depth, float(np.linalg.norm(T_world_camera[:3, 3])))
    if problem:
        raise MessageError(f"view of {stamp * 1e-9:.3f} s: {with_options(problem)}")
    with refusing():
        color, camera = image_to_color(at["camera/color/image_raw"]), info_to_camera(at["camera/color/camera_info"])
        view = View(stamp, color, depth, camera, T_world_camera)
    hypotheses = objects = unexplained = corrected = attention = attended = goal = None
    if "hypotheses" in at and "hypotheses/segmentation" in at:
        segmentation = image_to_segmentation(at["hypotheses/segmentation"])
        hypotheses = hypotheses_from_cloud(at["hypotheses"], segmentation, message.header.frame_id)
    if "objects" in at:
        objects = objects_from_cloud(at["objects"], world)
    if "objects/unexplained" in at:
        unexplained = points_from_cloud(at["objects/unexplained"], world)
    if CAMERA_POSES.name in at:
        poses = poses_from_array(at[CAMERA_POSES.name], world)
        corrected = poses[-1] if len(poses) else None
    if "attention" in at:
        attention, attended = attention_from_cloud(at["attention"], world)
    if "view_goal" in at:
        goal = pose_stamped_to_transform(at["view_goal"], world)
    return RecordedStep(view, hypotheses, objects, unexplained, corrected, attention, attended, goal, latency_ms)
