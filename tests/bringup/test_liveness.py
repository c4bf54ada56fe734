"""A hung process is noticed within seconds, and one that computes or has not begun to beat is left alone."""

import os
import signal
import subprocess
import sys

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from active6d_bringup.graph.liveness import HUNG_SECONDS, Pulses, processor_seconds
from active6d_core.ros.conversions import HARDWARE_ID


class Clock:
    now = 100.0

    def __call__(self):
        return self.now


@pytest.fixture
def pulses(graph, monkeypatch):
    clock, watch = Clock(), None
    watch = Pulses(graph.node, clock)
    watch.clock, watch.computed = clock, 0.0
    monkeypatch.setattr("active6d_bringup.graph.liveness.processor_seconds", lambda process: watch.computed)
    return watch


def beat(pulses):
    pulses._on_diagnostics(DiagnosticArray(status=[DiagnosticStatus(name="/cell/fusion", hardware_id=HARDWARE_ID)]))


def wait(pulses, seconds, work=0.0):
    """Look once a second; whether the node was found hung."""
    for _ in range(seconds):
        pulses.clock.now += 1.0
        pulses.computed += work
        if pulses.stopped("fusion", 1):
            return True
    return False


def test_a_silent_idle_node_hangs_and_a_beating_or_busy_one_does_not(pulses):
    assert not wait(pulses, 60)  # it has not begun
    beat(pulses)
    assert not wait(pulses, 60, work=0.9)
    assert wait(pulses, round(HUNG_SECONDS) + 2, work=0.005)
    pulses.forget("fusion")
    assert not wait(pulses, 60)
    for _ in range(20):
        beat(pulses)
        assert not wait(pulses, 3)


def test_the_silence_while_nobody_looked_does_not_count(pulses):
    beat(pulses)
    assert not wait(pulses, 3)
    pulses.clock.now += 1000.0  # the supervisor itself was stopped
    assert not wait(pulses, 3)


def test_processor_time_is_what_the_process_used():
    process = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        before = processor_seconds(process.pid)
        while processor_seconds(process.pid) < before + 0.1:
            pass
        process.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, process.pid, os.WSTOPPED)
        stopped = processor_seconds(process.pid)
        assert all(processor_seconds(process.pid) == stopped for _ in range(1000))
    finally:
        process.kill()
        process.wait()
