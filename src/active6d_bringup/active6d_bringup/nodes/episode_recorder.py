"""Node ``episode_recorder``: records every topic of the graph into a rosbag2 folder, message by message as sent."""

import signal
import time
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from std_srvs.srv import Trigger

from active6d_bringup.bags.writer import EpisodeWriter, RecordingError
from active6d_core.ros.adaptive_subscription import AdaptiveSubscription
from active6d_core.ros.node import GraphNode
from active6d_core.ros.runner import run_node
from active6d_core.ros.topics import CONTRACT, EPISODE_END, Topic, describe_missing


class EpisodeRecorderNode(GraphNode):
    """Writes a bag; the folder appears on configure, its metadata when the node ends.

    Queues keep everything, so nothing is lost however slow the disk; what is still queued when the node is destroyed is
    written before the bag is closed.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__("episode_recorder", **options)
        self.declare("bag", "", "folder to create for the bag")
        self.declare("settings", "{}", "parameters of the other nodes as JSON, kept in metadata.yaml for replay")
        self.declare("resume", False, "go on with the next file of a bag whose recorder was killed")
        self._writer: EpisodeWriter | None = None
        self._stopped = ""
        self._subscriptions_by_topic = {topic.name: self._listen(topic) for topic in CONTRACT}
        self.create_service(Trigger, "~/complete", self._answer_complete)

    def setup(self) -> None:
        """Create the bag.

        Raises:
            ValueError: no folder is named.
            RecordingError: the folder exists, or cannot be made.
        """
        self._folder = self.value("bag")
        if not self._folder:
            raise ValueError("episode_recorder: parameter 'bag' must name a folder to create")
        names = {topic: each.subscription.topic_name for topic, each in self._subscriptions_by_topic.items()}
        folder, resume = Path(self._folder).expanduser(), self.value("resume")
        self._writer = EpisodeWriter(folder, names, self.value("settings"), resume=resume)
        self._stopped = ""
        self.get_logger().info(f"recording into {self._folder}")

    def teardown(self) -> None:
        """Write what is still queued and close the bag."""
        self.drain()
        self.close_bag()

    def close_bag(self) -> None:
        """Close the bag without what is still queued."""
        writer, self._writer = self._writer, None
        if writer is None:
            return
        try:
            writer.close()
        except RecordingError as error:
            self.get_logger().error(str(error))
            return
        if self.context.ok():
            self.get_logger().info(f"{writer.message_count} messages in {self._folder}")

    def destroy_node(self) -> None:
        """Close the bag, then destroy the node."""
        self.teardown()
        super().destroy_node()

    def drain(self) -> None:
        """Write everything that has arrived but waits for its callback."""
        for topic, adaptive in self._subscriptions_by_topic.items():
            subscription = adaptive.subscription
            while (taken := subscription.handle.take_message(subscription.msg_type, True)) is not None:
                self._write(topic, taken[0])

    def missing(self, stamp: int) -> list[str]:
        """Topics that the recording of an episode ending at the view with this stamp (ns) still waits for."""
        return self._writer.missing(stamp) if self._writer is not None else []

    def _listen(self, topic: Topic) -> AdaptiveSubscription:
        qos = QoSProfile(
            history=HistoryPolicy.KEEP_ALL,
            reliability=ReliabilityPolicy.RELIABLE,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if topic.transient_local else DurabilityPolicy.VOLATILE,
        )
        return AdaptiveSubscription(self, topic, partial(self._write, topic.name), qos, raw=True)

    def _write(self, topic: str, payload: bytes) -> None:
        if self._writer is None:
            return
        try:
            # The system's time, whatever use_sim_time is: a log time says when something was recorded.
            self._writer.write(topic, payload, time.time_ns(), self.get_clock().now().nanoseconds)
        except RecordingError as error:
            self._stop(self._writer, str(error))

    def _stop(self, writer: EpisodeWriter, reason: str) -> None:
        """Close what there is and let the episode go on without a recording."""
        self._writer, self._stopped = None, f"recording stopped: {reason}"
        with suppress(RecordingError):
            writer.close()
        self.reject(self._stopped)

    def _answer_complete(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Whether the last episode that has ended is recorded completely."""
        if self._writer is None:
            response.success = bool(self._stopped)  # nothing is awaited any more
            response.message = self._stopped or "not recording"
            return response
        end = self._writer.last_end
        missing = [EPISODE_END.name] if end is None else self._writer.missing(end)
        response.success = not missing
        state = f"no answer from {describe_missing(missing)}" if missing else "complete"
        response.message = f"{self._writer.message_count} messages, {state}"
        return response


def main() -> None:
    """Entry point."""
    # An interrupt must end the spinning, not whatever is being written; rclpy's own handler does just that.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    run_node(EpisodeRecorderNode)


if __name__ == "__main__":
    main()
