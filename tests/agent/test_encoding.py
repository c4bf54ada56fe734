"""Network inputs and goals, against loops over episodes and objects."""

import numpy as np

from active6d_agent.policies.attention.encoding import decode, encode
from active6d_agent.policies.registry import MAX_OBJECTS
from active6d_core.view_sphere import ViewSphere

SPHERE = ViewSphere()


def test_of_too_many_objects_the_first_are_kept():
    features = np.random.default_rng(0).random((2, MAX_OBJECTS + 7, 6)).astype(np.float32)
    present = np.ones(features.shape[:2], bool)
    present[1, 3:] = False
    encoded = encode(features, present, np.zeros((2, 1, 3)), np.zeros(2, int), 5)
    np.testing.assert_array_equal(encoded["objects"], features[:, :MAX_OBJECTS])
    np.testing.assert_array_equal(encoded["mask"][0], np.ones(MAX_OBJECTS))
    np.testing.assert_array_equal(encoded["mask"][1], np.arange(MAX_OBJECTS) < 3)


def test_the_history_is_the_latest_positions_but_the_current():
    positions = np.random.default_rng(1).random((3, 9, 3)).astype(np.float32)
    moves = np.array([0, 2, 7])
    encoded = encode(np.zeros((3, 0, 6)), np.zeros((3, 0), bool), positions, moves, 4)
    for episode, moved in enumerate(moves):
        past = positions[episode, :moved][-4:]
        np.testing.assert_array_equal(encoded["camera"][episode], positions[episode, moved])
        np.testing.assert_array_equal(encoded["history"][episode, : len(past)], past)
        assert not encoded["history"][episode, len(past) :].any()


def test_a_goal_is_the_nearest_candidate():
    rng = np.random.default_rng(2)
    angles, candidates = rng.uniform(-1, 1, (50, 2)), rng.random((50, 100)) < 0.3
    for view, (azimuth, elevation), allowed in zip(decode(angles, SPHERE, candidates), angles, candidates, strict=True):
        goal = SPHERE.position(np.pi * azimuth, np.pi / 4 * (elevation + 1))
        apart = np.linalg.norm(SPHERE.positions - goal, axis=1)
        assert allowed[view]
        assert apart[view] <= apart[allowed].min() + 1e-9
