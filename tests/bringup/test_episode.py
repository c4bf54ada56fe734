"""An episode in one process, with a stub in place of camera and estimator: order, endings, failures, the result."""

import gc
import os
import signal
import time
import weakref

import numpy as np
import pytest
import yaml
from geometry_msgs.msg import PoseStamped
from rclpy.context import Context
from rclpy.node import Node
from ros_harness import fresh_domain

from active6d_agent.nodes import attention_policy
from active6d_bringup.bags.reader import read_episode
from active6d_bringup.bags.replay import ReplaySettings, replay
from active6d_bringup.bags.writer import TYPESTORE, RecordingError
from active6d_bringup.graph import composition
from active6d_bringup.graph.composition import GraphDescription
from active6d_bringup.graph.episode import EpisodeError, EpisodeInterrupted, EpisodeSettings, describe, run_episode
from active6d_core.ros.episode_messages import GoalStatus
from active6d_core.ros.graph_nodes import NODES, NodeEntry
from active6d_core.ros.topics import CONTRACT


@pytest.fixture(autouse=True)
def stub_camera(monkeypatch):
    monkeypatch.setitem(
        NODES,
        "camera_simulator",
        NodeEntry("stub_camera", "StubCameraNode"),
    )
    import stub_camera  # noqa: F401  registers the estimator


def settings(bag=None, **changes):
    default = {"estimator": "stub", "policy": "random", "steps": 3, "seed": 4, "patience": 10.0}
    return EpisodeSettings(**{**default, "bag": bag, "domain": fresh_domain(), **changes})


def test_result_and_bag_tell_the_same_story(tmp_path):
    seen = []
    result = run_episode(settings(tmp_path / "bag"), on_step=seen.append)
    record = read_episode(tmp_path / "bag")
    assert [step.index for step in seen] == [0, 1, 2, 3]
    assert result.reason == record.end_reason == "budget of 3 moves spent"
    assert (record.object, record.seed, record.policy) == ("mug", 4, "random")
    assert [step.stamp for step in result.steps] == [step.stamp for step in record.steps]
    for live, read in zip(result.steps, record.steps, strict=True):
        np.testing.assert_array_equal(live.T_world_camera, read.view.T_world_camera)
        np.testing.assert_array_equal(live.objects.T_world_object, read.objects.T_world_object)
        assert read.latency_ms.keys() >= {"pose_estimator", "hypothesis_fusion"}
    for before, after in zip(record.steps[:-1], record.steps[1:], strict=True):
        np.testing.assert_allclose(before.goal, after.view.T_world_camera, atol=1e-12)
    np.testing.assert_array_equal(result.ground_truth, record.ground_truth)
    chords = np.linalg.norm(np.diff(record.positions, axis=0), axis=1)
    assert result.distance == pytest.approx((2 * 0.8 * np.arcsin(chords / 1.6)).sum(), abs=1e-9)


def test_same_seed_gives_the_same_payloads(tmp_path):
    payloads = []
    for name in ("first", "second"):
        run_episode(settings(tmp_path / name))
        payloads.append(payloads_by_topic(tmp_path / name))
    assert payloads[0].keys() == {topic.name for topic in CONTRACT} - {"/diagnostics"}
    assert payloads[0] == payloads[1]
    run_episode(settings(tmp_path / "third", seed=5))
    assert payloads_by_topic(tmp_path / "third")["view_goal"] != payloads[0]["view_goal"]


def payloads_by_topic(folder):
    from rosbags.rosbag2 import Reader

    payloads = {}
    with Reader(folder) as reader:
        for connection, _, payload in reader.messages():
            payloads.setdefault(connection.topic.removeprefix("/"), []).append(bytes(payload))
    payloads.pop("diagnostics")
    return payloads


def test_replay_equals_the_recording(tmp_path):
    run_episode(settings(tmp_path / "bag"))
    progress = []
    result = replay(ReplaySettings(tmp_path / "bag", domain=fresh_domain()), lambda *count: progress.append(count))
    assert result.equal, result.largest_differences()
    assert (result.views, len(result.comparisons)) == (4, 16)
    assert progress[-1] == (4, 4)


def test_a_recorded_replay_holds_all_that_was_computed_and_names_its_object(tmp_path):
    run_episode(settings(tmp_path / "bag"))
    result = replay(ReplaySettings(tmp_path / "bag", record=tmp_path / "again", domain=fresh_domain()))
    first, again = payloads_by_topic(tmp_path / "bag"), payloads_by_topic(tmp_path / "again")
    for topic in ("hypotheses", "objects", "objects/markers", "camera/pose"):
        assert again[topic] == first[topic]
    assert "view_goal" not in again
    record = read_episode(tmp_path / "again")
    assert (record.object, record.end_reason, record.damage) == ("mug", "end of the bag", ())
    for step, view in zip(result.steps, record.steps, strict=True):
        assert (step.stamp, step.hypotheses) == (view.stamp, len(view.hypotheses))
        np.testing.assert_allclose(step.objects.T_world_object, view.objects.T_world_object)
    with pytest.raises(RecordingError, match="again exists already"):
        replay(ReplaySettings(tmp_path / "bag", record=tmp_path / "again"))


def test_replay_finds_what_is_different(tmp_path):
    run_episode(settings(tmp_path / "bag"))
    changed = {"pose_estimator": {"estimator_parameters": '{"offset": 0.015625}'}}
    result = replay(ReplaySettings(tmp_path / "bag", overrides=changed, domain=fresh_domain()))
    assert not result.equal
    assert result.largest_differences()["hypotheses.z"] == pytest.approx(0.015625, abs=1e-6)
    by_topic = {
        topic: [c.equal for c in result.comparisons if c.topic == topic] for topic in ("hypotheses/segmentation",)
    }
    assert all(by_topic["hypotheses/segmentation"])


def test_replay_at_the_bags_rate(tmp_path):
    run_episode(settings(tmp_path / "bag"))
    assert replay(ReplaySettings(tmp_path / "bag", rate=4.0, domain=fresh_domain())).equal


def test_zero_moves_is_a_single_view(tmp_path):
    result = run_episode(settings(tmp_path / "bag", steps=0))
    assert (len(result.steps), result.distance) == (1, 0.0)
    assert read_episode(tmp_path / "bag").end_reason == "budget of 0 moves spent"


def test_namespace(tmp_path):
    result = run_episode(settings(tmp_path / "bag", namespace="cell"))
    assert len(result.steps) == 4
    assert len(read_episode(tmp_path / "bag").steps) == 4


def test_camera_that_stops_answering_is_named(tmp_path):
    silent = settings(tmp_path / "bag", overrides={"camera_simulator": {"deaf_from": 2}}, patience=0.5)
    with pytest.raises(EpisodeError, match="no answer from camera_simulator"):
        run_episode(silent)
    assert len(read_episode(tmp_path / "bag").steps) == 2


def goals_and_statuses(folder):
    from rosbags.rosbag2 import Reader

    goals, statuses = [], []
    with Reader(folder) as reader:
        for connection, _, payload in reader.messages():
            if connection.topic == "/view_goal":
                goals.append(TYPESTORE.deserialize_cdr(payload, connection.msgtype))
            if connection.topic == "/view_goal/status":
                statuses.append(GoalStatus.from_message(TYPESTORE.deserialize_cdr(payload, connection.msgtype)))
    return goals, statuses


def test_three_refused_goals_end_well_with_other_views(tmp_path):
    result = run_episode(settings(tmp_path / "bag", overrides={"camera_simulator": {"refused": 3}}))
    assert result.reason == "budget of 3 moves spent"
    assert len(result.steps) == 4
    goals, statuses = goals_and_statuses(tmp_path / "bag")
    assert [status.state.value for status in statuses] == ["refused"] * 3 + ["accepted", "reached"] * 3
    places = np.array([[getattr(goal.pose.position, axis) for axis in "xyz"] for goal in goals])
    assert len(goals) == len(np.unique(places.round(6), axis=0)) == 6
    record = read_episode(tmp_path / "bag")
    np.testing.assert_allclose(record.positions[1:], places[3:], atol=1e-9)
    np.testing.assert_allclose(record.steps[0].goal[:3, 3], places[3], atol=1e-9)  # the goal that was reached
    np.testing.assert_allclose(result.steps[0].goal[:3, 3], places[3], atol=1e-9)


def test_a_goal_that_is_never_reached_gives_way_after_its_timeout(tmp_path):
    overrides = {"camera_simulator": {"ignored": 2}, "attention_policy": {"goal_timeout": 0.3}}
    result = run_episode(settings(tmp_path / "bag", overrides=overrides))
    assert (result.reason, len(result.steps)) == ("budget of 3 moves spent", 4)
    goals, statuses = goals_and_statuses(tmp_path / "bag")
    assert len(goals) == 5
    assert [status.state.value for status in statuses] == ["accepted"] * 2 + ["accepted", "reached"] * 3


def test_when_every_goal_is_refused_the_episode_ends_and_says_why(tmp_path):
    overrides = {"camera_simulator": {"refused": 1000}, "attention_policy": {"reach_views": [1, 2, 3]}}
    result = run_episode(settings(tmp_path / "bag", overrides=overrides))
    expected = "no reachable view is left (3 refused by the camera, the last because: a wall is in the way)"
    assert result.reason == read_episode(tmp_path / "bag").end_reason == expected
    assert len(result.steps) == 1


def test_a_goal_that_is_only_repeated_is_no_progress(monkeypatch):
    """The camera refuses the goals of two policies, of which each repeats its own."""
    monkeypatch.setattr(attention_policy, "_REPEAT_SECONDS", 0.2)
    of_two = settings(overrides={"attention_policy": {"goal_timeout": 3.0}}, patience=1.0)
    context = Context()
    context.init(args=[], domain_id=of_two.domain)
    other = Node("other_policy", context=context)
    other.create_publisher(PoseStamped, "view_goal", 1)
    try:
        with pytest.raises(EpisodeError, match=r"no progress for 1 s.*view_goal: 2 nodes publish it: .*other_policy"):
            run_episode(of_two, lambda step: _wait_for_discovery(other))
    finally:
        other.destroy_node()
        context.try_shutdown()


def _wait_for_discovery(other):
    deadline = time.monotonic() + 10.0
    while other.count_publishers("view_goal") < 2 and time.monotonic() < deadline:
        time.sleep(0.05)
    time.sleep(0.5)  # for the discovery in the other direction


def test_what_a_node_refused_is_told(tmp_path):
    elsewhere = settings(overrides={"attention_policy": {"world_frame": "map"}}, patience=1.0)
    with pytest.raises(EpisodeError, match=r"/attention_policy refused .*frame_id is 'world', expected 'map'"):
        run_episode(elsewhere)


def test_wrong_settings_are_one_clear_line(tmp_path):
    with pytest.raises(RecordingError, match="exists already"):
        run_episode(settings(tmp_path))
    with pytest.raises(ValueError, match="'steps' is -1"):
        run_episode(settings(steps=-1))
    with pytest.raises(ValueError, match="policy"):
        run_episode(settings(policy="clairvoyant"))
    with pytest.raises(ValueError, match="no node 'camera'"):
        run_episode(settings(overrides={"camera": {}}))
    with pytest.raises(ValueError, match=r"nowhere\.yaml does not exist"):
        run_episode(settings(params_file=tmp_path / "nowhere.yaml"))
    (tmp_path / "broken.yaml").write_text("a: [1\n")
    with pytest.raises(ValueError, match=r"broken\.yaml"):
        run_episode(settings(params_file=tmp_path / "broken.yaml"))


def test_params_file_reaches_the_nodes_and_overrides_win(tmp_path):
    (tmp_path / "params.yaml").write_text(
        yaml.safe_dump(
            {
                "/**": {"ros__parameters": {"world_frame": "cell"}},
                "attention_policy": {"ros__parameters": {"steps": 9, "metres": 0.0}},
            }
        )
    )
    result = run_episode(settings(tmp_path / "bag", params_file=tmp_path / "params.yaml", steps=1))
    assert len(result.steps) == 2
    assert read_episode(tmp_path / "bag").world_frame == "cell"


def test_interrupt_leaves_a_readable_bag(tmp_path):
    def interrupt(step):
        if step.index == 1:
            os.kill(os.getpid(), signal.SIGINT)

    before = signal.getsignal(signal.SIGINT)  # that of a shell's background job ignores it
    with pytest.raises(EpisodeInterrupted):
        run_episode(settings(tmp_path / "bag", steps=50), on_step=interrupt)
    assert signal.getsignal(signal.SIGINT) is before
    record = read_episode(tmp_path / "bag")
    assert (record.end_reason, len(record.steps) >= 2) == (None, True)


def test_exception_in_a_node_ends_the_episode(monkeypatch):
    from stub_camera import StubEstimator

    def fail(self, view):
        raise ZeroDivisionError("estimator broke")

    monkeypatch.setattr(StubEstimator, "estimate", fail)
    with pytest.raises(ZeroDivisionError, match="estimator broke"):
        run_episode(settings())


def test_starting_order_puts_listeners_first():
    order = describe(settings("bag")).in_order()
    assert order == ["episode_recorder", "attention_policy", "hypothesis_fusion", "pose_estimator", "camera_simulator"]
    with pytest.raises(ValueError, match="unknown node 'camera'"):
        GraphDescription({"camera": {}})


def test_nodes_are_gone_when_their_episode_has_ended(monkeypatch):
    nodes = []
    monkeypatch.setattr(
        composition, "load_node_type", lambda name, load=composition.load_node_type: watched(load(name), nodes)
    )
    gc.disable()
    try:
        run_episode(settings())
        assert len(nodes) == 4
        assert [node() for node in nodes if node() is not None] == []
    finally:
        gc.enable()


def watched(node_type, nodes):
    def make(*arguments, **options):
        node = node_type(*arguments, **options)
        nodes.append(weakref.ref(node))
        return node

    return make
