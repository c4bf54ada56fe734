"""Episodes with the camera on the simulated arm: what is found, and the seconds that it takes."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from active6d_agent.policies.episode_state import Limits
from active6d_agent.policies.registry import create_policy
from active6d_core.metrics import evaluate_scene
from active6d_core.object_model import load_object
from active6d_core.registry import AUTOMATIC
from active6d_core.view_sphere import ViewSphere
from active6d_sim.rendering.random_sensor import sensor_of
from active6d_sim.rendering.simulator import NANOSECONDS, Simulator, arrival
from active6d_sim.robot.arm import ArmSettings, CameraArm, hand_eye_error
from active6d_sim.scenes.scene_store import find_scene
from active6d_tools.direct_episode import DirectEpisode, DirectRunner, PerceivedView, Perception

#: Seconds at which the found objects are compared.
TIMES = tuple(range(0, 41, 2))


class ArmCamera:
    """The camera at the wrist of the arm in one scene. A view of the grid is rendered and estimated once.

    Args:
        scene_name: of a stored scene.
        perception: of its object.
        seed: of the sensor's noise and of the calibration's error.
        hand_eye: millimetres and degrees of that error.
        settings: of the arm.

    Attributes:
        scene: the scene.
        seconds: of every motion.
        clearances: least distance to anything along every motion, metres.
    """

    def __init__(
        self,
        scene_name: str,
        perception: Perception,
        seed: int = 0,
        hand_eye: tuple[float, float] = (1.0, 0.2),
        settings: ArmSettings | None = None,
    ) -> None:
        model = load_object(scene_name.split("/")[0])
        self.scene = find_scene(model.name, scene_name, 0)
        self._simulator = Simulator(self.scene, noise=sensor_of(AUTOMATIC, model, self.scene), seed=seed)
        self._perception, self._error = perception, hand_eye_error(*hand_eye, seed)
        self._arm, self._sphere = CameraArm(self.scene, settings), ViewSphere()
        self._known: dict[int, PerceivedView] = {}
        self.seconds: list[float] = []
        self.clearances: list[float] = []
        self._start = 0

    def start_at(self, rng: np.random.Generator) -> None:
        """Draw the first view of the next episodes from those that the arm reaches."""
        sphere = self._sphere
        reached = (v for v in rng.permutation(len(sphere)) if self._arm.reaches(sphere.pose(sphere.positions[v])))
        self._start = int(next(reached))

    def begin(self) -> PerceivedView:
        """Place the arm at the first view."""
        self._stamp = NANOSECONDS
        return self._perceive(self._arm.place(self._sphere.pose(self._sphere.positions[self._start])))

    def go_to(self, T_world_goal: np.ndarray) -> PerceivedView:
        """Move there.

        Raises:
            GoalError: the arm cannot.
        """
        motion = self._arm.plan(T_world_goal)
        self._arm.follow(motion)
        self.seconds.append(motion.seconds)
        self.clearances.append(self._arm.clearance(motion))
        self._stamp = arrival(self._stamp, motion.seconds)
        return self._perceive(motion.T_world_camera)

    def _perceive(self, T_world_camera: np.ndarray) -> PerceivedView:
        index = self._sphere.nearest(T_world_camera[:3, 3])
        if index not in self._known:
            view = self._simulator.capture(T_world_camera @ self._error, (index + 1) * NANOSECONDS)
            self._known[index] = self._perception(replace(view, T_world_camera=T_world_camera))
        return self._known[index].at(self._stamp)


def measure_arm(
    object_name: str,
    policies: Sequence[str],
    *,
    episodes: int = 20,
    steps: int = 5,
    scenes: int = 10,
    estimator: str = AUTOMATIC,
    seed: int = 0,
    hand_eye: tuple[float, float] = (1.0, 0.2),
    on_progress: Callable[[str, int, int], None] = lambda what, done, total: None,
) -> dict[str, Any]:
    """Run every policy from the same starts in the test scenes.

    Args:
        object_name: of the object.
        policies: their names.
        episodes: of each policy.
        steps: moves T.
        scenes: number of test scenes that the episodes are spread over.
        estimator: its name.
        seed: of starts, noise, calibration and policies.
        hand_eye: error of the calibration, millimetres and degrees.
        on_progress: called with a description, the number of episodes done and that of all.

    Returns:
        The settings, ``times``, and a row for each of ``policies``. Its ``found`` is the share after each move,
        ``found_at`` that at each of ``times``. ``refused`` goals and ``metres`` are per episode, and ``reasons`` has
        the number of refusals for each reason. What is of moves is None for a policy that made none.
    """
    model, sphere = load_object(object_name), ViewSphere()
    runner = DirectRunner(model, Limits(sphere, np.ones(len(sphere), bool), steps))
    perception = Perception(model, estimator)
    rows: dict[str, list[dict[str, Any]]] = {name: [] for name in policies}
    starts = -(-episodes // scenes)
    for number in range(episodes):
        if number % starts == 0:
            name = f"{object_name}/test/{number // starts}"
            camera = ArmCamera(name, perception, seed, hand_eye)
        camera.start_at(np.random.default_rng([seed, number]))
        for place, policy in enumerate(policies):
            on_progress(f"{name}, {policy}", number * len(policies) + place, episodes * len(policies))
            camera.seconds, camera.clearances = [], []
            done = runner.run(create_policy(policy, model), camera, np.random.default_rng([seed, number]))
            rows[policy].append(_describe(done, camera, runner.limits.sphere))
    settings = {"object": object_name, "episodes": episodes, "steps": steps, "seed": seed, "hand_eye": list(hand_eye)}
    return {**settings, "times": list(TIMES), "policies": {name: _summarise(own) for name, own in rows.items()}}


def _describe(episode: DirectEpisode, camera: ArmCamera, sphere: ViewSphere) -> dict[str, Any]:
    model, truth = load_object(camera.scene.object_name), camera.scene.T_world_object
    found = [evaluate_scene(model, objects.T_world_object, truth).detection_rate for objects in episode.objects]
    arrivals = np.concatenate([[0.0], np.cumsum(camera.seconds)])
    return {
        "found": found,
        # What is found at a time is what the last view until then has shown.
        "found_at": [found[int(np.searchsorted(arrivals, time, side="right")) - 1] for time in TIMES],
        "seconds": camera.seconds,
        "clearances": camera.clearances,
        "refused": episode.refused,
        "metres": sphere.path_length(np.array([seen.view.T_world_camera[:3, 3] for seen in episode.views])),
    }


def _summarise(rows: list[dict[str, Any]]) -> dict[str, Any]:
    seconds = np.concatenate([row["seconds"] for row in rows])
    clearances = np.concatenate([row["clearances"] for row in rows])
    # With a policy that takes one view, or where every goal is refused, nothing has moved.
    moved = len(seconds) > 0
    reasons = [reason for row in rows for reason in row["refused"]]
    longest = max(len(row["found"]) for row in rows)
    # An episode that ended early keeps what it had found.
    found = np.array([row["found"] + [row["found"][-1]] * (longest - len(row["found"])) for row in rows])
    return {
        "moves": len(seconds),
        "found": found.mean(axis=0).tolist(),
        "found_at": np.mean([row["found_at"] for row in rows], axis=0).tolist(),
        "seconds_per_move": float(seconds.mean()) if moved else None,
        "seconds_median": float(np.median(seconds)) if moved else None,
        "seconds_p95": float(np.quantile(seconds, 0.95)) if moved else None,
        "seconds_per_episode": float(np.mean([sum(row["seconds"]) for row in rows])),
        "metres": float(np.mean([row["metres"] for row in rows])),
        "refused": len(reasons) / len(rows),
        "reasons": {reason: reasons.count(reason) for reason in sorted(set(reasons))},
        "least_clearance_mm": 1e3 * float(clearances.min()) if moved else None,
    }
