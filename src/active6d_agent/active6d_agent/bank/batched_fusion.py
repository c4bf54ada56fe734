"""The deployed fusion on the scenes of a bank, for many episodes at once.

Values that do not depend on the chosen views are computed once: distances between hypotheses, their components,
and their boxes in every view. The fusion node calls the same :mod:`active6d_perception.scene.clustering`, so results
equal those of :class:`~active6d_perception.scene.fusion.SceneFusion` for the same views. The surface that a hypothesis
explains is computed at the first request and kept, see :mod:`active6d_perception.scene.observed_surface`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from active6d_agent.bank.scene_bank import BankScene, SceneBank, world_poses
from active6d_core.camera import DEFAULT_CAMERA, PinholeCamera
from active6d_core.hypotheses import SceneObjects
from active6d_core.metrics import MISSED_E_ADD, SceneScore, score_errors
from active6d_core.se3 import invert
from active6d_perception.model.model_views import model_views
from active6d_perception.model.symmetric_distance import SymmetricDistance
from active6d_perception.scene.clustering import cluster_groups
from active6d_perception.scene.fusion import FusionParameters, evidence, preference, project_features
from active6d_perception.scene.observed_surface import explainer
from active6d_perception.suppression import suppress_neighbours

_NO_ROW = np.iinfo(np.int64).max
# Groups of hypotheses are padded to the upper end of their range, so that few large ones do not cost all.
_SIZES = ((2, 2), (3, 4), (5, 8), (9, 16), (17, 32), (33, 10_000))


@dataclass(frozen=True, eq=False)
class FusedBatch:
    """Accumulated objects of E episodes.

    Attributes:
        objects: (E, n) rows of the accumulated objects, best first, -1 padding.
        leaders: (E, n) the same as indices into ``members``, -1 padding.
        seen: (E, n) row of each object's best hypothesis in the current view, -1 without one.
        episode: (k,) episode of each member.
        members: (k,) rows of all hypotheses of an episode's views, in fusion's order of preference.
        labels: (k,) the first member of each member's cluster, as an index into ``members``.
    """

    objects: np.ndarray
    leaders: np.ndarray
    seen: np.ndarray
    episode: np.ndarray
    members: np.ndarray
    labels: np.ndarray


class BatchedFusion:
    """Fusion and scoring by table look-up. "Rows" are hypotheses of all scenes, in fusion's order of preference.

    Args:
        bank: the scenes.
        parameters: of the fusion, those of the node by default.
        camera: that boxes are projected into.
    """

    def __init__(
        self, bank: SceneBank, parameters: FusionParameters | None = None, camera: PinholeCamera = DEFAULT_CAMERA
    ) -> None:
        self.bank, self.model, self.sphere = bank, bank.model, bank.sphere
        self.parameters = parameters or FusionParameters()
        self._camera = camera
        self._T_world_camera = np.stack([self.sphere.pose(position) for position in self.sphere.positions])
        self._cut = self.parameters.cut * self.model.diameter
        scenes = [self._sort(scene) for scene in bank.scenes]
        poses, tables, views, errors = zip(*scenes, strict=True)
        self.first_row = np.cumsum([0, *(len(view) for view in views)])
        self.object_count = np.array([error.shape[1] for error in errors])
        self.T_world_object, table = np.concatenate(poses), np.concatenate(tables).astype(float)
        self.view = np.concatenate(views)
        self.positions = np.ascontiguousarray(self.T_world_object[:, :3, 3])
        self.verification, self.score, self.box, self.depth = table[:, 7], table[:, 8], table[:, 9:13], table[:, 13]
        self._evidence = evidence(self.verification, self.score, self.parameters)
        self.errors = np.full((len(table), self.object_count.max()), np.inf, np.float32)
        for start, error in zip(self.first_row, errors, strict=False):
            self.errors[start : start + len(error), : error.shape[1]] = error
        self.nearest_object = np.concatenate(list(map(self._nearest_objects, bank.scenes, poses, errors)))
        self._rows_of_view = self._index_views(views)
        self._index_distances(poses)
        self._projected = np.zeros((len(self.sphere), len(table), 5), np.float32)
        self._is_projected = np.zeros((len(self.sphere), len(bank.scenes)), bool)
        self._index_surface()

    def _sort(self, scene: BankScene) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        T = world_poses(scene.table, scene.view, self.sphere)
        verification = scene.table[:, 7].astype(float)
        order = preference(verification, scene.table[:, 8].astype(float), T, self.parameters)
        return T[order], scene.table[order], scene.view[order], scene.errors[order]

    def _nearest_objects(self, scene: BankScene, T_world_object: np.ndarray, errors: np.ndarray) -> np.ndarray:
        """(h,) the true object of least ADD for each hypothesis, or the nearest one if none is within 50 mm."""
        apart = np.linalg.norm(T_world_object[:, None, :3, 3] - scene.T_world_object[:, :3, 3], axis=-1)
        return np.where(np.isfinite(errors).any(axis=1), errors.argmin(axis=1), apart.argmin(axis=1))

    def _index_views(self, views: Sequence[np.ndarray]) -> np.ndarray:
        """(S, M, r) rows of each view of each scene, padded."""
        M = len(self.sphere)
        most = max(np.bincount(view, minlength=M).max() for view in views)
        rows = np.full((len(views), M, most), _NO_ROW)
        for scene, view in enumerate(views):
            order = np.argsort(view, kind="stable")
            first = np.searchsorted(view[order], np.arange(M))
            place = np.arange(len(view)) - first[view[order]]
            rows[scene, view[order], place] = self.first_row[scene] + order
        return rows

    def _index_distances(self, poses: Sequence[np.ndarray]) -> None:
        """Distances between hypotheses, kept only within components of near pairs: no cluster reaches beyond one."""
        measure = SymmetricDistance(self.model)
        components, places, sizes, blocks = [], [], [], []
        for T in poses:
            distance = measure.between(T, T)
            count, component = connected_components(csr_array(distance <= self._cut), directed=False)
            place = np.zeros(len(T), int)
            for number in range(count):
                member = np.flatnonzero(component == number)
                place[member] = np.arange(len(member))
                blocks.append(distance[np.ix_(member, member)].ravel())
                sizes.append(len(member))
            components.append(component + len(sizes) - count)
            places.append(place)
        self._component, self._place = np.concatenate(components), np.concatenate(places)
        self._size = np.array(sizes)
        self._block = np.concatenate(blocks)
        self._block_start = np.cumsum(self._size**2) - self._size**2

    def _distances(self, rows: np.ndarray) -> np.ndarray:
        """(..., m, m) distances between (..., m) rows of one component."""
        component = self._component[rows[..., :1, None]]
        place = self._place[rows]
        entry = self._block_start[component] + place[..., :, None] * self._size[component] + place[..., None, :]
        return self._block[entry]

    def fuse(self, scene: np.ndarray, views: np.ndarray, current: np.ndarray) -> FusedBatch:
        """Fuse the views of E episodes.

        Args:
            scene: (E,) indices of scenes.
            views: (E, v) indices of views, -1 padding.
            current: (E,) index of the view that the camera is at.
        """
        count = len(scene)
        taken = np.where(views[..., None] >= 0, self._rows_of_view[scene[:, None], views], _NO_ROW)
        taken = np.sort(taken.reshape(count, -1), axis=1)
        episode, column = np.nonzero(taken != _NO_ROW)
        rows = taken[episode, column]
        labels = self._cluster(episode, rows)
        leaders = np.flatnonzero(labels == np.arange(len(rows)))
        if self._evidence is not None:
            gathered = np.bincount(labels, self._evidence[rows])[leaders]
            leaders = leaders[np.lexsort([-gathered, episode[leaders]])]
        number = np.bincount(episode[leaders], minlength=count)
        place = np.arange(len(leaders)) - (np.cumsum(number) - number)[episode[leaders]]
        table = np.full((count, number.max(initial=0)), -1)
        table[episode[leaders], place] = leaders
        positions = self.positions[rows[table]]
        kept = suppress_neighbours(positions, table >= 0, self.parameters.exclusion * self.model.diameter)
        order = np.argsort(~kept, axis=1, kind="stable")[:, : kept.sum(axis=1).max(initial=0)]
        table, kept = np.take_along_axis(table, order, 1), np.take_along_axis(kept, order, 1)
        seen = np.full(len(rows), -1)
        # Backwards, so that of several hypotheses of the current view the best is written last.
        now = np.flatnonzero(self.view[rows] == current[episode])[::-1]
        seen[labels[now]] = rows[now]
        objects = np.where(kept, rows[table], -1)
        return FusedBatch(objects, np.where(kept, table, -1), np.where(kept, seen[table], -1), episode, rows, labels)

    def _cluster(self, episode: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """(k,) index of the first member of each row's cluster."""
        labels = np.arange(len(rows))
        for members, valid in _groups_by_size(episode * len(self._size) + self._component[rows]):
            local = cluster_groups(self._distances(rows[members]), valid, self._cut)
            labels[members[valid]] = np.take_along_axis(members, local, axis=1)[valid]
        return labels

    def features(self, fused: FusedBatch, scene: np.ndarray, current: np.ndarray) -> np.ndarray:
        """(E, n, 6) box, depth and verification score of the accumulated objects in the current view (paper: B_t)."""
        for view, index in set(zip(current.tolist(), scene.tolist(), strict=True)):
            if not self._is_projected[view, index]:
                self._project(view, index)
        valid, seen = fused.objects >= 0, fused.seen >= 0
        features = np.zeros((*fused.objects.shape, 6))
        features[..., :5] = self._projected[current[:, None], fused.objects]
        features[..., 5] = self.verification[fused.objects]
        own = fused.seen[seen]
        features[seen, :4], features[seen, 4] = self.box[own], self.depth[own]
        features[~valid] = 0.0
        return features

    def project_everything(self) -> None:
        """Project all hypotheses into all views now, which otherwise happens as views are taken."""
        for view, scene in np.argwhere(~self._is_projected):
            self._project(view, scene)

    def _project(self, view: int, scene: int) -> None:
        rows = slice(self.first_row[scene], self.first_row[scene + 1])
        T_camera_object = invert(self._T_world_camera[view]) @ self.T_world_object[rows]
        box, depth = project_features(model_views(self.model), T_camera_object, self._camera)
        self._projected[view, rows] = np.column_stack([box, depth])
        self._is_projected[view, scene] = True

    def describe(self, fused: FusedBatch, scene: np.ndarray, current: np.ndarray) -> list[SceneObjects]:
        """The accumulated objects of every episode, as the fusion node publishes them."""
        features = self.features(fused, scene, current)
        count, M = len(fused.members), len(self.sphere)
        seen_from = np.unique(fused.labels * M + self.view[fused.members]) // M
        support, spread = np.bincount(seen_from, minlength=count), np.zeros(count)
        for members, valid in _groups_by_size(fused.labels):
            pairs = valid[:, :, None] & valid[:, None]
            widest = np.where(pairs, self._distances(fused.members[members]), 0.0).max(axis=(1, 2))
            spread[fused.labels[members[:, 0]]] = widest
        described = []
        for episode, leaders in enumerate(fused.leaders):
            leaders = leaders[leaders >= 0]
            rows, feature = fused.members[leaders], features[episode, : len(leaders)]
            objects = SceneObjects(
                T_world_object=self.T_world_object[rows],
                verification=self.verification[rows],
                score=self.score[rows],
                box=feature[:, :4],
                depth=feature[:, 4],
                support=support[leaders],
                spread=spread[leaders],
                probability=self.score[rows],
                entropy=np.zeros(len(rows)),
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
        # Zeros cost no memory until they are written to.
        self._explained = np.zeros((len(self.view), max(surface.shape[1] for surface in self._surface)), np.uint8)
        self._is_explained = np.zeros(len(self.view), bool)

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

    def object_errors(self, fused: FusedBatch) -> np.ndarray:
        """(E, o) ADD of each true object's best accumulated hypothesis, metres, at most 50 mm."""
        errors = np.where(fused.objects[..., None] >= 0, self.errors[fused.objects], np.inf)
        return np.minimum(errors.min(axis=1, initial=np.inf), MISSED_E_ADD)

    def evaluate(self, fused: FusedBatch, scene: np.ndarray) -> list[SceneScore]:
        """The paper's measures of every episode, hypotheses matched to objects one-to-one."""
        counts = self.object_count[scene]
        return [
            score_errors(self.errors[rows[rows >= 0], :count], self.model.diameter)
            for rows, count in zip(fused.objects, counts, strict=True)
        ]


def _groups_by_size(key: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Items with equal keys, by groups of two and more.

    Args:
        key: (k,) integers.

    Yields:
        (B, m) indices of the items of B groups of similar size, rising, padded with the first; (B, m) bool, which are
        not padding.
    """
    order = np.argsort(key, kind="stable")
    key = key[order]
    starts = np.flatnonzero(np.append(True, key[1:] != key[:-1])[: len(key)])
    sizes = np.diff(starts, append=len(key))
    for fewest, most in _SIZES:
        groups = np.flatnonzero((sizes >= fewest) & (sizes <= most))
        if len(groups):
            place = np.arange(sizes[groups].max())
            valid = place < sizes[groups, None]
            yield order[starts[groups, None] + np.where(valid, place, 0)], valid
