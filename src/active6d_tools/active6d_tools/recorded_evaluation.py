"""Policies on scenes recorded in BOP's format: which scenes, from which starts, and how they score."""

from collections import Counter
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
from active6d_sim.datasets.bop import CAMERA_FILE, TRUTH_FILE, BopScene, describe_cameras
from active6d_sim.datasets.bop_models import differs_from_data_set
from active6d_sim.physics.heap import VISIBILITY_THRESHOLD
from active6d_tools.bop_results import BopEstimates, number_scenes
from active6d_tools.direct_episode import DirectEpisode, DirectRunner, PerceivedView, Perception
from active6d_tools.recorded_scene import RecordedCamera, RecordedScene, find_bin, looks_down, of_object
from active6d_tools.view_registration import FEWEST_SHARED, register_views, upright

#: Objects that are less certain do not help to place an image.
_SURE = 0.5
#: A message names so many images.
_NAMED = 3
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
    for depth in ("", "*/", "*/*/"):
        if several := sorted(folder.glob(f"{depth}{Path(CAMERA_FILE).stem}_*.json")):
            scene = several[0].parent
            raise ValueError(f"{scene / CAMERA_FILE}: no such file{describe_cameras(scene)}")
    if not folder.is_dir():
        raise ValueError(f"{folder}: no such folder")
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

    Attributes:
        scenes: those that have the object.
        object_id: BOP's number of the object.
        numbering: what to say of the scenes' numbers in results files; empty if these are their names.
        starts: (E, 2) index of the scene, and of the first view in it.

    Raises:
        ValueError: a scene cannot be read, placed or scored, or none has the object; the message names it.
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
        self._model, self._steps, self._seed, self._warn = model, steps, seed, warn
        # A recording tells where its floor is, but not whether there are walls.
        self._fusion = AllViewsFusion(model, tray=OPEN_TABLE)
        perception = Perception(model, estimator)
        self.scenes: list[RecordedScene] = []
        every = [BopScene.load(folder, needs_poses=False) for folder in folders]
        self.object_id, recordings = _choose(every, object_id, warn)
        numbers, self.numbering = number_scenes([recording.folder for recording in every])
        self._numbers = [number for number, recording in zip(numbers, every, strict=True) if recording in recordings]
        if text := differs_from_data_set(recordings[0].folder, self.object_id, model):
            warn(text)
        for recording in recordings:
            _check(recording, model, self.object_id)
        for recording in recordings:
            placed, seen = _place(recording, model, perception, warn)
            T_bin_camera = find_bin(placed, model, warn)
            self.scenes.append(RecordedScene(placed, model, self.object_id, perception, T_bin_camera, seen))
        self._truths = [scene.truth(warn) for scene in self.scenes]
        self.starts = np.array(
            [
                (number, view)
                for number, scene in enumerate(self.scenes)
                for view in self._draw(number, np.unique(scene.nearest[scene.allowed]), starts)
            ]
        )

    @property
    def start_images(self) -> list[tuple[int, int]]:
        """E times the index of the scene, and BOP's number of the first image in it."""
        return [(number, self.scenes[number].recording.image_ids[view]) for number, view in self.starts.tolist()]

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
            The scores, with BOP's image numbers as views; and for each episode the objects in the camera of its last
            image.
        """
        rows, estimates, not_aligned = [], [], Counter[str]()
        for done, (number, start) in enumerate(self.starts.tolist()):
            scene = self.scenes[number]
            on_progress(f"{name}, {scene.recording.folder.name}", done, len(self.starts))
            own = {"entropy": self._entropy(scene)} if name == "entropy" else {}
            policy = create_policy(name, self._model, **{**own, **parameters})
            camera = RecordedCamera(scene, start)
            limits = Limits(scene.sphere, scene.allowed, self._steps)
            runner = DirectRunner(self._model, limits, self._fusion)
            episode = runner.run(policy, camera, np.random.default_rng([self._seed, number, start]))
            not_aligned.update(
                f"{scene.recording.folder.name}/{scene.recording.image_ids[camera.taken[index]]}"
                for index in episode.not_aligned
            )
            rows.append(self._score(number, episode, camera))
            estimates.append(_estimates(scene, self._numbers[number], episode, camera))
        if not_aligned:
            named = ", ".join(name for name, _ in not_aligned.most_common(_NAMED))
            self._warn(
                f"{name}: {not_aligned.total()} views, of {len(not_aligned)} images (such as {named}), could not be "
                "aligned by their depth with those before them; there, the given camera poses were used"
            )
        return EpisodeResults(self.starts[:, 0], *map(np.array, zip(*rows, strict=True))), estimates

    def _score(self, number: int, episode: DirectEpisode, camera: RecordedCamera) -> tuple[Any, ...]:
        objects, diameter = episode.objects[-1], self._model.diameter
        scene, true = self.scenes[number], self._truths[number]
        every = e_add(self._model, objects.T_world_object[:, None], true.T_bin_object[None], cutoff=MISSED_E_ADD)
        errors, sure = every[:, true.visible], objects.probability >= self._fusion.parameters.confirmed
        score = score_errors(errors, diameter)
        rate, confirmed, _ = score_confirmed(errors, sure, diameter)
        # An object that no image shows well need not be found, but who finds it is right.
        _, _, wrong = score_confirmed(every, sure, diameter)
        positions = np.array([seen.view.T_world_camera[:3, 3] for seen in episode.views])
        taken = [scene.recording.image_ids[view] for view in camera.taken]
        taken += [-1] * (self._steps + 1 - len(taken))
        metres = scene.sphere.path_length(positions)
        return score.detection_rate, score.mean_e_add_mm, metres, taken, rate, confirmed, wrong

    def _entropy(self, scene: RecordedScene) -> np.ndarray:
        of_image = {int(i): view_entropy(scene.perceive(int(i)).hypotheses.segmentation) for i in set(scene.nearest)}
        return np.array([of_image[int(i)] for i in scene.nearest])


def _choose(
    recordings: Sequence[BopScene], object_id: int | None, warn: Callable[[str], None]
) -> tuple[int, list[BopScene]]:
    """BOP's number of the object, and the recordings with labels of it that are visible enough; others are reported.

    Raises:
        ValueError: there is no ground truth, there are several objects to choose from, or no scene has the object.
    """
    for recording in recordings:
        if recording.truth is None:
            raise ValueError(f"{recording.folder / TRUTH_FILE}: no such file; policies need ground truth to be scored")
    folder = recordings[0].folder if len(recordings) == 1 else recordings[0].folder.parent
    labels = [image.object_id for recording in recordings for image in recording.truth or ()]
    known = np.unique(np.concatenate(labels)).tolist()
    names = ", ".join(map(str, known))
    if object_id is None and len(known) > 1:
        raise ValueError(f"{folder}: has objects {names}; choose with --object-id")
    chosen = object_id or (known[0] if known else 1)
    kept = [recording for recording in recordings if _shows(recording, chosen)]
    if not kept:
        visible = ", or none that is visible by a tenth" if chosen in known else f", only of [{names}]"
        raise ValueError(f"{folder}: no ground truth of object {chosen}{visible}")
    if len(kept) < len(recordings):
        lacking = [recording.folder.name for recording in recordings if not _shows(recording, chosen)]
        what = f"{len(lacking)} of {len(recordings)} scenes have no object {chosen} that is visible by a tenth"
        warn(f"{what} and are left out: {', '.join(lacking)}")
    return chosen, kept


def _shows(recording: BopScene, object_id: int) -> bool:
    """Whether an image has a label of the object that counts."""
    return any(
        not fraction < VISIBILITY_THRESHOLD
        for image in recording.truth or ()
        for fraction in image.visible_fraction[of_object(image, object_id)]
    )


def _check(recording: BopScene, model: ObjectModel, object_id: int) -> None:
    """ValueError where images are not of the model or cannot be placed, before they are estimated."""
    view, folder = recording.view(0, 0), recording.folder
    if np.isfinite(view.depth).any():
        try:
            check_span(model, view.depth, view.camera)
        except ValueError as error:
            raise ValueError(f"{folder}: {error}") from error
    missing = np.count_nonzero(~recording.has_pose)
    if 0 < missing < len(recording):
        raise ValueError(
            f"{folder}: {missing} of {len(recording)} images have no camera pose; remove these images from "
            f"{CAMERA_FILE}, or all poses: then images are placed by the objects in them"
        )
    most = max(int(of_object(image, object_id).sum()) for image in recording.truth or ())
    if missing and len(recording) > 1 and most < FEWEST_SHARED:
        raise ValueError(
            f"{folder}: has no camera poses, and images must share {FEWEST_SHARED} objects to be placed by them, but "
            f"no image's ground truth lists more than {most} of object {object_id}"
        )


def _estimates(scene: RecordedScene, number: int, episode: DirectEpisode, camera: RecordedCamera) -> BopEstimates:
    objects, index = episode.objects[-1], camera.taken[-1]
    return BopEstimates(
        number,
        scene.recording.image_ids[index],
        invert(episode.T_world_cameras[-1]) @ objects.T_world_object,
        objects.probability,
        sum(seen.seconds for seen in episode.views),
    )


def _place(
    recording: BopScene, model: ObjectModel, perception: Perception, warn: Callable[[str], None]
) -> tuple[BopScene, list[PerceivedView] | None]:
    """The recording in a world with z up, with camera poses found by the objects in its images where it has none.

    Returns:
        It, without the images that cannot be placed; and what was found in each image, if they had to be estimated.

    Raises:
        ValueError: the images cannot be placed.
    """
    folder = recording.folder
    if recording.has_pose.all():
        if looks_down(recording.T_world_camera):
            return recording, None
        up = "up is taken to be the normal of the largest plane in the first image"
        warn(f"{folder.name}: the world's z axis is not up; {up}")
        T_first_camera = invert(recording.T_world_camera[0]) @ recording.T_world_camera
        return replace(recording, T_world_camera=upright(T_first_camera, *_largest_plane(recording))), None
    views = [perception(recording.view(index, index + 1)) for index in range(len(recording))]
    sure = [seen.hypotheses.T_camera_object[seen.hypotheses.score >= _SURE] for seen in views]
    if not any(map(len, sure)):
        raise ValueError(
            f"{folder}: no object with a score of {_SURE:g} or more in any image; is --object what the images show, is "
            f"depth_scale in {CAMERA_FILE} right, and are the objects in the camera's range?"
        )
    placed, left_out = register_views(sure, model)
    why = _reasons({recording.image_ids[index]: reason for index, reason in left_out.items()})
    if len(placed) < min(2, len(recording)):
        raise ValueError(
            f"{folder}: has no camera poses, and no two images can be placed by their objects: {why}; is --object what "
            "the images show, and is its scale right?"
        )
    warn(f"{folder.name}: no camera poses; {len(placed)} images are placed by the objects in them")
    if left_out:
        warn(f"{folder.name}: {len(left_out)} of {len(views)} images cannot be placed and are left out: {why}")
    recording, views = recording.take(list(placed)), [views[index] for index in placed]
    poses = _align(views, np.array(list(placed.values())), model)
    return replace(recording, T_world_camera=upright(poses, *_largest_plane(recording))), views


def _reasons(by_image: dict[int, str]) -> str:
    """Why images are left out: those of the first few, and how many more there are."""
    texts = [f"image {image}: {reason}" for image, reason in list(by_image.items())[:_NAMED]]
    more = len(by_image) - len(texts)
    return "; ".join(texts) + (f"; and {more} more" if more else "")


def _align(views: Sequence[PerceivedView], poses: np.ndarray, model: ObjectModel) -> np.ndarray:
    """(m, 4, 4) camera poses corrected by the depth images: positions of objects place a camera to centimetres."""
    cameras = CameraAlignment()
    for seen, T in zip(views, poses, strict=True):
        view = seen.view
        cameras.add_view(view.stamp, measure_view(view.depth, view.camera, T, seen.hypotheses, ambiguity_of(model)))
    corrections = [cameras.alignment(seen.view.stamp).correction for seen in views]
    return np.array(corrections) @ poses


def _largest_plane(recording: BopScene) -> tuple[np.ndarray, np.ndarray]:
    """Normal towards the camera, and a point, of the largest plane in the first image, which is taken for the table.

    Raises:
        ValueError: the image has no depth.
    """
    view = recording.view(0, 0)
    points = backproject(view.depth, view.camera)[np.isfinite(view.depth)][::5].astype(float)
    if len(points) < 3:
        where = f"{recording.folder}: image {recording.image_ids[0]}"
        raise ValueError(f"{where} has no depth for the plane that tells what is up; remove it from {CAMERA_FILE}")
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    o3d.utility.random.seed(0)
    (*normal, offset), _ = cloud.segment_plane(0.004, 3, 1000)
    normal = np.array(normal) * (1.0 if offset > 0 else -1.0)
    return normal, -abs(offset) * normal
