"""What every look-up of a bank shares: features, unexplained surface and scores of the objects that it fuses.

A look-up has a table of poses. Each object of a :class:`FusedBatch` is a row of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from active6d_agent.bank.scene_bank import SceneBank
from active6d_core.camera import DEFAULT_CAMERA, PinholeCamera
from active6d_core.hypotheses import SceneObjects
from active6d_core.metrics import MISSED_E_ADD, SceneScore, score_errors
from active6d_core.se3 import invert
from active6d_perception.model.model_views import model_views
from active6d_perception.scene.fusion_parameters import FusionParameters
from active6d_perception.scene.object_features import project_features
from active6d_perception.scene.observed_surface import explainer


@dataclass(frozen=True, eq=False)
class FusedBatch:
    """Accumulated objects of E episodes, best first.

    Attributes:
        objects: (E, n) numbers of their poses in the look-up's table, -1 padding.
        best: (E, n) numbers of the hypotheses whose scores the objects have, -1 padding.
        seen: (E, n) number of each object's best hypothesis in the current view, -1 without one.
        probability: (E, n) of being right, 0 padding.
        entropy: (E, n) of the belief at the object's place, nats, 0 padding.
    """

    objects: np.ndarray
    best: np.ndarray
    seen: np.ndarray
    probability: np.ndarray
    entropy: np.ndarray


class SceneLookup:
    """Objects of any views of a bank's scenes, by table look-up.

    Args:
        bank: the scenes.
        parameters: of the fusion, those of the node by default.
        camera: that boxes are projected into.

    Attributes:
        bank: the scenes.
        model: the object.
        sphere: the views.
        parameters: of the fusion.
        T_world_object: (N, 4, 4) the table of poses, metres, scene after scene.
        positions: (N, 3) their origins, world, metres.
        first_pose: (S + 1,) number of the first pose of each scene.
        errors: (N, o) float32 ADD to the true objects of the scene, metres, ``inf`` from 50 mm on.
        nearest_object: (N,) the true object of least ADD for each pose, or the nearest one if none is within 50 mm.
        object_count: (S,) number of true objects.
        verification: (H,) of all hypotheses, as ``score``, ``box`` (H, 4) and ``depth``.
    """

    T_world_object: np.ndarray
    first_pose: np.ndarray
    errors: np.ndarray
    nearest_object: np.ndarray
    verification: np.ndarray
    score: np.ndarray
    box: np.ndarray
    depth: np.ndarray

    def __init__(
        self, bank: SceneBank, parameters: FusionParameters | None = None, camera: PinholeCamera = DEFAULT_CAMERA
    ) -> None:
        self.bank, self.model, self.sphere = bank, bank.model, bank.sphere
        self.parameters = parameters or FusionParameters()
        self._camera = camera
        self._T_world_camera = np.stack([self.sphere.pose(position) for position in self.sphere.positions])
        self.object_count = np.array([len(scene.T_world_object) for scene in bank.scenes])

    def _set_poses(self, poses: Sequence[np.ndarray], errors: Sequence[np.ndarray]) -> None:
        """Set the table from the (n, 4, 4) poses and (n, o) errors of each scene."""
        self.first_pose = np.cumsum([0, *map(len, poses)])
        self.T_world_object = np.concatenate(poses)
        self.positions = np.ascontiguousarray(self.T_world_object[:, :3, 3])
        self.errors = np.full((len(self.T_world_object), self.object_count.max()), np.inf, np.float32)
        for start, error in zip(self.first_pose, errors, strict=False):
            self.errors[start : start + len(error), : error.shape[1]] = error
        found = zip(self.bank.scenes, poses, errors, strict=True)
        self.nearest_object = np.concatenate(
            [_nearest_objects(scene.T_world_object, T, error) for scene, T, error in found]
        )
        # Zeros cost no memory until they are written to.
        self._projected = np.zeros((len(self.sphere), len(self.T_world_object), 5), np.float32)
        self._is_projected = np.zeros((len(self.sphere), len(self.bank.scenes)), bool)
        self._index_surface()

    def _set_hypotheses(self, table: np.ndarray) -> None:
        """Set the columns of (H, 14) hypotheses of all scenes, see :class:`.BankScene`."""
        self.verification, self.score, self.box, self.depth = table[:, 7], table[:, 8], table[:, 9:13], table[:, 13]

    def fuse(self, scene: np.ndarray, views: np.ndarray, current: np.ndarray) -> FusedBatch:
        """Fuse the views of E episodes.

        Args:
            scene: (E,) indices of scenes.
            views: (E, v) indices of views, -1 padding.
            current: (E,) index of the view that the camera is at.
        """
        raise NotImplementedError

    def _support(self, fused: FusedBatch) -> tuple[np.ndarray, np.ndarray]:
        """(E, n) number of views with a hypothesis of each object, and (E, n) spread of its hypotheses, metres."""
        raise NotImplementedError

    def features(self, fused: FusedBatch, scene: np.ndarray, current: np.ndarray) -> np.ndarray:
        """(E, n, 6) box, depth and verification score of the accumulated objects in the current view (paper: B_t)."""
        for view, index in set(zip(current.tolist(), scene.tolist(), strict=True)):
            if not self._is_projected[view, index]:
                self._project(view, index)
        valid, seen = fused.objects >= 0, fused.seen >= 0
        features = np.zeros((*fused.objects.shape, 6))
        features[..., :5] = self._projected[current[:, None], fused.objects]
        features[..., 5] = self.verification[fused.best]
        own = fused.seen[seen]
        features[seen, :4], features[seen, 4] = self.box[own], self.depth[own]
        features[~valid] = 0.0
        return features

    def project_everything(self) -> None:
        """Project all poses into all views now, which otherwise happens as views are taken."""
        for view, scene in np.argwhere(~self._is_projected):
            self._project(view, scene)

    def _project(self, view: int, scene: int) -> None:
        rows = slice(self.first_pose[scene], self.first_pose[scene + 1])
        T_camera_object = invert(self._T_world_camera[view]) @ self.T_world_object[rows]
        box, depth = project_features(model_views(self.model), T_camera_object, self._camera)
        self._projected[view, rows] = np.column_stack([box, depth])
        self._is_projected[view, scene] = True

    def describe(self, fused: FusedBatch, scene: np.ndarray, current: np.ndarray) -> list[SceneObjects]:
        """The accumulated objects of every episode, as the fusion node publishes them."""
        features = self.features(fused, scene, current)
        support, spread = self._support(fused)
        described = []
        for episode, row in enumerate(fused.objects >= 0):
            best = fused.best[episode, row]
            objects = SceneObjects(
                T_world_object=self.T_world_object[fused.objects[episode, row]],
                verification=self.verification[best],
                score=self.score[best],
                box=features[episode, row, :4],
                depth=features[episode, row, 4],
                support=support[episode, row],
                spread=spread[episode, row],
                probability=fused.probability[episode, row],
                entropy=fused.entropy[episode, row],
            )
            described.append(objects)
        return described

    def objects(self, scene: int, views: Sequence[int]) -> SceneObjects:
        """:meth:`describe` one scene after ``views``, the last of them current."""
        scenes, current = np.array([scene]), np.array([views[-1]])
        return self.describe(self.fuse(scenes, np.array([views]), current), scenes, current)[0]

    def _index_surface(self) -> None:
        """Of each scene, only the cells that some view of the grid shows are kept."""
        self._explainer = explainer(self.model, self.parameters.explained_within)
        self._shown, self._surface = [], []
        for scene in self.bank.scenes:
            bits = np.unpackbits(scene.surface, axis=1, count=len(self.bank.grid))
            cells = np.flatnonzero(bits.any(axis=0))
            self._shown.append(self.bank.grid.centres[cells])
            self._surface.append(np.packbits(bits[:, cells], axis=1))
        self._explained = np.zeros(
            (len(self.T_world_object), max(surface.shape[1] for surface in self._surface)), np.uint8
        )
        self._is_explained = np.zeros(len(self.T_world_object), bool)

    def unexplained(self, fused: FusedBatch, scene: np.ndarray, views: np.ndarray) -> list[np.ndarray]:
        """(k, 3) centres of the cells that any of each episode's (E, v) views, -1 padding, shows and that none of its
        accumulated objects explains, as the fusion node publishes them."""
        return [
            self._unexplained(index, rows[rows >= 0], taken[taken >= 0])
            for index, rows, taken in zip(scene.tolist(), fused.objects, views, strict=True)
        ]

    def _unexplained(self, scene: int, rows: np.ndarray, views: np.ndarray) -> np.ndarray:
        shown, surface = self._shown[scene], self._surface[scene]
        new = rows[~self._is_explained[rows]]
        if len(new):
            explained = self._explainer.explains(shown, self.T_world_object[new])
            self._explained[new, : surface.shape[1]] = np.packbits(explained, axis=1)
            self._is_explained[new] = True
        explained = np.bitwise_or.reduce(self._explained[rows, : surface.shape[1]], axis=0)
        left = np.bitwise_or.reduce(surface[views], axis=0) & ~explained
        return shown[np.unpackbits(left, count=len(shown)).view(bool)]

    def pair_errors(self, fused: FusedBatch) -> np.ndarray:
        """(E, n, o) ADD of each accumulated object to each true one, metres, ``inf`` from 50 mm on and for padding."""
        return np.where(fused.objects[..., None] >= 0, self.errors[fused.objects], np.inf)

    def object_errors(self, fused: FusedBatch) -> np.ndarray:
        """(E, o) ADD of each true object's best accumulated hypothesis, metres, at most 50 mm."""
        return np.minimum(self.pair_errors(fused).min(axis=1, initial=np.inf), MISSED_E_ADD)

    def evaluate(self, fused: FusedBatch, scene: np.ndarray) -> list[SceneScore]:
        """The paper's measures of every episode, hypotheses matched to objects one-to-one."""
        counts = self.object_count[scene]
        return [
            score_errors(self.errors[rows[rows >= 0], :count], self.model.diameter)
            for rows, count in zip(fused.objects, counts, strict=True)
        ]


def _nearest_objects(T_true: np.ndarray, T_world_object: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """(n,) the true object of least error for each pose, or the nearest one if none is within 50 mm."""
    apart = np.linalg.norm(T_world_object[:, None, :3, 3] - T_true[:, :3, 3], axis=-1)
    return np.where(np.isfinite(errors).any(axis=1), errors.argmin(axis=1), apart.argmin(axis=1))
