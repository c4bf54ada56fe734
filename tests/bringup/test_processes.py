"""Every node in its own process: they find each other, the dead come back or are named, none is left behind."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import psutil
import pytest
from rclpy.task import Future
from ros_harness import fresh_domain

from active6d_bringup.bags.reader import read_episode
from active6d_bringup.graph import episode as episode_module
from active6d_bringup.graph import processes as processes_module
from active6d_bringup.graph.composition import GraphDescription, running
from active6d_bringup.graph.episode import EpisodeInterrupted, EpisodeSettings, run_episode
from active6d_bringup.graph.processes import ProcessError, ProcessGraph
from active6d_core.ros.graph_nodes import NODES, NodeEntry


@pytest.fixture
def graphs(monkeypatch):
    """The process graphs that the test starts; afterwards, none of their processes may be left."""
    started = []

    class WatchedGraph(ProcessGraph):
        def __init__(self, *arguments, **options):
            super().__init__(*arguments, **options)
            started.append(self)

    monkeypatch.setattr(processes_module, "ProcessGraph", WatchedGraph)
    monkeypatch.setitem(
        NODES,
        "camera_simulator",
        NodeEntry("stub_camera", "StubCameraNode"),
    )
    monkeypatch.setitem(
        NODES,
        "pose_estimator",
        NodeEntry("stub_estimator", "PoseEstimatorNode", restarted=True),
    )
    yield started
    assert not [child for child in psutil.Process().children(recursive=True) if "--ros-args" in child.cmdline()]


def settings(bag=None, **changes):
    default = {"estimator": "stub", "policy": "random", "steps": 3, "seed": 4, "patience": 60.0, "processes": True}
    return EpisodeSettings(**{**default, "bag": bag, "domain": fresh_domain(), **changes})


def killer(graphs, victim, index=1):
    def kill(step):
        if step.index == index:
            os.kill(graphs[0].processes[victim].pid, signal.SIGKILL)

    return kill


@pytest.mark.slow
def test_a_node_that_hangs_at_the_first_view_is_noticed(graphs):
    events = []

    def stop(step):
        if step.index == 0:
            os.kill(graphs[0].processes["attention_policy"].pid, signal.SIGSTOP)

    result = run_episode(settings(patience=30.0), stop, events.append)
    assert sum("attention_policy hangs" in event for event in events) == 1
    assert len(result.steps) == 4


@pytest.mark.slow
def test_an_episode_waits_for_a_recorder_that_starts_again(graphs, tmp_path, monkeypatch):
    monkeypatch.setattr(episode_module, "_SETTLE_SECONDS", 0.5)  # a recorder takes longer to start
    result = run_episode(settings(tmp_path / "bag"), killer(graphs, "episode_recorder", 0))
    assert len(read_episode(tmp_path / "bag").steps) == len(result.steps) == 4
    assert (tmp_path / "bag" / "metadata.yaml").is_file()


@pytest.mark.slow
def test_killed_estimator_comes_back_and_the_episode_ends_as_ever(graphs, tmp_path):
    events = []
    result = run_episode(settings(tmp_path / "bag"), killer(graphs, "pose_estimator"), events.append)
    assert "pose_estimator died (SIGKILL), starting it again" in events
    record = read_episode(tmp_path / "bag")
    assert record.end_reason == result.reason == "budget of 3 moves spent"
    composed = run_episode(settings(processes=False))
    for lived, expected in zip(result.steps, composed.steps, strict=True):
        assert lived.stamp == expected.stamp
        np.testing.assert_array_equal(lived.T_world_camera, expected.T_world_camera)
        np.testing.assert_array_equal(lived.objects.T_world_object, expected.objects.T_world_object)
    # A word that the estimator was killed over may have reached fusion but not the recorder, which then says so.
    incomplete = any("bag is not complete" in event for event in events)
    for recorded, expected in zip(record.steps, composed.steps, strict=True):
        assert recorded.hypotheses is not None or incomplete
        np.testing.assert_array_equal(recorded.objects.T_world_object, expected.objects.T_world_object)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("victim", "number"),
    [
        ("episode_recorder", signal.SIGKILL),
        ("pose_estimator", signal.SIGSTOP),
    ],
)
def test_killed_recorder_and_hung_estimator_come_back(graphs, tmp_path, victim, number):
    def strike(step):
        if step.index == 1:
            os.kill(graphs[0].processes[victim].pid, number)

    events = []
    result = run_episode(settings(tmp_path / "bag"), strike, events.append)
    assert any(event.startswith(f"{victim} died (SIGKILL)") for event in events)
    assert (f"{victim} hangs: no heartbeat for 5 s" in events) == (number == signal.SIGSTOP)
    record = read_episode(tmp_path / "bag")
    assert record.damage == ()
    assert [step.stamp for step in record.steps] == [step.stamp for step in result.steps]
    assert len(list((tmp_path / "bag").glob("*.mcap"))) == (2 if victim == "episode_recorder" else 1)


@pytest.mark.slow
def test_killed_policy_comes_back_and_the_episode_ends_as_ever(graphs, tmp_path):
    events = []
    result = run_episode(settings(tmp_path / "bag"), killer(graphs, "attention_policy", 2), events.append)
    assert "attention_policy died (SIGKILL), starting it again" in events
    record = read_episode(tmp_path / "bag")
    assert record.end_reason == result.reason == "budget of 3 moves spent"
    composed = run_episode(settings(processes=False))
    for lived, recorded, expected in zip(result.steps, record.steps, composed.steps, strict=True):
        assert lived.stamp == recorded.stamp == expected.stamp
        np.testing.assert_array_equal(lived.T_world_camera, expected.T_world_camera)
        np.testing.assert_array_equal(recorded.objects.T_world_object, expected.objects.T_world_object)


@pytest.mark.slow
@pytest.mark.parametrize(("number", "seconds"), [(signal.SIGKILL, 3.0), (signal.SIGSTOP, 10.0)])
def test_a_camera_that_dies_or_hangs_ends_the_episode_within_seconds(graphs, tmp_path, number, seconds):
    struck = []

    def strike(step):
        if step.index == 1:
            os.kill(graphs[0].processes["camera_simulator"].pid, number)
            struck.append(time.monotonic())

    with pytest.raises(ProcessError, match=r"camera_simulator ended \(SIGKILL\)"):
        run_episode(settings(tmp_path / "bag", steps=500), strike)
    assert time.monotonic() - struck[0] < seconds + 5.0, "five seconds are for the end of the other processes"
    assert len(read_episode(tmp_path / "bag").steps) >= 2


def test_node_that_cannot_be_replaced_is_named(graphs):
    graph = processes_module.ProcessGraph(GraphDescription({"camera_simulator": {}}, domain=fresh_domain()))
    with running(graph):
        graph.start()
        graph.processes["camera_simulator"].kill()
        with pytest.raises(ProcessError, match=r"camera_simulator ended \(SIGKILL\)"):
            spin(graph)


def test_a_question_whose_answer_is_lost_is_asked_again():
    calls = []

    class Client:
        def call_async(self, request):
            calls.append(Future())
            if len(calls) == 2:
                calls[-1].set_result("answer")
            return calls[-1]

    client, answers = Client(), []
    answers.append(client.call_async(None))
    now = time.monotonic()
    assert not processes_module._answered(client, answers, now)
    assert processes_module._answered(client, answers, now - processes_module._ASK_AGAIN_SECONDS - 1.0)
    assert len(calls) == 2


def test_bad_parameter_is_not_restarted(graphs):
    description = GraphDescription({"hypothesis_fusion": {"epsilon": -1.0}}, domain=fresh_domain())
    graph = processes_module.ProcessGraph(description)
    with running(graph), pytest.raises(ProcessError, match=r"hypothesis_fusion ended \(exit code 2\)"):
        graph.start()


def spin(graph, seconds=20.0):
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        graph.spin_once(0.05)


@pytest.mark.slow
def test_interrupt_closes_the_bag_and_ends_every_process(graphs, tmp_path):
    def interrupt(step):
        if step.index == 1:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(EpisodeInterrupted):
        run_episode(settings(tmp_path / "bag", steps=500), interrupt)
    assert len(read_episode(tmp_path / "bag").steps) >= 2


@pytest.mark.slow
def test_nodes_die_with_a_killed_supervisor(graphs):
    script = (
        "import sys, time; from active6d_bringup.graph.composition import GraphDescription;"
        "from active6d_core.ros.graph_nodes import NODES, NodeEntry;"
        "from active6d_bringup.graph.processes import ProcessGraph;"
        "graph = ProcessGraph(GraphDescription({'attention_policy': {}}, domain=int(sys.argv[1])));"
        "graph.start(); print(*[process.pid for process in graph.processes.values()], flush=True); time.sleep(60)"
    )
    command = [sys.executable, "-c", script, str(fresh_domain())]
    supervisor = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    nodes = [psutil.Process(int(pid)) for pid in supervisor.stdout.readline().split()]
    assert len(nodes) == 1
    supervisor.kill()
    supervisor.wait()
    _, alive = psutil.wait_procs(nodes, timeout=15)
    assert not alive
