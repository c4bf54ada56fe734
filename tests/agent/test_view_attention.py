"""The policy that values every view: what must not matter does not, its labels are the truth, and it learns."""

import copy
import json
import time
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from synthetic_bank import synthetic_bank

from active6d_agent.bank.best_view_lookup import BestViewLookup
from active6d_agent.environment.rollout import observe
from active6d_agent.evaluation.oracle import known, search_views, tally, worth
from active6d_agent.evaluation.policy_evaluation import all_starts, run_named, run_policy
from active6d_agent.policies.registry import create_policy
from active6d_agent.policies.view_attention import dagger as dagger
from active6d_agent.policies.view_attention import features as scene_state
from active6d_agent.policies.view_attention.features import (
    best_verified,
    cluster_unexplained,
    gather,
    likely_centre,
    represent,
)
from active6d_agent.policies.view_attention.network import (
    ViewAttention,
    ViewAttentionPolicy,
    Weighing,
    load_network,
    save_network,
    trace,
    value_views,
)
from active6d_core.object_model import load_object
from active6d_core.se3 import make_transform
from active6d_perception.scene.expected_visibility import Tray, expected_visibility


@pytest.fixture(scope="module")
def lookup():
    return BestViewLookup(synthetic_bank("mug", scenes=2, objects=8))


@pytest.fixture(scope="module")
def network(lookup):
    torch.manual_seed(0)
    return ViewAttention().eval()


@pytest.fixture
def observation(lookup):
    return observe(lookup, np.array([0]), np.array([[3, 47, 80]]), np.array([3]))[0]


@pytest.fixture
def policy(lookup, network, tmp_path):
    save_network(network, tmp_path / "weights.safetensors", "mug")

    def make(**parameters):
        return ViewAttentionPolicy(lookup.model, str(tmp_path / "weights.safetensors"), **parameters)

    return make


def states(observations, name="mug"):
    return [represent(each, load_object(name)) for each in observations]


def terms(network, observations, name="mug"):
    with torch.inference_mode():
        return [part.numpy() for part in network(gather(states(observations, name)))]


def values(network, observations, name="mug"):
    return [part.sum(axis=2) for part in terms(network, observations, name)]


def valued(network, observation, weighing):
    return value_views(network, [observation], states([observation]), weighing)


def without_objects(observation, count=0):
    """The same with the first ``count`` objects only, and no surface of others."""
    return replace(observation, objects=observation.objects.take(np.arange(count)), unexplained=np.zeros((0, 3)))


def test_the_order_of_objects_does_not_matter(network, observation):
    order = np.random.default_rng(0).permutation(len(observation.objects))
    shuffled = replace(observation, objects=observation.objects.take(order))
    best = values(network, [observation])
    again = values(network, [shuffled])
    np.testing.assert_allclose(again[0], best[0], atol=1e-5)
    np.testing.assert_allclose(again[1], best[1], atol=1e-5)


def test_the_order_of_earlier_views_does_not_matter(network, observation):
    other = replace(observation, positions=observation.positions[[1, 0, 2]])
    np.testing.assert_allclose(values(network, [other])[0], values(network, [observation])[0], atol=1e-5)


@pytest.mark.parametrize("name", ["mug", "coffee_cup"])
def test_turning_the_world_about_the_vertical_turns_the_values(name, observation):
    """By a quarter, for the tray is square: the value of a view moves on to the view five further. Without clusters, as
    what stands in for them does not turn with the world."""
    torch.manual_seed(1)
    network = ViewAttention().eval()
    turn = Rotation.from_euler("z", np.pi / 2).as_matrix()
    observation = replace(observation, unexplained=np.zeros((0, 3)))
    T = make_transform(turn, np.zeros(3)) @ observation.objects.T_world_object
    turned = replace(
        observation,
        objects=replace(observation.objects, T_world_object=T),
        positions=observation.positions @ turn.T,
    )
    before, after = values(network, [observation], name), values(network, [turned], name)
    for part in range(2):
        rolled = np.roll(before[part][0].reshape(5, 20, -1), 5, axis=1).reshape(100, -1)
        np.testing.assert_allclose(after[part][0], rolled, atol=1e-4)
    assert np.ptp(before[0]) > 1e-3, "the values do differ"


def test_turning_a_cup_about_its_axis_does_not_matter(observation):
    cup = load_object("coffee_cup")
    torch.manual_seed(2)
    network = ViewAttention().eval()
    spin = make_transform(Rotation.from_rotvec(1.1 * cup.symmetry.axis).as_matrix(), np.zeros(3))
    spun = replace(
        observation, objects=replace(observation.objects, T_world_object=observation.objects.T_world_object @ spin)
    )
    before, after = states([observation, spun], cup.name)
    # What is shown is told from other samples of the same surface.
    assert np.abs(after.shown - before.shown).mean() < 0.03
    after = replace(after, shown=before.shown, seen=before.seen)
    with torch.inference_mode():
        expected, told = (network(gather([state]))[0] for state in (before, after))
    np.testing.assert_allclose(told, expected, atol=1e-4)


def test_padding_does_not_matter(network, lookup, observation):
    """Alone, and beside observations with more objects and more views."""
    many = observe(lookup, np.array([1]), np.array([[5, 6, 7, 8, 20, 60, 70]]), np.array([1]))[0]
    none = without_objects(observation)
    for each in (observation, many, none):
        alone = values(network, [each])
        row = [id(x) for x in (many, none, observation)].index(id(each))
        together = values(network, [many, none, observation])
        for part in range(2):
            np.testing.assert_allclose(together[part][row], alone[part][0], atol=1e-3)
        n = len(states([each])[0].pose)
        for part in terms(network, [many, none, observation]):
            assert not part[row][:, n:-1].any(), "padding gains nothing"


def test_some_views_are_those_of_all(network, observation):
    some, state = np.array([70, 3, 41]), states([observation, without_objects(observation, 2)])
    with torch.inference_mode():
        everything, chosen = network(gather(state)), network(gather(state, some))
    for of_all, of_some in zip(everything, chosen, strict=True):
        np.testing.assert_allclose(of_some, of_all[:, some], atol=1e-4)


def test_nothing_is_left_to_gain_after_the_last_move(network, observation):
    assert not values(network, [replace(observation, steps_left=1)])[1].any()
    assert values(network, [observation])[1].any()


def test_pairs_begin_with_what_views_show(network, observation, lookup):
    """Of objects and of the likely objects of clusters, and how much more that is than the best view has shown."""
    pairs = gather(states([observation]))["pairs"]
    best, seen, shown = shown_of_items(observation, lookup)
    n = len(best)
    assert len(shown) > n
    for index in [0, 3, n - 1, n]:
        np.testing.assert_allclose(pairs[0, :, index, 0], shown[index], atol=1e-6)
        np.testing.assert_allclose(pairs[0, :, index, 1], shown[index] - seen[index].max(), atol=1e-6)


def shown_of_items(observation, lookup):
    """Poses of the n objects in the network's order, and what is (n + m, t) seen and (n + m, M) shown."""
    best = observation.objects.take(best_verified(observation)).T_world_object
    model, turn = lookup.model, np.eye(3)
    surface = observation.unexplained
    guessed = [
        make_transform(turn, likely_centre(surface, patch, model))
        for patch in cluster_unexplained(surface, model.diameter)
    ]
    visibility, items = expected_visibility(model), np.concatenate([best, guessed])
    tray = Tray.for_model(model)
    seen, shown = (
        visibility.shares(items, eyes, tray, len(best)) for eyes in (observation.positions, lookup.sphere.positions)
    )
    return best, seen, shown


def test_pairs_are_what_geometry_says(network, observation, lookup):
    """Columns 2 to 12, one pair at a time, by their definitions."""
    scene = states([observation])[0]
    pairs = gather([scene])["pairs"]
    grid, taken = lookup.sphere.positions, observation.positions
    best, seen, _ = shown_of_items(observation, lookup)
    for view, index in [(0, 0), (25, 3), (60, 1), (99, len(best) - 1)]:
        R, centre = best[index, :3, :3], best[index, :3, 3]
        ray = (grid[view] - centre) / np.linalg.norm(grid[view] - centre)
        earlier = taken - centre
        cosines = earlier / np.linalg.norm(earlier, axis=1, keepdims=True) @ ray
        expected = [
            ray[2],
            np.arccos(cosines.max()) / np.pi,
            cosines.max(),
            (seen[index] * (1 + cosines) / 2).max(),
            np.linalg.norm(grid[view] - centre) / lookup.sphere.radius - 1,
            ray[:2] @ centre[:2] / np.linalg.norm(centre[:2]),
            ray @ grid[view] / lookup.sphere.radius - 0.95,
            *(R.T @ ray),
        ]
        information = scene.uncertainty[index] * scene.shown[index, view] * (1 - expected[3])
        expected.append(information)
        np.testing.assert_allclose(pairs[0, view, index, 2:], expected, atol=2e-4)


def test_uncertainty_is_the_entropy_of_what_is_not_known(observation):
    """Right or wrong and which of the poses, for every object; a toss for every cluster."""
    objects = observation.objects
    rng = np.random.default_rng(5)
    probability, entropy = rng.random(len(objects)), rng.random(len(objects))
    probability[:2] = 0.0, 1.0
    known = replace(objects, probability=probability, entropy=entropy)
    state = states([replace(observation, objects=known)])[0]
    best = best_verified(observation)
    for item, index in enumerate(best):
        chances = np.array([probability[index], 1 - probability[index]])
        chances = chances[chances > 0]
        expected = entropy[index] - (chances * np.log(chances)).sum()
        assert state.uncertainty[item] == pytest.approx(expected, abs=1e-6)
    clusters = state.uncertainty[len(best) :]
    assert len(clusters)
    np.testing.assert_allclose(clusters, np.log(2), atol=1e-6)


def test_information_gain_looks_at_what_is_uncertain(lookup, observation):
    """Of objects that are all sure but one, that one has the attention, and the view is the one that shows most of it
    from a side that is new; all sure, no view tells anything."""
    clear = without_objects(observation, len(observation.objects))
    sure = np.ones(len(clear.objects))
    for index in (0, len(sure) - 1):
        probability = sure.copy()
        probability[index] = 0.5
        objects = replace(clear.objects, probability=probability, entropy=np.zeros(len(sure)))
        decision = create_policy("information-gain", lookup.model, metres_weight=0.0).decide(
            replace(clear, objects=objects)
        )
        assert decision.attended == index
        assert decision.attention[index] == pytest.approx(1.0)
        item = list(best_verified(clear)).index(index)
        pairs = gather(states([clear]))["pairs"][0, :, item].numpy()
        new = np.where(clear.candidates(), pairs[:, 0] * (1 - pairs[:, 5]), -1)
        assert new[decision.view] == pytest.approx(new.max(), abs=1e-4)
    done = replace(clear, objects=replace(clear.objects, probability=sure, entropy=np.zeros(len(sure))))
    policy = create_policy("information-gain", lookup.model, stop_below=0.01)
    assert policy.decide(done).stop
    assert not create_policy("information-gain", lookup.model).decide(done).stop


def test_the_attention_is_the_share_of_what_the_move_is_worth(policy, network, observation):
    """Of the chosen view, item by item; what is missing to one is of clusters and of objects without any item."""
    decision = policy(lookahead=0.5).decide(observation)
    now, later = terms(network, [observation])
    worth = (now + 0.5 * later)[0, decision.view].astype(float) @ [1.0, Weighing().error_weight]
    positive = np.maximum(worth, 0.0)
    best = best_verified(observation)
    np.testing.assert_allclose(decision.attention[best], positive[: len(best)] / positive.sum(), atol=1e-5)
    largest = positive.argmax()
    assert decision.attended == (best[largest] if largest < len(best) else None)


@pytest.mark.parametrize("inputs", ["all", "belief", "poses"])
def test_training_ignores_the_inputs_that_it_is_asked_to(lookup, observation, inputs, tmp_path):
    """After a round of training, what is ignored changes no value; what is used does."""
    parameters = dagger.DaggerParameters(
        rounds=1, episodes=2, updates=3, starts=2, evaluate_every=1, inputs=inputs, longest=2
    )
    list(dagger.train_dagger(lookup, lookup, tmp_path, parameters))
    trained = load_network(tmp_path / "best.safetensors", "mug")
    state = gather(states([observation]))
    items, pairs = state["items"].clone(), state["pairs"].clone()
    items[..., scene_state.BELIEF] += 1.0
    pairs[..., scene_state.INFORMATION] += 1.0
    with torch.inference_mode():
        before = trained(state)[0]
        of_belief = trained({**state, "items": items})[0]
        of_information = trained({**state, "pairs": pairs})[0]
    assert torch.equal(before, of_belief) == (inputs == "poses")
    assert torch.equal(before, of_information) == (inputs != "all")


def test_the_network_is_what_its_layers_say(network, lookup, observation):
    """One view and one object at a time, beside a padded row: attention pools, gains of objects add up."""
    fewer = replace(without_objects(observation, 3), steps_left=2)
    state = gather(states([observation, fewer]))
    with torch.inference_mode():
        now, later = network(state)
        objects, pairs, views = state["items"], state["pairs"], state["outlooks"]
        for row, view in [(0, 0), (0, 77), (1, 30)]:
            n = int(state["present"][row].sum())
            h = network.of_object(objects[row, :n])
            pooled = h.mean(dim=0)
            h = network.in_context(torch.cat([h, pooled.expand_as(h)], dim=1))
            of_view = network.pair_from_view(views[row, view])
            e = torch.relu(network.of_pair(pairs[row, view, :n]) + network.pair_from_object(h) + of_view)
            e = e + network.mix(e)
            weights = torch.softmax(network.attend(e)[:, 0], dim=0)
            whole = torch.cat([weights @ e, e.mean(dim=0), pooled, views[row, view]])
            gains = torch.cat([now[row, view], later[row, view]], dim=1)
            np.testing.assert_allclose(gains[:n], network.per_object(e), atol=1e-4)
            np.testing.assert_allclose(gains[-1], network.per_view(whole), atol=1e-4)


def test_the_deployed_network_is_the_trained_one(network, lookup):
    """Whatever the number of objects and views, to the last bit."""
    deployed = trace(network, lookup.model)
    for views in ([3], [47, 80], [1, 20, 40, 60, 80, 99]):
        seen = observe(lookup, np.array([1]), np.array([views]), np.array([2]))[0]
        for n in (0, 1, 2, len(seen.objects)):
            each = without_objects(seen, n) if n < 2 else replace(seen, objects=seen.objects.take(np.arange(n)))
            for before, after in zip(values(network, [each]), values(deployed, [each]), strict=True):
                np.testing.assert_array_equal(after, before)


def test_policies_of_one_file_share_its_network_until_it_changes(network, tmp_path, lookup, observation):
    path = tmp_path / "weights.safetensors"
    save_network(network, path, "mug")
    first, second = (create_policy("view-attention", lookup.model, weights=str(path)) for _ in range(2))
    assert first._network is second._network
    before = first.decide(observation).attention
    other = copy.deepcopy(network)
    with torch.no_grad():
        for parameter in other.parameters():
            parameter.mul_(2.0)
    save_network(other, path, "mug")
    after = create_policy("view-attention", lookup.model, weights=str(path)).decide(observation).attention
    assert np.abs(after - before).max() > 1e-3
    np.testing.assert_array_equal(first.decide(observation).attention, before)


def test_no_decision_waits_for_the_compiler(policy, observation):
    decider = policy()
    compiled = len(scene_state._pair.signatures)
    assert compiled
    decider.decide(observation)
    assert len(scene_state._pair.signatures) == compiled


def test_a_decision_leaves_the_threads_as_they_were(policy, observation):
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        policy().decide(observation)
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(threads)


def test_candidates_are_kept_to(policy, observation):
    made = policy()
    assert made.decide(observation).view not in (3, 47, 80)
    only = replace(observation, allowed=np.isin(np.arange(100), [3, 47, 80, 99]))
    assert made.decide(only).view == 99
    nothing = replace(observation, allowed=np.isin(np.arange(100), [3, 47, 80]))
    assert made.decide(nothing).stop
    assert made.decide(replace(observation, metres_left=0.01)).stop
    blind = without_objects(observation)
    decision = made.decide(blind)
    assert decision.view is not None
    assert decision.attended is None


def test_many_objects_keep_the_best_verified(policy, observation):
    many = observation.objects.take(np.tile(np.arange(len(observation.objects)), 40))
    scores = np.linspace(0, 1, len(many))
    decision = policy().decide(replace(observation, objects=replace(many, verification=scores)))
    assert decision.attention.shape == (len(many),)
    assert 0 < decision.attention.sum() <= 1
    assert np.flatnonzero(decision.attention).min() >= len(many) - 64


def test_metres_are_weighed_at_run_time(policy, network, observation):
    """Free, the view of the largest gain; dear, the nearest one."""
    sphere = observation.sphere
    free, dear = (policy(metres_weight=weight, lookahead=1.0).decide(observation).view for weight in (0.0, 100.0))
    assert free == valued(network, observation, Weighing()).gain[0].round(5).argmax()
    arcs = sphere.arc(sphere.positions, observation.positions[-1])
    assert arcs[dear] == pytest.approx(arcs[observation.candidates()].min())


def test_high_walls_raise_the_camera(policy, observation, monkeypatch):
    """The bin that is told is the bin that hides."""
    seen = []

    def watched(network, observations, states, weighing):
        seen.append(states[0].shown)
        return value_views(network, observations, states, weighing)

    monkeypatch.setattr("active6d_agent.policies.view_attention.network.value_views", watched)
    for height in (0.0, 0.5):
        policy(wall_height=height, bin_width=0.5).decide(observation)
    open_table, well = seen
    low = np.arange(100) < 20
    assert open_table[:, low].mean() > 0.2
    assert well[:, low].max() == 0.0


def test_it_stops_when_nothing_is_to_be_gained(policy, network, observation):
    gain = valued(network, observation, Weighing()).gain.max()
    assert not policy(stop_below=0.0).decide(observation).stop
    assert policy(stop_below=abs(gain) + 1.0).decide(observation).stop


def test_what_counts_adds_up(network, observation):
    weighing = Weighing(metres_weight=0.3, error_weight=0.7, lookahead=0.5)
    now, later = (part[0].astype(float) for part in values(network, [observation]))
    found = valued(network, observation, weighing)
    arcs = observation.sphere.arc(observation.sphere.positions, observation.positions[-1])
    for view in np.flatnonzero(observation.candidates()):
        expected = now[view] @ [1, 0.7] + 0.5 * later[view] @ [1, 0.7] - 0.3 * arcs[view]
        assert found.worth[0, view] == pytest.approx(expected, abs=2e-5)


NO_PATCH = np.zeros((0, 3))


def test_labels_are_what_views_gain(lookup):
    """Against whole episodes, view by view; the oracle takes the best of them."""
    now, later = dagger.candidate_gains(lookup, 1, np.array([8, 30]), 3, NO_PATCH)
    assert np.isnan(now[[8, 30]]).all()
    assert np.isnan(later[[8, 30]]).all()
    scene = np.array([1])
    for view in (0, 31, 99):
        path = np.array([[8, 30, view]])
        whole = dagger.spread(lookup.sphere, path, 2)
        added = tally(lookup, scene, path) - tally(lookup, scene, path[:, :2])
        np.testing.assert_allclose(now[view].sum(axis=0), added[0], atol=1e-6)
        added = tally(lookup, scene, whole) - tally(lookup, scene, path)
        np.testing.assert_allclose(later[view].sum(axis=0), added[0], atol=1e-6)
    worths = [worth(lookup, scene, np.array([[8, view]]))[0] if view != 8 else -1 for view in range(100)]
    first, last = (gains.sum(axis=1) for gains in dagger.candidate_gains(lookup, 1, np.array([8]), 1, NO_PATCH))
    assert int(np.argmax(worths)) == int(np.nanargmax(np.round(first @ [1.0, 0.999 / 8], 9)))
    assert int(np.argmax(worths)) == search_views(lookup, 1, 8, 1)[1]
    assert np.nanmax(np.abs(last)) == 0.0


@pytest.mark.parametrize("certainty", [0.0, 0.4, 1.0])
def test_detections_count_with_their_probability(lookup, certainty):
    """Object by object: the most probable of the poses that detect it, and the whole detection without certainty."""
    scene, views = np.array([0, 1]), np.array([[3, 47], [20, 81]])
    fused = lookup.fuse(scene, views, views[:, -1])
    found = known(lookup, scene, views, certainty)
    limit = 0.1 * lookup.model.diameter
    for episode in range(2):
        rows = fused.objects[episode]
        for index in range(lookup.object_count[episode]):
            right = [n for n, row in enumerate(rows) if row >= 0 and lookup.errors[row, index] < limit]
            best = max((fused.probability[episode, n] for n in right), default=None)
            expected = 0.0 if best is None else 1 - certainty + certainty * best
            assert found[episode, index, 0] == pytest.approx(expected)
    assert 0 < (found[..., 0] > 0).sum() < found[..., 0].size
    assert (fused.probability[fused.objects >= 0] > 0).any()


def test_spread_views_are_the_farthest_of_their_ring(lookup):
    sphere = lookup.sphere
    elevation = np.degrees(np.arcsin(sphere.positions[:, 2] / sphere.radius))
    ring = np.flatnonzero(np.abs(elevation - 60) < 1)
    (path,) = dagger.spread(sphere, np.array([[3, 70]]), 4)
    for count in range(2, 6):
        nearest = [min(sphere.arc(sphere.positions[view], sphere.positions[v]) for v in path[:count]) for view in ring]
        assert path[count] in ring
        assert nearest[list(ring).index(path[count])] == pytest.approx(max(nearest), abs=3e-3)
    assert len(set(path)) == 6


def test_labels_tell_which_object_gains(lookup):
    """Each true object's gain is its stand-in's, in the network's order; the others' comes last."""
    taken, view, limit = [8, 30], 31, 0.1 * lookup.model.diameter
    (before,), (after,) = (
        lookup.object_errors(lookup.fuse(np.array([1]), np.array([views]), np.array([views[-1]])))
        for views in (taken, [*taken, view])
    )
    gains = dagger.candidate_gains(lookup, 1, np.array(taken), 2, NO_PATCH)[0][view]
    observation = observe(lookup, np.array([1]), np.array([taken]), np.array([2]))[0]
    order, stand_ins = best_verified(observation).tolist(), {}
    for index, position in enumerate(observation.objects.T_world_object[:, :3, 3]):
        row = np.linalg.norm(lookup.positions - position, axis=1).argmin()
        stand_ins.setdefault(lookup.nearest_object[row], order.index(index))
    count = lookup.object_count[1]
    detected = (after < limit).astype(int) - (before < limit)
    for index in range(count):
        if index in stand_ins:
            assert gains[stand_ins[index], 0] == detected[index]
            assert gains[stand_ins[index], 1] == pytest.approx((before[index] - after[index]) / 0.05, abs=1e-6)
    others = [index for index in range(count) if index not in stand_ins]
    assert gains[-1, 0] == pytest.approx(detected[others].sum(), abs=1e-9)
    assert len(gains) == len(order) + 1


def test_a_cluster_stands_for_the_nearest_object_without_a_hypothesis(lookup):
    """Its gain moves from what nobody stands for to the cluster; nothing else changes."""
    taken, true = np.array([8]), lookup.bank.scenes[1].T_world_object[:, :3, 3]
    plain = dagger.candidate_gains(lookup, 1, taken, 3, NO_PATCH)[0]
    stood_for = lookup.nearest_object[lookup.fuse(np.array([1]), taken[None], taken).objects[0]]
    missed = np.setdiff1d(np.arange(len(true)), stood_for)
    assert len(missed) > 0
    far, near = true[stood_for[0]] + [0.0, 0.0, 5.0], true[missed[0]] + [0.0, 0.0, 0.01]
    told = dagger.candidate_gains(lookup, 1, taken, 3, np.stack([far, near]))[0]
    np.testing.assert_array_equal(told[:, : plain.shape[1] - 1], plain[:, :-1])
    far, near, rest = np.moveaxis(told[:, -3:], 1, 0)
    assert not np.nan_to_num(far).any()
    np.testing.assert_allclose(near + rest, plain[:, -1], atol=1e-6)
    for view in (20, 50, 99):
        found = lookup.object_errors(lookup.fuse(np.array([1]), np.array([[8, view]]), np.array([view])))[0, missed[0]]
        assert near[view, 0] == (found < 0.1 * lookup.model.diameter)


def test_clusters_are_balls_of_what_is_unexplained():
    rng = np.random.default_rng(0)
    large, small = rng.normal(0, 0.004, (60, 3)), rng.normal(0, 0.004, (20, 3)) + [0.2, 0.0, 0.0]
    lonely = np.array([[0.0, 0.3, 0.0]])
    middles = cluster_unexplained(rng.permutation(np.concatenate([small, large, lonely])), 0.1)
    np.testing.assert_allclose(middles, [large.mean(axis=0), small.mean(axis=0)], atol=1e-9)
    assert len(cluster_unexplained(rng.uniform(-0.3, 0.3, (2000, 3)) * [1, 1, 0], 0.1)) == 8
    assert cluster_unexplained(np.zeros((0, 3)), 0.1).shape == (0, 3)


@pytest.mark.parametrize("name", ["bunny", "coffee_cup", "mug"])
def test_the_middle_is_guessed_behind_the_surface_that_shows(name):
    """Of objects turned at random that show the third that is nearest to the camera."""
    model, towards, middle = load_object(name), np.array([0.6, 0.0, 0.8]), np.array([0.3, 0.1, 0.05])
    points, off = model.mesh.sample(400, seed=0), []
    for R in Rotation.random(20, random_state=1).as_matrix():
        depth = points @ R.T @ towards
        shown = (points @ R.T)[depth > np.quantile(depth, 2 / 3)] + middle
        patch = shown.mean(axis=0)
        off.append([np.linalg.norm(each - middle) for each in (likely_centre(shown, patch, model), patch)])
    guessed, plain = np.mean(off, axis=0) / model.diameter
    assert guessed < 0.75 * plain


def test_unexplained_surface_is_counted_about_every_item(observation, lookup):
    """Within 0.35 and 0.65 diameters of objects and clusters alike, fifty points being one."""
    state, surface = states([observation])[0], observation.unexplained
    assert len(surface) > 50
    for centre, scalars in zip(state.pose[:, :, 3], state.scalars, strict=True):
        apart = np.linalg.norm(surface - centre, axis=1) / lookup.model.diameter
        np.testing.assert_allclose(scalars[5:7], [(apart < 0.35).sum() / 50, (apart < 0.65).sum() / 50], atol=0.03)


def test_states_in_which_little_is_left_count_more():
    """Twice the spread of gains is a quarter of the weight, above a floor."""
    gains = np.random.default_rng(0).normal(size=(2, 1000, 1, 2)).astype(np.float32) * [[[[10.0]]], [[[20.0]]]]
    weight = dagger._weigh_states(gains).numpy()
    assert weight.sum() == pytest.approx(2.0, rel=1e-5)
    assert weight[0] / weight[1] == pytest.approx(gains[1, ..., 0].var() / gains[0, ..., 0].var(), rel=0.01)


def test_training_and_deployment_move_alike(lookup, network, policy):
    starts = all_starts(lookup, 10, 0)
    deployed = run_policy(lookup, lambda scene: policy(), starts, 4)
    measured = dagger.validate(network, lookup, starts, 4)
    assert measured[0] == pytest.approx(deployed.detection_rate.mean())
    assert measured[2] == pytest.approx(deployed.distance_m.mean())


@pytest.mark.slow
def test_an_interrupted_training_goes_on_between_evaluations(tmp_path, monkeypatch):
    lookup = BestViewLookup(synthetic_bank("mug", scenes=2, objects=3))
    settings = {"episodes": 2, "updates": 2, "longest": 2, "steps": 2, "starts": 4, "batch": 8}
    parameters = dagger.DaggerParameters(rounds=3, evaluate_every=3, **settings)
    monkeypatch.setattr("active6d_core.files.Checkpoints.due", lambda self: True)
    rounds = []
    advance = dagger._Learner.advance

    def counted(learner):
        if learner.round == 2 and 2 not in rounds:
            rounds.append(2)
            raise KeyboardInterrupt
        rounds.append(learner.round)
        return advance(learner)

    monkeypatch.setattr(dagger._Learner, "advance", counted)
    with pytest.raises(KeyboardInterrupt):
        next(dagger.train_dagger(lookup, lookup, tmp_path, parameters))
    assert [p.round for p in dagger.train_dagger(lookup, lookup, tmp_path, parameters, resume=True)] == [3]
    assert rounds == [0, 1, 2, 2]


def test_it_learns_its_way_past_random_and_resumes(tmp_path):
    lookup = BestViewLookup(synthetic_bank("mug", scenes=3, objects=12))
    starts = all_starts(lookup, 40, 0)
    random = run_named(lookup, "random", starts, 4)
    settings = {"episodes": 10, "updates": 60, "longest": 4, "steps": 4, "starts": 40, "batch": 48, "certainty": 0.0}
    parameters = dagger.DaggerParameters(rounds=4, evaluate_every=2, **settings)
    curve = list(dagger.train_dagger(lookup, lookup, tmp_path, parameters, Weighing(metres_weight=0.05)))
    assert [progress.round for progress in curve] == [2, 4]
    best = max(progress.detection_rate for progress in curve)
    assert best > random.detection_rate.mean() + 0.03
    weights = {"weights": str(tmp_path / "best.safetensors")}
    deployed = run_named(lookup, "view-attention", starts, 4, parameters=weights)
    settled = json.loads((tmp_path / "best.json").read_text())["provenance"]["settled"]
    assert deployed.detection_rate.mean() == pytest.approx(settled["detection_rate"])
    assert deployed.detection_rate.mean() > random.detection_rate.mean() + 0.03
    assert deployed.e_add_mm.mean() < random.e_add_mm.mean()
    assert deployed.distance_m.mean() <= random.distance_m.mean()
    quick = settings | {"episodes": 2, "updates": 2, "starts": 4}
    more = dagger.DaggerParameters(rounds=5, evaluate_every=2, **quick)
    assert [p.round for p in dagger.train_dagger(lookup, lookup, tmp_path, more, resume=True)] == [5]
    assert len((tmp_path / "curve.jsonl").read_text().splitlines()) == 3
    with pytest.raises(ValueError, match="no weights of the view-attention policy"):
        next(dagger.train_dagger(lookup, lookup, tmp_path / "none", more, resume=True))


def test_the_weighing_is_the_best_that_is_not_longer_than_random(lookup, network):
    starts = all_starts(lookup, 15, 0)
    given = network.weighing
    chosen = dagger.choose_weighing(network, lookup, starts, 4)
    assert network.weighing == given
    most = run_named(lookup, "random", starts, 4).distance_m.mean()

    def rate(**changes):
        measured = dagger.validate(replace_weighing(network, replace(chosen, **changes)), lookup, starts, 4)
        return measured[0] if measured[2] <= most else -1.0

    assert rate() == max(rate(metres_weight=each) for each in (0.0, 0.02, 0.05, 0.1, 0.2, 0.4, 0.7, 1.0)) > 0


def replace_weighing(network, weighing):
    changed = ViewAttention()
    changed.load_state_dict(network.state_dict())
    changed.weighing = weighing
    return changed.eval()


def test_a_decision_is_fast(policy, lookup):
    """The best of several, since other load on the machine only adds to it."""
    made = policy()
    seen = observe(lookup, np.array([0]), np.array([[1, 20, 40, 60, 80, 99]]), np.array([1]))[0]
    times = []
    for _ in range(10):
        began = time.perf_counter()
        made.decide(seen)
        times.append(time.perf_counter() - began)
    assert min(times) < 0.02


@pytest.mark.parametrize(
    ("name", "damage", "message"),
    [
        ("weights.safetensors", lambda path: path.write_bytes(b"no tensors"), "no weights of the view-attention"),
        ("weights.safetensors", lambda path: path.unlink(), "active6d train policy --object NAME --policy"),
        ("weights.json", lambda path: path.unlink(), "no weights of the view-attention policy"),
        ("weights.json", lambda path: path.write_text('{"policy": "attention"}'), "weights of policy 'attention'"),
        (
            "weights.json",
            lambda path: path.write_text(json.dumps({**json.loads(path.read_text()), "hidden": 9})),
            r"'attend.weight' has shape",
        ),
        (
            "weights.json",
            lambda path: path.write_text(json.dumps({**json.loads(path.read_text()), "object": "bunny"})),
            "weights for 'bunny', not for 'mug'",
        ),
    ],
)
def test_damaged_weights_are_refused_in_one_line(network, lookup, tmp_path, name, damage, message):
    save_network(network, tmp_path / "weights.safetensors", "mug")
    damage(tmp_path / name)
    with pytest.raises(ValueError, match=message) as error:
        create_policy("view-attention", lookup.model, weights=str(tmp_path / "weights.safetensors"))
    assert "\n" not in str(error.value)
    assert "weights.safetensors" in str(error.value)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"metres_weight": -1.0}, "metres_weight"),
        ({"lookahead": 2.0}, "lookahead"),
        ({"bin_width": 0.0}, "bin_width"),
        ({"bin_depth": -1.0}, "bin_depth"),
        ({"wall_height": float("nan")}, "wall_height"),
    ],
)
def test_parameters_out_of_range_are_named(policy, parameters, message):
    with pytest.raises(ValueError, match=message):
        policy(**parameters)
    with pytest.raises(ValueError, match="rounds"):
        dagger.DaggerParameters(rounds=0)
