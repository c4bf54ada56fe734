"""Node ``attention_policy``: accumulated objects in, attention and the next view out, until the budget is spent."""

from dataclasses import dataclass, field

import numpy as np
import yaml
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import PointCloud2

from active6d_agent.policies.registry import Decision, Observation, choose_policy, create_policy, list_policies
from active6d_core.hypotheses import SceneObjects
from active6d_core.object_model import load_object
from active6d_core.registry import AUTOMATIC
from active6d_core.ros.conversions import (
    MessageError,
    attention_to_cloud,
    make_header,
    objects_from_cloud,
    points_from_cloud,
    pose_stamped_to_transform,
    stamp_to_ns,
    transform_to_pose,
)
from active6d_core.ros.node import GraphNode, StampSynchronizer, run_node
from active6d_core.view_sphere import ViewSphere


@dataclass
class _Episode:
    """Views since ``start`` (ns), the camera's positions by stamp, and how it ended."""

    start: int
    positions: dict[int, np.ndarray] = field(default_factory=dict)
    ended: bool = False


class AttentionPolicyNode(GraphNode):
    """Publishes ``attention`` and ``view_goal`` once a stamp's ``objects``, ``objects/unexplained`` and ``camera/pose``
    are there, T times.

    After the T-th move, or when the policy stops, ``episode/end`` says why. A newer ``episode/start`` begins the next
    episode; without one (a camera that knows no episodes) the first view does. The same view again publishes the same
    messages again.
    """

    def __init__(self, **node_arguments) -> None:
        super().__init__("attention_policy", **node_arguments)
        self.object_name = self.declare("object", "mug", "name of the object that fills the bin")
        policy = self.declare(
            "policy",
            AUTOMATIC,
            "which policy chooses views; auto: the learned one where weights ship for the object",
            choices=[AUTOMATIC, *list_policies()],
        )
        self.policy_name = choose_policy(self.object_name) if policy == AUTOMATIC else policy
        self.policy_parameters = self.declare("policy_parameters", "{}", "the policy's own parameters, a YAML mapping")
        self.steps = self.declare("steps", 5, "budget of moves T; T moves are T + 1 views", minimum=0, maximum=10_000)
        self.metres = self.declare("metres", 0.0, "budget of metres along the hemisphere, 0 for none", minimum=0.0)
        self.seed = self.declare("seed", 0, "of the policy's randomness", minimum=0)
        self.sphere, self.allowed = self._declare_views()
        latched = self.declare("latched_camera", True, "camera/pose is transient-local, false for plain drivers")
        self.attention = self.output(PointCloud2, "attention")
        self.goal = self.output(PoseStamped, "view_goal")
        self.end = self.output(DiagnosticArray, "episode/end", latched=True)
        self.input(PointCloud2, "objects", self._on_objects, latched=True)
        self.input(PointCloud2, "objects/unexplained", self._on_unexplained, latched=True)
        self.camera_input(PoseStamped, "camera/pose", self._on_pose, latched)
        self.input(DiagnosticArray, "episode/start", self._on_start, latched=True)
        self._forget()

    def setup(self) -> None:
        """Load the object and the policy."""
        try:
            parameters = yaml.safe_load(self.policy_parameters)
        except yaml.YAMLError:
            parameters = None
        if not isinstance(parameters, dict):
            raise ValueError(f"{self.get_name()}: parameter 'policy_parameters' must be a YAML mapping")
        self.policy = create_policy(self.policy_name, load_object(self.object_name), **parameters)
        self._forget()

    def _forget(self) -> None:
        self._episode: _Episode | None = None
        self._latest: tuple[int, SceneObjects, np.ndarray] | None = None
        self._published: list = []
        self._views = StampSynchronizer(["objects", "objects/unexplained", "camera/pose"], self._on_view)

    def _declare_views(self) -> tuple[ViewSphere, np.ndarray]:
        """The grid of views and which of them the robot can reach."""
        radius = self.declare("radius", 0.8, "of the hemisphere of views, metres", minimum=0.01)
        elevations = self.declare("elevations_degrees", [15.0, 30.0, 45.0, 60.0, 75.0], "levels of the grid")
        azimuths = self.declare("azimuths", 20, "views per level, evenly spaced from world +x", minimum=1, maximum=3600)
        low = self.declare("reach_elevation_min_degrees", 0.0, "lowest view in reach", minimum=0.0, maximum=90.0)
        high = self.declare("reach_elevation_max_degrees", 90.0, "highest view in reach", minimum=0.0, maximum=90.0)
        centre = self.declare("reach_azimuth_degrees", 0.0, "middle of the sector in reach, from world +x")
        width = self.declare("reach_sector_degrees", 360.0, "width of the sector in reach", minimum=0.0, maximum=360.0)
        views = self.declare("reach_views", [-1], "numbers of the views in reach, -1 for all of the sector")
        sphere = ViewSphere(radius, tuple(elevations), azimuths)
        azimuth, elevation = np.degrees(sphere.angles(sphere.positions)).T
        allowed = (elevation >= low - 1e-6) & (elevation <= high + 1e-6)
        allowed &= np.abs(np.mod(azimuth - centre + 180.0, 360.0) - 180.0) <= width / 2 + 1e-6
        if list(views) != [-1]:
            if not all(0 <= view < len(sphere) for view in views):
                raise ValueError(f"{self.get_name()}: parameter 'reach_views' must be within 0 and {len(sphere) - 1}")
            allowed &= np.isin(np.arange(len(sphere)), views)
        if not allowed.any():
            raise ValueError(f"{self.get_name()}: the parameters 'reach_*' leave no view of the grid")
        return sphere, allowed

    def _on_start(self, message: DiagnosticArray) -> None:
        start = stamp_to_ns(message.header.stamp)
        if self._episode is not None and start <= self._episode.start:
            return
        positions = {} if self._episode is None else self._episode.positions
        self._begin_episode(start)
        # The first view may have overtaken the announcement of its episode.
        self._episode.positions = {stamp: position for stamp, position in positions.items() if stamp >= start}
        if self._latest is not None and self._latest[0] >= start:
            self._decide(*self._latest)

    def _begin_episode(self, start: int) -> None:
        self._episode = _Episode(start)
        self.policy.reset(np.random.default_rng([self.seed, start]))

    def _on_objects(self, message: PointCloud2) -> None:
        stamp = stamp_to_ns(message.header.stamp)
        objects = objects_from_cloud(message, self.world_frame)
        if self._is_latest(stamp):
            for publisher, published in self._published:
                publisher.publish(published)
            return
        self._views.add("objects", stamp, objects)

    def _on_unexplained(self, message: PointCloud2) -> None:
        stamp = stamp_to_ns(message.header.stamp)
        points = points_from_cloud(message, self.world_frame)
        if not self._is_latest(stamp):
            self._views.add("objects/unexplained", stamp, points)

    def _on_pose(self, message: PoseStamped) -> None:
        stamp = stamp_to_ns(message.header.stamp)
        T_world_camera = pose_stamped_to_transform(message, self.world_frame)
        if not self._is_latest(stamp):
            self._views.add("camera/pose", stamp, T_world_camera[:3, 3])

    def _is_latest(self, stamp: int) -> bool:
        return self._latest is not None and stamp == self._latest[0]

    def _on_view(self, stamp: int, view: dict) -> None:
        if self._episode is None:
            self._begin_episode(stamp)
        if stamp < self._episode.start:
            raise MessageError(f"view of {stamp * 1e-9:.3f} s is older than the episode")
        self._latest = (stamp, view["objects"], view["objects/unexplained"])
        self._episode.positions[stamp] = view["camera/pose"]
        self._published = []
        if not self._episode.ended:
            with self.measure(stamp):
                self._decide(*self._latest)

    def _decide(self, stamp: int, objects: SceneObjects, unexplained: np.ndarray) -> None:
        positions = np.stack(list(self._episode.positions.values()))
        travelled = self.sphere.path_length(positions)
        steps_left = self.steps - (len(positions) - 1)
        if steps_left <= 0:
            self._finish(stamp, f"budget of {self.steps} moves spent", positions, travelled)
            return
        metres_left = self.metres - travelled if self.metres > 0 else np.inf
        observation = Observation(
            objects, positions, self.sphere, self.allowed, steps_left, metres_left, unexplained=unexplained
        )
        decision = self.policy.decide(observation)
        self._publish_attention(stamp, objects, decision)
        if decision.stop:
            reason = "policy is content" if observation.candidates().any() else "no reachable view is left"
            self._finish(stamp, reason, positions, travelled)
        else:
            goal = PoseStamped(header=make_header(stamp, self.world_frame))
            goal.pose = transform_to_pose(self.sphere.pose(decision.position))
            self._publish(self.goal, goal)

    def _publish_attention(self, stamp: int, objects: SceneObjects, decision: Decision) -> None:
        centres = objects.T_world_object[:, :3, 3]
        cloud = attention_to_cloud(centres, decision.attention, decision.attended, stamp, self.world_frame)
        self._publish(self.attention, cloud)

    def _finish(self, stamp: int, reason: str, positions: np.ndarray, travelled: float) -> None:
        self._episode.ended = True
        values = {
            "policy": self.policy_name,
            "seed": str(self.seed),
            "moves": str(len(positions) - 1),
            "metres": f"{travelled:.6f}",
        }
        status = DiagnosticStatus(level=DiagnosticStatus.OK, name="episode", message=reason, hardware_id="active6d")
        status.values = [KeyValue(key=key, value=value) for key, value in values.items()]
        self._publish(self.end, DiagnosticArray(header=make_header(stamp, self.world_frame), status=[status]))

    def _publish(self, publisher, message) -> None:
        publisher.publish(message)
        self._published.append((publisher, message))


def main() -> None:
    """Run the node."""
    run_node(AttentionPolicyNode)


if __name__ == "__main__":
    main()
