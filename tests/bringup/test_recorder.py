"""The recorder's bag holds what was sent, byte by byte, and two other libraries read it."""

import errno
import io
import os
import signal
import subprocess
import sys
import time
from collections import defaultdict

import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.interfaces import QosDurability, QosReliability
from rosbags.rosbag2 import Reader
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger
from stub_episode import StubEpisode, is_latched

from active6d_bringup.bags.index import read_bag
from active6d_bringup.bags.writer import EpisodeWriter, RecordingError, clear_padding, stamp_of
from active6d_bringup.nodes.episode_recorder import EpisodeRecorderNode
from active6d_core.ros.conversions import ns_to_stamp
from active6d_core.ros.node import GraphNode
from active6d_core.ros.topics import CONTRACT

TYPES = {topic.name: topic.type for topic in CONTRACT}


def record(graph, folder, episode, late=False):
    """Send the stub episode past a recorder, which starts after the first latched messages if ``late``."""
    sent = episode.messages()
    first = {topic: message for topic, message in reversed(sent) if is_latched(topic) and topic != "episode/end"}
    early = list(first.items()) if late else []
    for topic, message in early:
        graph.publish(topic, message, latched=True, subscribers=0)
    recorder = graph.add(EpisodeRecorderNode(context=graph.context, overrides={"bag": str(folder), "heartbeat": 0.0}))
    for topic, message in sent:
        if not any(message is other for _, other in early):
            graph.publish(topic, message, latched=is_latched(topic))
    return recorder, sent


def assert_holds(folder, sent):
    expected = defaultdict(list)
    for topic, message in sent:
        name = topic if topic.startswith("/") else f"/{topic}"
        expected[name].append(clear_padding(TYPES[topic], serialize_message(message)))
    found = defaultdict(list)
    with Reader(folder) as reader:
        for connection, _, payload in reader.messages():
            found[connection.topic].append(bytes(payload))
    assert found == expected


def test_padding_is_cleared_and_nothing_else():
    for topic, message in StubEpisode().messages():
        payload = serialize_message(message)
        cleared = clear_padding(TYPES[topic], payload)
        assert deserialize_message(cleared, type(message)) == deserialize_message(payload, type(message))
        assert len(cleared) == len(payload)
    message = PoseStamped()
    message.header.frame_id = "ab"
    payload = bytearray(serialize_message(message))
    payload[19:20] = (
        b"\x7f"  # after 4 bytes of encapsulation, 8 of stamp, 4 of length and "ab\0": the gap before a double
    )
    assert clear_padding(TYPES["camera/pose"], bytes(payload))[19] == 0
    garbled = serialize_message(message).replace(b"ab", b"\xff\xfe")
    assert clear_padding(TYPES["camera/pose"], garbled) == garbled


@pytest.mark.parametrize("late", [False, True])
def test_every_message_is_recorded_unchanged(graph, tmp_path, late):
    recorder, sent = record(graph, tmp_path / "bag", StubEpisode(), late)
    if late:  # what was latched comes from the middleware's own thread
        graph.spin_until(lambda: not recorder.missing(2_000_000_000))
    graph.remove(recorder)  # what has not been taken from the queues yet is written at the end
    assert_holds(tmp_path / "bag", sent)


def test_metadata_and_chunks(graph, tmp_path):
    recorder, sent = record(graph, tmp_path / "bag", StubEpisode())
    graph.remove(recorder)
    metadata = yaml.safe_load((tmp_path / "bag/metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert metadata["storage_identifier"] == "mcap"
    assert metadata["message_count"] == len(sent)
    with Reader(tmp_path / "bag") as reader:
        offered = {item.topic.lstrip("/"): item.ext.offered_qos_profiles[0] for item in reader.connections}
    assert offered.keys() == {topic.name.lstrip("/") for topic in CONTRACT}
    for topic in CONTRACT:
        qos = offered[topic.name.lstrip("/")]
        assert qos.reliability == QosReliability.RELIABLE
        assert (qos.durability == QosDurability.TRANSIENT_LOCAL) == topic.transient_local
    with next((tmp_path / "bag").glob("*.mcap")).open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert {index.compression for index in summary.chunk_indexes} == {"zstd"}


def test_mcap_library_decodes_by_the_schema_in_the_file(graph, tmp_path):
    episode = StubEpisode()
    recorder, sent = record(graph, tmp_path / "bag", episode)
    graph.remove(recorder)
    decoded = defaultdict(list)
    data = io.BytesIO(next((tmp_path / "bag").glob("*.mcap")).read_bytes())
    reader = make_reader(data, decoder_factories=[DecoderFactory()])
    for _, channel, _, message in reader.iter_decoded_messages():
        decoded[channel.topic].append(message)
    assert sum(map(len, decoded.values())) == len(sent)
    assert [m.header.stamp.nanosec for m in decoded["/camera/pose"]] == [s.view.stamp % 10**9 for s in episode.steps]
    assert bytes(decoded["/camera/color/image_raw"][1].data) == episode.steps[1].view.color.tobytes()
    assert decoded["/objects/markers"][0].markers[1].mesh_resource == "package://x/mug.obj"


def test_completeness_names_the_topics_awaited(graph, tmp_path):
    recorder = graph.add(
        EpisodeRecorderNode(context=graph.context, overrides={"bag": str(tmp_path / "bag"), "heartbeat": 0.0})
    )
    assert "episode/end" in graph.call(Trigger, "episode_recorder/complete").message
    sent = StubEpisode(moves=1).messages()
    last = sent[-1][1].header.stamp.sec * 10**9 + sent[-1][1].header.stamp.nanosec
    withheld = [("view_goal", 0), ("objects/markers", 1)]
    seen = defaultdict(int)
    late = []
    for topic, message in sent:
        if (topic, seen[topic]) in withheld:
            late.append((topic, message))
        else:
            graph.publish(topic, message, latched=is_latched(topic))
        seen[topic] += 1
    graph.spin_until(lambda: "episode/end" not in recorder.missing(last))
    graph.spin_until(lambda: set(recorder.missing(last)) == {"view_goal", "objects/markers"})
    answer = graph.call(Trigger, "episode_recorder/complete")
    assert not answer.success
    assert "attention_policy, hypothesis_fusion" in answer.message
    for topic, message in late:
        graph.publish(topic, message, latched=is_latched(topic))
    graph.spin_until(lambda: not recorder.missing(last))
    assert graph.call(Trigger, "episode_recorder/complete").success


def test_with_use_sim_time_log_times_are_the_systems_and_publish_times_the_clocks(graph, tmp_path):
    began = time.time_ns()
    overrides = {"bag": str(tmp_path / "bag"), "heartbeat": 0.0, "use_sim_time": True}
    recorder = graph.add(EpisodeRecorderNode(context=graph.context, overrides=overrides))
    sent, times = StubEpisode(moves=0).messages(), (5 * 10**9, 8 * 10**9)
    for now, part in zip(times, (sent[:4], sent[4:]), strict=True):
        graph.publish("/clock", Clock(clock=ns_to_stamp(now)))
        graph.spin_until(lambda now=now: recorder.get_clock().now().nanoseconds == now, what="the clock")
        for topic, message in part:
            graph.publish(topic, message, latched=is_latched(topic))
        expected = 4 if now == times[0] else len(sent)
        graph.spin_until(lambda expected=expected: recorder._writer.message_count == expected, what="its messages")
    graph.remove(recorder)
    data = io.BytesIO((tmp_path / "bag/bag.mcap").read_bytes())
    recorded = [message for _, _, message in make_reader(data).iter_messages()]
    assert all(began <= message.log_time <= time.time_ns() for message in recorded)
    assert sorted(message.publish_time for message in recorded) == [times[0]] * 4 + [times[1]] * (len(sent) - 4)


def test_a_killed_recording_is_read_and_goes_on_in_the_next_file(graph, tmp_path):
    folder, sent = tmp_path / "bag", StubEpisode().messages()
    names = {topic.name: topic.name if topic.name.startswith("/") else f"/{topic.name}" for topic in CONTRACT}
    killed = EpisodeWriter(folder, names, '{"pose_estimator": {"object": "mug"}}')
    for index, (topic, message) in enumerate(sent[:20]):
        killed.write(topic, serialize_message(message), 10**18 + index)
    killed._stream.close()  # the system closes the files of a killed process, and frees its lock
    with (folder / "bag.mcap").open("ab") as file:
        file.write(b"\x06half a record")  # what a SIGKILL in the middle of a write leaves
    index = read_bag(folder)
    assert index.damage[0] == "there is no metadata.yaml: the recording was killed, or its file was moved"
    assert "cannot be read from byte" in index.damage[1]
    assert index.settings == {"pose_estimator": {"object": "mug"}}
    assert sum(map(len, index.payloads.values())) + len(index.diagnostics) == 20
    writer = EpisodeWriter(folder, names, resume=True)
    for number, (topic, message) in enumerate(sent[18:]):  # latched messages come again
        writer.write(topic, serialize_message(message), 10**18 + 100 + number)
    assert not writer.missing(writer.last_end)
    writer.close()
    assert sorted(path.name for path in folder.iterdir()) == ["bag.mcap", "bag_1.mcap", "metadata.yaml"]
    index = read_bag(folder)
    assert index.damage == ()
    assert sum(map(len, index.payloads.values())) + len(index.diagnostics) == len(sent)
    with Reader(folder) as reader:  # another library finds both files whole
        assert sum(1 for _ in reader.messages()) == len(sent) + 2


def test_a_full_disk_names_the_folder_and_lets_the_episode_end(graph, tmp_path, monkeypatch):
    recorder = graph.add(
        EpisodeRecorderNode(context=graph.context, overrides={"bag": str(tmp_path / "bag"), "heartbeat": 0.0})
    )
    diagnostics = graph.mailbox(DiagnosticArray, "/diagnostics")
    sent = StubEpisode().messages()
    for topic, message in sent[:10]:
        recorder._write(topic, serialize_message(message))

    def full():
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(recorder._writer._writer, "flush", full)
    for topic, message in sent[10:]:
        recorder._write(topic, serialize_message(message))
    graph.spin_until(lambda: any("recording stopped" in d.status[0].message for d in diagnostics))
    reason = f"{tmp_path / 'bag'} cannot be written: No space left on device; it holds 1 views, 10 messages"
    assert any(reason in d.status[0].message for d in diagnostics)
    assert recorder.missing(10**9) == []
    answer = graph.call(Trigger, "episode_recorder/complete")
    assert answer.success
    assert reason in answer.message
    graph.remove(recorder)
    assert sum(map(len, read_bag(tmp_path / "bag").payloads.values())) >= 10


def test_existing_folder_is_refused(graph, tmp_path):
    with pytest.raises(RecordingError, match="exists already"):
        graph.add(EpisodeRecorderNode(context=graph.context, overrides={"bag": str(tmp_path)}))


def test_namespace_is_kept(graph, tmp_path):
    recorder = EpisodeRecorderNode(
        context=graph.context, namespace="cell", overrides={"bag": str(tmp_path / "bag"), "heartbeat": 0.0}
    )
    graph.add(recorder)
    for topic, message in StubEpisode().messages():
        graph.publish(topic if topic.startswith("/") else f"cell/{topic}", message, latched=is_latched(topic))
    graph.remove(recorder)
    with Reader(tmp_path / "bag") as reader:
        assert "/cell/camera/pose" in {connection.topic for connection in reader.connections}
        assert reader.message_count == len(StubEpisode().messages())


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_recorder_closes_its_bag(graph, tmp_path, number):
    command = [sys.executable, "-m", "active6d_bringup.nodes.episode_recorder"]
    command += ["--ros-args", "-p", f"bag:={tmp_path / 'bag'}", "-p", "heartbeat:=0.0"]
    process = subprocess.Popen(command, env={**os.environ, "ROS_DOMAIN_ID": str(graph.domain)})
    try:
        sent = StubEpisode().messages()
        for topic, message in sent[:20]:
            graph.publish(topic, message, latched=is_latched(topic), timeout=20)
        graph.spin_until(lambda: graph.call(Trigger, "episode_recorder/complete").message.startswith("20 messages"))
        process.send_signal(number)
        assert process.wait(10) == 0
    finally:
        process.kill()
        process.wait()
    assert_holds(tmp_path / "bag", sent[:20])


@pytest.mark.parametrize("topic", CONTRACT, ids=lambda topic: topic.name)
def test_stamp_is_read_from_the_serialized_message(topic):
    for name, message in StubEpisode(first=7_123_456_789).messages():
        if name == topic.name:
            header = message.markers[0].header if hasattr(message, "markers") else message.header
            expected = header.stamp.sec * 10**9 + header.stamp.nanosec
            assert stamp_of(topic.type, serialize_message(message)) == expected


def test_recorder_is_a_graph_node():
    assert issubclass(EpisodeRecorderNode, GraphNode)
