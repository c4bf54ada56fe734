"""The base of every node: parameters, guarded inputs, diagnostics, lifecycle and the matching of stamps."""

import gc
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from hypothesis import given
from hypothesis import strategies as st
from rcl_interfaces.srv import SetParameters
from rclpy.context import Context
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from ros_harness import fresh_domain, reliable
from sensor_msgs.msg import Image
from std_msgs.msg import String

from active6d_core.ros.conversions import MessageError, OutdatedError, depth_to_image, image_to_depth, stamp_to_ns
from active6d_core.ros.heartbeat import Awaited, Watch
from active6d_core.ros.node import GraphNode
from active6d_core.ros.parameters import describe_limits
from active6d_core.ros.synchronizer import StampSynchronizer
from active6d_core.ros.topics import Per, Topic

RESULT = Topic("result", "std_msgs/msg/String", Per.VIEW, "depth_node")
DEPTH = Topic("depth", "sensor_msgs/msg/Image", Per.VIEW, "camera")


class DepthNode(GraphNode):
    """Takes depth images, publishes their mean."""

    def __init__(self, **kwargs):
        super().__init__("depth_node", **kwargs)
        self.declare("gain", 1.0, "factor", minimum=0.0, maximum=10.0)
        self.declare("mode", "mean", "what to publish", choices=("mean", "max"))
        self.declare("count", 1, "how many", minimum=1)
        self.result = self.output(RESULT)
        self.input(DEPTH, self.on_depth)
        self.fail_at_setup = False
        self.wanted = None

    def awaited(self):
        return self.wanted

    def setup(self):
        if self.fail_at_setup:
            raise ValueError("mesh missing.ply does not exist")
        self.gain = self.value("gain")

    def on_depth(self, message):
        depth = image_to_depth(message)
        if depth.shape == (2, 1):
            raise OutdatedError("it is over")
        if depth.shape == (1, 1):
            raise ZeroDivisionError("a defect in the node")
        with self.measure(stamp_to_ns(message.header.stamp)):
            self.result.publish(String(data=f"{depth.mean():.1f}"))


@pytest.mark.parametrize(
    ("overrides", "text"),
    [
        ({"gain": -1.0}, "parameter 'gain' is -1.0, must be >= 0.0 and <= 10.0"),
        ({"gain": float("nan")}, "parameter 'gain' is nan"),
        ({"gain": "much"}, "parameter 'gain' must be a float such as 1.0"),
        ({"mode": "median"}, "must be one of mean, max"),
    ],
)
def test_bad_parameters_are_named(graph, overrides, text):
    with pytest.raises(ValueError, match=text):
        DepthNode(context=graph.context, overrides=overrides)


def test_a_mistyped_parameter_is_named(graph):
    log = graph.log()
    graph.add(DepthNode(context=graph.context, overrides={"gian": 2.0, "use_sim_time": False, "mode": "max"}))
    expected = "parameter 'gian' is unknown and has no effect, did you mean 'gain'?"
    graph.spin_until(lambda: [line.msg for line in log if "unknown" in line.msg] == [expected])


def test_limits_are_descriptor_ranges(graph):
    node = graph.add(DepthNode(context=graph.context), start=False)
    (gain,) = node.describe_parameter("gain").floating_point_range
    assert (gain.from_value, gain.to_value) == (0.0, 10.0)
    assert node.describe_parameter("mode").additional_constraints == "one of mean, max"
    (count,) = node.describe_parameter("count").integer_range
    assert (count.from_value, count.to_value) == (1, 2**63 - 1)
    limits = {name: describe_limits(node.describe_parameter(name)) for name in ("gain", "mode", "count", "autostart")}
    assert limits == {"gain": ">= 0.0; <= 10.0", "mode": "one of mean, max", "count": ">= 1", "autostart": ""}


def set_parameter(graph, name, value):
    """What `ros2 param set` does; the reason for a refusal, empty if the value was taken."""
    request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
    (result,) = graph.call(SetParameters, "depth_node/set_parameters", request).results
    assert result.successful == (not result.reason)
    return result.reason


def test_a_parameter_can_be_set_until_the_node_is_configured(graph):
    node = graph.add(DepthNode(context=graph.context), start=False)
    assert set_parameter(graph, "gain", 3.0) == ""
    node.start()
    assert node.gain == 3.0
    assert "'gain' can be set only while the node is unconfigured" in set_parameter(graph, "gain", 4.0)
    node.trigger_deactivate()
    assert "`ros2 lifecycle set /depth_node deactivate`" in set_parameter(graph, "gain", 4.0)
    node.trigger_cleanup()
    assert set_parameter(graph, "gain", 4.0) == ""
    node.start()
    assert node.gain == 4.0


def test_a_failed_setup_leaves_the_parameters_settable(graph):
    node = graph.add(DepthNode(context=graph.context), start=False)
    node.fail_at_setup = True
    node.trigger_configure()
    assert set_parameter(graph, "gain", 4.0) == ""


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("gain", 11.0, "out of range"),
        ("gain", float("nan"), "out of range"),
        ("gain", 1, "Wrong parameter type"),
        ("mode", "median", "'mode' is 'median', must be one of mean, max"),
        ("autostart", False, "read-only"),
    ],
)
def test_bad_values_are_refused_on_set(graph, name, value, reason):
    node = graph.add(DepthNode(context=graph.context), start=False)
    before = node.value(name)
    assert reason in set_parameter(graph, name, value)
    assert node.value(name) == before


def heartbeats(graph, node, text, timeout=10.0):
    """Beat until a heartbeat holds the text; its status."""
    found = graph.mailbox(DiagnosticArray, "/diagnostics")
    statuses = []

    def beaten():
        node.beat()
        statuses[:] = [s for message in found for s in message.status if text in s.message]
        return statuses

    graph.spin_until(beaten, timeout, text)
    return statuses[0]


def test_the_heartbeat_comes_every_second_without_input(graph):
    graph.add(DepthNode(context=graph.context, overrides={"heartbeat": 0.1}), start=False)
    found = graph.mailbox(DiagnosticArray, "/diagnostics")
    graph.spin_until_filled([found], 3)
    assert {message.status[0].message for message in found} == {"unconfigured, waiting for a lifecycle transition"}


def test_the_heartbeat_can_be_off(graph):
    graph.add(DepthNode(context=graph.context, overrides={"heartbeat": 0.0}))
    found = graph.mailbox(DiagnosticArray, "/diagnostics")
    graph.spin_for(1.3)
    assert found == []


def test_the_heartbeat_names_what_is_awaited_and_since_when(graph):
    node = graph.add(DepthNode(context=graph.context))
    now = [100.0]
    node._watch = Watch(node, lambda: now[0])
    publisher = graph.node.create_publisher(Image, "depth", reliable(True))
    graph.spin_until(lambda: node.count_publishers("depth"))
    node.wanted = Awaited(("depth",), 12_400_000_000)
    node.beat()
    now[0] += 7.0
    status = heartbeats(graph, node, "waiting for depth of 12.400 s for 7 s")
    assert status.level == DiagnosticStatus.OK  # somebody publishes it: it may just take its time
    values = {pair.key: pair.value for pair in status.values}
    assert (values["waiting_for"], values["waiting_s"]) == ("/depth", "7")
    node.wanted = Awaited(("depth",), 13_000_000_000)
    assert heartbeats(graph, node, "13.000").message == "waiting for depth of 13.000 s for 0 s"
    graph.node.destroy_publisher(publisher)


def test_a_topic_without_publisher_is_a_warning_that_names_it_once(graph):
    logged = graph.log()
    node = graph.add(DepthNode(context=graph.context))
    now = [100.0]
    node._watch = Watch(node, lambda: now[0])
    node.wanted = Awaited(("depth",))
    node.beat()
    now[0] += 4.0
    assert heartbeats(graph, node, "for 4 s").level == DiagnosticStatus.OK
    now[0] += 2.0
    status = heartbeats(graph, node, "for 6 s")
    assert status.level == DiagnosticStatus.WARN
    cause = f"nobody publishes depth in namespace / and domain {graph.domain}"
    assert status.message == f"waiting for depth for 6 s: {cause}"
    for _ in range(3):
        node.beat()
    graph.spin_until(lambda: any(cause in entry.msg for entry in logged))
    graph.spin_for(0.2)
    assert sum(cause in entry.msg for entry in logged) == 1


def test_an_incompatible_publisher_is_named_as_the_cause(graph):
    logged = graph.log()
    node = graph.add(DepthNode(context=graph.context))
    graph.node.create_publisher(Image, "depth", QoSProfile(depth=1, durability=DurabilityPolicy.VOLATILE))
    cause = "a publisher of depth offers an incompatible QoS (durability)"
    graph.spin_until(lambda: any(cause in entry.msg for entry in logged))
    now = [time.monotonic()]
    node._watch._clock = lambda: now[0]
    node.wanted = Awaited(("depth",))
    node.beat()
    now[0] += 6.0
    status = heartbeats(graph, node, cause)
    assert status.level == DiagnosticStatus.WARN


def test_messages_of_the_past_are_no_error_but_the_cause_of_waiting(graph):
    node = graph.add(DepthNode(context=graph.context))
    now = [100.0]
    node._watch = Watch(node, lambda: now[0])
    node.wanted = Awaited(("depth",), 5_000_000_000)
    node.beat()
    now[0] += 6.0
    found = graph.mailbox(DiagnosticArray, "/diagnostics")
    old = depth_to_image(np.ones((2, 1), np.float32), 1_000_000_000, "c")  # see on_depth
    graph.publish("depth", old, latched=True)
    graph.spin_until(lambda: any("ignored depth: it is over" in d.status[0].message for d in found))
    assert all(d.status[0].level != DiagnosticStatus.ERROR for d in found)
    assert "if the camera was restarted" in heartbeats(graph, node, "too old").message


def test_bad_input_is_refused_and_the_node_lives(graph):
    graph.add(DepthNode(context=graph.context))
    results, diagnostics = graph.mailbox(String, "result"), graph.mailbox(DiagnosticArray, "/diagnostics")
    bad = depth_to_image(np.ones((2, 2), np.float32), 1, "c")
    bad.encoding = "rgb8"
    graph.publish("depth", bad, latched=True)
    graph.spin_until_filled([diagnostics])
    status = diagnostics[0].status[0]
    assert status.level == DiagnosticStatus.ERROR
    assert status.name == "/depth_node"
    assert "'rgb8' is not 32FC1" in status.message
    graph.publish("depth", depth_to_image(np.full((2, 2), 3, np.float32), 7_000_000_005, "c"), latched=True)
    graph.spin_until_filled([results])
    assert results[0].data == "3.0"
    graph.spin_until(lambda: len(diagnostics) == 2)
    values = {item.key: item.value for item in diagnostics[1].status[0].values}
    assert stamp_to_ns(diagnostics[1].header.stamp) == 7_000_000_005
    assert (values["views"], values["rejected"]) == ("1", "1")
    assert float(values["latency_ms"]) > 0


def test_a_defect_in_a_callback_is_not_hidden(graph):
    graph.add(DepthNode(context=graph.context))
    graph.publish("depth", depth_to_image(np.ones((1, 1), np.float32), 1, "c"), latched=True)
    with pytest.raises(ZeroDivisionError):
        graph.spin_for(5.0)


def test_inputs_are_ignored_until_the_node_is_active(graph):
    node = graph.add(DriverNode(context=graph.context), start=False)
    publisher = graph.node.create_publisher(Image, "camera/depth", reliable())
    graph.spin_until(publisher.get_subscription_count)
    publisher.publish(depth_to_image(np.ones((2, 2), np.float32), 1_000_000_000, "c"))
    graph.spin_for(0.3)
    node.start()
    publisher.publish(depth_to_image(np.ones((2, 2), np.float32), 2_000_000_000, "c"))
    graph.spin_until(lambda: node.stamps)
    assert node.stamps == [2]


def test_latched_inputs_wait_for_activation(graph):
    """What a node heard while inactive it takes once, in order, as many as are latched, and then what comes."""
    node = graph.add(DepthNode(context=graph.context), start=False)
    results, diagnostics = graph.mailbox(String, "result", True), graph.mailbox(DiagnosticArray, "/diagnostics")

    def send(value):
        graph.publish("depth", depth_to_image(np.full((2, 2), value, np.float32), 1, "c"), latched=True)

    for value in range(1, 14):
        send(value)
    bad = depth_to_image(np.ones((2, 2), np.float32), 1, "c")
    bad.encoding = "rgb8"
    graph.publish("depth", bad, latched=True)
    graph.spin_until(lambda: len(node._held[0][1]) == 10 and node._held[0][1][-1].encoding == "rgb8")
    assert results == []
    node.start()
    graph.spin_until_filled([results], 9)
    graph.spin_until(lambda: any("'rgb8' is not 32FC1" in d.status[0].message for d in diagnostics))
    node.trigger_deactivate()
    send(14)
    graph.spin_until(lambda: node._held[0][1])
    node.trigger_activate()
    send(15)
    graph.spin_until_filled([results], 11)
    assert [result.data for result in results] == [f"{value:.1f}" for value in (*range(5, 14), 14, 15)]


def test_a_failing_setup_is_reported_once_with_its_reason(graph, capfd):
    node = graph.add(DepthNode(context=graph.context), start=False)
    node.fail_at_setup = True
    with pytest.raises(ValueError, match=r"missing\.ply"):
        node.start()
    assert capfd.readouterr().err == ""
    node.trigger_configure()  # what a lifecycle manager asks for over a service: it sees a refusal, the log says why
    assert "setup failed: mesh missing.ply does not exist" in capfd.readouterr().err


def test_a_node_that_fails_to_begin_stays_inactive(graph):
    class FailingNode(DepthNode):
        def begin(self):
            raise ValueError("no first view")

    node, results = graph.add(FailingNode(context=graph.context), start=False), graph.mailbox(String, "result")
    with pytest.raises(ValueError, match="no first view"):
        node.start()
    graph.publish("depth", depth_to_image(np.ones((2, 2), np.float32), 1, "c"), latched=True)
    graph.spin_for(0.3)
    assert results == []


RUN_A_NODE = """
import sys
import threading
import rclpy
from active6d_core.ros import runner
from test_node import DepthNode

class Defective(DepthNode):
    def begin(self):
        self.create_timer(0.0, self.fail)

    def fail(self):
        raise ValueError("a defect in the node")

class Ended(DepthNode):
    def begin(self):
        # The context ends and nobody wakes the executor, as when rclpy's wake comes before the end.
        threading.Timer(0.5, lambda: rclpy.get_default_context().handle.shutdown()).start()

class Refused(DepthNode):
    def __init__(self):
        raise RuntimeError("pthread_create failed: Resource temporarily unavailable")

kind = {"refused": Refused, "defect": Defective, "end": Ended}.get(sys.argv[1], DepthNode)
runner.run_node(kind, sys.argv[:1] + sys.argv[2:])
"""


def run_a_node(*arguments, **variables):
    environment = {**os.environ, "ROS_DOMAIN_ID": str(fresh_domain()), **variables}
    environment["PYTHONPATH"] += os.pathsep + str(Path(__file__).parent)
    command = [sys.executable, "-c", RUN_A_NODE, *arguments]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)


@pytest.mark.parametrize(
    ("arguments", "code", "text"),
    [
        (["defect"], 1, "Traceback"),
        (["parameter", "--ros-args", "-p", "gain:=-1.0"], 2, "error: depth_node: parameter 'gain' is -1.0"),
        (["parameter", "-p", "gain:=1.0"], 2, "error: '-p' is not for a node; parameters come after --ros-args"),
    ],
)
def test_exit_code_two_is_for_parameters_and_a_defect_shows_its_traceback(arguments, code, text):
    ended = run_a_node(*arguments)
    assert ended.returncode == code
    assert text in ended.stderr
    assert ("Traceback" in ended.stderr) == (code == 1)


HOLDS = "the file must hold NODE: {ros__parameters: {NAME: VALUE}}"


@pytest.mark.parametrize(
    ("text", "words", "advice"),
    [
        (
            "n:\n  ros__parameters:\n    hand_eye: [0.03, 0, 0.06, 0, 0, 0, 1]\n",
            ", line 3: the values of a list differ in type; ",
            "write 0.0 in place of 0",
        ),
        ("n:\n  gain: 1.0\n", ", line 2: ", HOLDS),
        ("n:\n  hand_eye: [1.0]\n", ", line 2: ", HOLDS),
        ("n:\n  ros__parameters:\n    - [\n", ", line 3: ", "correct it, or leave it out"),
        (None, " does not exist or cannot be read; ", "name another one after --params-file"),
    ],
)
def test_a_broken_parameter_file_is_one_line(tmp_path, text, words, advice):
    path = tmp_path / "my cell.yaml"
    if text is not None:
        path.write_text(text)
    ended = run_a_node("file", "--ros-args", "--params-file", str(path))
    assert ended.returncode == 2
    assert ended.stderr.startswith(f"error: params file {path}{words}")
    assert advice in ended.stderr
    assert len(ended.stderr.splitlines()) == 1


def test_a_list_of_mixed_numbers_on_the_command_line_is_one_line():
    ended = run_a_node("list", "--ros-args", "-p", "hand_eye:=[0.1, 0]")
    assert (ended.returncode, len(ended.stderr.splitlines())) == (2, 1)
    assert ended.stderr.startswith(
        "error: parameter hand_eye:=[0.1, 0]: the values of a list differ in type; write 0.0"
    )


def test_a_node_that_the_system_refuses_is_one_line():
    ended = run_a_node("refused")
    reason = "pthread_create failed: Resource temporarily unavailable"
    assert (ended.returncode, ended.stderr) == (1, f"error: the node cannot be created: {reason}\n")
    assert "Traceback" in run_a_node("refused", ACTIVE6D_TRACEBACK="1").stderr


@pytest.mark.parametrize(
    ("variables", "text"),
    [
        ({"ROS_DOMAIN_ID": "seven"}, "error: ROS_DOMAIN_ID is 'seven', expected a number from 0 to 101"),
        ({"ROS_DOMAIN_ID": "500"}, "error: ROS_DOMAIN_ID is '500', expected a number from 0 to 101"),
        ({"ROS_LOG_DIR": "/dev/null/log"}, "error: the log folder cannot be written; set ROS_LOG_DIR to another one"),
    ],
)
def test_surroundings_in_which_no_node_starts_are_one_line(variables, text):
    ended = run_a_node("end", **variables)
    assert ended.returncode == 2
    assert ended.stderr.startswith(text)
    assert len(ended.stderr.splitlines()) == 1


def test_help_shows_how_parameters_are_given():
    ended = run_a_node("help", "--help")
    assert ended.returncode == 0
    assert "--ros-args -p NAME:=VALUE" in ended.stdout


def test_an_end_that_wakes_nobody_still_ends_the_node():
    ended = run_a_node("end")
    assert ended.returncode == 0
    assert all("[INFO]" in line for line in ended.stderr.splitlines()), ended.stderr


def test_latched_inputs_reach_a_node_that_comes_late(graph):
    results = graph.mailbox(String, "result")
    graph.publish("depth", depth_to_image(np.full((2, 2), 5, np.float32), 1, "c"), latched=True, subscribers=0)
    graph.add(DepthNode(context=graph.context))
    graph.spin_until_filled([results])
    assert results[0].data == "5.0"


class DriverNode(GraphNode):
    """Listens to a camera that is not this project's."""

    def __init__(self, **kwargs):
        super().__init__("driver_node", **kwargs)
        self.stamps = []
        topic = Topic("camera/depth", "sensor_msgs/msg/Image", Per.VIEW, "camera")
        self.input(topic, lambda message: self.stamps.append(message.header.stamp.sec))


@pytest.mark.parametrize("reliability", [ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE])
@pytest.mark.parametrize("durability", [DurabilityPolicy.VOLATILE, DurabilityPolicy.TRANSIENT_LOCAL])
def test_every_drivers_quality_of_service_is_matched(graph, reliability, durability):
    node = graph.add(DriverNode(context=graph.context))
    qos = QoSProfile(depth=5, reliability=reliability, durability=durability)
    publisher = graph.node.create_publisher(Image, "camera/depth", qos)
    graph.spin_until(publisher.get_subscription_count)
    publisher.publish(depth_to_image(np.ones((2, 2), np.float32), 3_000_000_000, "c"))
    graph.spin_until(lambda: node.stamps == [3])
    (taken,) = [s.qos_profile for s in node.subscriptions if s.topic_name == "/camera/depth"]
    assert (taken.reliability, taken.durability) == (reliability, durability)


def test_every_big_image_of_a_reliable_volatile_driver_arrives(graph):
    """As best effort, big messages are lost without a word."""
    node = graph.add(DriverNode(context=graph.context))
    publisher = graph.node.create_publisher(Image, "camera/depth", QoSProfile(depth=10))
    graph.spin_until(publisher.get_subscription_count)
    depth = np.full((480, 640), 0.8, np.float32)
    for second in range(1, 21):
        publisher.publish(depth_to_image(depth, second * 1_000_000_000, "c"))
        graph.spin_until(lambda: node.stamps[-1:] == [second])  # noqa: B023
    assert node.stamps == list(range(1, 21))


@given(st.permutations([(stamp, name) for stamp in (1, 2, 3) for name in "abc"]))
def test_sets_are_handed_on_once_and_never_after_a_newer_one_that_they_began_before(arrivals):
    complete, dropped, refused = [], [], []
    synchronizer = StampSynchronizer(
        "abc", lambda stamp, values: complete.append((stamp, values)), lambda stamp, absent: dropped.append(stamp)
    )
    for stamp, name in arrivals:
        try:
            synchronizer.add(name, stamp, f"{name}{stamp}")
        except MessageError:
            refused.append(stamp)
    stamps = [stamp for stamp, _ in complete]
    assert all(values == {name: f"{name}{stamp}" for name in "abc"} for stamp, values in complete)
    # By hand: a set is dropped when a newer one completes while it is begun and incomplete.
    ends = {stamp: max(at for at, (other, _) in enumerate(arrivals) if other == stamp) for stamp in (1, 2, 3)}
    begins = {stamp: min(at for at, (other, _) in enumerate(arrivals) if other == stamp) for stamp in (1, 2, 3)}
    expected, over = [], set()
    for stamp in sorted(ends, key=ends.get):
        if stamp not in over:
            expected.append(stamp)
            over |= {older for older in range(1, stamp) if begins[older] < ends[stamp] < ends[older]}
    assert stamps == expected
    assert sorted(dropped) == sorted(over)
    assert set(refused) == over


def test_a_replacement_is_taken_until_the_set_is_complete():
    complete = []
    synchronizer = StampSynchronizer("ab", lambda stamp, values: complete.append(values))
    synchronizer.add("a", 1, "first")
    synchronizer.add("a", 1, "again")
    assert synchronizer.missing() == {1: {"b"}}
    synchronizer.add("a", 2, "a")
    synchronizer.add("b", 2, "b")
    assert complete == [{"a": "a", "b": "b"}]
    with pytest.raises(OutdatedError, match="duplicate"):
        synchronizer.add("b", 2, "b")
    with pytest.raises(OutdatedError, match="stale"):
        synchronizer.add("b", 1, "b")


def test_incomplete_sets_do_not_pile_up_unnoticed():
    lost = []
    synchronizer = StampSynchronizer("ab", lambda stamp, values: None, lambda *loss: lost.append(loss), depth=4)
    for stamp in range(100):
        synchronizer.add("a", stamp * 1_000_000_000, None)
    assert lost == [(second * 1_000_000_000, ["b"]) for second in range(96)]
    assert sorted(synchronizer.missing()) == [second * 1_000_000_000 for second in range(96, 100)]
    synchronizer.add("b", 98 * 1_000_000_000, None)  # completes one, and overtakes those before it
    assert lost[96:] == [(96_000_000_000, ["b"]), (97_000_000_000, ["b"])]
    assert sorted(synchronizer.missing()) == [99 * 1_000_000_000]


@given(st.lists(st.integers(10**9, 2 * 10**18), min_size=1, max_size=100))
def test_lone_messages_of_any_stamp_leave_room_for_what_comes_next(stamps):
    complete = []
    synchronizer = StampSynchronizer("ab", lambda stamp, values: complete.append(stamp))
    for stamp in stamps:
        synchronizer.add("a", stamp, None)
    for stamp in (10, 11):
        synchronizer.add("a", stamp, None)
        synchronizer.add("b", stamp, None)
    assert complete == [10, 11]


def test_a_destroyed_node_leaves_no_threads():
    def threads():
        return len(os.listdir("/proc/self/task"))

    context = Context()
    context.init(args=[], domain_id=fresh_domain())
    gc.disable()  # rclpy by itself leaves a lifecycle node's participant to the garbage collector
    try:
        before = threads()
        node = DepthNode(context=context)
        node.start()
        assert threads() > before
        node.destroy_node()
        assert threads() == before
    finally:
        gc.enable()
        context.try_shutdown()
