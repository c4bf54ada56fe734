"""The policy node: an episode by hand, budgets, repeats and restarts, and everything that may come in wrong."""

import array

import numpy as np
import pytest
import torch
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from rclpy.parameter import Parameter
from ros_harness import GraphHarness, reliable
from sensor_msgs.msg import PointCloud2
from synthetic_bank import synthetic_bank

from active6d_agent.bank.best_view_lookup import BestViewLookup
from active6d_agent.environment.gym_environment import Active6DEnv
from active6d_agent.nodes import attention_policy
from active6d_agent.nodes.attention_policy import AttentionPolicyNode
from active6d_agent.policies.attention.network import AttentionNetwork, save_network
from active6d_agent.policies.registry import Decision, register_policy
from active6d_core.ros.conversions import (
    attention_from_cloud,
    make_header,
    objects_to_cloud,
    points_to_cloud,
    pose_stamped_to_transform,
    stamp_to_ns,
    transform_to_pose,
)
from active6d_core.ros.episode_messages import EpisodeEnd, EpisodeStart, GoalState, GoalStatus
from active6d_core.view_sphere import ViewSphere

SPHERE = ViewSphere()
SECOND = 1_000_000_000


class Episode:
    """Plays camera and fusion: sends views, collects what the policy says."""

    def __init__(self, graph, make_objects, **overrides):
        self.graph = graph
        self.objects = make_objects([[0.1, 0, 0], [-0.1, 0, 0.05]], [0.9, 0.3])
        self.unexplained = np.zeros((0, 3))
        self.goals = graph.mailbox(PoseStamped, "view_goal")
        self.attention = graph.mailbox(PointCloud2, "attention")
        self.ends = graph.mailbox(DiagnosticArray, "episode/end", latched=True)
        self.diagnostics = graph.mailbox(DiagnosticArray, "/diagnostics")
        self.node = graph.add(AttentionPolicyNode(context=graph.context, overrides=overrides))
        outputs = (self.node.goal, self.node.attention, self.node.end)
        graph.spin_until(lambda: all(output.get_subscription_count() for output in outputs))
        self.stamp = 0

    def start(self, stamp, **info):
        announcement = EpisodeStart(stamp, "world", info).to_message()
        self.graph.publish("episode/start", announcement, latched=True)

    def pose(self, view, stamp):
        message = PoseStamped(header=make_header(stamp, "world"))
        message.pose = transform_to_pose(SPHERE.pose(SPHERE.positions[view]))
        self.graph.publish("camera/pose", message, latched=True)

    def view(self, view, stamp=None):
        self.stamp = self.stamp + SECOND if stamp is None else stamp
        self.pose(view, self.stamp)
        cloud = points_to_cloud(self.unexplained, self.stamp, "world")
        self.graph.publish("objects/unexplained", cloud, latched=True)
        self.graph.publish("objects", objects_to_cloud(self.objects, self.stamp, "world"), latched=True)

    def goal_views(self):
        return [SPHERE.nearest(pose_stamped_to_transform(goal, "world")[:3, 3]) for goal in self.goals]

    def run(self, view):
        """Follow the goals until the episode ends; returns the views taken."""
        views, ends = [view], len(self.ends)
        while True:
            goals = len(self.goals)
            self.view(views[-1])
            self.graph.spin_until(lambda goals=goals: len(self.goals) > goals or len(self.ends) > ends)
            if len(self.ends) > ends:
                return views
            views.append(self.goal_views()[-1])

    def errors(self):
        return [s.message for message in self.diagnostics for s in message.status if s.level == DiagnosticStatus.ERROR]


@pytest.fixture
def episode(graph, make_objects):
    return lambda **overrides: Episode(graph, make_objects, **{"policy": "lowest-score", "steps": 2, **overrides})


def test_a_parameter_of_a_configured_node_is_refused(episode):
    (result,) = episode().node.set_parameters([Parameter("steps", value=3)])
    assert not result.successful
    assert "'steps' can be set only while the node is unconfigured" in result.reason


def test_an_episode_of_two_moves(episode):
    played = episode()
    played.start(SECOND)
    views = played.run(40)
    assert len(views) == 3
    assert [stamp_to_ns(goal.header.stamp) for goal in played.goals] == [SECOND, 2 * SECOND]
    for goal, view in zip(played.goals, views[1:], strict=True):
        np.testing.assert_allclose(
            pose_stamped_to_transform(goal, "world"), SPHERE.pose(SPHERE.positions[view]), atol=1e-9
        )
    end = played.ends[0]
    assert stamp_to_ns(end.header.stamp) == 3 * SECOND
    assert end.status[0].message == "budget of 2 moves spent"
    values = {value.key: value.value for value in end.status[0].values}
    assert values["moves"] == "2"
    assert float(values["metres"]) == pytest.approx(SPHERE.path_length(SPHERE.positions[views]), abs=1e-6)
    played.graph.spin_until(lambda: len(played.attention) == 2)
    weights, attended = attention_from_cloud(played.attention[0], "world")
    assert attended == 1
    assert weights[1] > weights[0]
    assert played.errors() == []


def test_a_policy_that_starts_within_an_episode_without_its_first_views_ends_it(episode):
    played = episode()
    played.start(SECOND)
    played.view(40, 5 * SECOND)
    played.graph.spin_until(lambda: len(played.ends) == 1)
    assert played.ends[0].status[0].message.startswith("attention_policy was started again")
    assert len(played.goals) == 0


def test_the_answer_of_another_episodes_camera_is_refused(episode):
    played = episode()
    played.start(SECOND, id="mine")
    played.view(40)
    played.graph.spin_until(lambda: len(played.goals) == 1)
    for name, goals in (("other", 1), ("mine", 2)):
        status = GoalStatus(SECOND, "world", GoalState.REFUSED, "no", name)
        played.graph.publish("view_goal/status", status.to_message(), latched=True)
        played.graph.spin_until(lambda: len(played.errors()) == 1)
        played.graph.spin_until(lambda goals=goals: len(played.goals) == goals)
    assert "it belongs to episode 'other', this one is 'mine'" in played.errors()[0]


def test_the_end_names_its_episode(episode):
    played = episode(steps=0)
    played.start(SECOND, id="mine")
    played.view(40)
    played.graph.spin_until(lambda: len(played.ends) == 1)
    assert EpisodeEnd.from_message(played.ends[0]).episode == "mine"


def test_the_seed_decides(make_objects):
    paths = []
    for seed in (3, 3, 4):
        graph = GraphHarness()  # a fresh one, since what was latched for the last policy is not for the next
        paths.append(Episode(graph, make_objects, policy="random", steps=4, seed=seed).run(0))
        graph.close()
    assert paths[0] == paths[1] != paths[2]


def test_a_repeated_view_repeats_the_goal(episode):
    played = episode()
    played.view(10)
    played.graph.spin_until(lambda: len(played.goals) == 1)
    played.view(10, played.stamp)
    played.graph.spin_until(lambda: len(played.goals) == len(played.attention) == 2)
    assert played.goals[0] == played.goals[1]
    assert played.attention[0] == played.attention[1]
    assert played.errors() == []


def test_the_next_episode_begins_afresh(episode):
    played = episode()
    played.start(SECOND)
    first = played.run(40)
    played.start(played.stamp + SECOND)
    assert played.run(40) == first
    assert len(played.ends) == 2


def test_a_first_view_that_overtakes_the_start_is_decided_on_again(episode):
    played = episode(steps=1)
    played.start(SECOND)
    played.run(40)
    played.view(41, 10 * SECOND)
    played.start(10 * SECOND)
    played.graph.spin_until(lambda: len(played.goals) == 2)
    assert stamp_to_ns(played.goals[1].header.stamp) == 10 * SECOND


def test_the_reach_is_respected(episode):
    reach = {"reach_elevation_min_degrees": 40.0, "reach_azimuth_degrees": 90.0, "reach_sector_degrees": 120.0}
    played = episode(policy="random", steps=6, **reach)
    azimuth, elevation = np.degrees(SPHERE.angles(SPHERE.positions[played.run(60)[1:]])).T
    assert (elevation > 40).all()
    assert ((azimuth >= 30) & (azimuth <= 150)).all()


def test_listed_views_then_no_reachable_view_is_left(episode):
    played = episode(policy="max-distance", steps=6, reach_views=[7, 9])
    assert sorted(played.run(0)[1:]) == [7, 9]
    assert played.ends[0].status[0].message == "no reachable view is left"


def test_metres_are_a_budget(episode):
    played = episode(policy="max-distance", steps=20, metres=2.5)
    left = 2.5 - SPHERE.path_length(SPHERE.positions[played.run(0)])
    assert left >= 0
    assert played.ends[0].status[0].message == f"no view within the {left:.2f} m left of the budget of 2.50 m"


def answer(played, state, reason=""):
    """The camera's answer to the goal of the last view."""
    message = GoalStatus(played.stamp, "world", state, reason).to_message()
    played.graph.publish("view_goal/status", message, latched=True)


def test_a_motion_node_may_refuse_with_the_usual_quality_of_service_and_no_frame(episode):
    played = episode(policy="max-distance")
    arm = played.graph.node.create_publisher(DiagnosticArray, "view_goal/status", 10)
    played.start(SECOND)
    played.view(40)
    played.graph.spin_until(lambda: len(played.goals) == 1 and arm.get_subscription_count())
    arm.publish(GoalStatus(played.stamp, "", GoalState.REFUSED, "in the wall").to_message())
    played.graph.spin_until(lambda: len(played.goals) == 2)


def test_three_refused_goals_give_way_to_other_views(episode):
    played = episode(policy="max-distance")
    played.start(SECOND)
    played.view(40)
    for number in range(1, 4):
        played.graph.spin_until(lambda number=number: len(played.goals) == number)
        answer(played, GoalState.REFUSED, "in the wall")
    played.graph.spin_until(lambda: len(played.goals) == 4)
    assert len(set(played.goal_views())) == 4
    assert {stamp_to_ns(goal.header.stamp) for goal in played.goals} == {SECOND}
    answer(played, GoalState.ACCEPTED)
    answer(played, GoalState.REACHED)
    taken = [40, *played.run(played.goal_views()[-1])]
    assert len(taken) == 3
    assert not set(taken[1:]) & set(played.goal_views()[:3])
    assert played.ends[0].status[0].message == "budget of 2 moves spent"


def test_a_repeated_goal_that_the_camera_refuses_as_stale_strikes_nothing(episode):
    played = episode()
    played.view(10)
    played.graph.spin_until(lambda: len(played.goals) == 1)
    answer(played, GoalState.REACHED)
    answer(played, GoalState.REFUSED, "stale goal")
    played.view(10, played.stamp)  # a restarted fusion node repeats its objects
    played.graph.spin_until(lambda: len(played.goals) == 2)
    assert played.goals[0] == played.goals[1]


def test_answers_to_other_goals_are_ignored(episode):
    played = episode()
    played.view(10)
    played.graph.spin_until(lambda: len(played.goals) == 1)
    answered = GoalStatus(played.stamp + 1, "world", GoalState.REFUSED, "another policy's").to_message()
    played.graph.publish("view_goal/status", answered, latched=True)
    played.graph.spin_for(0.3)
    assert len(played.goals) == 1


def test_when_every_view_is_refused_the_episode_ends_and_says_why(episode):
    played = episode(reach_views=[7, 9, 11])
    played.view(0)
    for number in range(1, 4):
        played.graph.spin_until(lambda number=number: len(played.goals) == number)
        answer(played, GoalState.REFUSED, f"collision {number}")
    played.graph.spin_until(lambda: played.ends)
    assert sorted(played.goal_views()) == [7, 9, 11]
    reason = played.ends[0].status[0].message
    assert reason == "no reachable view is left (3 refused by the camera, the last because: collision 3)"


def test_a_goal_that_is_not_reached_in_time_gives_way(episode):
    played = episode(reach_views=[7, 9], goal_timeout=0.3)
    played.view(0)
    played.graph.spin_until(lambda: len(played.goals) == 1)
    answer(played, GoalState.ACCEPTED)
    played.graph.spin_until(lambda: len(played.goals) == 2)
    assert sorted(played.goal_views()) == [7, 9]
    played.graph.spin_until(lambda: played.ends)
    assert played.ends[0].status[0].message == "no reachable view is left (2 not reached within 0.3 s)"


def test_a_view_under_way_stops_the_clock_of_its_goal(episode):
    """A camera that answers no goals: its next pose is the sign that it arrived, however long perception takes."""
    played = episode(goal_timeout=0.3)
    played.view(0)
    played.graph.spin_until(lambda: len(played.goals) == 1)
    played.pose(played.goal_views()[0], 2 * SECOND)
    played.graph.spin_for(1.0)
    assert len(played.goals) == 1


def camera_that_answers(played):
    """A camera that joins now; what it hears."""
    camera, heard = Node("camera", context=played.graph.context), []
    played.graph.add(camera)
    camera.create_publisher(DiagnosticArray, "view_goal/status", reliable(latched=True))
    camera.create_subscription(PoseStamped, "view_goal", heard.append, reliable())
    played.graph.spin_until(lambda: played.node.count_publishers("view_goal/status"))
    return heard


def test_a_goal_without_an_answer_comes_again_for_a_camera_that_joins_late(episode, monkeypatch):
    monkeypatch.setattr(attention_policy, "_REPEAT_SECONDS", 0.3)
    played = episode(goal_timeout=0.0)
    played.view(10)
    played.graph.spin_until(lambda: len(played.goals) == 1)
    played.graph.spin_for(0.7)
    assert len(played.goals) == 1, "nobody here answers goals: a second one would be a second move"
    heard = camera_that_answers(played)
    played.graph.spin_until(lambda: heard)
    assert heard[0] == played.goals[0]
    answer(played, GoalState.ACCEPTED)
    played.graph.spin_for(0.3)
    count = len(played.goals)
    played.graph.spin_for(0.7)
    assert len(played.goals) == count, "an accepted goal is not repeated"


def test_a_goal_whose_view_is_coming_is_not_repeated(episode, monkeypatch):
    monkeypatch.setattr(attention_policy, "_REPEAT_SECONDS", 0.3)
    played = episode()
    played.view(10)
    played.graph.spin_until(lambda: len(played.goals) == 1)
    camera_that_answers(played)
    played.pose(played.goal_views()[0], 2 * SECOND)
    played.graph.spin_for(1.0)
    assert len(played.goals) == 1


def test_camera_and_arm_may_both_answer_goals(episode):
    played = episode(policy="max-distance")
    played.view(40)
    played.graph.spin_until(lambda: len(played.goals) == 1)
    arm = Node("arm", context=played.graph.context)
    played.graph.add(arm)
    status = arm.create_publisher(DiagnosticArray, "view_goal/status", reliable(latched=True))
    answer(played, GoalState.ACCEPTED)
    status.publish(GoalStatus(played.stamp, "world", GoalState.REFUSED, "no plan").to_message())
    played.graph.spin_until(lambda: len(played.goals) == 2)
    assert played.errors() == []


def test_an_announced_episode_may_wait_for_its_first_view(episode):
    played = episode(goal_timeout=0.1)
    played.start(SECOND)
    played.graph.spin_for(0.3)
    played.view(0)
    played.graph.spin_until(lambda: len(played.goals) == 1)


def test_a_status_that_cannot_be_read_is_refused(episode):
    played = episode()
    message = GoalStatus(SECOND, "world", GoalState.REFUSED).to_message()
    message.status[0].values[0].value = "bored"
    played.graph.publish("view_goal/status", message, latched=True)
    played.graph.spin_until(lambda: any("goal state is 'bored'" in error for error in played.errors()))


def wrong_frame(cloud):
    cloud.header.frame_id = "map"


def cut_short(cloud):
    cloud.data = cloud.data[:-4]


def lost_column(cloud):
    cloud.fields = cloud.fields[1:]


def not_a_number(cloud):
    cloud.data[0:4] = array.array("B", np.float32(np.nan).tobytes())


@pytest.mark.parametrize(
    ("damage", "complaint"),
    [
        (wrong_frame, "frame_id is 'map'"),
        (cut_short, "bytes"),
        (lost_column, "column 'x'"),
        (not_a_number, "finite"),
    ],
)
def test_bad_objects_are_refused_and_the_node_lives(episode, damage, complaint):
    played = episode()
    cloud = objects_to_cloud(played.objects, SECOND, "world")
    damage(cloud)
    played.pose(3, SECOND)
    played.graph.publish("objects", cloud, latched=True)
    played.graph.spin_until(lambda: any(complaint in error for error in played.errors()), what=complaint)
    assert not played.goals
    played.view(3, SECOND)
    played.graph.spin_until(lambda: len(played.goals) == 1)


def not_a_number_of_a_point(cloud):
    cloud.data[8:12] = array.array("B", np.float32(np.inf).tobytes())


@pytest.mark.parametrize(
    ("damage", "complaint"),
    [
        (wrong_frame, "frame_id is 'map'"),
        (cut_short, "bytes"),
        (lost_column, "column 'x'"),
        (not_a_number_of_a_point, "'z' holds a number that is not finite"),
    ],
)
def test_bad_surface_is_refused_and_the_node_lives(episode, damage, complaint):
    played = episode()
    cloud = points_to_cloud(np.ones((3, 3)), SECOND, "world")
    damage(cloud)
    played.graph.publish("objects/unexplained", cloud, latched=True)
    played.graph.spin_until(lambda: any(complaint in error for error in played.errors()), what=complaint)
    assert not played.goals
    played.view(3, SECOND)
    played.graph.spin_until(lambda: len(played.goals) == 1)


@register_policy("watching")
class Watching:
    """Remembers what it saw."""

    def __init__(self, model):
        self.seen = []

    def reset(self, rng):
        self.seen.clear()

    def decide(self, observation):
        self.seen.append(observation)
        return Decision.go_to(observation, int(np.flatnonzero(observation.candidates())[0]))


def test_the_policy_sees_the_unexplained_surface_of_its_view(episode):
    played = episode(policy="watching")
    for count in (4, 0):
        played.unexplained = np.random.default_rng(count).uniform(-0.1, 0.1, (count, 3)).astype(np.float32)
        goals = len(played.goals)
        played.view(10 + goals)
        played.graph.spin_until(lambda goals=goals: len(played.goals) > goals)
        np.testing.assert_array_equal(played.node.policy.seen[-1].unexplained, played.unexplained)
    assert played.errors() == []


@pytest.mark.parametrize(
    ("damage", "complaint"),
    [
        (lambda message: setattr(message.header, "frame_id", "map"), "frame_id is 'map'"),
        (lambda message: setattr(message.pose.position, "x", float("nan")), "finite"),
        (lambda message: setattr(message.pose.orientation, "w", 5.0), "quaternion"),
    ],
)
def test_bad_poses_are_refused_and_the_node_lives(episode, damage, complaint):
    played = episode()
    message = PoseStamped(header=make_header(SECOND, "world"))
    message.pose = transform_to_pose(SPHERE.pose(SPHERE.positions[3]))
    damage(message)
    played.graph.publish("camera/pose", message, latched=True)
    played.graph.spin_until(lambda: any(complaint in error for error in played.errors()), what=complaint)
    played.view(3, SECOND)
    played.graph.spin_until(lambda: len(played.goals) == 1)


def test_a_stale_view_is_ignored(episode):
    played = episode(steps=4)
    played.pose(4, 2 * SECOND)
    played.view(3, 5 * SECOND)
    played.graph.spin_until(lambda: len(played.goals) == 1)
    played.view(4, 2 * SECOND)
    played.graph.spin_until(lambda: any("stale stamp 2.000 s" in d.status[0].message for d in played.diagnostics))
    played.view(4, 6 * SECOND)
    played.graph.spin_until(lambda: len(played.goals) == 2)
    assert not played.errors()  # a restarted node repeats what it published last


def test_an_empty_scene_still_moves(episode, make_objects):
    played = episode()
    played.objects = make_objects()
    assert len(played.run(0)) == 3
    assert all(cloud.width == 0 for cloud in played.attention)


def test_the_node_chooses_what_the_environment_would(episode, tmp_path):
    """The paper's network, once behind topics and once on a bank: the same views and the same attended objects."""
    torch.manual_seed(0)
    network, lookup = AttentionNetwork().eval(), BestViewLookup(synthetic_bank("mug", scenes=1))
    save_network(network, tmp_path / "weights.safetensors")
    parameters = f"{{weights: {tmp_path / 'weights.safetensors'}}}"
    played = episode(policy="attention", policy_parameters=parameters, steps=3)
    env = Active6DEnv(lookup, steps=5)
    observation, info = env.reset(options={"scene": 0, "view": 21})
    views = [info["view"]]
    for step in range(3):
        played.objects = lookup.objects(0, views)
        played.view(views[-1])
        played.graph.spin_until(lambda step=step: len(played.goals) == len(played.attention) == step + 1)
        with torch.inference_mode():
            mean, weight, index = network({name: torch.from_numpy(value[None]) for name, value in observation.items()})
        observation, _, _, _, info = env.step(np.append(mean[0].clamp(-1, 1).numpy(), index[0]))
        views.append(info["view"])
        published, attended = attention_from_cloud(played.attention[-1], "world")
        assert attended == index[0]
        np.testing.assert_allclose(published, weight[0, : len(published)], atol=1e-5)
    assert played.goal_views() == views[1:]


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"policy": "clever"}, "parameter 'policy' is 'clever'"),
        ({"steps": -1}, "parameter 'steps' is -1"),
        ({"policy_parameters": "[1]"}, "parameter 'policy_parameters' must be a YAML mapping"),
        ({"policy_parameters": "{a: ["}, "parameter 'policy_parameters'"),
        ({"policy": "random", "policy_parameters": "{sigma: 1}"}, "policy 'random' has no parameter 'sigma'"),
        ({"object": "teapot"}, "unknown object 'teapot'"),
        ({"reach_views": [100]}, "parameter 'reach_views' must be within 0 and 99"),
        ({"reach_elevation_min_degrees": 80.0}, "leave no view"),
        ({"elevations_degrees": [-10.0]}, "elevations must be within"),
    ],
)
def test_bad_parameters_are_named(graph, overrides, message):
    with pytest.raises(ValueError, match=message):
        graph.add(AttentionPolicyNode(context=graph.context, overrides=overrides))
