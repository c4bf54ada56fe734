"""Views that the camera refuses or does not reach are struck, and the episode ends with a reason."""

import numpy as np
import pytest

from active6d_agent.policies.episode_state import MOST_MISSED, EpisodeState, Limits
from active6d_agent.policies.registry import Decision, create_policy
from active6d_core.hypotheses import SceneObjects
from active6d_core.object_model import load_object
from active6d_core.view_sphere import ViewSphere

SPHERE = ViewSphere()
NOTHING = np.zeros((0, 3))


def make_state(views=None, **limits):
    allowed = np.ones(len(SPHERE), bool) if views is None else np.isin(np.arange(len(SPHERE)), views)
    state = EpisodeState(1, Limits(SPHERE, allowed, **{"steps": 3, **limits}))
    state.add_view(1, SPHERE.positions[0])
    return state


@pytest.fixture
def policy():
    policy = create_policy("max-distance", load_object("mug"))
    policy.reset(np.random.default_rng(0))
    return policy


def decide(state, policy):
    return state.decide(policy, SceneObjects.empty(), NOTHING)


def test_refused_views_are_not_chosen_again(policy):
    state = make_state()
    views = []
    for _ in range(3):
        decision, reason = decide(state, policy)
        assert reason == ""
        views.append(decision.view)
        assert state.refused("in the wall")
    decision, reason = decide(state, policy)
    assert (reason, decision.stop) == ("", False)
    assert len({*views, decision.view}) == 4
    # The policy takes the view farthest away: what follows is never farther than what was struck.
    arcs = SPHERE.arc(SPHERE.positions[[*views, decision.view]], SPHERE.positions[0])
    assert (np.diff(arcs) <= 1e-9).all()


def test_a_policy_that_stops_is_named_as_the_reason():
    policy = create_policy("single-view", load_object("mug"))
    policy.reset(np.random.default_rng(0))
    decision, reason = decide(make_state(), policy)
    assert decision.stop
    assert reason == "the policy stopped: no view is worth the move"


def test_struck_views_stay_struck_after_the_next_view(policy):
    state = make_state(views=[5, 9])
    first = decide(state, policy)[0].view
    state.refused("no")
    second = decide(state, policy)[0].view
    assert {first, second} == {5, 9}
    state.add_view(2, SPHERE.positions[second])
    decision, reason = decide(state, policy)
    assert decision.stop
    assert reason == "no reachable view is left (1 refused by the camera, the last because: no)"


def test_all_views_refused_ends_with_the_reason(policy):
    state = make_state(views=[5, 9, 40])
    for number in range(3):
        assert decide(state, policy)[1] == ""
        assert state.refused(f"reason {number}")
    decision, reason = decide(state, policy)
    assert decision.stop
    assert reason == "no reachable view is left (3 refused by the camera, the last because: reason 2)"


def test_a_refusal_after_arrival_strikes_nothing(policy):
    state = make_state()
    decide(state, policy)
    state.reached()
    assert not state.refused("stale goal")
    assert not state.waiting
    assert not state.wait(1e6)


def test_a_goal_that_is_not_reached_in_time_is_struck(policy):
    state = make_state(goal_timeout=2.0, views=[5, 9])
    first = decide(state, policy)[0].view
    assert [state.wait(0.5) for _ in range(4)] == [False, False, False, True]
    second = decide(state, policy)[0].view
    assert {first, second} == {5, 9}
    assert not state.wait(1.5)  # each goal has its own two seconds
    assert state.wait(0.5)
    assert decide(state, policy)[1] == "no reachable view is left (2 not reached within 2 s)"


def test_without_a_limit_the_camera_may_take_for_ever(policy):
    state = make_state()
    decide(state, policy)
    assert not state.wait(1e9)
    assert state.waiting


def test_a_camera_that_reaches_nothing_ends_the_episode(policy):
    state = make_state(goal_timeout=1.0)
    for _ in range(MOST_MISSED - 1):
        decide(state, policy)
        assert state.wait(1.0)
    decide(state, policy)
    assert state.refused("it answers")  # the count starts again
    for _ in range(MOST_MISSED):
        assert decide(state, policy)[1] == ""
        assert state.wait(1.0)
    decision, reason = decide(state, policy)
    assert decision is None
    assert reason.startswith(f"the camera reached none of the last {MOST_MISSED} goals within 1 s each")


def test_budgets_end_it(policy):
    assert decide(make_state(steps=0), policy) == (None, "budget of 0 moves spent")
    assert decide(make_state(metres=1e-3), policy)[1] == "no view within the 0.00 m left of the budget of 0.00 m"


def test_a_budget_whose_rest_is_too_short_is_named(policy):
    # Neighbours on the ring of 15 degrees: 20 views around a circle of 0.8 m times cos(15), a chord of 0.2418 m.
    arc = 0.8 * 2 * np.arcsin(np.sin(np.pi / 20) * np.cos(np.radians(15.0)))
    state = make_state(metres=arc + 0.04)
    state.add_view(1 + 2 * 10**9, SPHERE.positions[1])
    total = f"{arc + 0.04:.2f} m"
    assert decide(state, policy)[1] == f"no view within the 0.04 m left of the budget of {total}"
    # Two seconds for that way, half a second is left; the nearest views are 15 degrees, 0.21 m, away.
    state = make_state(seconds=2.5)
    state.add_view(1 + 2 * 10**9, SPHERE.positions[1])
    assert decide(state, policy)[1] == "no view within the 0.5 s left of the budget of 2.5 s"
    # Nothing is left whatever the budget.
    state = make_state(views=[0, 1], metres=10.0)
    state.add_view(2, SPHERE.positions[1])
    assert decide(state, policy)[1] == "no reachable view is left"


def test_seconds_are_counted_by_stamps_and_limit_the_way_at_the_pace_so_far(policy):
    state = make_state(seconds=10.0, steps=9)
    assert decide(state, policy)[1] == ""  # how fast the camera is shows with the first move
    state.add_view(1 + 4 * 10**9, SPHERE.positions[5])
    assert state.elapsed == pytest.approx(4.0)
    decision, reason = decide(state, policy)
    assert reason == ""
    # Four seconds for this arc, so the six left are enough for one and a half of it.
    arc = SPHERE.arc(SPHERE.positions[0], SPHERE.positions[5])
    assert SPHERE.arc(SPHERE.positions[decision.view], SPHERE.positions[5]) <= 1.5 * arc + 1e-9
    state.add_view(1 + 10 * 10**9, SPHERE.positions[decision.view])
    assert decide(state, policy) == (None, "budget of 10 s spent")


class BesideTheGrid:
    """Always asks for the same place, which is no view of the grid."""

    place = SPHERE.position(np.radians(3.0), np.radians(46.0))

    def decide(self, observation):
        return Decision(self.place, None, np.zeros(0))


def test_a_goal_beside_the_grid_gives_way_to_the_nearest_view():
    state, policy = make_state(), BesideTheGrid()
    np.testing.assert_array_equal(decide(state, policy)[0].position, policy.place)
    state.refused("no")
    views = []
    for _ in range(2):
        views.append(decide(state, policy)[0].view)
        state.refused("no")
    arcs = SPHERE.arc(SPHERE.positions, policy.place)
    assert SPHERE.nearest(policy.place) not in views
    assert sorted(views) == sorted(np.argsort(arcs, kind="stable")[1:3])
