"""The registry, the budget's and the mask's arithmetic, and the baselines against their definitions."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from active6d_agent.policies import baselines
from active6d_agent.policies import registry as policy_module
from active6d_agent.policies.registry import (
    choose_policy,
    create_policy,
    list_policies,
    uniform_attention,
    weights_path,
)
from active6d_core.view_sphere import ViewSphere

SPHERE = ViewSphere()
MOVING = ["random", "unidirectional", "max-distance", "lowest-score"]


def run_episode(policy, observe, start, steps, seed=0, **constraints):
    """Views taken by a policy that sees the same objects all the time."""
    policy.reset(np.random.default_rng(seed))
    views = [start]
    while len(views) <= steps:
        decision = policy.decide(observe(views, steps, **constraints))
        if decision.stop:
            break
        np.testing.assert_array_equal(decision.position, SPHERE.positions[decision.view])
        views.append(decision.view)
    return views


def path_length(views):
    return SPHERE.path_length(SPHERE.positions[views])


# The registry


def test_all_baselines_are_listed_and_made(model):
    assert {*MOVING, "single-view", "entropy"} <= set(list_policies())
    for name in MOVING:
        create_policy(name, model)


@pytest.mark.parametrize(
    ("name", "parameters", "message"),
    [
        ("clever", {}, "unknown policy 'clever'; known: .*random"),
        ("random", {"sigma": 3}, "policy 'random' has no parameter 'sigma'; it has: azimuth_mean_degrees, "),
        ("max-distance", {"sigma": 3}, "has no parameter 'sigma'; it has: none"),
        ("random", {"azimuth_std_degrees": -1.0}, "policy 'random': .*not negative"),
        ("random", {"azimuth_std_degrees": "wide"}, "policy 'random'"),
        ("unidirectional", {"elevation_degrees": 95}, "elevation_degrees is 95, must be between 0 and 90"),
        ("lowest-score", {"sight_weight": -1}, "weights must be finite and not negative"),
        ("entropy", {}, "policy 'entropy' needs the parameter 'entropy'"),
        ("entropy", {"entropy": [np.nan]}, "finite"),
    ],
)
def test_mistakes_are_named(model, name, parameters, message):
    with pytest.raises(ValueError, match=message):
        create_policy(name, model, **parameters)


# Budgets and masks


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    name=st.sampled_from(MOVING),
    seed=st.integers(0, 2**32 - 1),
    start=st.integers(0, 99),
    steps=st.integers(1, 12),
    count=st.integers(0, 4),
)
def test_policies_keep_to_the_mask_and_never_repeat_a_view(
    model, observe, make_objects, name, seed, start, steps, count
):
    rng = np.random.default_rng(seed)
    allowed = rng.random(100) < 0.3
    objects = make_objects(rng.uniform(-0.1, 0.1, (count, 3)), rng.random(count))
    views = run_episode(create_policy(name, model), observe, start, steps, seed, allowed=allowed, objects=objects)
    assert len(set(views)) == len(views)
    assert allowed[views[1:]].all()
    assert len(views) == 1 + min(steps, np.setdiff1d(np.flatnonzero(allowed), [start]).size)


@pytest.mark.parametrize("name", MOVING)
def test_policies_keep_to_the_metres_left_and_stop_when_nothing_is_affordable(model, observe, name):
    policy = create_policy(name, model)
    policy.reset(np.random.default_rng(0))
    for start in range(0, 100, 7):
        decision = policy.decide(observe([start], metres_left=0.3))
        assert SPHERE.arc(SPHERE.positions[start], decision.position) <= 0.3
    stopped = policy.decide(observe([0], metres_left=0.01))
    assert stopped.stop
    assert stopped.view is None
    np.testing.assert_array_equal(stopped.position, SPHERE.positions[0])


@pytest.mark.parametrize("name", MOVING)
def test_ninety_nine_moves_take_all_views(model, observe, name):
    assert sorted(run_episode(create_policy(name, model), observe, 42, 99)) == list(range(100))


@pytest.mark.parametrize("metres", [0.0, 0.005, 0.02])
def test_a_position_next_to_a_view_counts_as_that_view(observe, metres):
    """A robot's camera has arrived within two centimetres of its goal."""
    observation = observe([3])
    beside = SPHERE.position(*(SPHERE.angles(SPHERE.positions[7]) + [0.0, metres / SPHERE.radius]))
    moved = type(observation)(
        observation.objects, np.stack([SPHERE.positions[3], beside]), SPHERE, observation.allowed, 4
    )
    np.testing.assert_array_equal(np.flatnonzero(moved.visited()), [3, 7])
    assert moved.steps == 5


def test_of_a_fine_grid_only_the_nearest_view_is_visited(observe):
    fine, observation = ViewSphere(azimuths=720), observe([3])
    moved = replace(observation, positions=fine.positions[[10, 1000]], sphere=fine, allowed=np.ones(len(fine), bool))
    np.testing.assert_array_equal(np.flatnonzero(moved.visited()), [10, 1000])


# The baselines


def test_random_is_its_seed(model, observe):
    policy = create_policy("random", model)
    first = run_episode(policy, observe, 0, 8, seed=1)
    assert run_episode(policy, observe, 0, 8, seed=1) == first
    assert run_episode(policy, observe, 0, 8, seed=2) != first


def test_random_reaches_the_whole_hemisphere_evenly(model, observe):
    policy = create_policy("random", model)
    policy.reset(np.random.default_rng(0))
    views = np.array([policy.decide(observe([0])).view for _ in range(2000)])
    counts = np.bincount(views, minlength=100)
    assert (counts[1:] > 0).all()
    rings = counts.reshape(5, 20).sum(axis=1) / 2000
    assert (np.abs(rings - 0.2) < 0.06).all()


def test_random_means_are_configuration(model, observe):
    narrow = {"azimuth_mean_degrees": 90, "azimuth_std_degrees": 0, "elevation_std_degrees": 0}
    policy = create_policy("random", model, **narrow)
    policy.reset(np.random.default_rng(0))
    np.testing.assert_allclose(np.degrees(SPHERE.angles(policy.decide(observe([0])).position)), [90, 45])


@pytest.mark.parametrize("start", [40, 47, 0, 85])
def test_unidirectional_is_one_revolution(model, observe, start):
    views = run_episode(create_policy("unidirectional", model), observe, start, 5)
    azimuth, elevation = np.degrees(SPHERE.angles(SPHERE.positions[views])).T
    np.testing.assert_allclose(elevation[1:], 45.0)
    turns = np.mod(np.diff(azimuth), 360.0)
    # Sixty degrees lie between the grid's 18-degree steps.
    assert set(np.round(turns)) <= {54, 72}
    assert turns.sum() == pytest.approx(300, abs=9)
    if start in (40, 47):
        assert path_length(views) == pytest.approx(2.89, rel=0.03)


def test_unidirectional_closes_the_circle_for_any_budget(model, observe):
    views = run_episode(create_policy("unidirectional", model), observe, 45, 19)
    assert views == [40 + (5 + i) % 20 for i in range(20)]


def test_max_distance_is_the_largest_minimum(model, observe):
    policy = create_policy("max-distance", model)
    rng = np.random.default_rng(0)
    for _ in range(20):
        taken = list(rng.choice(100, rng.integers(1, 5), replace=False))
        chosen = policy.decide(observe(taken, 9)).view
        unit = SPHERE.positions / 0.8
        nearest = np.arccos(np.clip(unit @ unit[taken].T, -1, 1)).min(axis=1)
        assert nearest[chosen] == pytest.approx(nearest.max())


def test_max_distance_travels_about_as_far_as_the_papers(model, observe):
    """7.66 m in five moves; this grid has no view below 15 degrees, which costs it a little."""
    lengths = [path_length(run_episode(create_policy("max-distance", model), observe, s, 5)) for s in range(0, 100, 5)]
    assert np.mean(lengths) == pytest.approx(6.96, abs=0.2)


def test_lowest_score_goes_where_the_least_certain_object_is_in_sight(model, observe, make_objects):
    # A weak object at +x behind a wall of sure ones towards +x and above it: only the other side is free.
    weak = [0.1, 0.0, 0.0]
    wall = [[0.2, y, z] for y in (-0.1, 0.0, 0.1) for z in (0.0, 0.1)]
    objects = make_objects([weak, *wall], [0.2, *[0.9] * 6])
    policy = create_policy("lowest-score", model)
    policy.reset(np.random.default_rng(0))
    decision = policy.decide(observe([50], objects=objects))
    assert decision.attended == 0
    assert decision.attention[0] == decision.attention.max()
    assert decision.attention.sum() == pytest.approx(1.0)
    assert baselines.line_of_sight(objects.T_world_object[:, :3, 3], 0, decision.position[None], 0.1)[0] > 0.9


def test_lowest_score_weighs_height_novelty_sight_and_motion(model, observe, make_objects):
    """The documented sum, written with angles and loops."""
    rng = np.random.default_rng(0)
    objects = make_objects(rng.uniform(-0.1, 0.1, (5, 3)), [0.8, 0.7, 0.4, 0.9, 0.6])
    taken = [12, 55, 71]
    centre = objects.T_world_object[2, :3, 3]
    sight = baselines.line_of_sight(objects.T_world_object[:, :3, 3], 2, SPHERE.positions, model.diameter)

    def angle(a, b):
        return np.arccos(a @ b / np.linalg.norm(a) / np.linalg.norm(b))

    worth = np.full(100, -np.inf)
    for view in np.setdiff1d(np.arange(100), taken):
        ray = SPHERE.positions[view] - centre
        novelty = min(1.0, min(angle(ray, SPHERE.positions[old] - centre) for old in taken) / (np.pi / 2))
        motion = angle(SPHERE.positions[view], SPHERE.positions[71]) / np.pi
        worth[view] = np.sin(np.pi / 2 - angle(ray, np.array([0, 0, 1.0]))) + 2 * novelty + 3 * sight[view] - 4 * motion
    weights = {"novelty_weight": 2, "sight_weight": 3, "motion_weight": 4}
    policy = create_policy("lowest-score", model, **weights)
    assert policy.decide(observe(taken, objects=objects)).view == worth.argmax()


def test_line_of_sight_of_a_ball_behind_another():
    centres = np.array([[0.0, 0, 0], [0.3, 0, 0], [0.001, 0, 0]])
    views = np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0], [1.0, 0.05 / 0.3, 0]])
    beside = 0.3 * np.sin(np.arctan2(0.05 / 0.3, 1.0))
    expected = [0.0, 1.0, 1.0, beside / 0.1]
    np.testing.assert_allclose(baselines.line_of_sight(centres, 0, views, 0.1), expected, atol=1e-9)


def test_lowest_score_without_objects_explores(model, observe):
    observation = observe([12])
    lowest, farthest = (create_policy(name, model) for name in ("lowest-score", "max-distance"))
    assert lowest.decide(observation).view == farthest.decide(observation).view


def test_entropy_takes_the_views_in_order_of_their_entropy(model, observe):
    entropy = np.random.default_rng(0).random(100)
    views = run_episode(create_policy("entropy", model, entropy=entropy), observe, 17, 5)
    order = [view for view in np.argsort(-entropy) if view != 17]
    assert views[1:] == order[:5]


def test_single_view_stops_at_once(model, observe):
    assert run_episode(create_policy("single-view", model), observe, 5, 5) == [5]


@pytest.mark.parametrize("count", [0, 1, 6])
def test_uniform_attention_sums_to_one(count):
    np.testing.assert_allclose(uniform_attention(count), np.full(count, 1 / max(count, 1)))


def test_auto_is_the_learned_policy_where_its_weights_ship(model, tmp_path, monkeypatch):
    monkeypatch.setattr(policy_module, "SHIPPED_WEIGHTS", tmp_path)
    assert choose_policy("mug") == "unidirectional"
    assert type(create_policy("auto", model)) is type(create_policy("unidirectional", model))
    (tmp_path / "view-attention_mug.safetensors").touch()
    assert choose_policy("mug") == "view-attention"
    assert choose_policy("bunny") == "unidirectional"
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "view-attention_bunny.safetensors").touch()
    monkeypatch.setenv("ACTIVE6D_OBJECT_PATH", str(mine))
    assert choose_policy("bunny") == "view-attention"
    assert weights_path("view-attention", "bunny") == mine / "view-attention_bunny.safetensors"
    assert weights_path("view-attention", "mug") == tmp_path / "view-attention_mug.safetensors"
