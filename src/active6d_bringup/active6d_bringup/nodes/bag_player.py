"""Node ``bag_player``: publishes the camera's messages of a recorded episode again."""

from collections import defaultdict
from pathlib import Path
from typing import Any

from geometry_msgs.msg import PoseStamped
from rclpy.timer import Timer
from sensor_msgs.msg import PointCloud2

from active6d_bringup.bags.camera_topics import CameraOptions
from active6d_bringup.bags.index import read_bag
from active6d_bringup.bags.source import BagError
from active6d_bringup.camera.rectification import RECTIFIED
from active6d_core.ros import topics
from active6d_core.ros.clock_output import ClockOutput
from active6d_core.ros.conversions import stamp_to_ns
from active6d_core.ros.episode_messages import EpisodeEnd, GoalState, GoalStatus
from active6d_core.ros.heartbeat import Awaited
from active6d_core.ros.node import GraphNode
from active6d_core.ros.runner import run_node


class BagPlayerNode(GraphNode):
    """Publishes the camera's recorded messages, view by view and byte by byte, then ``episode/end``.

    With ``rate`` 0 the next view goes out when ``objects`` of the last one have arrived; otherwise when as much time
    has passed as in the recording, divided by ``rate``. Goals are refused, because the views are fixed.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__("bag_player", **options)
        self.declare("bag", "", "folder of the bag to play")
        self.declare(
            "rate",
            0.0,
            "speed relative to the recording; 0: the next view follows when the objects of the last one have arrived",
            minimum=0.0,
        )
        self.declare("topics", "", "topics of a foreign recording, such as color=/left/image,depth=/left/depth")
        self.declare("depth_scale", 0.0, "metres per unit of its depth, 0: as REP-118 says", minimum=0.0)
        self.declare(
            "rectified",
            "auto",
            "whether its images are rectified already; auto: if rect is a word of the colour topic's name",
            choices=tuple(RECTIFIED),
        )
        self._clock_output = ClockOutput(self)
        self._outputs = {}
        for topic in topics.REPLAYED_TOPICS:
            self._outputs[topic.name] = self.output(topic)
        self._end = self.output(topics.EPISODE_END)
        self._status = self.output(topics.GOAL_STATUS)
        self.input(topics.OBJECTS, self._on_objects)
        self.input(topics.VIEW_GOAL, self._on_goal)
        self._timer: Timer | None = None

    def setup(self) -> None:
        """Read the bag.

        Raises:
            BagError: it cannot be read, or has no complete view.
        """
        folder, self._rate = self.value("bag"), self.value("rate")
        if not folder:
            raise ValueError("bag_player: parameter 'bag' must name the folder of a bag")
        rectified = RECTIFIED[self.value("rectified")]
        options = CameraOptions.parse(self.value("topics"), self.value("depth_scale"), rectified)
        self._views, self._received = _read_views(Path(folder).expanduser(), options)
        self._stamps = sorted(self._views)
        self._next = 0

    def begin(self) -> None:
        """Publish the first view."""
        self._publish_next()

    def awaited(self) -> Awaited | None:
        """The objects of the last view; if views follow by time and nobody sets that time, the clock."""
        if self._rate > 0 and self._waits_for_clock():
            return Awaited((topics.CLOCK.name,))
        if self._rate > 0 or self._next > len(self._stamps):
            return None
        return Awaited(("objects",), self._stamps[self._next - 1])

    def _waits_for_clock(self) -> bool:
        """Whether the next view waits for a time that stands still: with use_sim_time and without /clock."""
        if self._timer is None or self.value("publish_clock"):
            return False
        return self.get_clock().ros_time_is_active and not self.count_publishers(topics.CLOCK.name)

    def teardown(self) -> None:
        """Stop playing."""
        if self._timer is not None:
            self.destroy_timer(self._timer)
            self._timer = None

    def _on_objects(self, message: PointCloud2) -> None:
        # Objects of the last view may come again after the end: a fusion node that was restarted repeats them.
        if self._rate == 0 and stamp_to_ns(message.header.stamp) == self._stamps[: self._next][-1]:
            self._publish_next()

    def _on_goal(self, message: PoseStamped) -> None:
        stamp, reason = stamp_to_ns(message.header.stamp), "a bag's views come in the order of their recording"
        self._status.publish(GoalStatus(stamp, self.world_frame, GoalState.REFUSED, reason).to_message())

    def _publish_next(self) -> None:
        self.teardown()
        if self._next == len(self._stamps):
            self._end.publish(EpisodeEnd(self._stamps[-1], self.world_frame, "end of the bag").to_message())
            self._next += 1
            self.get_logger().info("episode ended: end of the bag")
            return
        if self._next > len(self._stamps):
            return
        stamp = self._stamps[self._next]
        with self.measure(stamp):
            self._clock_output.set(stamp)
            for topic, payload in self._views[stamp].items():
                self._outputs[topic].publish(payload)
        self._next += 1
        if self._rate > 0:
            following = self._stamps[min(self._next, len(self._stamps) - 1)]
            pause = (self._received[following] - self._received[stamp]) * 1e-9 / self._rate
            # On its own /clock, which stands still between views, the player would wait forever.
            timer = self.wall_timer if self.value("publish_clock") else self.create_timer
            self._timer = timer(max(pause, 0.0), self._publish_next)


def _read_views(folder: Path, options: CameraOptions) -> tuple[dict[int, dict[str, bytes]], dict[int, int]]:
    """Per complete view's stamp: its serialized messages by topic, and when (ns) its pose was recorded."""
    index = read_bag(folder, options)
    views: dict[int, dict[str, bytes]] = defaultdict(dict)
    for topic in topics.REPLAYED_TOPICS:
        for stamp, payload in index.payloads.get(topic.name, {}).items():
            views[stamp][topic.name] = payload
    complete = {
        stamp: messages
        for stamp, messages in views.items()
        if all(topic.name in messages for topic in topics.CAMERA_TOPICS)
    }
    if not complete:
        raise BagError(f"{folder}: holds no complete view (color, depth, camera_info and pose of one stamp)")
    return complete, index.received[topics.CAMERA_POSE.name]


def main() -> None:
    """Entry point."""
    run_node(BagPlayerNode)


if __name__ == "__main__":
    main()
