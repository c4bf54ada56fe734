"""Policies on scenes recorded in BOP's format: which scenes, from which starts, and how they score."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d

from active6d_agent.bank.observation import view_entropy
from active6d_agent.environment.rollout import EpisodeResults
from active6d_agent.policies.episode_state import Limits
from active6d_agent.policies.registry import create_policy
from active6d_core.camera import backproject
from active6d_core.metrics import MISSED_E_ADD, e_add, score_confirmed, score_errors
from active6d_core.object_model import ObjectModel
from active6d_core.registry import AUTOMATIC
from active6d_core.se3 import invert
from active6d_perception.active6d import check_span
from active6d_perception.model.ambiguity import ambiguity_of
from active6d_perception.scene.all_views_fusion import AllViewsFusion
from active6d_perception.scene.camera_alignment import CameraAlignment
from active6d_perception.scene.expected_visibility import OPEN_TABLE
from active6d_perception.scene.measured_view import measure_view
from active6d_sim.datasets.bop import CAMERA_FILE, TRUTH_FILE, BopScene
from active6d_sim.datasets.bop_models import differs_from_data_set
from active6d_tools.bop_results import BopEstimates
from active6d_tools.direct_episode import DirectEpisode, DirectRunner, PerceivedView, Perception
from active6d_tools.recorded_scene import RecordedCamera, RecordedScene, find_bin
from active6d_tools.view_registration import register_views, upright

#: Objects that are less certain do not help to place an image.
_SURE = 0.5
OnProgress = Callable[[str, int, int], None]


def scene_folders(folder: Path) -> list[Path]:
    """Scene folders of a data set, of a split of it, or the folder of a single scene.

    Raises:
        ValueError: there is none.
    """
    for pattern in (CAMERA_FILE, f"*/{CAMERA_FILE}", f"*/*/{CAMERA_FILE}"):
        found = sorted(path.parent for path in folder.glob(pattern))
        splits = sorted({scene.parent for scene in found})
        if len(splits) > 1:
            names = ", ".join(split.name for split in splits)
            raise ValueError(f"{folder}: has scenes in {names}; name one of these folders")
        if found:
            return found
    raise ValueError(f"{folder}: no {CAMERA_FILE} in it or in its subfolders; it must be a data set in BOP's format")


class RecordedEvaluation:
    """Runs policies on recorded scenes. Images are estimated once for all of them.

    Args:
        folders: of the scenes.
        model: of the object.
        object_id: BOP's number of the object; None if all objects are of the model.
        estimator: its name.
        steps: moves T.
        starts: number of first views in each scene.
        seed: of first views and policies.
        warn: called with what a user should know of a scene.

    Raises:
        ValueError: a scene cannot be read, placed or scored; the message names it.
    """

    def __init__(
        self,
        folders: Sequence[Path],
        model: ObjectModel,
        *,
        object_id: int | None = None,
        estimator: str = AUTOMATIC,
        steps: int = 5,
        starts: int = 5,
        seed: int = 0,
        warn: Callable[[str], None] = lambda text: None,
    ) -> None:
        self._model, self._steps, self._seed = model, steps, seed
        # A recording tells where its floor is, but not whether there are walls.
        self._fusion = AllViewsFusion(model, tray=OPEN_TABLE)
        perception = Perception(model, estimator)
        self.scenes: list[RecordedScene] = []
        #: BOP's number of the object.
        self.object_id = object_id or 1
        for folder in folders:
            recording = BopScene.load(folder, needs_poses=False)
            self.object_id = _check(recording, model, object_id)
            if not self.scenes and (text := differs_from_data_set(folder, self.object_id, model)):
                warn(text)
            placed = _place(recording, model, perception, warn)
            self.scenes.append(RecordedScene(placed, model, object_id, perception, find_bin(placed, model, warn)))
        self._truths = [scene.truth() for scene in self.scenes]
        self.starts = np.array(
            [
                (number, view)
                for number, scene in enumerate(self.scenes)
                for view in self._draw(number, np.unique(scene.nearest[scene.allowed]), starts)
            ]
        )

    def _draw(self, number: int, views: np.ndarray, count: int) -> np.ndarray:
        rng = np.random.default_rng([self._seed, number])
        return rng.choice(views, min(count, len(views)), replace=False)

    def run(
        self, name: str, parameters: dict[str, Any], on_progress: OnProgress = lambda what, done, total: None
    ) -> tuple[EpisodeResults, list[BopEstimates]]:
        """Run one policy from every start.

        Args:
            name: of the policy.
            parameters: of the policy.
            on_progress: called with a description, the number of episodes done and that of all.

        Returns:
            The scores; and for each episode the objects in the camera of its last image.
        """
        rows, estimates = [], []
        for done, (number, start) in enumerate(self.starts.tolist()):
            scene = self.scenes[number]
            on_progress(f"{name}, {scene.recording.folder.name}", done, len(self.starts))
            own = {"entropy": self._entropy(scene)} if name == "entropy" else {}
            policy = create_policy(name, self._model, **{**own, **parameters})
            camera = RecordedCamera(scene, start)
            limits = Limits(scene.sphere, scene.allowed, self._steps)
            runner = DirectRunner(self._model, limits, self._fusion)
            episode = runner.run(policy, camera, np.random.default_rng([self._seed, number, start]))
            rows.append(self._score(number, episode, camera))
            estimates.append(_estimates(scene, episode, camera))
        return EpisodeResults(self.starts[:, 0], *map(np.array, zip(*rows, strict=True))), estimates

    def _score(self, number: int, episode: DirectEpisode, camera: RecordedCamera) -> tuple[Any, ...]:
        objects, diameter = episode.objects[-1], self._model.diameter
        errors = e_add(self._model, objects.T_world_object[:, None], self._truths[number][None], cutoff=MISSED_E_ADD)
        score = score_errors(errors, diameter)
        sure = score_confirmed(errors, objects.probability >= self._fusion.parameters.confirmed, diameter)
        positions = np.array([seen.view.T_world_camera[:3, 3] for seen in episode.views])
        taken = camera.taken + [-1] * (self._steps + 1 - len(camera.taken))
        metres = self.scenes[number].sphere.path_length(positions)
        return score.detection_rate, score.mean_e_add_mm, metres, taken, *sure

    def _entropy(self, scene: RecordedScene) -> np.ndarray:
        of_image = {int(i): view_entropy(scene.perceive(int(i)).hypotheses.segmentation) for i in set(scene.nearest)}
        return np.array([of_image[int(i)] for i in scene.nearest])


def _check(recording: BopScene, model: ObjectModel, object_id: int | None) -> int:
    """BOP's number of the object; ValueError where a recording cannot be scored, before its images are estimated."""
    if recording.truth is None:
        raise ValueError(f"{recording.folder / TRUTH_FILE}: no such file; policies need ground truth to be scored")
    known = sorted({int(each) for image in recording.truth for each in image.object_id})
    if object_id is None and len(known) > 1:
        raise ValueError(f"{recording.folder}: has objects {', '.join(map(str, known))}; choose with --object-id")
    if object_id is not None and object_id not in known:
        raise ValueError(f"{recording.folder}: no ground truth of object {object_id}, only of {known}")
    view = recording.view(0, 0)
    if np.isfinite(view.depth).any():
        try:
            check_span(model, view.depth, view.camera)
        except ValueError as error:
            raise ValueError(f"{recording.folder}: {error}") from error
    return object_id or (known[0] if known else 1)


def _estimates(scene: RecordedScene, episode: DirectEpisode, camera: RecordedCamera) -> BopEstimates:
    objects, index = episode.objects[-1], camera.taken[-1]
    name = scene.recording.folder.resolve().name
    return BopEstimates(
        int(name) if name.isdecimal() else 0,
        scene.recording.image_ids[index],
        invert(scene.T_bin_camera[index]) @ objects.T_world_object,
        objects.probability,
        sum(seen.seconds for seen in episode.views),
    )


def _place(recording: BopScene, model: ObjectModel, perception: Perception, warn: Callable[[str], None]) -> BopScene:
    """The recording, with camera poses found by the objects in its images where it has none.

    Raises:
        ValueError: the images cannot be placed.
    """
    missing = [np.array_equal(T, np.eye(4)) for T in recording.T_world_camera]
    if not any(missing):
        return recording
    folder = recording.folder
    if not all(missing):
        raise ValueError(
            f"{folder}: {sum(missing)} of {len(missing)} images have no camera pose; remove these images from "
            f"{CAMERA_FILE}, or all poses: then images are placed by the objects in them"
        )
    views = [perception(recording.view(index, index + 1)) for index in range(len(recording))]
    sure = [seen.hypotheses.T_camera_object[seen.hypotheses.score >= _SURE] for seen in views]
    placed, left_out = register_views(sure, model)
    why = "; ".join(f"image {recording.image_ids[index]}: {reason}" for index, reason in left_out.items())
    if len(placed) < min(2, len(recording)):
        raise ValueError(f"{folder}: has no camera poses, and no two images can be placed by their objects: {why}")
    warn(f"{folder.name}: no camera poses; {len(placed)} images are placed by the objects in them")
    if left_out:
        warn(f"{folder.name}: {len(left_out)} of {len(views)} images cannot be placed and are left out: {why}")
    recording = recording.take(list(placed))
    poses = _align([views[index] for index in placed], np.array(list(placed.values())), model)
    return replace(recording, T_world_camera=upright(poses, *_largest_plane(recording)))


def _align(views: Sequence[PerceivedView], poses: np.ndarray, model: ObjectModel) -> np.ndarray:
    """(m, 4, 4) camera poses corrected by the depth images: positions of objects place a camera to centimetres."""
    cameras = CameraAlignment()
    for seen, T in zip(views, poses, strict=True):
        view = seen.view
        cameras.add_view(view.stamp, measure_view(view.depth, view.camera, T, seen.hypotheses, ambiguity_of(model)))
    corrections = [cameras.alignment(seen.view.stamp).correction for seen in views]
    return np.array(corrections) @ poses


def _largest_plane(recording: BopScene) -> tuple[np.ndarray, np.ndarray]:
    """Normal towards the camera, and a point, of the largest plane in the first image, which is taken for the table."""
    view = recording.view(0, 0)
    points = backproject(view.depth, view.camera)[np.isfinite(view.depth)][::5].astype(float)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    o3d.utility.random.seed(0)
    (*normal, offset), _ = cloud.segment_plane(0.004, 3, 1000)
    normal = np.array(normal) * (1.0 if offset > 0 else -1.0)
    return normal, -abs(offset) * normal
