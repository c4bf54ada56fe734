"""The reliability battery: seeded attacks on messages, bags, views, files and processes, as many as the time allows.

    python tests/battery.py --seconds 1200 --seed 0

Each row of the table is one kind of attack with the number of trials and of failures; exit code 1 if there are any.
"""

import argparse
import os
import shutil
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

ROOT = Path(__file__).parent
sys.path += [str(ROOT), str(ROOT / "core"), str(ROOT / "bringup")]

import numpy as np  # noqa: E402
import psutil  # noqa: E402
from rclpy.context import Context  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.serialization import deserialize_message, serialize_message  # noqa: E402
from ros_harness import GraphHarness, fresh_domain, reliable  # noqa: E402
from stub_episode import StubEpisode  # noqa: E402
from test_bag_reader import damage_of, write_bag  # noqa: E402
from test_view_inputs import Follower  # noqa: E402

from active6d_bringup.bags.reader import read_episode  # noqa: E402
from active6d_bringup.graph import processes  # noqa: E402
from active6d_bringup.graph.episode import EpisodeResult, EpisodeSettings, EpisodeStep, run_episode  # noqa: E402
from active6d_core.camera import PinholeCamera, View  # noqa: E402
from active6d_core.object_model import load_object  # noqa: E402
from active6d_core.ros import conversions  # noqa: E402
from active6d_core.ros.conversions import MessageError  # noqa: E402
from active6d_core.ros.graph_nodes import NODES, NodeEntry  # noqa: E402
from active6d_core.ros.topics import CAMERA_INFO, CAMERA_POSE  # noqa: E402
from active6d_perception.estimators.registry import create_estimator  # noqa: E402

SECOND = 10**9
FRAME = "camera_optical_frame"
#: Seconds of processor time; a view that takes longer counts as a failure.
SLOWEST_VIEW = 2.0
#: Seconds in which an episode ends that cannot go on, and megabytes that episodes in one process may come to use.
LATEST_END, MOST_GROWTH = 10.0, 20.0
#: Episodes after which the memory of a process should be level.
WARM_UP = 20
Trial = Callable[[np.random.Generator], str]


def stamps() -> Iterator[Trial]:
    """Random messages with random stamps, then twenty valid views, of which none may be lost."""
    graph = GraphHarness()

    def trial(rng: np.random.Generator) -> str:
        follower = graph.add(Follower(context=graph.context))
        follower.view(10 * SECOND)
        for _ in range(int(rng.integers(1, 120))):
            kind = rng.choice(["info", "pose", "view", "announce"])
            late = int(rng.integers(2**31)) * SECOND + int(rng.integers(1, SECOND))
            getattr(follower, kind)(int(rng.choice([late, 0, SECOND + 1, 5 * SECOND + 1])))
        follower.views.clear()
        expected = [second * SECOND for second in range(11, 31)]
        for stamp in expected:
            follower.view(stamp)
        graph.remove(follower)
        return "" if follower.views == expected else f"{len(follower.views)} of 20 views"

    yield trial
    graph.close()


def messages() -> Iterator[Trial]:
    """Serialized messages with flipped bytes: read, or refused with a MessageError."""
    readers = {
        "camera/color/image_raw": conversions.image_to_color,
        "camera/depth/image_raw": conversions.image_to_depth,
        "camera/color/camera_info": conversions.info_to_camera,
        "camera/pose": lambda message: conversions.pose_stamped_to_transform(message, "world"),
        "hypotheses": lambda message: conversions.hypotheses_from_cloud(message, np.ones((24, 32), np.uint16), FRAME),
        "objects": lambda message: conversions.objects_from_cloud(message, "world"),
        "objects/unexplained": lambda message: conversions.points_from_cloud(message, "world"),
    }
    sent = [(topic, message) for topic, message in StubEpisode().messages() if topic in readers]

    def trial(rng: np.random.Generator) -> str:
        topic, message = sent[rng.integers(len(sent))]
        data = bytearray(serialize_message(message))
        last = min(len(data), int(rng.choice([200, len(data)])))
        for position in rng.integers(4, last, int(rng.integers(1, 20))):
            data[position] ^= int(rng.integers(1, 256))
        try:
            received = deserialize_message(bytes(data), type(message))
        except Exception:  # the middleware drops what it cannot read
            return ""
        try:
            conversions.stamp_to_ns(received.header.stamp)
            readers[topic](received)
        except MessageError:
            pass
        return ""

    yield trial


def wire() -> Iterator[Trial]:
    """Messages with flipped bytes through the middleware, then a valid view, which must arrive."""
    graph, context = GraphHarness(), Context()
    follower = graph.add(Follower(context=graph.context))
    context.init(args=[], domain_id=graph.domain)
    sender = Node("sender", context=context)
    topics = {topic.name: topic for topic in (CAMERA_INFO, CAMERA_POSE)}
    publishers = {
        name: sender.create_publisher(topic.message_type, name, reliable(True)) for name, topic in topics.items()
    }
    valid = {topic: message for topic, message in StubEpisode().messages() if topic in topics}
    count = 0

    def trial(rng: np.random.Generator) -> str:
        nonlocal count
        for _ in range(int(rng.integers(1, 30))):
            topic = str(rng.choice(list(valid)))
            data = bytearray(serialize_message(valid[topic]))
            for position in rng.integers(0, len(data), int(rng.integers(1, 20))):
                data[position] ^= int(rng.integers(1, 256))
            publishers[topic].publish(
                bytes(data[: int(rng.integers(1, len(data) + 1))] if rng.random() < 0.3 else data)
            )
        count += 1
        stamp = 10**15 + count * SECOND
        for topic, publisher in publishers.items():
            valid[topic].header.stamp = conversions.ns_to_stamp(stamp)
            publisher.publish(valid[topic])
        graph.spin_until(lambda: stamp in follower.views, timeout=10.0, what="the valid view")
        return ""

    yield trial
    sender.destroy_node()
    context.try_shutdown()
    graph.close()


@contextmanager
def stub_nodes() -> Iterator[None]:
    """The camera and estimator of episodes are those that answer at once."""
    stubs = {
        "camera_simulator": NodeEntry("stub_camera", "StubCameraNode"),
        "pose_estimator": NodeEntry("stub_estimator", "PoseEstimatorNode", restarted=True),
    }
    before = {name: NODES[name] for name in stubs}
    NODES.update(stubs)
    yield
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


def episodes() -> Iterator[Trial]:
    """Episodes one after the other in one process: results of the first, and memory that is level after a while."""
    with stub_nodes():
        expected, used, count = run_episode(stub_episode()), 0.0, 0

        def trial(rng: np.random.Generator) -> str:
            nonlocal used, count
            result, count = run_episode(stub_episode()), count + 1
            megabytes = psutil.Process().memory_info().rss / 1e6
            if count <= WARM_UP:
                used = megabytes
            grown = megabytes - used
            if not same(result, expected):
                return "another result"
            return "" if grown < MOST_GROWTH else f"{grown:.0f} MB more after {count} episodes"

        yield trial


def kills() -> Iterator[Trial]:
    """A node that is killed or stopped: the episode ends as ever, or within ten seconds; its bag is read."""
    with stub_nodes(), TemporaryDirectory() as folder:
        expected = run_episode(stub_episode())

        def trial(rng: np.random.Generator) -> str:
            graphs: list[processes.ProcessGraph] = []
            victim = str(rng.choice(["camera_simulator", "pose_estimator", "hypothesis_fusion", "attention_policy"]))
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


def bags() -> Iterator[Trial]:
    """A bag that is cut anywhere, or has one flipped byte: what is missing is reported."""
    with TemporaryDirectory() as folder:
        whole = write_bag(Path(folder) / "bag", StubEpisode().messages())

        def trial(rng: np.random.Generator) -> str:
            damaged = Path(shutil.copytree(whole, Path(folder) / "copy" / "bag"))
            path = damaged / "bag.mcap"
            data = bytearray(path.read_bytes())
            position = int(rng.integers(len(data)))
            if cut := rng.random() < 0.5:
                data = data[:position]
            else:
                data[position] ^= int(rng.integers(1, 256))
            path.write_bytes(data)
            try:
                reported = damage_of(damaged)
            finally:
                shutil.rmtree(damaged.parent)
            return "" if reported else f"{'cut at' if cut else 'flip of'} byte {position} is not reported"

        yield trial


def views() -> Iterator[Trial]:
    """Depth images that no scene shows, through the training-free estimator."""
    camera = PinholeCamera.from_field_of_view(160, 120, 60.0)
    estimator = create_estimator("geometric", load_object("mug"))
    color, noise = np.zeros((120, 160, 3), np.uint8), np.random.default_rng(0).uniform(0.5, 1.0, (120, 160))
    estimator.estimate(View(1, color, noise.astype(np.float32), camera, np.eye(4)))  # compiles its loops

    def trial(rng: np.random.Generator) -> str:
        rows, columns = np.indices((120, 160))
        near, far = np.sort(rng.uniform(0.05, 20.0, 2))
        period = int(rng.integers(1, 40))
        kinds = [
            rng.uniform(near, far, rows.shape),
            np.where((rows // period + columns // period) % 2, near, far),
            near + (far - near) * columns / 160,
            0.7 + 0.1 * np.sin(rows / period) * np.sin(columns / period),
            np.full(rows.shape, near),
        ]
        depth = kinds[rng.integers(len(kinds))].astype(np.float32)
        depth[rng.random(depth.shape) < rng.choice([0.0, 0.5, 0.999])] = np.nan
        started = time.process_time()
        estimator.estimate(View(1, color, depth, camera, np.eye(4)))
        seconds = time.process_time() - started
        return "" if seconds < SLOWEST_VIEW else f"{seconds:.1f} s"

    yield trial


def files() -> Iterator[Trial]:
    """Hostile files: read or refused within twenty seconds, with less than 2 GB, and without a traceback."""
    command = [sys.executable, str(ROOT / "hostile_files.py")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as reader:
        assert reader.stdin is not None and reader.stdout is not None  # noqa: PT018
        reader.stdout.readline()

        def trial(rng: np.random.Generator) -> str:
            reader.stdin.write(f"{rng.integers(2**62)}\n")
            reader.stdin.flush()
            return reader.stdout.readline().strip()

        yield trial
        reader.stdin.close()


ATTACKS = {
    "stamps": stamps,
    "messages": messages,
    "wire": wire,
    "bags": bags,
    "views": views,
    "files": files,
    "episodes": episodes,
    "kills": kills,
}
#: A trial of these takes more than half a minute.
SLOW = {"kills"}


def run(attack: Callable[[], Iterator[Trial]], seconds: float, seed: int) -> tuple[int, list[str]]:
    """Repeat one kind of attack for a time; the number of trials and what failed."""
    failures, trials = [], 0
    source = attack()
    trial, deadline = next(source), time.monotonic() + seconds
    while time.monotonic() < deadline:
        try:
            failure = trial(np.random.default_rng([seed, trials]))
        except Exception:
            failure = traceback.format_exc().strip().replace("\n", " | ")
        if failure:
            failures.append(f"trial {trials}: {failure}")
        trials += 1
    next(source, None)
    return trials, failures


def main() -> int:
    """Run all attacks, each for an equal share of the time; print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="for all attacks together")
    parser.add_argument("--seed", type=int, default=0, help="of the first trial")
    options = parser.parse_args()
    print("| attack | trials | failures |\n|---|---|---|")
    failed: list[str] = []
    for name, attack in ATTACKS.items():
        trials, failures = run(attack, options.seconds / len(ATTACKS), options.seed)
        failed += [f"{name}, {failure}" for failure in failures[:5]]
        print(f"| {name} | {trials} | {len(failures)} |", flush=True)
    print(*failed, sep="\n")
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main())
