"""The environment: fusion as the node's, rewards from the equations, Gymnasium's own checks."""

import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
import trimesh
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic_bank import synthetic_bank

from active6d_agent.bank.best_view_lookup import BestViewLookup
from active6d_agent.environment.episodes import RewardParameters
from active6d_agent.environment.gym_environment import Active6DEnv, Active6DVectorEnv
from active6d_agent.environment.gym_registration import ENVIRONMENT_ID
from active6d_agent.environment.throughput import measure_steps_per_second
from active6d_agent.policies.registry import MAX_OBJECTS
from active6d_core.camera import DEFAULT_CAMERA
from active6d_core.hypotheses import Hypotheses
from active6d_core.metrics import e_add, evaluate_scene
from active6d_core.se3 import transform_from_quaternion
from active6d_perception.scene.best_view_fusion import BestViewFusion
from active6d_perception.scene.fusion_parameters import FusionParameters

EPISODE = [12, 57, 3, 80, 44, 99]


@pytest.fixture(scope="module", params=["mug", "coffee_cup"])
def lookup(request):
    return BestViewLookup(synthetic_bank(request.param))


def fuse_as_the_node_does(lookup, scene, views, parameters=None):
    """Feed the views to the class that the fusion node runs."""
    bank_scene, fusion = lookup.bank.scenes[scene], BestViewFusion(lookup.model, parameters)
    for view in views:
        table = bank_scene.table[bank_scene.view == view].astype(float)
        T_world_camera = lookup.sphere.pose(lookup.sphere.positions[view])
        T = transform_from_quaternion(table[:, 3:7], table[:, :3])
        label, image = np.ones(len(table), np.uint16), np.ones((2, 2), np.uint16)
        hypotheses = Hypotheses(T, table[:, 8], table[:, 9:13], table[:, 13], label, image)
        fusion.add_view(view + 1, T_world_camera, hypotheses, table[:, 7])
    return fusion.objects(views[-1] + 1, T_world_camera, DEFAULT_CAMERA)


@settings(max_examples=40, deadline=None)
@given(scene=st.integers(0, 1), views=st.lists(st.integers(0, 99), min_size=1, max_size=12, unique=True))
def test_fusion_is_the_nodes(lookup, scene, views):
    expected, actual = fuse_as_the_node_does(lookup, scene, views), lookup.objects(scene, views)
    for name in ("T_world_object", "verification", "score", "depth", "box", "support", "spread"):
        np.testing.assert_allclose(getattr(actual, name), getattr(expected, name), atol=2e-6, err_msg=name)


def test_fusion_of_a_slim_object_is_the_nodes(tmp_path, monkeypatch):
    """Shorter distances separate its hypotheses and its objects."""
    trimesh.creation.box((0.2, 0.02, 0.02)).export(tmp_path / "slim_rod.ply")
    text = "name: slim_rod\nmesh: slim_rod.ply\ninstances: [1, 3]\ncolor: [0.5, 0.5, 0.5]\n"
    (tmp_path / "slim_rod.yaml").write_text(text)
    monkeypatch.setenv("ACTIVE6D_OBJECT_PATH", str(tmp_path))
    lookup = BestViewLookup(synthetic_bank("slim_rod", scenes=1))
    expected, actual = fuse_as_the_node_does(lookup, 0, EPISODE), lookup.objects(0, EPISODE)
    np.testing.assert_allclose(actual.T_world_object, expected.T_world_object, atol=1e-9)
    np.testing.assert_array_equal(actual.support, expected.support)


def test_fusion_parameters_are_honoured():
    parameters = FusionParameters(cut=0.1, exclusion=0.4, min_verification=0.5)
    lookup = BestViewLookup(synthetic_bank("mug", scenes=1), parameters)
    expected, actual = fuse_as_the_node_does(lookup, 0, EPISODE, parameters), lookup.objects(0, EPISODE)
    np.testing.assert_allclose(actual.T_world_object, expected.T_world_object, atol=1e-9)


def test_episodes_side_by_side_are_fused_as_one_by_one(lookup):
    rng = np.random.default_rng(0)
    scene = rng.integers(2, size=9)
    views = np.stack([rng.choice(100, 6, replace=False) for _ in scene])
    views[::2, 4:] = -1
    current = np.where(views[:, -1] >= 0, views[:, -1], views[:, 3])
    fused = lookup.fuse(scene, views, current)
    for index in range(len(scene)):
        taken = views[index][views[index] >= 0]
        rows = fused.objects[index][fused.objects[index] >= 0]
        np.testing.assert_allclose(lookup.T_world_object[rows], lookup.objects(scene[index], taken).T_world_object)


def test_an_episode_reports_the_papers_measures(lookup):
    env = Active6DEnv(lookup)
    _, info = env.reset(seed=0, options={"scene": 1, "view": 7})
    views = [info["view"]]
    for action in np.random.default_rng(0).uniform(-1, 1, (5, 3)):
        _, _, done, truncated, info = env.step(action)
        views.append(info["view"])
        assert not truncated
    assert done
    objects = lookup.objects(1, views)
    score = evaluate_scene(lookup.model, objects.T_world_object, lookup.bank.scenes[1].T_world_object)
    assert info["detection_rate"] == pytest.approx(score.detection_rate)
    assert info["e_add_mm"] == pytest.approx(score.mean_e_add_mm, abs=1e-3)
    assert info["distance_m"] == pytest.approx(lookup.sphere.path_length(lookup.sphere.positions[views]))


@pytest.mark.parametrize("as_printed", [False, True])
def test_the_reward_is_equation_4(lookup, as_printed):
    reward = RewardParameters(0.4, 0.7, 2.0, 3.0, 0.5, as_printed)
    env = Active6DEnv(lookup, reward=reward)
    views = [env.reset(seed=1, options={"scene": 0, "view": 31})[1]["view"]]
    rng, model, truth = np.random.default_rng(1), lookup.model, lookup.bank.scenes[0].T_world_object
    for _ in range(5):
        before = lookup.objects(0, views)
        attended = int(rng.integers(len(before)))
        _, given_reward, _, _, info = env.step(np.array([*rng.uniform(-1, 1, 2), attended]))
        views.append(info["view"])
        after = lookup.objects(0, views)
        table = np.minimum(e_add(model, before.T_world_object[:, None], truth, cutoff=0.05), 0.05)
        centres = np.linalg.norm(before.T_world_object[attended, :3, 3] - truth[:, :3, 3], axis=1)
        target = table[attended].argmin() if table[attended].min() < 0.05 else centres.argmin()
        later = np.minimum(e_add(model, after.T_world_object, truth[target], cutoff=0.05), 0.05).min()
        error_drop = (table[:, target].min() - later) / (0.1 * model.diameter)
        camera = lookup.sphere.positions[views[-2:]]
        place = before.T_world_object[attended, :3, 3]
        now = after.T_world_object[:, :3, 3]
        now = now[np.linalg.norm(now - place, axis=1).argmin()]
        approach = (np.linalg.norm(place - camera[0]) - np.linalg.norm(now - camera[1])) / 0.8
        motion = np.abs(camera[1] - camera[0]).sum() / 0.8
        sign = -1 if as_printed else 1
        expected = sign * (0.6 * 2.0 * error_drop + 0.4 * 0.7 * 3.0 * approach) - 0.6 * 0.3 * 0.5 * motion
        assert given_reward == pytest.approx(expected, abs=1e-4)


def test_every_object_can_be_rewarded(lookup):
    """Equation 2 of the sum over all objects, whatever is attended."""
    reward = RewardParameters(alpha=0.0, motion_scale=0.0, every_object=True)
    env, model, truth = Active6DEnv(lookup, reward=reward), lookup.model, lookup.bank.scenes[0].T_world_object
    views = [env.reset(seed=1, options={"scene": 0, "view": 31})[1]["view"]]
    rng = np.random.default_rng(5)
    for _ in range(5):
        before = lookup.objects(0, views)
        _, given_reward, _, _, info = env.step(np.array([*rng.uniform(-1, 1, 2), rng.integers(MAX_OBJECTS)]))
        views.append(info["view"])
        sums = [
            np.minimum(e_add(model, T[:, None], truth, cutoff=0.05), 0.05).min(axis=0).sum()
            for T in (before.T_world_object, lookup.objects(0, views).T_world_object)
        ]
        assert given_reward == pytest.approx((sums[0] - sums[1]) / (0.1 * model.diameter), abs=1e-4)


def test_attending_to_nothing_is_paid_for_motion_only(lookup):
    env = Active6DEnv(lookup, reward=RewardParameters(0.5, 0.5, motion_scale=1.0))
    views = [env.reset(seed=2)[1]["view"]]
    _, reward, _, _, info = env.step(np.array([0.3, 0.1, MAX_OBJECTS - 1]))
    camera = lookup.sphere.positions[[views[0], info["view"]]] / 0.8
    assert reward == pytest.approx(-0.25 * np.abs(camera[1] - camera[0]).sum())


def test_the_observation_is_the_papers_state(lookup):
    env = Active6DEnv(lookup)
    observation, info = env.reset(seed=3, options={"scene": 0, "view": 20})
    views = [20]
    for step in range(3):
        objects = lookup.objects(0, views)
        count = len(objects)
        np.testing.assert_allclose(observation["objects"][:count], objects.features(), atol=1e-6)
        assert not observation["objects"][count:].any()
        np.testing.assert_array_equal(observation["mask"], np.arange(MAX_OBJECTS) < count)
        unit = lookup.sphere.positions / 0.8
        np.testing.assert_allclose(observation["camera"], unit[views[-1]], atol=1e-7)
        np.testing.assert_allclose(observation["history"][:step], unit[views[:-1]], atol=1e-7)
        assert not observation["history"][step:].any()
        observation, _, _, _, info = env.step(np.array([0.7 * step - 1, 0.0, 0.0]))
        views.append(info["view"])


@settings(max_examples=30, deadline=None)
@given(azimuth=st.floats(-1, 1), elevation=st.floats(-1, 1), start=st.integers(0, 99))
def test_an_action_snaps_to_the_nearest_view_not_taken(lookup, azimuth, elevation, start):
    env = Active6DEnv(lookup)
    env.reset(seed=0, options={"scene": 0, "view": start})
    info = env.step(np.array([azimuth, elevation, 0.0]))[4]
    goal = lookup.sphere.position(np.pi * azimuth, np.pi / 4 * (elevation + 1))
    free = np.arange(100) != start
    distances = np.linalg.norm(lookup.sphere.positions - goal, axis=1)
    assert info["view"] != start
    assert distances[info["view"]] <= distances[free].min() + 1e-9


def test_gymnasium_is_content(lookup):
    check_env(Active6DEnv(lookup), skip_render_check=True)
    assert gym.make(ENVIRONMENT_ID, bank=lookup, steps=3).reset(seed=0)[0]["history"].shape == (3, 3)
    assert gym.make_vec(ENVIRONMENT_ID, num_envs=4, bank=lookup).reset(seed=0)[0]["objects"].shape == (
        4,
        MAX_OBJECTS,
        6,
    )


def test_importing_the_package_registers_the_environment():
    code = "import gymnasium, active6d_agent, sys; print(gymnasium.spec('Active6D-v0').entry_point)"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert shown.strip() == "active6d_agent.environment.gym_environment:Active6DEnv"


def test_the_vector_environment_is_many_single_ones(lookup):
    scenes, starts = np.array([0, 1, 0, 1]), np.array([5, 6, 70, 99])
    vector = Active6DVectorEnv(lookup, 4)
    observations, _ = vector.reset(seed=0, options={"scene": scenes, "view": starts})
    singles = [Active6DEnv(lookup) for _ in scenes]
    for env, scene, view in zip(singles, scenes, starts, strict=True):
        env.reset(seed=0, options={"scene": scene, "view": view})
    rng = np.random.default_rng(0)
    for step in range(5):
        actions = np.column_stack([rng.uniform(-1, 1, (4, 2)), rng.integers(0, 9, 4)])
        observations, rewards, done, _, info = vector.step(actions)
        alone = [env.step(action) for env, action in zip(singles, actions, strict=True)]
        np.testing.assert_allclose(rewards, [result[1] for result in alone])
        assert done.all() == (step == 4)
        shown = info["final_obs"] if step == 4 else observations
        for name, values in shown.items():
            np.testing.assert_allclose(values, [result[0][name] for result in alone], atol=1e-7)
    for name in ("detection_rate", "e_add_mm", "distance_m"):
        np.testing.assert_allclose(info[name], [result[4][name] for result in alone])
    assert (vector.episodes.time == 0).all(), "a new episode follows"


def test_equal_seeds_give_equal_episodes(lookup):
    rewards = []
    for _ in range(2):
        env = Active6DVectorEnv(lookup, 3)
        env.reset(seed=5)
        rng = np.random.default_rng(0)
        rewards.append([env.step(rng.uniform(-1, 1, (3, 3)))[1] for _ in range(7)])
    np.testing.assert_array_equal(*rewards)


def test_throughput_is_measured_in_processes_of_its_own(tmp_path):
    synthetic_bank("mug", scenes=1).save(tmp_path / "bank.npz")
    assert measure_steps_per_second(tmp_path / "bank.npz", workers=1, environments=64, seconds=0.3) > 500


def test_bad_settings_are_named(lookup):
    with pytest.raises(ValueError, match="steps is 100"):
        Active6DEnv(lookup, steps=100)
    with pytest.raises(ValueError, match="alpha and beta"):
        RewardParameters(alpha=1.5)
    with pytest.raises(ValueError, match=r"nowhere\.npz"):
        Active6DEnv("nowhere.npz")
