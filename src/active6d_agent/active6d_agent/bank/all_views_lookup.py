"""Fusion of all views by table look-up: :class:`.AllViewsFusion` on the fixed candidates of a bank's scenes.

"Poses" are the candidates' poses with each rotation, of all scenes one after the other. The objects of a
:class:`.FusedBatch` are numbers of poses.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from active6d_agent.bank.belief_kernel import Belief, SceneIndex, fuse_episode
from active6d_agent.bank.best_view_lookup import BestViewLookup
from active6d_agent.bank.scene_bank import BankScene, SceneBank, world_poses
from active6d_agent.bank.scene_lookup import FusedBatch, SceneLookup
from active6d_core.camera import DEFAULT_CAMERA, PinholeCamera
from active6d_core.metrics import DETECTION_FRACTION, MISSED_E_ADD, e_add
from active6d_core.object_model import ObjectModel
from active6d_core.se3 import transform_points
from active6d_core.view_sphere import ViewSphere
from active6d_perception.model.ambiguity import Ambiguity, ambiguity_of
from active6d_perception.scene.all_views_fusion import BESIDE
from active6d_perception.scene.belief_weights import BeliefWeights, belief_path, load_belief
from active6d_perception.scene.evidence_tables import EvidenceTables
from active6d_perception.scene.expected_visibility import Tray
from active6d_perception.scene.feasibility import against_container, against_neighbour
from active6d_perception.scene.fusion_parameters import FusionParameters
from active6d_perception.scene.hypothesis_table import confidence


@dataclass(frozen=True, eq=False)
class AllViewsBatch(FusedBatch):
    """Accumulated objects with what fusion knows of their hypotheses.

    Attributes:
        support: (E, n) int, number of views with a hypothesis of the object.
        spread: (E, n) largest distance of a hypothesis from the object, metres.
    """

    support: np.ndarray
    spread: np.ndarray


# Candidates of one place whose bodies are nearer than this to a candidate's twin are that twin, diameters.
_TWIN = 0.15


def evidence_of(scene: BankScene) -> EvidenceTables:
    """The tables of a scene.

    Raises:
        ValueError: the bank was made without them.
    """
    if scene.evidence is None:
        raise ValueError(f"{scene.name}: the bank has no evidence of all views; make it again with 'active6d bank'")
    return scene.evidence


def make_belief(model: ObjectModel, weights: BeliefWeights, parameters: FusionParameters) -> Belief:
    """What the kernel needs beside the evidence."""
    ambiguity, tolerance = ambiguity_of(model), DETECTION_FRACTION * model.diameter
    errors = ambiguity.rotation_errors
    similar = np.maximum(0.0, 1.0 - (errors / tolerance) ** 2)
    apart = parameters.cut * ambiguity.spacing, parameters.exclusion * ambiguity.spacing
    return Belief.of(
        weights, similar, errors < tolerance, model.diameter / ambiguity.scale, *apart, parameters.least_probability
    )


def index_scene(scene: BankScene, model: ObjectModel, sphere: ViewSphere, cut: float) -> SceneIndex:
    """The arrays that the kernel needs of a scene with evidence; ``cut`` in metres.

    Raises:
        ValueError: the bank has no evidence, or evidence on other rotations than those of the model.
    """
    tables, ambiguity = evidence_of(scene), ambiguity_of(model)
    stored, count = tables.T_world_object.shape[1], len(ambiguity.rotations)
    # The kernel does not check its indices.
    if stored != count:
        raise ValueError(
            f"{scene.name}: the bank has {stored} rotations of each body, and {model.name} has {count}; make it again "
            "with 'active6d bank'"
        )
    T = world_poses(scene.table, scene.view, sphere)
    near = ambiguity.body_distance.between(tables.T_world_body, T).astype(np.float32)
    middles, bodies = (transform_points(each, ambiguity.middle[None])[:, 0] for each in (T, tables.T_world_body))
    apart = np.linalg.norm(bodies[:, None] - middles, axis=-1).astype(np.float32)
    candidate = near.argmin(axis=0) if len(near) else np.zeros(len(T), int)
    candidate = np.where(near[candidate, np.arange(len(T))] < cut, candidate, -1) if len(near) else candidate - 1
    verification, score = scene.table[:, 7].astype(float), scene.table[:, 8].astype(float)
    arrays: list[Any] = [
        np.searchsorted(scene.view, np.arange(len(sphere) + 1)),
        candidate,
        scene.view.astype(np.int64),
        confidence(verification, score),
        score,
        near,
        apart,
        _twins(tables, ambiguity),
        tables.place.astype(np.int64),
        tables.body[:, :, None],
        tables.twin[:, :, None],
        tables.telling,
        *_feasibility(tables, ambiguity, bodies, Tray.for_model(model)),
        np.ascontiguousarray(tables.T_world_object[..., :3, 3].reshape(-1, 3)),
    ]
    return SceneIndex(*arrays)


def _twins(tables: EvidenceTables, ambiguity: Ambiguity) -> np.ndarray:
    T, twins = tables.T_world_body, np.zeros((len(tables.place),) * 2, bool)
    for twin in ambiguity.twins[1:]:
        twins |= ambiguity.body_distance.between(T @ twin, T) < _TWIN * ambiguity.diameter
    return (twins | twins.T) & (tables.place[:, None] == tables.place)


def _feasibility(
    tables: EvidenceTables, ambiguity: Ambiguity, middles: np.ndarray, tray: Tray
) -> tuple[np.ndarray, ...]:
    """The columns of :class:`.SceneIndex` on container and neighbours; (K, 3) ``middles`` of bodies."""
    T, same = tables.T_world_body, np.eye(4)[None]
    other = tables.place[:, None] != tables.place
    near = np.linalg.norm(middles[:, None] - middles, axis=-1) < BESIDE * ambiguity.diameter
    own, neighbour = np.nonzero(other & near)
    parts = (same, ambiguity.body_points), (ambiguity.rotations, ambiguity.telling_points)
    container, turned = (against_container(T, rotations, points, tray, ambiguity.scale) for rotations, points in parts)
    pairs, turned_pairs = (
        against_neighbour(T[own], T[neighbour], rotations, points, ambiguity.solid, ambiguity.scale)
        for rotations, points in parts
    )
    first = np.searchsorted(own, np.arange(len(T) + 1))
    return container[:, 0], turned, first, neighbour, np.ascontiguousarray(pairs), turned_pairs


class AllViewsLookup(SceneLookup):
    """Fusion of all views; "poses" are those of the candidates with each rotation.

    Args:
        bank: scenes with evidence.
        parameters: of the fusion, those of the node by default.
        camera: that boxes are projected into.
        weights: of the belief; those of the object when None.

    Attributes:
        scenes: what the kernel needs of each scene of the bank.
    """

    def __init__(
        self,
        bank: SceneBank,
        parameters: FusionParameters | None = None,
        camera: PinholeCamera = DEFAULT_CAMERA,
        weights: BeliefWeights | None = None,
    ) -> None:
        super().__init__(bank, parameters, camera)
        weights = weights or load_belief(belief_path(self.model.name))
        self._belief = make_belief(self.model, weights, self.parameters)
        self.scenes = [index_scene(scene, self.model, self.sphere, self._belief.cut) for scene in bank.scenes]
        self._first_row = np.cumsum([0, *(len(scene.view) for scene in bank.scenes)])
        self._set_hypotheses(np.concatenate([scene.table for scene in bank.scenes]).astype(float))
        poses = [evidence_of(scene).T_world_object.reshape(-1, 4, 4) for scene in bank.scenes]
        self._set_poses(poses, [self._errors_of(scene, T) for scene, T in zip(bank.scenes, poses, strict=True)])

    def _errors_of(self, scene: BankScene, T: np.ndarray) -> np.ndarray:
        errors = e_add(self.model, T[:, None], scene.T_world_object[None], cutoff=MISSED_E_ADD)
        return np.where(errors < MISSED_E_ADD, errors, np.inf)

    def fuse(self, scene: np.ndarray, views: np.ndarray, current: np.ndarray) -> AllViewsBatch:
        """Fuse the views of E episodes; see :meth:`.SceneLookup.fuse`."""
        taken = np.asarray(views, np.int64)
        fused = [
            fuse_episode(self.scenes[index], row, now, self._belief)
            for index, row, now in zip(scene.tolist(), taken, current.tolist(), strict=True)
        ]
        count = np.array([len(each.pose) for each in fused], int)
        rows = np.repeat(np.arange(len(fused)), count)
        places = np.arange(len(rows)) - np.repeat(np.cumsum(count) - count, count)

        def pad(name: str, nothing: float, first: np.ndarray | None = None) -> np.ndarray:
            table = np.full((len(fused), count.max(initial=0)), nothing)
            if fused:
                values = np.concatenate([getattr(each, name) for each in fused])
                table[rows, places] = (
                    values if first is None else np.where(values >= 0, values + first[scene[rows]], -1)
                )
            return table

        return AllViewsBatch(
            pad("pose", -1, self.first_pose),
            pad("best", -1, self._first_row),
            pad("seen", -1, self._first_row),
            pad("probability", 0.0),
            pad("entropy", 0.0),
            pad("support", 0),
            pad("spread", 0.0),
        )

    def describe_fused(self, scene: int, views: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Fuse (v,) different views of a scene, the camera being at the last one.

        Returns:
            (n, columns) descriptions of the n objects, see :data:`.OBJECT_COLUMNS`, and (n,) bool, which are right.
        """
        fused = fuse_episode(self.scenes[scene], views, int(views[-1]), self._belief)
        errors = self.errors[self.first_pose[scene] + fused.pose, : self.object_count[scene]]
        right: np.ndarray = np.any(errors < DETECTION_FRACTION * self.model.diameter, axis=1)
        return fused.description, right

    def _support(self, fused: FusedBatch) -> tuple[np.ndarray, np.ndarray]:
        assert isinstance(fused, AllViewsBatch), "of another look-up"
        return fused.support, fused.spread


def make_lookup(bank: SceneBank, parameters: FusionParameters | None = None) -> SceneLookup:
    """The look-up of the deployed fusion; of fusion by the best view for a bank without evidence."""
    if all(scene.evidence is not None for scene in bank.scenes):
        return AllViewsLookup(bank, parameters)
    return BestViewLookup(bank, parameters)
