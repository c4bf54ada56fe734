"""Algorithm 1 against a loop over objects, the trained policy against its export, and weights that are damaged."""

import json

import numpy as np
import pytest
import torch
from synthetic_bank import synthetic_bank

from active6d_agent.bank.best_view_lookup import BestViewLookup
from active6d_agent.environment.episodes import RewardParameters
from active6d_agent.environment.gym_environment import Active6DEnv, Active6DVectorEnv
from active6d_agent.policies.attention.network import (
    AttentionNetwork,
    AttentionPolicy,
    ObjectAttention,
    encode_observations,
    load_network,
    save_network,
)
from active6d_agent.policies.attention.ppo import BankVecEnv, PpoParameters, train_ppo, validate
from active6d_agent.policies.attention.ppo_policy import PaperPolicy
from active6d_agent.policies.registry import Observation, create_policy


@pytest.fixture(scope="module")
def lookup():
    return BestViewLookup(synthetic_bank("mug"))


@pytest.fixture
def network():
    torch.manual_seed(0)
    return AttentionNetwork().eval()


def algorithm_1(module, features):
    """The paper's loops, in numpy."""
    tensors = {name: value.detach().double().numpy() for name, value in module.state_dict().items()}
    g = [np.maximum(tensors["fc.0.weight"] @ f + tensors["fc.0.bias"], 0.0) for f in features]
    g_global = sum(g) / len(g)
    w = [
        float(tensors["selector.weight"][0] @ np.concatenate([gi, g_global]) + tensors["selector.bias"][0]) for gi in g
    ]
    weights = np.exp(w) / np.exp(w).sum()
    m = int(np.argmax(weights))
    return np.concatenate([g[m] * weights[m], features[m]]), weights, m


@pytest.mark.parametrize("count", [1, 2, 7, 20])
def test_attention_is_algorithm_1(count):
    torch.manual_seed(count)
    module, rng = ObjectAttention(), np.random.default_rng(count)
    padded = np.zeros((2, 20, 6), np.float32)
    features = rng.random((2, count, 6)).astype(np.float32)
    padded[:, :count] = features
    mask = torch.arange(20).expand(2, 20) < count
    attended, weight, index = module(torch.from_numpy(padded), mask.float())
    for scene in range(2):
        expected, weights, m = algorithm_1(module, features[scene].astype(float))
        np.testing.assert_allclose(attended[scene].detach(), expected, atol=1e-5)
        np.testing.assert_allclose(weight[scene, :count].detach(), weights, atol=1e-5)
        assert index[scene] == m
    assert not weight[:, count:].any()


def test_sizes_are_the_papers():
    """Supplement E: the Selector maps 12 to 1, the policy network has 128 units; NOTES: 12 + 3 + 3 T numbers."""
    network = AttentionNetwork(steps=5)
    assert network.attention.selector.weight.shape == (1, 12)
    assert network.attention.fc[0].weight.shape == (6, 6)
    assert network.policy[0].weight.shape == (128, 12 + 3 + 15)
    assert network.mean.weight.shape == (2, 128)


def test_what_is_padding_does_not_matter():
    torch.manual_seed(1)
    module, objects = ObjectAttention(), torch.rand(1, 9, 6)
    mask = (torch.arange(9) < 4).float()[None]
    noisy = objects.clone()
    noisy[:, 4:] = 100.0
    for a, b in zip(module(objects, mask), module(noisy, mask), strict=True):
        torch.testing.assert_close(a, b)


def test_order_of_objects_does_not_matter():
    torch.manual_seed(2)
    module, objects = ObjectAttention(), torch.rand(1, 6, 6)
    order = torch.tensor([3, 0, 5, 1, 4, 2])
    mask = torch.ones(1, 6)
    attended, weight, index = module(objects, mask)
    shuffled = module(objects[:, order], mask)
    torch.testing.assert_close(attended, shuffled[0])
    torch.testing.assert_close(weight[:, order], shuffled[1])
    assert order[shuffled[2]] == index


def test_the_ablation_attends_to_the_lowest_score():
    torch.manual_seed(5)
    module, objects = ObjectAttention("lowest-score"), torch.rand(4, 9, 6)
    mask = (torch.arange(9) < 6).float().expand(4, 9)
    attended, weight, index = module(objects, mask)
    torch.testing.assert_close(index, objects[:, :6, 5].argmin(dim=1))
    torch.testing.assert_close(weight.argmax(dim=1), index)
    torch.testing.assert_close(weight.sum(dim=1), torch.ones(4))
    torch.testing.assert_close(attended[:, 6:], objects[torch.arange(4), index])
    torch.testing.assert_close(attended[:, :6], module.fc(objects)[torch.arange(4), index])
    with pytest.raises(ValueError, match="no rule 'psychic'"):
        ObjectAttention("psychic")


def test_without_objects_nothing_is_attended():
    attended, weight, index = ObjectAttention()(torch.rand(1, 5, 6), torch.zeros(1, 5))
    assert not attended.any()
    assert not weight.any()
    assert index == 4


def test_gradients_flow_from_the_policy_through_the_weight(network):
    torch.manual_seed(3)
    observation = {
        "objects": torch.rand(4, 8, 6),
        "mask": torch.ones(4, 8),
        "camera": torch.rand(4, 3),
        "history": torch.zeros(4, 5, 3),
    }
    network(observation)[0].sum().backward()
    for name, parameter in network.attention.named_parameters():
        if name != "selector.bias":  # one constant added to all scores leaves their softmax as it is
            assert parameter.grad.abs().sum() > 0, name


def test_ppos_objective_teaches_the_attention(lookup):
    """Its gradient by the Selector is that of finite differences: it flows through the weight in o_t alone."""
    environment = BankVecEnv(Active6DVectorEnv(lookup, 6))
    environment.seed(1)
    torch.manual_seed(6)
    policy = PaperPolicy(environment.observation_space, environment.action_space, lambda _: 1e-4).double()
    observation = {name: torch.from_numpy(values).double() for name, values in environment.reset().items()}
    angles, advantage = torch.randn(6, 2, dtype=torch.float64), torch.randn(6, dtype=torch.float64)

    def objective():
        # As in evaluate_actions, which casts observations to single precision.
        latent, _ = policy.mlp_extractor(policy.features_extractor(observation))
        return (policy._get_action_dist_from_latent(latent).log_prob(angles) * advantage).sum()

    selector = policy.features_extractor.attention.selector.weight
    objective().backward()
    gradient, step = selector.grad.clone(), 1e-6
    assert gradient.abs().max() > 1e-6
    for place in range(12):
        with torch.no_grad():
            selector[0, place] += step
            higher = objective()
            selector[0, place] -= 2 * step
            lower = objective()
            selector[0, place] += step
        assert float((higher - lower) / (2 * step)) == pytest.approx(float(gradient[0, place]), abs=1e-5)


def test_the_deployed_policy_sees_what_the_environment_shows(lookup, network, tmp_path):
    """Node and environment choose the same view from the same observation, attending to the same object."""
    save_network(network, tmp_path / "weights.safetensors")
    policy = AttentionPolicy(lookup.model, str(tmp_path / "weights.safetensors"))
    policy.reset(np.random.default_rng(0))
    for scene in range(2):
        env = Active6DEnv(lookup)
        observation, info = env.reset(seed=0, options={"scene": scene, "view": 33})
        views = [info["view"]]
        for _ in range(5):
            seen = Observation(
                lookup.objects(scene, views),
                lookup.sphere.positions[views],
                lookup.sphere,
                np.ones(100, bool),
                6 - len(views),
            )
            for name, values in encode_observations([seen], 5).items():
                np.testing.assert_allclose(values[0], observation[name], atol=1e-6, err_msg=name)
            decision = policy.decide(seen)
            batch = {name: torch.from_numpy(values[None]) for name, values in observation.items()}
            with torch.inference_mode():
                mean, _, index = network(batch)
            assert decision.attended == int(index[0])
            assert decision.attention.argmax() == decision.attended
            assert decision.attention.sum() == pytest.approx(1.0)
            observation, _, _, _, info = env.step(np.append(mean[0].clamp(-1, 1).numpy(), index[0]))
            views.append(info["view"])
            assert decision.view == info["view"]


def test_the_export_is_the_trained_policy(lookup):
    environment = BankVecEnv(Active6DVectorEnv(lookup, 6))
    environment.seed(0)
    torch.manual_seed(4)
    policy = PaperPolicy(environment.observation_space, environment.action_space, lambda _: 1e-4)
    network, observation = policy.network(), environment.reset()
    actions, _ = policy.predict(observation, deterministic=True)
    with torch.inference_mode():
        mean, _, index = network({name: torch.from_numpy(values) for name, values in observation.items()})
    np.testing.assert_allclose(actions[:, :2], mean.clamp(-1, 1), atol=1e-6)
    np.testing.assert_array_equal(actions[:, 2], index)
    tensors = {name: torch.from_numpy(values) for name, values in observation.items()}
    sampled, values, log_prob = policy.forward(tensors)
    again = policy.evaluate_actions(tensors, sampled)
    torch.testing.assert_close(again[0], values)
    torch.testing.assert_close(again[1], log_prob)


def make_policy(lookup, **keywords):
    environment = BankVecEnv(Active6DVectorEnv(lookup, 6))
    environment.seed(0)
    torch.manual_seed(4)
    policy = PaperPolicy(environment.observation_space, environment.action_space, lambda _: 1e-4, **keywords)
    return policy, {name: torch.from_numpy(values) for name, values in environment.reset().items()}


def test_the_export_of_standardised_features_takes_raw_ones(lookup):
    rng = np.random.default_rng(8)
    statistics = {"mean": rng.random(6), "deviation": rng.uniform(0.05, 2.0, 6)}
    policy, tensors = make_policy(lookup, features_extractor_kwargs=statistics)
    tensors["mask"][0] = tensors["objects"][0] = 0.0  # an episode without objects
    with torch.inference_mode():
        actions = policy.forward(tensors, deterministic=True)[0]
        mean, _, index = policy.network()(tensors)
    torch.testing.assert_close(actions[:, :2], mean, atol=1e-5, rtol=0.0)
    torch.testing.assert_close(actions[:, 2].long(), index)


def test_with_credit_the_attended_object_is_drawn_and_has_a_probability(lookup):
    policy, tensors = make_policy(lookup, credit=True)
    tensors["mask"][0] = tensors["objects"][0] = 0.0
    with torch.no_grad():
        policy.features_extractor.attention.selector.weight *= 20.0  # weights that differ
        drawn = [policy.forward(tensors) for _ in range(400)]
        _, weight, most = policy.features_extractor.attention(tensors["objects"], tensors["mask"])
        index = torch.stack([actions[:, 2].long() for actions, _, _ in drawn])
        share = torch.stack([(index == each).float().mean(dim=0) for each in range(weight.shape[1])], dim=1)
        torch.testing.assert_close(share[1:], weight[1:], atol=0.12, rtol=0.0)
        assert (index[:, 0] == weight.shape[1] - 1).all(), "without objects the last index is certain"
        actions, values, log_probability = drawn[0]
        again = policy.evaluate_actions(tensors, actions)
        torch.testing.assert_close(again[0], values)
        torch.testing.assert_close(again[1], log_probability)
        # Against the same state with that index, as if it were certain.
        latent = policy.mlp_extractor.forward_actor(policy.features_extractor(tensors, index[0]))
        angles = policy._get_action_dist_from_latent(latent).log_prob(actions[:, :2])
        chosen = torch.where(torch.arange(6) > 0, weight[torch.arange(6), index[0]].log(), 0.0)
        torch.testing.assert_close(log_probability, angles + chosen)
        # The value does not know which object was drawn.
        torch.testing.assert_close(torch.stack([each for _, each, _ in drawn]).std(dim=0).max(), torch.tensor(0.0))
        torch.testing.assert_close(policy.forward(tensors, deterministic=True)[0][:, 2].long(), most)


def test_statistics_of_returns_outlive_an_interruption(lookup, tmp_path):
    settings = {"environments": 8, "rollout": 5, "batch": 20, "evaluate_every": 40, "credit": True, "normalise": True}
    list(train_ppo(lookup, lookup, tmp_path, PpoParameters(total=40, **settings)))
    count = json.loads((tmp_path / "latest.json").read_text())["returns"][2]
    assert count == pytest.approx(40, abs=1e-3)
    list(train_ppo(lookup, lookup, tmp_path, PpoParameters(total=80, **settings), resume=True))
    assert json.loads((tmp_path / "latest.json").read_text())["returns"][2] == pytest.approx(80, abs=1e-3)


def test_an_interrupted_training_goes_on_between_evaluations(lookup, tmp_path, monkeypatch):
    settings = {"environments": 8, "rollout": 5, "batch": 20, "evaluate_every": 40, "seed": 3}
    monkeypatch.setattr("active6d_core.files.Checkpoints.due", lambda self: True)
    parameters = PpoParameters(total=120, **settings)
    monkeypatch.setattr("active6d_agent.policies.attention.ppo.validate", lambda *_: (0.5, 1.0, 1.0))
    assert next(train_ppo(lookup, lookup, tmp_path, parameters)).steps == 40
    state = json.loads((tmp_path / "latest.json").read_text())
    # As a version wrote it that had fewer parameters.
    del state["parameters"]["credit"], state["reward"]["every_object"]
    # As an interruption in the middle of the second part leaves it.
    (tmp_path / "latest.json").write_text(json.dumps({**state, "steps": 56}))
    assert [p.steps for p in train_ppo(lookup, lookup, tmp_path, parameters, resume=True)] == [96, 136]


def test_training_is_its_seed_learns_and_resumes(lookup, tmp_path):
    settings = {"environments": 8, "rollout": 5, "batch": 20, "evaluate_every": 40, "seed": 3}
    curves = []
    for name in ("a", "b"):
        parameters = PpoParameters(total=80, **settings)
        curves.append(list(train_ppo(lookup, lookup, tmp_path / name, parameters)))
    assert [(p.steps, p.detection_rate, p.e_add_mm, p.mean_return) for p in curves[0]] == [
        (p.steps, p.detection_rate, p.e_add_mm, p.mean_return) for p in curves[1]
    ]
    longer = PpoParameters(total=120, **settings)
    later = list(train_ppo(lookup, lookup, tmp_path / "a", longer, resume=True))
    assert [p.steps for p in later] == [120]
    assert len((tmp_path / "a" / "curve.jsonl").read_text().splitlines()) == 3
    best = max(
        (json.loads(line) for line in (tmp_path / "a" / "curve.jsonl").open()), key=lambda p: p["detection_rate"]
    )
    network = load_network(tmp_path / "a" / "best.safetensors")
    assert validate(network, lookup, 5)[0] == pytest.approx(best["detection_rate"])
    with pytest.raises(ValueError, match="other parameters"):
        list(train_ppo(lookup, lookup, tmp_path / "a", PpoParameters(total=9, gamma=0.5), resume=True))
    with pytest.raises(ValueError, match="nothing to resume from"):
        list(train_ppo(lookup, lookup, tmp_path / "c", longer, resume=True))


def test_training_learns_what_is_rewarded(lookup, tmp_path):
    """With a penalty on motion alone, the policy must come to stay near."""
    reward = RewardParameters(alpha=0.0, beta=0.0, error_scale=0.0, motion_scale=1.0)
    parameters = PpoParameters(
        total=12_800, environments=64, rollout=10, evaluate_every=1_280, learning_rate=3e-3, batch=128
    )
    curve = list(train_ppo(lookup, lookup, tmp_path, parameters, reward))
    assert curve[-1].mean_return > 0.7 * curve[0].mean_return, "the returns are negative"
    assert curve[-1].distance_m < 0.7 * curve[0].distance_m


@pytest.mark.parametrize(
    ("name", "damage", "message"),
    [
        ("weights.safetensors", lambda path: path.write_bytes(b"no tensors"), "no weights of the attention policy"),
        ("weights.safetensors", lambda path: path.unlink(), "no weights of the attention policy"),
        ("weights.json", lambda path: path.unlink(), "no weights of the attention policy"),
        ("weights.json", lambda path: path.write_text("{}"), "policy"),
        ("weights.json", lambda path: path.write_text('{"policy": "other"}'), "weights of policy 'other'"),
        (
            "weights.json",
            lambda path: path.write_text('{"policy": "attention", "steps": 9, "hidden": 128, "rule": "learned"}'),
            r"'policy.0.weight' has shape \(128, 30\), expected",
        ),
    ],
)
def test_damaged_weights_are_refused_in_one_line(network, model, tmp_path, name, damage, message):
    save_network(network, tmp_path / "weights.safetensors")
    damage(tmp_path / name)
    with pytest.raises(ValueError, match=message) as error:
        create_policy("attention", model, weights=str(tmp_path / "weights.safetensors"))
    assert "\n" not in str(error.value)
    assert "weights.safetensors" in str(error.value)
