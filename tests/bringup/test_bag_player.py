"""The player sends a bag's camera again, as it was, when its consumers are ready."""

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.serialization import serialize_message
from sensor_msgs.msg import PointCloud2
from stub_episode import StubEpisode

from active6d_bringup.bags.writer import EpisodeWriter
from active6d_bringup.nodes.bag_player import BagPlayerNode
from active6d_core.ros.conversions import objects_to_cloud, stamp_to_ns
from active6d_core.ros.topics import CONTRACT


def test_objects_that_come_again_neither_skip_a_view_nor_end_the_player(graph, tmp_path):
    episode = StubEpisode(seed=4, moves=1)
    names = {topic.name: topic.name if topic.name.startswith("/") else f"/{topic.name}" for topic in CONTRACT}
    writer = EpisodeWriter(tmp_path / "bag", names)
    for index, (topic, message) in enumerate(episode.messages()):
        writer.write(topic, serialize_message(message), 10**18 + index)
    writer.close()

    poses, ends = graph.mailbox(PoseStamped, "camera/pose", True), graph.mailbox(DiagnosticArray, "episode/end", True)
    graph.add(BagPlayerNode(context=graph.context, overrides={"bag": str(tmp_path / "bag")}))
    graph.spin_until_filled([poses])
    first, last = (step.view.stamp for step in episode.steps)
    answers = {step.view.stamp: objects_to_cloud(step.objects, step.view.stamp, "world") for step in episode.steps}
    for stamp in (first, first, last):
        graph.publish("objects", answers[stamp], latched=True)
        graph.spin_until_filled([poses], count=2)
    graph.spin_until_filled([ends])
    heard = graph.mailbox(PointCloud2, "objects")
    graph.publish("objects", answers[last], latched=True, subscribers=2)
    graph.spin_until_filled([heard])
    graph.spin_for(0.2)
    assert [stamp_to_ns(pose.header.stamp) for pose in poses] == [first, last]
    assert len(ends) == 1
