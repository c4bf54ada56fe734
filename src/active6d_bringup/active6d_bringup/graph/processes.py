"""The same graph with every node in an operating system process of its own, supervised."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from threading import Event
from typing import Any

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.client import Client
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_srvs.srv import Trigger

from active6d_bringup.graph.composition import (
    UNANSWERED,
    EpisodeInterrupted,
    GraphDescription,
    OnEvent,
    open_context,
)
from active6d_bringup.graph.liveness import HUNG_SECONDS, Pulses
from active6d_core.interrupts import INTERRUPTS
from active6d_core.ros.graph_nodes import BAD_PARAMETERS, MAX_RESTARTS, NODES
from active6d_core.ros.node import connections

# Nodes have nothing to lose, and one that computes ignores an interrupt. The recorder closes its bag.
_STOP_SECONDS, _STOP_RECORDER_SECONDS = 1.5, 10.0
_GRACE_SECONDS = 4.5
_ASK_AGAIN_SECONDS = 3.0


class ProcessError(RuntimeError):
    """A node's process ended or did not answer; the text names it."""


class ProcessGraph:
    """One process a node. A node that dies is reported, and started again if the episode can survive that.

    No process outlives this one: they are ended by :meth:`close`, and by the kernel if this process is killed.

    Args:
        description: of the graph.
        on_event: called with what happens to the nodes, in words.
        patience: seconds that a node has to come up, and again to set itself up.
        interrupted: once it is set, starting is given up.
    """

    def __init__(
        self,
        description: GraphDescription,
        on_event: OnEvent = lambda text: None,
        patience: float = 120.0,
        interrupted: Event | None = None,
    ) -> None:
        self._description = description
        self._interrupted = interrupted or Event()
        # The nodes are interrupted first, then the recorder, so that it records all of them.
        INTERRUPTS.grace = _GRACE_SECONDS
        self._patience = patience
        self._on_event = on_event
        self.context = open_context(description)
        self.executor = SingleThreadedExecutor(context=self.context)
        self._node = Node(
            "supervisor", context=self.context, namespace=description.namespace, use_global_arguments=False
        )
        self.executor.add_node(self._node)
        self._guests: list[Node] = []
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self.restarted: list[str] = []
        self._started = False
        self._pulses = Pulses(self._node)
        self._complete = self._node.create_client(Trigger, "episode_recorder/complete")
        self._recorded: list[Any] = []
        self._asked = 0.0
        self._unrecorded = [UNANSWERED]

    def add(self, node: Node) -> None:
        """Spin one more node of the caller's in this process."""
        self._guests.append(node)
        self.executor.add_node(node)

    def start(self) -> None:
        """Start every process, let them find each other, then configure all of them at once and activate them in order.

        Raises:
            ProcessError: a node ended, or did not come up in time.
        """
        for name in self._description.in_order():
            self._on_event(f"starting {name}")
            self._spawn(name, autostart=False)
        clients = {
            name: self._node.create_client(ChangeState, f"{name}/change_state") for name in self._description.in_order()
        }
        for name, client in clients.items():
            self._wait(client.service_is_ready, f"{name} did not come up")
        self._wait(self._all_connected, "the nodes did not find each other")
        self._change(clients, Transition.TRANSITION_CONFIGURE)
        for name, client in clients.items():
            self._change({name: client}, Transition.TRANSITION_ACTIVATE)
        self._started = True

    def spin_once(self, timeout: float) -> None:
        """Run one callback of this process and look after the others.

        Raises:
            ProcessError: a node ended that the episode cannot do without.
        """
        self.executor.spin_once(timeout_sec=timeout)
        for name, process in list(self.processes.items()):
            if process.poll() is None and self._started and self._pulses.stopped(name, process.pid):
                self._on_event(f"{name} hangs: no heartbeat for {HUNG_SECONDS:.0f} s")
                process.kill()
                process.wait()
            if process.poll() is not None:
                self._bury(name, process.returncode)

    def missing(self, stamp: int) -> list[str]:
        """What the recorder's process still waits for."""
        if "episode_recorder" not in self.processes:
            return []
        if not self._recorded:
            self._asked = time.monotonic()
        if _answered(self._complete, self._recorded, self._asked):
            answer = next(answer for answer in self._recorded if answer.done()).result()
            self._recorded = []
            self._unrecorded = [] if answer.success else [f"episode_recorder, {answer.message}"]
        return self._unrecorded

    def close(self) -> None:
        """Interrupt every process, the recorder last so that it sees all of them end; kill what does not listen."""
        recorder = self.processes.pop("episode_recorder", None)
        _end([*self.processes.values()], _STOP_SECONDS)
        _end([recorder] if recorder else [], _STOP_RECORDER_SECONDS)
        for node in [*self._guests, self._node]:
            self.executor.remove_node(node)
            node.destroy_node()
        self.executor.shutdown()
        self.context.try_shutdown()
        self._description.release_domain()

    def _spawn(self, name: str, autostart: bool) -> None:
        description = self._description
        parameters = {**description.nodes[name], "autostart": autostart}
        if name == "episode_recorder" and self._started:
            parameters["resume"] = True
            # What its predecessor was asked is not answered any more.
            self._recorded, self._unrecorded = [], [UNANSWERED]
        self._pulses.forget(name)
        command = [sys.executable, "-m", NODES[name].module, *description.ros_arguments()]
        if description.namespace:
            command += ["-r", f"__ns:=/{description.namespace.strip('/')}"]
        for key, value in parameters.items():
            command += ["-p", f"{key}:={json.dumps(value)}"]
        if setpriv := shutil.which("setpriv"):
            command = [setpriv, "--pdeathsig", "TERM", *command]
        environment = {**os.environ, "ROS_DOMAIN_ID": str(description.domain_id())}
        # Own process group: Ctrl-C reaches this process only, which then ends the others in order.
        self.processes[name] = subprocess.Popen(command, env=environment, process_group=0)

    def _bury(self, name: str, code: int) -> None:
        cause = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        del self.processes[name]
        if not self._started or code == BAD_PARAMETERS or not NODES[name].restarted:
            raise ProcessError(f"{name} ended ({cause}); see its own message above")
        if self.restarted.count(name) == MAX_RESTARTS:
            raise ProcessError(f"{name} ended ({cause}) for the {MAX_RESTARTS + 1}th time; giving up")
        self.restarted.append(name)
        self._on_event(f"{name} died ({cause}), starting it again")
        self._spawn(name, autostart=True)

    def _wait(self, predicate: Callable[[], bool], failure: str) -> None:
        deadline = time.monotonic() + self._patience
        while not predicate():
            if self._interrupted.is_set():
                raise EpisodeInterrupted
            if time.monotonic() > deadline:
                raise ProcessError(f"{failure} within {self._patience:.0f} s")
            self.spin_once(0.05)

    def _all_connected(self) -> bool:
        """Whether every node has found all publishers and subscribers of its topics, this process's own among them."""
        reports = [connections(node) for node in self._guests]
        for name in self._description.in_order():
            client = self._node.create_client(Trigger, f"{name}/connections")
            self._wait(client.service_is_ready, f"{name} did not come up")
            answers = [client.call_async(Trigger.Request())]
            self._wait(partial(_answered, client, answers, time.monotonic()), f"{name} did not answer")
            reports += [json.loads(answer.result().message) for answer in answers if answer.done()][:1]
            self._node.destroy_client(client)
        for own, others in (("outputs", "inputs"), ("inputs", "outputs")):
            expected = Counter(topic for report in reports for topic, _ in report[others])
            if any(found < expected[topic] for report in reports for topic, found in report[own]):
                return False
        return True

    def _change(self, clients: dict[str, Client], transition: int) -> None:
        request = ChangeState.Request(transition=Transition(id=transition))
        answers = {name: client.call_async(request) for name, client in clients.items()}
        for name, answer in answers.items():
            self._wait(answer.done, f"{name} did not answer")
            if not answer.result().success:
                raise ProcessError(f"{name} could not start; see its own message above")


def _answered(client: Client, answers: list[Any], began: float) -> bool:
    """Whether one of the calls was answered; the first is made at once, and one more after some seconds without.

    A service that has not discovered its client yet cannot answer: the middleware drops what it sends.
    """
    if time.monotonic() >= began + _ASK_AGAIN_SECONDS * len(answers):
        answers.append(client.call_async(Trigger.Request()))
    return any(answer.done() for answer in answers)


def _end(processes: list[subprocess.Popen[bytes]], seconds: float) -> None:
    for process in processes:
        # Not SIGINT: a process that still imports would print a traceback.
        process.terminate()
    deadline = time.monotonic() + seconds
    for process in processes:
        try:
            process.wait(max(deadline - time.monotonic(), 0.1))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
