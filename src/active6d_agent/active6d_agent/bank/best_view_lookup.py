"""The paper's fusion, by the best view, on the scenes of a bank, for many episodes at once.

Values that do not depend on the chosen views are computed once: distances between hypotheses, their components,
and their boxes in every view. :class:`.BestViewFusion` calls the same
:mod:`active6d_perception.scene.clustering`, so results are equal for the same views. The surface that a hypothesis
explains is computed at the first request and kept, see :mod:`active6d_perception.scene.observed_surface`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from active6d_agent.bank.scene_bank import BankScene, SceneBank, world_poses
from active6d_agent.bank.scene_lookup import FusedBatch, SceneLookup
from active6d_core.camera import DEFAULT_CAMERA, PinholeCamera
from active6d_perception.model.length_scale import spacing
from active6d_perception.model.symmetric_distance import SymmetricDistance
from active6d_perception.scene.clustering import cluster_groups
from active6d_perception.scene.fusion_parameters import FusionParameters
from active6d_perception.scene.hypothesis_table import evidence, preference
from active6d_perception.suppression import suppress_neighbours

_NO_ROW = np.iinfo(np.int64).max
# Groups of hypotheses are padded to the upper end of their range, so that few large ones do not cost all.
_SIZES = ((2, 2), (3, 4), (5, 8), (9, 16), (17, 32), (33, 10_000))


@dataclass(frozen=True, eq=False)
class BestViewBatch(FusedBatch):
    """Accumulated objects that are clusters of hypotheses; their poses are those of hypotheses.

    Attributes:
        leaders: (E, n) the objects as indices into ``members``, -1 padding.
        members: (k,) rows of all hypotheses of an episode's views, in fusion's order of preference.
        labels: (k,) the first member of each member's cluster, as an index into ``members``.
    """

    leaders: np.ndarray
    members: np.ndarray
    labels: np.ndarray


class BestViewLookup(SceneLookup):
    """Fusion by the best view. "Rows" are hypotheses of all scenes, in fusion's order of preference."""

    def __init__(
        self, bank: SceneBank, parameters: FusionParameters | None = None, camera: PinholeCamera = DEFAULT_CAMERA
    ) -> None:
        super().__init__(bank, parameters, camera)
        self._cut = self.parameters.cut * spacing(self.model)
        self._exclusion = self.parameters.exclusion * spacing(self.model)
        poses, tables, views, errors = zip(*map(self._sort, bank.scenes), strict=True)
        self._set_hypotheses(np.concatenate(tables).astype(float))
        self._set_poses(poses, errors)
        self.view = np.concatenate(views)
        self._evidence = evidence(self.verification, self.score, self.parameters)
        self._rows_of_view = self._index_views(views)
        self._index_distances(poses)

    def _sort(self, scene: BankScene) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        T = world_poses(scene.table, scene.view, self.sphere)
        verification = scene.table[:, 7].astype(float)
        order = preference(verification, scene.table[:, 8].astype(float), T, self.parameters)
        return T[order], scene.table[order], scene.view[order], scene.errors[order]

    def _index_views(self, views: Sequence[np.ndarray]) -> np.ndarray:
        """(S, M, r) rows of each view of each scene, padded."""
        M = len(self.sphere)
        most = max(np.bincount(view, minlength=M).max() for view in views)
        rows = np.full((len(views), M, most), _NO_ROW)
        for scene, view in enumerate(views):
            order = np.argsort(view, kind="stable")
            first = np.searchsorted(view[order], np.arange(M))
            place = np.arange(len(view)) - first[view[order]]
            rows[scene, view[order], place] = self.first_pose[scene] + order
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

    def fuse(self, scene: np.ndarray, views: np.ndarray, current: np.ndarray) -> BestViewBatch:
        """Fuse the views of E episodes; see :meth:`.SceneLookup.fuse`."""
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
        kept = suppress_neighbours(positions, table >= 0, self._exclusion)
        order = np.argsort(~kept, axis=1, kind="stable")[:, : kept.sum(axis=1).max(initial=0)]
        table, kept = np.take_along_axis(table, order, 1), np.take_along_axis(kept, order, 1)
        seen = np.full(len(rows), -1)
        # Backwards, so that of several hypotheses of the current view the best is written last.
        now = np.flatnonzero(self.view[rows] == current[episode])[::-1]
        seen[labels[now]] = rows[now]
        objects = np.where(kept, rows[table], -1)
        return BestViewBatch(
            objects,
            objects,
            np.where(kept, seen[table], -1),
            np.where(kept, self.score[objects], 0.0),
            np.zeros(objects.shape),
            np.where(kept, table, -1),
            rows,
            labels,
        )

    def _support(self, fused: FusedBatch) -> tuple[np.ndarray, np.ndarray]:
        assert isinstance(fused, BestViewBatch), "of another look-up"
        count, M = len(fused.members), len(self.sphere)
        seen_from = np.unique(fused.labels * M + self.view[fused.members]) // M
        support, spread = np.bincount(seen_from, minlength=count), np.zeros(count)
        for members, valid in _groups_by_size(fused.labels):
            pairs = valid[:, :, None] & valid[:, None]
            widest = np.where(pairs, self._distances(fused.members[members]), 0.0).max(axis=(1, 2))
            spread[fused.labels[members[:, 0]]] = widest
        if not count:
            return np.zeros(fused.leaders.shape, int), np.zeros(fused.leaders.shape)
        return support[fused.leaders], spread[fused.leaders]

    def _cluster(self, episode: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """(k,) index of the first member of each row's cluster."""
        labels = np.arange(len(rows))
        for members, valid in _groups_by_size(episode * len(self._size) + self._component[rows]):
            local = cluster_groups(self._distances(rows[members]), valid, self._cut)
            labels[members[valid]] = np.take_along_axis(members, local, axis=1)[valid]
        return labels


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
