"""Fusion of the depth images of all views: bodies are refined jointly, and a belief resolves ambiguous poses.

:class:`.BestViewFusion` keeps the best hypothesis of a single view. This fusion uses hypotheses only as proposals. The
evidence is what every depth image measured where a candidate has its surface: that surface, something in front of it,
or something behind it. Poses in which solid objects overlap are improbable.

The result depends on the set of views. It does not depend on their order, unless poses of cameras are corrected
(:mod:`.camera_alignment`). The comparison of a pose with all views is a sum that is cached (:mod:`.memo`): a new view
is compared with all poses, and the views before it with poses that are new.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import expit

from active6d_core.camera import PinholeCamera
from active6d_core.hypotheses import Hypotheses, SceneObjects
from active6d_core.metrics import DETECTION_FRACTION
from active6d_core.object_model import ObjectModel
from active6d_core.se3 import invert, transform_points
from active6d_perception.model.ambiguity import Ambiguity, ambiguity_of
from active6d_perception.model.visible_samples import VisibleSamples
from active6d_perception.scene.belief_weights import BeliefWeights, belief_path, load_belief
from active6d_perception.scene.body_candidates import BodyCandidates, gather_candidates, merge_duplicates
from active6d_perception.scene.body_refinement import BodyRefinement
from active6d_perception.scene.camera_alignment import CameraAlignment
from active6d_perception.scene.clustering import cluster
from active6d_perception.scene.expected_visibility import Tray
from active6d_perception.scene.feasibility import against_container, against_neighbour, combine_neighbours
from active6d_perception.scene.fusion_parameters import FusionParameters
from active6d_perception.scene.hypothesis_table import HypothesisTable, confidence, preference
from active6d_perception.scene.measured_cases import CASES, count_cases
from active6d_perception.scene.measured_view import MeasuredView, measure_view
from active6d_perception.scene.memo import Memo, ViewSums
from active6d_perception.scene.object_features import project_features
from active6d_perception.scene.object_probability import OBJECT_COLUMNS, describe_objects
from active6d_perception.scene.pose_lattice import round_poses
from active6d_perception.scene.rotation_belief import PlaceBeliefs, decide, posterior
from active6d_perception.scene.scene_evidence import BodyEvidence, SceneEvidence
from active6d_perception.suppression import suppress_neighbours

#: An instance whose body's middle is nearer than this to a candidate's is the candidate's own, fraction of
#: :attr:`.Ambiguity.spacing`.
OWN_PLACE = 0.25
#: Bodies whose middles are farther apart than this do not touch, diameters.
BESIDE = 1.3
# Refinement, metres: gates of the steps, and the lattice. Bodies are many and only compared; what is reported is finer.
_BODY_GATES, _BODY_LATTICE = (0.008, 0.004, 0.004), 0.002
WHOLE_GATES, _WHOLE_LATTICE = (0.008, 0.004), 0.0005
#: A body with more of its surface than this beyond a wall stands in it.
_IN_WALL = 0.25
#: A body that reaches deeper below the floor than this is wrong, or the floor is, metres; the floor if there are more
#: than this share of them.
_SUNK, _FEW = 0.012, 0.25
#: A body whose log-odds are this far below those of the best at its place is dropped.
HOPELESS = 12.0
# Evidence is taken at poses on this lattice, metres.
_LATTICE = 0.001


@dataclass(frozen=True, eq=False)
class _Part:
    """Part of the surface to compare.

    Attributes:
        name: of the part.
        rotations: (r, 4, 4) to try.
        points: (p, 3) of the part, object frame, metres; compared with solids.
        samples: of the part; compared with depth images.
    """

    name: str
    rotations: np.ndarray
    points: np.ndarray
    samples: VisibleSamples


@dataclass(frozen=True, eq=False)
class DescribedObjects:
    """Fused objects with what is known of them, best first.

    Attributes:
        objects: their table.
        description: (n, columns) see :func:`.describe_objects`.
    """

    objects: SceneObjects
    description: np.ndarray


class AllViewsFusion:
    """Accumulates views and computes the objects of the scene from all of them.

    Args:
        model: the object.
        parameters: settings shared with :class:`.BestViewFusion`.
        weights: of the belief; those of the object when None.
        tray: floor and walls; those of the object's usual bin when None.
        walled: whether the walls are really there; objects that stand in them are withdrawn.
        align: whether poses of cameras are corrected, see :mod:`.camera_alignment`.
    """

    def __init__(
        self,
        model: ObjectModel,
        parameters: FusionParameters | None = None,
        weights: BeliefWeights | None = None,
        tray: Tray | None = None,
        *,
        walled: bool = False,
        align: bool = True,
    ) -> None:
        self.parameters = parameters or FusionParameters()
        self._align, self.cameras, self._walled = align, CameraAlignment(), walled
        #: How many objects were last withdrawn because they stand in a wall, and, if many do, how many reach below the
        #: floor.
        self.in_walls = self.below_floor = 0
        self.ambiguity: Ambiguity = ambiguity_of(model)
        self.weights = weights or load_belief(belief_path(model.name))
        self._tray = tray or Tray.for_model(model)
        self._known = HypothesisTable(self.ambiguity.body_distance.between)
        scale = self.ambiguity.scale
        self._bodies = BodyRefinement(
            self.ambiguity.body_samples, scaled_gates(_BODY_GATES, scale), scale * _BODY_LATTICE
        )
        self._whole = BodyRefinement(
            self.ambiguity.all_samples, scaled_gates(WHOLE_GATES, scale), scale * _WHOLE_LATTICE, search=False
        )
        self.reset()
        self._compile()

    def _compile(self) -> None:
        """Call every compiled function once, so that no view has to wait."""
        camera, depth = PinholeCamera(8, 8, 8.0, 8.0, 3.5, 3.5), np.full((8, 8), 0.5, np.float32)
        pose = np.eye(4)
        pose[2, 3] = 0.5
        mask = np.ones((8, 8), np.uint16)
        hypotheses = Hypotheses.from_masks(pose[None], np.ones(1), np.ones(1), mask, depth)
        self.add_view(0, np.eye(4), hypotheses, np.ones(1), depth, camera)
        self.objects(0, np.eye(4), camera)
        self.reset()

    @property
    def views(self) -> dict[int, MeasuredView]:
        """What is kept of each view, by its stamp."""
        return dict(self._views)

    def reset(self) -> None:
        """Forget all views."""
        self._known.reset()
        self._views: dict[int, MeasuredView] = {}
        self.cameras.reset()
        self._sums, self._feasible = ViewSums(), Memo()

    def forget_before(self, stamp: int) -> None:
        """Forget the views that were added before the one of ``stamp`` (nanoseconds); all without that one."""
        self._known.forget_before(stamp)
        self.cameras.forget_before(stamp)
        self._views = {known: self._views[known] for known in self._known.stamps}

    def add_view(
        self,
        stamp: int,
        T_world_camera: np.ndarray,
        hypotheses: Hypotheses,
        verification: np.ndarray,
        depth: np.ndarray,
        camera: PinholeCamera,
    ) -> bool:
        """Add one view; arguments as for :meth:`.HypothesisTable.add_view` and :func:`.measure_view`.

        Returns:
            False if the view had been added before, and nothing has changed.
        """
        measured = measure_view(depth, camera, T_world_camera, hypotheses, self.ambiguity)
        return self.add_measured(stamp, T_world_camera, hypotheses, verification, measured)

    def add_measured(
        self,
        stamp: int,
        T_world_camera: np.ndarray,
        hypotheses: Hypotheses,
        verification: np.ndarray,
        measured: MeasuredView,
    ) -> bool:
        """:meth:`add_view` for a view that has been reduced by :func:`.measure_view`."""
        if stamp in self._views:
            return False
        if self._align:
            measured = self.cameras.add_view(stamp, measured)
        self._known.add_view(stamp, invert(measured.T_camera_world), hypotheses, verification)
        self._views[stamp] = measured
        return True

    def evidence(self) -> SceneEvidence:
        """What all views say of every candidate that its body does not rule out."""
        ambiguity, same = self.ambiguity, np.eye(4)[None]
        whole = _Part("body", same, ambiguity.body_points, ambiguity.body_samples)
        twins = _Part("twin", same, ambiguity.body_points, ambiguity.twin_samples)
        candidates = self.candidates()
        heads = self._rounded(candidates.take(candidates.heads()))
        bodies = BodyEvidence(
            candidates,
            self._count(candidates, whole)[:, 0],
            self._count(candidates, twins)[:, 0],
            self._in_container(candidates, whole)[:, 0],
            self._among_neighbours(candidates, heads, whole)[:, 0],
        )
        bodies = bodies.take(self._possible(bodies))
        candidates = bodies.candidates
        telling = _Part("telling", ambiguity.rotations, ambiguity.telling_points, ambiguity.telling_samples)
        evidence = SceneEvidence(
            bodies,
            self._count(candidates, telling),
            self._in_container(candidates, telling),
            self._among_neighbours(candidates, heads, telling),
            ambiguity.diameter / ambiguity.scale,
        )
        self._feasible.sweep()
        self._sums.sweep()
        return evidence

    def _possible(self, bodies: BodyEvidence) -> np.ndarray:
        """Indices of the candidates that have a chance beside the best body at their place."""
        log_odds, place = self.weights.body(bodies.columns()), bodies.candidates.place
        best = np.full(place.max(initial=-1) + 1, -np.inf)
        np.maximum.at(best, place, log_odds)
        return np.flatnonzero(log_odds > best[place] - HOPELESS)

    def _order(self) -> np.ndarray:
        known = self._known
        return preference(known.table[:, 0], known.table[:, 1], known.T_world_object, self.parameters)

    def _all_views(self) -> ViewSums:
        self._sums.follow([self._views[stamp] for stamp in sorted(self._views)])
        return self._sums

    def candidates(self) -> BodyCandidates:
        """The refined bodies that the hypotheses of all views propose, with their twins."""
        known, ambiguity, order = self._known, self.ambiguity, self._order()
        distances = known.distances.take(order, axis=0).take(order, axis=1)
        labels = cluster(distances, self.parameters.cut * ambiguity.spacing) if len(order) else order
        table = known.table[order]
        squared = confidence(table[:, 0], table[:, 1]) ** 2
        found = gather_candidates(labels, known.T_world_object[order], squared, ambiguity)
        refined = self._bodies.refine(found.T_world_object, self._all_views())
        return merge_duplicates(replace(found, T_world_object=refined), ambiguity)

    def _rounded(self, candidates: BodyCandidates) -> tuple[np.ndarray, list[bytes]]:
        """(K, 4, 4) poses at which evidence is taken, and their keys."""
        return round_poses(candidates.T_world_object, candidates.T_world_start, self.ambiguity.scale * _LATTICE)

    def _count(self, candidates: BodyCandidates, part: _Part) -> np.ndarray:
        """(K, r, CASES) counts of a part over all views."""
        ambiguity = self.ambiguity
        rounded, keys = self._rounded(candidates)
        none = np.zeros((len(part.rotations), CASES), np.int64)
        if not part.samples.number.any():
            return np.tile(none, (len(keys), 1, 1))

        def compute(missing: np.ndarray, view: MeasuredView) -> np.ndarray:
            place = OWN_PLACE * ambiguity.spacing
            return count_cases(
                rounded[missing], part.rotations, ambiguity.middle, place, part.samples, view, ambiguity.scale
            )

        return self._all_views().sums([(part.name, key) for key in keys], compute, none)

    def _in_container(self, candidates: BodyCandidates, part: _Part) -> np.ndarray:
        """(K, r, 5), see :func:`.against_container`."""
        rounded, keys = self._rounded(candidates)
        # The container is in the world, the candidates are in the frame of the corrected camera poses.
        anchor = self.cameras.T_world_anchor
        in_world = anchor @ rounded

        def compute(missing: np.ndarray) -> np.ndarray:
            return against_container(in_world[missing], part.rotations, part.points, self._tray, self.ambiguity.scale)

        return self._feasible.rows([(part.name, anchor.tobytes(), key) for key in keys], compute)

    def _among_neighbours(
        self, candidates: BodyCandidates, heads: tuple[np.ndarray, list[bytes]], part: _Part
    ) -> np.ndarray:
        """(K, r, 2) overlap with the most evident bodies of other places, given as rounded poses and their keys."""
        ambiguity, solid = self.ambiguity, self.ambiguity.solid
        rounded, keys = self._rounded(candidates)
        middles, others = (transform_points(T, ambiguity.middle[None])[:, 0] for T in (rounded, heads[0]))
        apart = np.linalg.norm(middles[:, None] - others, axis=-1)
        other = candidates.place[:, None] != np.arange(len(others))
        own, neighbour = np.nonzero(other & (apart < BESIDE * ambiguity.diameter))

        def compute(missing: np.ndarray) -> np.ndarray:
            pair = rounded[own[missing]], heads[0][neighbour[missing]]
            return against_neighbour(*pair, part.rotations, part.points, solid, ambiguity.scale)

        pairs = [(part.name, keys[a], heads[1][b]) for a, b in zip(own, neighbour, strict=True)]
        return combine_neighbours(self._feasible.rows(pairs, compute), own, len(keys))

    def believe(self, evidence: SceneEvidence) -> PlaceBeliefs:
        """The most probable pose at each place."""
        log_odds = self.weights.rotation(evidence.columns())
        log_odds += self.weights.body(evidence.bodies.columns())[:, None]
        place = evidence.candidates.place
        tolerance = DETECTION_FRACTION * self.ambiguity.diameter
        return decide(posterior(log_odds, place), place, self.ambiguity.rotation_errors, tolerance)

    def poses(self, evidence: SceneEvidence, beliefs: PlaceBeliefs) -> np.ndarray:
        """(n, 4, 4) ``T_world_object`` of the beliefs, refined as whole objects, metres."""
        rotation = self.ambiguity.mean_rotation(beliefs.weight)
        T = evidence.candidates.T_world_object[beliefs.candidate] @ rotation
        return self._whole.refine(T, self._all_views())

    def describe(self, stamp: int, T_world_camera: np.ndarray, camera: PinholeCamera) -> DescribedObjects:
        """The objects of all views so far with what is known of them; arguments as for :meth:`objects`."""
        self.in_walls = self.below_floor = 0
        order = self._order()
        if not len(order):
            return DescribedObjects(SceneObjects.empty(), np.zeros((0, len(OBJECT_COLUMNS))))
        evidence = self.evidence()
        beliefs = self.believe(evidence)
        T = self.poses(evidence, beliefs)
        known, ambiguity = self._known, self.ambiguity
        table, stamps, hypotheses = known.table[order], known.stamp[order], known.T_world_object[order]
        apart, members = self._members(T, hypotheses)
        description = describe_objects(evidence, beliefs, members, table[:, 1], stamps)
        probability = expit(self.weights.probability(description))
        probability = self._check_container(evidence.bodies.container[beliefs.candidate], probability)
        first = np.argsort(-probability, kind="stable")
        first = first[probability[first] >= self.parameters.least_probability]
        apart_enough = self.parameters.exclusion * ambiguity.spacing
        kept = first[suppress_neighbours(T[first, :3, 3][None], np.ones((1, len(first)), bool), apart_enough)[0]]
        T_camera_anchor = invert(self.cameras.alignment(stamp).correction @ T_world_camera)
        box, depth = project_features(ambiguity.views, T_camera_anchor @ T[kept], camera)
        columns = []
        for row, own in enumerate(members[kept]):
            mine = np.flatnonzero(own)
            now = mine[stamps[mine] == stamp]
            if len(now):
                box[row], depth[row] = table[now[0], 2:6], table[now[0], 6]
            columns.append((*table[mine[0], :2], len(np.unique(stamps[mine])), apart[kept[row], mine].max()))
        verification, score, support, spread = np.array(columns).reshape(-1, 4).T
        objects = SceneObjects(
            self.cameras.T_world_anchor @ T[kept],
            verification,
            score,
            box,
            depth,
            support.astype(int),
            spread,
            probability[kept],
            beliefs.entropy[kept],
        )
        return DescribedObjects(objects, description[kept])

    def _members(self, T_world_object: np.ndarray, hypotheses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(n, h) distances of the bodies of (n, 4, 4) objects from those of (h, 4, 4) hypotheses, metres, and (n, h)
        bool, which hypotheses stand for each object: those of its body.

        A twin that no hypothesis is of has the hypothesis with the nearest middle.
        """
        ambiguity = self.ambiguity
        cut = self.parameters.cut * ambiguity.spacing
        apart = ambiguity.body_distance.between(T_world_object, hypotheses)
        members = apart < cut
        alone = np.flatnonzero(~members.any(axis=1))
        middles, others = (
            transform_points(T, ambiguity.middle[None])[:, 0] for T in (T_world_object[alone], hypotheses)
        )
        members[alone, np.linalg.norm(middles[:, None] - others, axis=-1).argmin(axis=1)] = True
        return apart, members

    def _check_container(self, container: np.ndarray, probability: np.ndarray) -> np.ndarray:
        """(n,) probabilities, 0 of objects in walls; counts these and objects below the floor, by (n, 5) columns."""
        sunk = int(np.count_nonzero(container[:, 1] < -_SUNK))
        self.below_floor = sunk if sunk > max(1, _FEW * len(container)) else 0
        if not self._walled:
            return probability
        impossible = container[:, 2] > _IN_WALL
        self.in_walls = int((impossible & (probability >= self.parameters.confirmed)).sum())
        return np.where(impossible, 0.0, probability)

    def objects(self, stamp: int, T_world_camera: np.ndarray, camera: PinholeCamera) -> SceneObjects:
        """The objects of all views so far, most probable first; arguments and features as for
        :meth:`.BestViewFusion.objects`."""
        return self.describe(stamp, T_world_camera, camera).objects


def scaled_gates(gates: tuple[float, ...], scale: float) -> tuple[float, ...]:
    """The gates of refinement, metres, for an object of another size."""
    return tuple(scale * gate for gate in gates)
