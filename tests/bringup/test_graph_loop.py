"""The whole loop with the real nodes: every number in the bag against the core functions called by hand."""

import io
import subprocess
import sys

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from ros_harness import fresh_domain
from rosbags.rosbag2 import Reader
from scipy.spatial.transform import Rotation

from active6d_agent.policies.registry import Observation, create_policy
from active6d_bringup.bags.reader import read_episode
from active6d_bringup.bags.replay import ReplaySettings, replay
from active6d_bringup.bags.writer import TYPESTORE
from active6d_bringup.graph.episode import EpisodeSettings, run_episode
from active6d_core.object_model import load_object
from active6d_core.ros.conversions import (
    hypotheses_from_cloud,
    hypotheses_to_cloud,
    objects_from_cloud,
    objects_to_cloud,
)
from active6d_core.ros.topics import CONTRACT, Per
from active6d_core.se3 import make_transform
from active6d_core.view_sphere import ViewSphere
from active6d_perception.estimators.registry import create_estimator
from active6d_perception.scene.all_views_fusion import AllViewsFusion
from active6d_perception.scene.observed_surface import ObservedSurface
from active6d_perception.scene.verification import Verifier
from active6d_sim.rendering.active_stereo import ActiveStereo
from active6d_sim.rendering.simulator import Simulator
from active6d_sim.scenes.scene import Bin, Scene

MOVES = 2
SPHERE = ViewSphere()


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Three mugs side by side as a stored scene, which spares the tests the physics."""
    folder = tmp_path_factory.mktemp("scenes")
    rotations = Rotation.from_euler("xyz", [[0, 0, 0], [90, 0, 40], [0, 0, 200]], degrees=True).as_matrix()
    T = make_transform(rotations, [[-0.11, 0.0, 0.05], [0.0, 0.1, 0.05], [0.12, -0.03, 0.05]])
    scene = Scene("mug", "mug/test/0", 5, T, Bin(0.36, 0.36, 0.06, 0.01), np.ones((len(SPHERE), 3)))
    (folder / "mug").mkdir()
    scene.save(folder / "mug" / "test_00.npz")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ACTIVE6D_SCENE_PATH", str(folder))
        yield scene


@pytest.fixture(scope="module")
def settings(scene):
    camera = {"width": 320, "height": 240}
    return EpisodeSettings(
        "mug", seed=3, scene=scene.name, steps=MOVES, estimator="geometric", overrides={"camera_simulator": camera}
    )


@pytest.fixture(scope="module")
def bags(settings, tmp_path_factory):
    """Two recordings of the same episode."""
    from dataclasses import replace

    folder = tmp_path_factory.mktemp("bags")
    for name in ("first", "second"):
        run_episode(replace(settings, bag=folder / name, domain=fresh_domain()))
    return folder / "first", folder / "second"


@pytest.fixture(scope="module")
def record(bags):
    return read_episode(bags[0])


def messages(folder):
    """Topic to (stamp, payload), in order."""
    found = {}
    with Reader(folder) as reader:
        for connection, _, payload in reader.messages():
            message = TYPESTORE.deserialize_cdr(payload, connection.msgtype)
            header = getattr(message, "header", None) or message.markers[0].header
            stamp = header.stamp.sec * 10**9 + header.stamp.nanosec
            found.setdefault(connection.topic.removeprefix("/"), []).append((stamp, bytes(payload)))
    return found


def test_stamps_agree_on_every_topic(bags, record):
    stamps = [step.stamp for step in record.steps]
    assert len(stamps) == MOVES + 1
    assert stamps[0] == 1_000_000_000
    found = messages(bags[0])
    for topic in CONTRACT:
        expected = {
            Per.VIEW: stamps,
            Per.MOVE: stamps[:-1],
            Per.EPISODE: stamps[:1] if topic.name == "episode/start" else stamps[-1:],
            Per.WHENEVER: stamps[:1],
        }
        if topic.name == "view_goal/status":  # accepted and reached
            expected[Per.WHENEVER] = [stamp for stamp in stamps[:-1] for _ in range(2)]
        if topic.name != "/diagnostics":
            assert [stamp for stamp, _ in found[topic.name]] == expected[topic.per], topic.name
    for step in record.steps:
        assert step.latency_ms.keys() >= {"camera_simulator", "pose_estimator", "hypothesis_fusion"}


def test_camera_goes_where_it_was_sent_at_its_speed(record):
    for before, after in zip(record.steps[:-1], record.steps[1:], strict=True):
        np.testing.assert_allclose(after.view.T_world_camera, before.goal, atol=1e-9)
        arc = SPHERE.arc(before.view.T_world_camera[:3, 3], after.view.T_world_camera[:3, 3])
        assert (after.stamp - before.stamp) * 1e-9 == pytest.approx(max(arc / 0.25, 0.1), abs=1e-6)
    for step in record.steps:
        T = step.view.T_world_camera
        assert np.linalg.norm(SPHERE.positions - T[:3, 3], axis=1).min() < 1e-9
        np.testing.assert_allclose(T, SPHERE.pose(T[:3, 3]), atol=1e-9)


def test_images_are_the_simulators(record, scene, settings):
    simulator = Simulator(scene, record.steps[0].view.camera, ActiveStereo(), settings.seed)
    for step in record.steps:
        # The recorded pose went through a quaternion; quantised depth shows even the last bit of that.
        grid_view = SPHERE.nearest(step.view.T_world_camera[:3, 3])
        view = simulator.capture(SPHERE.pose(SPHERE.positions[grid_view]), step.stamp)
        np.testing.assert_array_equal(step.view.color, view.color)
        np.testing.assert_array_equal(step.view.depth, view.depth)
    np.testing.assert_allclose(record.ground_truth, scene.T_world_object, atol=1e-9)


def test_perception_and_policy_are_the_core_functions(record):
    model = load_object("mug")
    estimator, verifier, fusion = create_estimator("geometric", model), Verifier(model), AllViewsFusion(model)
    surface = ObservedSurface(model)
    policy = create_policy("auto", model)
    policy.reset(np.random.default_rng([3, record.steps[0].stamp]))
    found_any = 0
    for index, step in enumerate(record.steps):
        view = step.view
        found = estimator.estimate(view)
        hypotheses = hypotheses_from_cloud(
            hypotheses_to_cloud(found, view.stamp, "c"), found.segmentation, "c"
        )  # messages hold float32
        assert_same(step.hypotheses, hypotheses)
        verification = verifier.score(view.depth, view.camera, hypotheses)
        fusion.add_view(view.stamp, view.T_world_camera, hypotheses, verification, view.depth, view.camera)
        fused = fusion.objects(view.stamp, view.T_world_camera, view.camera)
        objects = objects_from_cloud(objects_to_cloud(fused, view.stamp, "w"), "w")
        assert_same(step.objects, objects)
        surface.add_view(view.stamp, view.depth, view.camera, view.T_world_camera)
        np.testing.assert_array_equal(step.unexplained, surface.unexplained(fused.T_world_object))
        found_any += len(objects)
        if step.goal is not None:
            positions = record.positions[: index + 1]
            observation = Observation(
                step.objects,
                positions,
                SPHERE,
                np.ones(len(SPHERE), bool),
                MOVES - index,
                unexplained=step.unexplained,
            )
            decision = policy.decide(observation)
            np.testing.assert_allclose(step.goal[:3, 3], decision.position, atol=1e-12)
            np.testing.assert_allclose(step.attention, decision.attention, atol=1e-7)
            assert step.attended == decision.attended
    assert found_any


def assert_same(read, expected):
    for name, values in vars(expected).items():
        np.testing.assert_array_equal(getattr(read, name), values, err_msg=name)


def test_same_seed_gives_the_same_payloads(bags):
    first, second = (messages(bag) for bag in bags)
    assert first.keys() == second.keys() == {topic.name.removeprefix("/") for topic in CONTRACT}
    for topic in first.keys() - {"diagnostics"}:
        assert first[topic] == second[topic], topic


def test_rosbags_and_mcap_read_every_message(bags):
    counted = {topic: len(found) for topic, found in messages(bags[0]).items()}
    data = io.BytesIO((bags[0] / f"{bags[0].name}.mcap").read_bytes())
    decoded = {}
    for _, channel, _, message in make_reader(data, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
        assert message is not None
        decoded[channel.topic.removeprefix("/")] = decoded.get(channel.topic.removeprefix("/"), 0) + 1
    assert decoded == counted


def test_replay_through_live_perception_is_equal_and_names_other_nodes(bags, graph):
    events = []
    result = replay(ReplaySettings(bags[0], domain=graph.domain), on_event=events.append)
    assert f"also in ROS domain {graph.domain}: /tester" in events
    assert result.equal, result.largest_differences()
    assert result.views == MOVES + 1


# What a robot does not install; None makes an import fail.
ROBOT = """
import sys

for name in ("gymnasium", "stable_baselines3", "pybullet", "active6d_sim", "active6d_tools"):
    sys.modules[name] = None

import time
from pathlib import Path

from active6d_bringup.graph.composition import ComposedGraph, GraphDescription, running

bag, copy, domain, moves = sys.argv[1:]
nodes = {
    "bag_player": {"bag": bag},
    "pose_estimator": {"object": "mug", "estimator": "geometric"},
    "hypothesis_fusion": {"object": "mug"},
    "attention_policy": {"object": "mug", "policy": "view-attention", "steps": int(moves)},
    "episode_recorder": {"bag": copy},
}
with running(ComposedGraph(GraphDescription(nodes, domain=int(domain)))) as graph:
    graph.start()
    recorder, deadline = graph.nodes["episode_recorder"], time.monotonic() + 60
    while recorder._writer.last_end is None and time.monotonic() < deadline:
        graph.spin_once(0.1)
"""


def test_a_robot_without_simulator_and_trainer_runs_an_episode_from_a_bag(bags, record, tmp_path):
    copy = tmp_path / "copy"
    command = [sys.executable, "-c", ROBOT, str(bags[0]), str(copy), str(fresh_domain()), str(MOVES)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=110, check=False)
    assert done.returncode == 0, done.stderr
    played = read_episode(copy)
    assert [step.stamp for step in played.steps] == [step.stamp for step in record.steps]
    for step, expected in zip(played.steps, record.steps, strict=True):
        np.testing.assert_array_equal(step.objects.T_world_object, expected.objects.T_world_object)
