"""The reliability battery: seeded attacks on stamps, messages, bags, views and files, as many as the time allows.

    python tests/battery.py --seconds 1200 --seed 0

Each row of the table is one kind of attack with the number of trials and of failures; exit code 1 if there are any.
"""

import argparse
import shutil
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

ROOT = Path(__file__).parent
sys.path += [str(ROOT), str(ROOT / "core"), str(ROOT / "bringup")]

import numpy as np  # noqa: E402
from rclpy.serialization import deserialize_message, serialize_message  # noqa: E402
from ros_harness import GraphHarness  # noqa: E402
from stub_episode import StubEpisode  # noqa: E402
from test_bag_reader import damage_of, write_bag  # noqa: E402
from test_view_inputs import Follower  # noqa: E402

from active6d_core.camera import PinholeCamera, View  # noqa: E402
from active6d_core.object_model import load_object  # noqa: E402
from active6d_core.ros import conversions  # noqa: E402
from active6d_core.ros.conversions import MessageError  # noqa: E402
from active6d_perception.estimators.registry import create_estimator  # noqa: E402

SECOND = 10**9
FRAME = "camera_optical_frame"
#: Seconds of processor time; a view that takes longer counts as a failure.
SLOWEST_VIEW = 2.0
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


ATTACKS = {"stamps": stamps, "messages": messages, "bags": bags, "views": views, "files": files}


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
