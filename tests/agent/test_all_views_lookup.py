"""Fusion of all views by look-up: its belief is that of the fusion node, and so are most of its objects."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hand_made_scenes import make_model, three_mugs
from scipy.special import expit

from active6d_agent.bank.all_views_lookup import AllViewsLookup, index_scene, make_belief, make_lookup
from active6d_agent.bank.belief_kernel import fuse_episode
from active6d_agent.bank.best_view_lookup import BestViewLookup
from active6d_agent.bank.observation import observe_scene
from active6d_agent.bank.scene_bank import SceneBank, load_bank
from active6d_core.camera import DEFAULT_CAMERA
from active6d_core.hypotheses import Hypotheses
from active6d_core.metrics import DETECTION_FRACTION, e_add
from active6d_core.object_model import load_object
from active6d_core.se3 import invert, make_transform
from active6d_core.view_sphere import ViewSphere
from active6d_perception.model.ambiguity import ambiguity_of
from active6d_perception.scene.all_views_fusion import BESIDE, AllViewsFusion
from active6d_perception.scene.belief_weights import belief_path, load_belief
from active6d_perception.scene.body_candidates import BodyCandidates
from active6d_perception.scene.feasibility import against_container, against_neighbour, combine_neighbours
from active6d_perception.scene.fusion_parameters import FusionParameters
from active6d_perception.scene.object_probability import describe_objects
from active6d_perception.scene.observed_surface import WorkspaceGrid
from active6d_perception.scene.scene_evidence import BodyEvidence, SceneEvidence
from active6d_perception.scene.verification import Verifier
from active6d_sim.rendering.simulator import Simulator

SPHERE = ViewSphere(0.8, (20.0, 45.0, 60.0), 4)


class GuessesHandles:
    """Finds every visible mug some millimetres off; the rotation about its axis is guessed."""

    def __init__(self, simulator):
        self.simulator, self.rng = simulator, np.random.default_rng(0)

    def estimate(self, view):
        instance = self.simulator.renderer.render(view.T_world_camera, view.camera).instance
        found = [index for index in range(3) if (instance == index).sum() > 200]
        masks = np.where(np.isin(instance, found), instance + 1, 0).astype(np.uint16)
        rotations = ambiguity_of(load_object("mug")).rotations
        guessed = rotations[self.rng.integers(len(rotations), size=len(found))]
        slip = make_transform(np.tile(np.eye(3), (len(found), 1, 1)), self.rng.normal(0, 0.002, (len(found), 3)))
        T = invert(view.T_world_camera) @ self.simulator.scene.T_world_object[found] @ guessed @ slip
        return Hypotheses.from_masks(T, self.rng.uniform(0.4, 0.9, len(T)), np.array(found) + 1, masks, view.depth)


class FindsNothing:
    """An estimator for which the scene is empty."""

    def estimate(self, view):
        return Hypotheses.empty(*view.depth.shape)


@pytest.fixture(scope="module")
def simulator():
    return Simulator(three_mugs())


def observed(simulator, estimator):
    """The scene as a bank keeps it."""
    model, scene = load_object("mug"), simulator.scene
    parts = scene.name, scene.T_world_object, simulator.capture, estimator, Verifier(model), model
    return observe_scene(*parts, SPHERE, WorkspaceGrid.for_model(model))


@pytest.fixture(scope="module")
def bank(simulator, tmp_path_factory):
    """A bank that was written and read."""
    path = tmp_path_factory.mktemp("bank") / "bank.npz"
    seen = observed(simulator, GuessesHandles(simulator))
    SceneBank("mug", SPHERE, WorkspaceGrid.for_model(load_object("mug")), [seen], {}).save(path)
    return load_bank(path)


def evidence_of_views(scene, index, views):
    """What the tables say after these views, as :class:`.AllViewsFusion` has it."""
    tables, ambiguity = scene.evidence, ambiguity_of(load_object("mug"))
    rows = np.flatnonzero(np.isin(scene.view, views))
    evidence = np.bincount(index.candidate[rows], index.confidence[rows] ** 2, len(tables.place))
    alone = (evidence == 0) & (index.twins & (evidence > 0)).any(axis=1)
    proposed = np.flatnonzero((evidence > 0) | alone)
    T = tables.T_world_body[proposed]
    place = np.unique(tables.place[proposed], return_inverse=True)[1]
    candidates = BodyCandidates(T, T, place, evidence[proposed], alone[proposed])
    heads = candidates.heads()
    apart = np.linalg.norm((T @ [*ambiguity.middle, 1])[:, None] - T[heads] @ [*ambiguity.middle, 1], axis=-1)
    own, neighbour = np.nonzero((place[:, None] != place[heads]) & (apart < BESIDE * ambiguity.diameter))
    parts = (np.eye(4)[None], ambiguity.body_points), (ambiguity.rotations, ambiguity.telling_points)
    tray = AllViewsFusion(load_object("mug"))._tray
    container = [against_container(T, *part, tray, 1.0) for part in parts]
    among = [
        combine_neighbours(against_neighbour(T[own], T[heads][neighbour], *part, ambiguity.solid, 1.0), own, len(T))
        for part in parts
    ]
    body, twin, telling = (
        (getattr(tables, name)[views][:, proposed].astype(np.int64) ** 2).sum(axis=0)
        for name in ("body", "twin", "telling")
    )
    bodies = BodyEvidence(candidates, body, twin, container[0][:, 0], among[0][:, 0])
    return proposed, SceneEvidence(bodies, telling, container[1], among[1], ambiguity.diameter)


def test_the_compiled_belief_is_that_of_the_fusion(bank):
    model, parameters = load_object("mug"), FusionParameters(least_probability=0.0, exclusion=1e-6)
    weights = load_belief(belief_path("mug"))
    belief, fusion = make_belief(model, weights, parameters), AllViewsFusion(model, weights=weights)
    scene = bank.scenes[0]
    index = index_scene(scene, model, SPHERE, belief.cut)
    for views in ([0, 4, 9], [2], [1, 3, 5, 6, 8, 11]):
        fused = fuse_episode(index, np.array(views), views[-1], belief)
        proposed, evidence = evidence_of_views(scene, index, views)
        possible = fusion._possible(evidence.bodies)
        kept = SceneEvidence(
            evidence.bodies.take(possible),
            evidence.telling[possible],
            evidence.container[possible],
            evidence.neighbours[possible],
            evidence.diameter,
        )
        beliefs = fusion.believe(kept)
        rows = np.flatnonzero(np.isin(scene.view, views))
        chosen = proposed[possible][beliefs.candidate]
        members = index.near[chosen][:, rows] < belief.cut
        alone = np.flatnonzero(~members.any(axis=1))
        members[alone, index.middles[chosen[alone]][:, rows].argmin(axis=1)] = True
        expected = describe_objects(kept, beliefs, members, index.score[rows], scene.view[rows])
        probability = expit(weights.probability(expected))
        order = np.argsort(-probability, kind="stable")
        pose = chosen * len(belief.similar) + beliefs.rotation
        np.testing.assert_array_equal(fused.pose, pose[order])
        np.testing.assert_allclose(fused.description, expected[order], rtol=1e-3, atol=2e-3)
        np.testing.assert_allclose(fused.probability, probability[order], atol=2e-3)
        np.testing.assert_allclose(fused.entropy, beliefs.entropy[order], atol=2e-3)


def test_shorter_distances_separate_slim_objects():
    rod = make_model(trimesh.creation.box((0.2, 0.02, 0.02)))
    belief = make_belief(rod, load_belief(belief_path("mug")), FusionParameters(cut=0.3, exclusion=0.2))
    # 0.2 diameters become three quarters of the thickness.
    assert (belief.cut, belief.exclusion) == pytest.approx((0.0225, 0.015))


def test_the_look_up_finds_what_the_node_finds(bank, simulator):
    model, scene = load_object("mug"), simulator.scene
    lookup = make_lookup(bank)
    assert isinstance(lookup, AllViewsLookup)
    fusion, verifier, estimator = AllViewsFusion(model), Verifier(model), GuessesHandles(simulator)
    views = [0, 3, 6, 9, 10]
    # The estimator guesses again in the order of the bank.
    seen = {}
    for number, position in enumerate(SPHERE.positions):
        view = simulator.capture(SPHERE.pose(position), (number + 1) * 1_000_000_000)
        seen[number] = view, estimator.estimate(view)
    for number in views:
        view, hypotheses = seen[number]
        known = view.stamp, view.T_world_camera, hypotheses, verifier.score(view.depth, view.camera, hypotheses)
        fusion.add_view(*known, view.depth, view.camera)
    node, table = fusion.objects(view.stamp, view.T_world_camera, DEFAULT_CAMERA), lookup.objects(0, views)
    limit = DETECTION_FRACTION * model.diameter
    found = [
        (e_add(model, each.T_world_object[:, None], scene.T_world_object) < limit).any(axis=0) for each in (node, table)
    ]
    np.testing.assert_array_equal(*found)
    assert found[0].sum() >= 2
    assert len(node) == len(table)
    np.testing.assert_allclose(np.sort(node.probability), np.sort(table.probability), atol=0.15)
    assert sorted(node.support) == sorted(table.support)


def test_a_scene_in_which_nothing_was_found_has_no_object(bank, simulator, tmp_path):
    scenes = [replace(observed(simulator, FindsNothing()), name="mug/val/1"), *bank.scenes]
    replace(bank, scenes=scenes).save(tmp_path / "bank.npz")
    lookup = make_lookup(load_bank(tmp_path / "bank.npz"))
    views = np.array([[0, 4, 9], [0, 4, 9]])
    fused = lookup.fuse(np.array([0, 1]), views, views[:, -1])
    assert (fused.objects >= 0).sum(axis=1).tolist() == [0, 3]
    assert len(lookup.fuse(np.zeros(2, int), views, views[:, -1]).objects[0]) == 0
    assert len(lookup.describe_fused(0, np.array([1, 2]))[1]) == 0


def test_a_bank_of_other_rotations_is_refused(bank):
    """As after a symmetry was declared: indices beyond the tables are not checked in the kernel."""
    tables = bank.scenes[0].evidence
    fewer = replace(tables, T_world_object=tables.T_world_object[:, :6], telling=tables.telling[:, :, :6])
    old = replace(bank, scenes=[replace(bank.scenes[0], evidence=fewer)])
    with pytest.raises(ValueError, match="6 rotations of each body, and mug has 36; make it again"):
        AllViewsLookup(old)


def test_a_bank_without_evidence_is_fused_by_the_best_view(bank):
    old = replace(bank, scenes=[replace(scene, evidence=None) for scene in bank.scenes])
    assert isinstance(make_lookup(old), BestViewLookup)
    with pytest.raises(ValueError, match="no evidence of all views; make it again"):
        AllViewsLookup(old)
