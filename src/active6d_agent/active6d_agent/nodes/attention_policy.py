"""Node ``attention_policy``: subscribes to the fused objects, publishes attention and the next view."""

from functools import partial
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.timer import Timer
from sensor_msgs.msg import PointCloud2

from active6d_agent.policies.episode_state import EpisodeState, Limits
from active6d_agent.policies.registry import Decision, choose_policy, create_policy, list_policies
from active6d_core.hypotheses import SceneObjects
from active6d_core.object_model import load_object
from active6d_core.registry import AUTOMATIC
from active6d_core.ros import topics
from active6d_core.ros.conversions import (
    attention_to_cloud,
    objects_from_cloud,
    points_from_cloud,
    stamp_to_ns,
    transform_to_pose_stamped,
)
from active6d_core.ros.episode_messages import EpisodeEnd, EpisodeStart, GoalState, GoalStatus, check_episode
from active6d_core.ros.heartbeat import Awaited
from active6d_core.ros.node import GraphNode
from active6d_core.ros.runner import run_node
from active6d_core.ros.view_inputs import ViewInputs
from active6d_core.view_sphere import ViewSphere

#: What belongs to a view beside the camera's pose, part to topic.
_OTHERS = {"objects": "objects", "unexplained": "objects/unexplained"}
_TICKS_PER_TIMEOUT = 10
#: A goal that got no answer for so long is published again: the camera may not have discovered this node before.
_REPEAT_SECONDS = 3.0


class AttentionPolicyNode(GraphNode):
    """Publishes ``attention`` and ``view_goal`` for each view whose objects, unexplained surface and pose are there.

    A goal that the camera refuses or does not reach in time is replaced by another one with the same stamp. After T
    moves, or when the policy stops, ``episode/end`` gives the reason. A newer ``episode/start`` begins the next
    episode; without one (a camera that knows no episodes) the first view does. The same view again publishes the same
    messages again.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__("attention_policy", **options)
        self.declare("object", "mug", "name of the object that fills the bin")
        self.declare(
            "policy",
            AUTOMATIC,
            "policy that chooses views; auto: view-attention if it has weights for the object, else unidirectional",
            choices=[AUTOMATIC, *list_policies()],
        )
        self.declare("policy_parameters", "{}", "parameters of the policy, a YAML mapping")
        self.declare("steps", 5, "budget of moves T; T moves give T + 1 views", minimum=0, maximum=10_000)
        self.declare("metres", 0.0, "travel budget along the hemisphere in metres, 0: no limit", minimum=0.0)
        self.declare("seconds", 0.0, "time from the first view in which moves may begin, 0: no limit", minimum=0.0)
        self.declare("seed", 0, "seed of the policy's random generator", minimum=0)
        self.declare(
            "goal_timeout",
            30.0,
            "seconds in which the camera must reach a goal before another view is chosen, 0: no limit",
            minimum=0.0,
        )
        self._declare_views()
        self.attention = self.output(topics.ATTENTION)
        self.goal = self.output(topics.VIEW_GOAL)
        self.end = self.output(topics.EPISODE_END)
        self.input(topics.OBJECTS, self._on_objects)
        self.input(topics.UNEXPLAINED, self._on_unexplained)
        self._views = ViewInputs(self, ["pose"], self._on_view, _OTHERS, self._on_start)
        self.input(topics.GOAL_STATUS, self._on_status)
        self._timers: list[Timer] = []
        self._forget()

    def setup(self) -> None:
        """Load the object and the policy."""
        timeout = self.value("goal_timeout")
        budget = {name: self.value(name) for name in ("steps", "metres", "seconds")}
        self._budget = Limits(*self._read_views(), **budget, goal_timeout=timeout)
        name, policy = self.value("object"), self.value("policy")
        model = load_object(name)
        self.policy_name = choose_policy(name) if policy == AUTOMATIC else policy
        self.policy = create_policy(self.policy_name, model, **self.mapping("policy_parameters"))
        if timeout > 0:
            # Ticks, not a deadline: time in which this process could not listen does not count.
            tick = timeout / _TICKS_PER_TIMEOUT
            self._timers.append(self.wall_timer(tick, partial(self._on_tick, tick)))
        self._repeat_timer = self.wall_timer(_REPEAT_SECONDS, self._repeat_goal)
        self._timers.append(self._repeat_timer)
        self._forget()

    def teardown(self) -> None:
        """Stop counting."""
        while self._timers:
            self.destroy_timer(self._timers.pop())

    def _forget(self) -> None:
        self._episode: EpisodeState | None = None
        self._episode_id = ""
        self._latest: tuple[int, SceneObjects, np.ndarray] | None = None
        self._published: list[tuple[Any, Any]] = []
        self._unanswered: PoseStamped | None = None
        self._views.reset()

    def awaited(self) -> Awaited | None:
        """The next view; nothing after the end of an episode."""
        return None if self._episode is not None and self._episode.ended else self._views.awaited()

    def _declare_views(self) -> None:
        """The grid of views and which of them the robot can reach."""
        self.declare("radius", 0.8, "radius of the hemisphere of views in metres", minimum=0.01)
        self.declare("elevations_degrees", [15.0, 30.0, 45.0, 60.0, 75.0], "elevations of the grid of views in degrees")
        self.declare(
            "azimuths", 20, "views per elevation, evenly spaced from the world's +x axis", minimum=1, maximum=3600
        )
        self.declare(
            "reach_elevation_min_degrees", 0.0, "lowest reachable elevation in degrees", minimum=0.0, maximum=90.0
        )
        self.declare(
            "reach_elevation_max_degrees", 90.0, "highest reachable elevation in degrees", minimum=0.0, maximum=90.0
        )
        self.declare("reach_azimuth_degrees", 0.0, "middle of the reachable sector in degrees from the world's +x axis")
        self.declare(
            "reach_sector_degrees", 360.0, "width of the reachable sector in degrees", minimum=0.0, maximum=360.0
        )
        self.declare("reach_views", [-1], "numbers of the reachable views, [-1]: all views of the sector")

    def _read_views(self) -> tuple[ViewSphere, np.ndarray]:
        """The grid of views and (M,) bool, those of them that the robot can reach."""
        low, high = self.value("reach_elevation_min_degrees"), self.value("reach_elevation_max_degrees")
        centre, width = self.value("reach_azimuth_degrees"), self.value("reach_sector_degrees")
        views = self.value("reach_views")
        sphere = ViewSphere(self.value("radius"), tuple(self.value("elevations_degrees")), self.value("azimuths"))
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

    def _on_start(self, start: EpisodeStart, new: bool) -> None:
        views = {} if new or self._episode is None else self._episode.views_from(start.stamp)
        episode = self._begin_episode(start.stamp)
        self._episode_id = start.id
        if new:
            self._latest = None
            return
        # The first view overtook the announcement of its episode.
        for stamp, position in views.items():
            episode.add_view(stamp, position)
        if self._latest is not None and views:
            self._decide(episode, *self._latest)

    def _begin_episode(self, start: int) -> EpisodeState:
        self._episode = episode = EpisodeState(start, self._budget)
        self.policy.reset(np.random.default_rng([self.value("seed"), start]))
        return episode

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
            self._views.add("unexplained", stamp, points)

    def _is_latest(self, stamp: int) -> bool:
        return self._latest is not None and stamp == self._latest[0]

    def _on_view(self, stamp: int, view: dict[str, Any]) -> None:
        unknown = self._episode is None and self._views.began_before(stamp)
        episode = self._episode or self._begin_episode(stamp)
        self._latest = (stamp, view["objects"], view["unexplained"])
        episode.add_view(stamp, view["pose"][:3, 3])
        self._published, self._unanswered = [], None
        if unknown:
            # How many moves are left cannot be known.
            self._finish(episode, stamp, "attention_policy was started again, and earlier views are no longer kept")
        if not episode.ended:
            with self.measure(stamp) as summary:
                self._decide(episode, *self._latest)
                summary.append(f"{len(view['objects'])} objects, {len(episode.positions)} views so far")

    def _on_status(self, message: DiagnosticArray) -> None:
        status = GoalStatus.from_message(message, self.world_frame)
        check_episode(status.episode, self._episode_id)
        episode, latest = self._episode, self._latest
        if episode is None or latest is None or status.stamp != latest[0]:
            return
        self._unanswered = None
        if status.state == GoalState.REACHED:
            episode.reached()
        elif status.state == GoalState.REFUSED and episode.refused(status.reason):
            self.get_logger().info(f"the camera refuses the goal, another view is chosen: {status.reason}")
            self._decide(episode, *latest)

    def _on_tick(self, seconds: float) -> None:
        episode, latest = self._episode, self._latest
        if episode is None or latest is None or not self._active:
            return
        if self._views.under_way:  # of a camera that does not answer goals
            episode.reached()
        if episode.wait(seconds):
            timeout = self.value("goal_timeout")
            self.get_logger().warning(f"the camera did not reach the goal within {timeout:g} s, another view is chosen")
            self._decide(episode, *latest)

    def _repeat_goal(self) -> None:
        """Publish a goal again that had no answer, unless its view is coming or no camera here answers goals."""
        answers = self._active and self.count_publishers(topics.GOAL_STATUS.name) > 0
        if self._unanswered is not None and answers and not self._views.under_way:
            self.goal.publish(self._unanswered)

    def _decide(self, episode: EpisodeState, stamp: int, objects: SceneObjects, unexplained: np.ndarray) -> None:
        self._published, self._unanswered = [], None
        decision, end = episode.decide(self.policy, objects, unexplained)
        if decision is not None:
            self._publish_attention(stamp, objects, decision)
        if decision is None or end:
            self._finish(episode, stamp, end)
            return
        T_world_goal = self._budget.sphere.pose(decision.position)
        self._unanswered = transform_to_pose_stamped(T_world_goal, stamp, self.world_frame)
        self._publish(self.goal, self._unanswered)
        self._repeat_timer.reset()

    def _publish_attention(self, stamp: int, objects: SceneObjects, decision: Decision) -> None:
        centres = objects.T_world_object[:, :3, 3]
        cloud = attention_to_cloud(centres, decision.attention, decision.attended, stamp, self.world_frame)
        self._publish(self.attention, cloud)

    def _finish(self, episode: EpisodeState, stamp: int, reason: str) -> None:
        episode.ended = True
        moves, travelled = episode.moves, episode.travelled
        values = {
            "policy": self.policy_name,
            "seed": str(self.value("seed")),
            "moves": str(moves),
            "metres": f"{travelled:.6f}",
            "seconds": f"{episode.elapsed:.3f}",
        }
        if self._episode_id:
            values["episode"] = self._episode_id
        self._publish(self.end, EpisodeEnd(stamp, self.world_frame, reason, values).to_message())
        spent = f"{moves} moves, {travelled:.2f} m and {episode.elapsed:.1f} s"
        self.get_logger().info(f"episode ended after {spent}: {reason}")

    def _publish(self, publisher: Any, message: Any) -> None:
        publisher.publish(message)
        self._published.append((publisher, message))


def main() -> None:
    """Run the node."""
    run_node(AttentionPolicyNode)


if __name__ == "__main__":
    main()
