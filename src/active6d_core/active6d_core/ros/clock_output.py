"""The stamps of views as /clock, for nodes that run with use_sim_time."""

from rosgraph_msgs.msg import Clock

from active6d_core.ros.conversions import ns_to_stamp
from active6d_core.ros.node import GraphNode
from active6d_core.ros.topics import CLOCK

_PERIOD_SECONDS = 0.1


class ClockOutput:
    """Publishes the stamp of the last view on /clock, again and again for late-joining subscribers.

    Args:
        node: the node that takes the views; it gets the parameter ``publish_clock``.
    """

    def __init__(self, node: GraphNode) -> None:
        node.declare("publish_clock", False, "publish the stamps of views on /clock, for use_sim_time", fixed=True)
        self._stamp: int | None = None
        self._publisher = node.output(CLOCK) if node.value("publish_clock") else None
        if self._publisher is not None:
            node.wall_timer(_PERIOD_SECONDS, self._publish)

    def set(self, stamp: int) -> None:
        """Set the clock to a view's stamp in nanoseconds."""
        self._stamp = stamp
        self._publish()

    def _publish(self) -> None:
        if self._publisher is not None and self._stamp is not None:
            self._publisher.publish(Clock(clock=ns_to_stamp(self._stamp)))
