"""Attacks on whole graphs of stub nodes: many in one process, resets, two in one domain, killed nodes and processes."""

import multiprocessing
import os
import shutil
import signal
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import psutil
import stub_camera  # noqa: F401  registers the estimator
from geometry_msgs.msg import PoseArray, PoseStamped
from rclpy.node import Node
from ros_harness import fresh_domain, reliable
from std_srvs.srv import Trigger
from stub_nodes import STUBS

from active6d_bringup.bags.reader import read_episode
from active6d_bringup.graph import processes
from active6d_bringup.graph.composition import ComposedGraph, running
from active6d_bringup.graph.episode import (
    EpisodeError,
    EpisodeResult,
    EpisodeSettings,
    EpisodeStep,
    describe,
    run_episode,
)
from active6d_core.ros.graph_nodes import NODES
from active6d_core.ros.network import DomainError
from active6d_core.ros.topics import EPISODE_END
from battery.trials import Level, Trial, Verdict

#: Seconds in which an episode ends that cannot go on, and that a kill of the one process may lose.
LATEST_END, MOST_LOST = 10.0, 1.0


@contextmanager
def stub_nodes() -> Iterator[None]:
    """The camera and estimator of episodes are those that answer at once."""
    before = {name: NODES[name] for name in STUBS}
    NODES.update(STUBS)
    try:
        yield
    finally:
        NODES.update(before)


def stub_episode(**changes: object) -> EpisodeSettings:
    """Settings of a short episode of stub nodes."""
    common = {"estimator": "stub", "policy": "random", "steps": 3, "seed": 4, "domain": fresh_domain()}
    return EpisodeSettings(**{**common, **changes})


def same(result: EpisodeResult, expected: EpisodeResult) -> bool:
    """Whether two episodes went the same way and found the same."""
    pairs = zip(result.steps, expected.steps, strict=False)
    return len(result.steps) == len(expected.steps) and all(
        np.array_equal(a.T_world_camera, b.T_world_camera)
        and np.array_equal(a.objects.T_world_object, b.objects.T_world_object)
        for a, b in pairs
    )


def _megabytes() -> float:
    return psutil.Process().memory_info().rss / 1e6


def episodes() -> Iterator[Trial | Verdict]:
    """Episodes one after the other in one process: results of the first, and memory that is level after a while."""
    with stub_nodes():
        expected, level = run_episode(stub_episode()), Level()

        def trial(rng: np.random.Generator) -> str:
            result = run_episode(stub_episode())
            level.add(_megabytes())
            return "" if same(result, expected) else "another result"

        yield trial
        yield level.verdict()


def resets() -> Iterator[Trial | Verdict]:
    """Episodes one after the other in one graph, each begun by the service of the real camera: equal, memory level."""
    # Sensor noise and the random policy have other numbers at every stamp. The camera is as small as the stub's.
    camera = {"width": 64, "height": 48, "noise_scale": 0.0}
    settings = EpisodeSettings(
        scene="mug/test/0",
        estimator="stub",
        policy="unidirectional",
        steps=2,
        domain=fresh_domain(),
        overrides={"camera_simulator": camera},
    )
    with running(ComposedGraph(describe(settings))) as graph:
        listener = _Listener(graph)
        graph.start()
        expected, level = listener.episode(), Level(warm_up=100)  # nodes remember 256 stamps

        def trial(rng: np.random.Generator) -> str:
            listener.reset()
            found = listener.episode()
            level.add(_megabytes())
            return "" if found == expected else "another result"

        yield trial
        yield level.verdict()


class _Listener:
    """Goes through the episodes of a composed graph: the camera's poses and the objects' of each."""

    def __init__(self, graph: ComposedGraph) -> None:
        self._graph = graph
        node = Node("battery", context=graph.context, start_parameter_services=False, enable_rosout=False)
        graph.add(node)
        self._found: list[bytes] = []
        self._ends: list[Any] = []
        node.create_subscription(PoseStamped, "camera/pose", lambda m: self._keep(m.pose), reliable(True))
        node.create_subscription(PoseArray, "objects/poses", lambda m: self._keep(m.poses), reliable(True))
        node.create_subscription(EPISODE_END.message_type, EPISODE_END.name, self._ends.append, reliable())
        self._client = node.create_client(Trigger, "camera_simulator/reset")

    def _keep(self, poses: Any) -> None:
        self._found.append(repr(poses).encode())

    def reset(self) -> None:
        """Begin a new episode."""
        self._spin_until(self._client.service_is_ready)
        answer = self._client.call_async(Trigger.Request())
        self._spin_until(answer.done)

    def episode(self) -> list[bytes]:
        """What the episode that runs shows until it ends, in an order that does not depend on threads."""
        self._spin_until(lambda: self._ends and len(self._found) == 6)
        found = sorted(self._found)
        self._found.clear()
        self._ends.clear()
        return found

    def _spin_until(self, predicate: Any) -> None:
        deadline = time.monotonic() + 20.0
        while not predicate():
            if time.monotonic() > deadline:
                raise TimeoutError(f"{len(self._found)} messages, {len(self._ends)} ends in 20 s")
            self._graph.spin_once(0.05)


def pairs() -> Iterator[Trial]:
    """Two episodes at once in one domain: both right, or refused; also where neither sees the other's lock."""
    with stub_nodes(), TemporaryDirectory() as folder:
        expected = run_episode(stub_episode())
        with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as pool:

            def trial(rng: np.random.Generator) -> str:
                domain, begin = fresh_domain(), time.time() + 0.2
                seen = bool(rng.random() < 0.5)
                jobs = []
                for number in range(2):
                    locks = Path(folder) / ("locks" if seen else f"locks_{number}")
                    locks.mkdir(exist_ok=True)
                    jobs.append(pool.submit(_one_of_two, domain, locks, begin))
                    begin += float(rng.choice([0.0, rng.uniform(0.0, 0.5)]))
                ends = [job.result(timeout=120.0) for job in jobs]
                wrong = [end for end in ends if isinstance(end, EpisodeResult) and not same(end, expected)]
                refused = [end for end in ends if isinstance(end, str)]
                told = all("another active6d command" in text or "nodes publish it" in text for text in refused)
                if wrong or not told or (seen and len(refused) == 2):
                    return f"{'one lock' if seen else 'two locks'}: {len(wrong)} wrong; {refused}"
                return ""

            yield trial


def _one_of_two(domain: int, locks: Path, begin: float) -> EpisodeResult | str:
    """An episode that begins at a time; the reason if it did not come to its end."""
    tempfile.tempdir = str(locks)
    NODES.update(STUBS)
    time.sleep(max(begin - time.time(), 0.0))
    try:
        return run_episode(stub_episode(domain=domain, patience=10.0))
    except (DomainError, EpisodeError) as error:
        return str(error)


def composed() -> Iterator[Trial]:
    """SIGKILL of the one process of an episode: what it had found a second before is in the bag."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["battery.graphs"])
    with TemporaryDirectory() as folder:

        def trial(rng: np.random.Generator) -> str:
            bag = Path(folder) / "bag"
            ours, theirs = context.Pipe()
            child = context.Process(target=_recorded, args=(bag, fresh_domain(), theirs))
            child.start()
            theirs.close()
            steps, struck = [], time.time() + 60.0
            try:
                while time.time() < struck and ours.poll(max(struck - time.time(), 0.0)):
                    steps.append(ours.recv())
                    if len(steps) == 1:
                        struck = time.time() + rng.uniform(0.0, 3.0)
                assert child.pid is not None
                os.kill(child.pid, signal.SIGKILL)
                struck = time.time()
                child.join()
                recorded = read_episode(bag)
            finally:
                child.kill()
                shutil.rmtree(bag, ignore_errors=True)
            held = {step.stamp: len(step.objects) for step in recorded.steps if step.objects is not None}
            lost = [index for index, stamp, at, count in steps if at < struck - MOST_LOST and held.get(stamp) != count]
            return "" if steps and not lost else f"views {lost} of {len(steps)} are not in the bag"

        yield trial


def _recorded(bag: Path, domain: int, sent: Connection) -> None:
    NODES.update(STUBS)
    settings = stub_episode(bag=bag, domain=domain, steps=90)
    run_episode(settings, lambda step: sent.send((step.index, step.stamp, time.time(), len(step.objects))))
    time.sleep(60.0)


def kills() -> Iterator[Trial]:
    """A node that is killed or stopped: the episode ends as ever, or within ten seconds; its bag is read."""
    with stub_nodes(), TemporaryDirectory() as folder:
        expected = run_episode(stub_episode())

        def trial(rng: np.random.Generator) -> str:
            graphs: list[processes.ProcessGraph] = []
            victim = str(
                rng.choice(
                    ["camera_simulator", "pose_estimator", "hypothesis_fusion", "attention_policy", "episode_recorder"]
                )
            )
            number = signal.Signals(rng.choice([signal.SIGKILL, signal.SIGSTOP]))
            index, bag, struck = int(rng.integers(3)), Path(folder) / "bag", 0.0

            class Watched(processes.ProcessGraph):
                def __init__(self, *arguments: object, **options: object) -> None:
                    super().__init__(*arguments, **options)  # type: ignore[arg-type]
                    graphs.append(self)

            def strike(step: EpisodeStep) -> None:
                nonlocal struck
                if step.index == index and not struck:
                    struck = time.monotonic()
                    os.kill(graphs[0].processes[victim].pid, number)

            what, original = f"{victim}, {number.name} at view {index}", processes.ProcessGraph
            processes.ProcessGraph = Watched  # type: ignore[misc]
            try:
                result = run_episode(stub_episode(processes=True, bag=bag, patience=60.0), strike)
                recorded = read_episode(bag)
                right = same(result, expected) and len(recorded.steps) == len(result.steps)
                return "" if right else f"{what}: another result"
            except processes.ProcessError as error:
                seconds = time.monotonic() - struck
                if victim != "camera_simulator" or seconds > LATEST_END:
                    return f"{what}: {error} after {seconds:.1f} s"
                return "" if len(read_episode(bag).steps) > index else f"{what}: views are not in the bag"
            finally:
                processes.ProcessGraph = original  # type: ignore[misc]
                shutil.rmtree(bag, ignore_errors=True)

        yield trial
