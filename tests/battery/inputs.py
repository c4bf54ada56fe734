"""Attacks on what nodes read: stamps, messages, what the middleware brings, and views."""

import time
from collections.abc import Iterator

import numpy as np
from rclpy.context import Context
from rclpy.node import Node
from rclpy.serialization import deserialize_message, serialize_message
from ros_harness import GraphHarness, reliable
from stub_episode import StubEpisode
from test_view_inputs import Follower

from active6d_core.camera import PinholeCamera, View
from active6d_core.object_model import load_object
from active6d_core.ros import conversions
from active6d_core.ros.conversions import MessageError
from active6d_core.ros.topics import CAMERA_INFO, CAMERA_POSE
from active6d_perception.estimators.registry import create_estimator
from battery.trials import Trial

SECOND = 10**9
FRAME = "camera_optical_frame"
#: Seconds of processor time; a view that takes longer counts as a failure.
SLOWEST_VIEW = 2.0


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
