"""Episodes by direct calls of estimator, fusion and policy, without ROS: as the graph runs them, for many episodes."""

import time
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from active6d_agent.policies.episode_state import EpisodeState, Limits
from active6d_agent.policies.registry import Policy
from active6d_core.camera import View
from active6d_core.hypotheses import Hypotheses, SceneObjects
from active6d_core.object_model import ObjectModel
from active6d_core.registry import AUTOMATIC
from active6d_perception.estimators.registry import create_estimator
from active6d_perception.scene.all_views_fusion import AllViewsFusion
from active6d_perception.scene.observed_surface import ObservedSurface
from active6d_perception.scene.verification import Verifier
from active6d_sim.rendering.simulator import GoalError


@dataclass(frozen=True, eq=False)
class PerceivedView:
    """A view and what the estimator found in it.

    Attributes:
        view: images and pose of the camera.
        hypotheses: k of the estimator.
        verification: (k,) their verification scores.
        T_world_shown: (4, 4) pose of the camera that boxes and depths of the hypotheses are those of, where it is
            turned against the view's.
        seconds: of estimator and verification.
    """

    view: View
    hypotheses: Hypotheses
    verification: np.ndarray
    T_world_shown: np.ndarray | None = None
    seconds: float = 0.0

    def at(self, stamp: int) -> "PerceivedView":
        """The same, taken at another time in nanoseconds."""
        return replace(self, view=replace(self.view, stamp=stamp))


class Perception:
    """Estimator and verification of one object."""

    def __init__(self, model: ObjectModel, estimator: str = AUTOMATIC) -> None:
        self._estimator, self._verifier = create_estimator(estimator, model), Verifier(model)

    def __call__(self, view: View) -> PerceivedView:
        """Estimate and verify."""
        began = time.perf_counter()
        hypotheses = self._estimator.estimate(view)
        verification = self._verifier.score(view.depth, view.camera, hypotheses)
        return PerceivedView(view, hypotheses, verification, seconds=time.perf_counter() - began)


class DirectCamera(Protocol):
    """Takes views for :func:`run_directly`; stamps of later views are later."""

    def begin(self) -> PerceivedView:
        """The first view."""

    def go_to(self, T_world_goal: np.ndarray) -> PerceivedView:
        """The view of a goal (4, 4).

        Raises:
            GoalError: the camera cannot go there.
        """


@dataclass(eq=False)
class DirectEpisode:
    """An episode that has ended.

    Attributes:
        views: t + 1 in order.
        objects: t + 1, what was known after each view.
        T_world_cameras: (t + 1, 4, 4) poses of the camera as fusion corrected them by the end, metres.
        not_aligned: numbers of the views whose depth images fit none before; their camera poses are as given.
        refused: why goals were refused, in order.
        reason: why it ended.
    """

    views: list[PerceivedView] = field(default_factory=list)
    objects: list[SceneObjects] = field(default_factory=list)
    T_world_cameras: np.ndarray = field(default_factory=lambda: np.zeros((0, 4, 4)))
    not_aligned: list[int] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)
    reason: str = ""


class DirectRunner:
    """Runs episodes of one object; fusion is compiled once.

    Args:
        model: of the object.
        limits: of every episode.
        fusion: in the object's usual bin, as the graph's, when None.
    """

    def __init__(self, model: ObjectModel, limits: Limits, fusion: AllViewsFusion | None = None) -> None:
        self.limits, self._surface = limits, ObservedSurface(model)
        self._fusion = AllViewsFusion(model) if fusion is None else fusion

    def run(self, policy: Policy, camera: DirectCamera, rng: np.random.Generator) -> DirectEpisode:
        """Run one episode to its end; ``rng`` is the policy's."""
        episode, fusion, surface = DirectEpisode(), self._fusion, self._surface
        fusion.reset()
        surface.reset()
        policy.reset(rng)
        seen = camera.begin()
        state = EpisodeState(seen.view.stamp, self.limits)
        while True:
            view = seen.view
            pose, found = view.T_world_camera, (seen.hypotheses, seen.verification)
            fusion.add_view(view.stamp, pose, *found, view.depth, view.camera)
            aligned = fusion.cameras.alignment(view.stamp)
            if not aligned.aligned:
                episode.not_aligned.append(len(episode.views))
            surface.add_view(view.stamp, view.depth, view.camera, aligned.correction @ pose)
            shown = pose if seen.T_world_shown is None else seen.T_world_shown
            objects = fusion.objects(view.stamp, shown, view.camera)
            episode.views.append(seen)
            episode.objects.append(objects)
            state.add_view(view.stamp, view.T_world_camera[:3, 3])
            unexplained = surface.unexplained(objects.T_world_object, fusion.cameras.T_world_anchor)
            reached = None
            while reached is None:
                decision, episode.reason = state.decide(policy, objects, unexplained)
                if decision is None or episode.reason:
                    episode.T_world_cameras = fusion.cameras.T_world_cameras()
                    return episode
                try:
                    reached = camera.go_to(self.limits.sphere.pose(decision.position))
                except GoalError as error:
                    episode.refused.append(str(error))
                    state.refused(str(error))
            seen = reached
