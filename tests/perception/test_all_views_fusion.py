"""Fusion from all views on rendered mugs: what one view guesses wrong, the others correct."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from active6d_core.camera import PinholeCamera
from active6d_core.hypotheses import Hypotheses
from active6d_core.metrics import e_add
from active6d_core.object_model import ObjectModel, Symmetry, load_object
from active6d_core.se3 import invert, make_transform
from active6d_core.view_sphere import ViewSphere
from active6d_perception import parallel
from active6d_perception.model.ambiguity import ambiguity_of
from active6d_perception.scene import all_views_fusion, body_candidates, body_refinement
from active6d_perception.scene.all_views_fusion import AllViewsFusion
from active6d_perception.scene.belief_weights import BeliefWeights, Scorer
from active6d_perception.scene.camera_alignment import CameraAlignment
from active6d_perception.scene.expected_visibility import OPEN_TABLE, Tray
from active6d_perception.scene.feasibility import against_container
from active6d_perception.scene.measured_cases import (
    CASES,
    FITTING,
    LOOKED_THROUGH,
    NOT_MEASURED,
    WHAT,
    WHOSE,
    count_cases,
)
from active6d_perception.scene.measured_view import measure_view
from active6d_perception.scene.object_probability import OBJECT_COLUMNS
from active6d_perception.scene.scene_evidence import BODY_COLUMNS, ROTATION_COLUMNS

SPHERE = ViewSphere()
CAMERA = PinholeCamera(320, 240, 277.0, 277.0, 159.5, 119.5)
#: Two mugs on their sides, 16 cm apart.
TRUE = make_transform(
    Rotation.from_euler("xyz", [[90, 0, 40], [90, 30, 200]], degrees=True).as_matrix(),
    [[-0.08, 0.0, 0.045], [0.08, 0.02, 0.045]],
)
VIEWS = (30, 37, 44, 51)


def hand_set_weights() -> BeliefWeights:
    """What fits speaks for a pose, what the camera looked through against it, and overlap too."""
    case = np.zeros((WHAT, WHOSE))
    case[FITTING], case[LOOKED_THROUGH] = 2.0, -2.0
    rotation, body, probability = (np.zeros(len(each)) for each in (ROTATION_COLUMNS, BODY_COLUMNS, OBJECT_COLUMNS))
    rotation[:CASES] = body[:CASES] = body[CASES : 2 * CASES] = case.ravel()
    rotation[ROTATION_COLUMNS.index("share in neighbours")] = -3.0
    rotation[ROTATION_COLUMNS.index("share below the floor")] = -3.0
    probability[OBJECT_COLUMNS.index("log-odds of the pose")] = 1.0
    return BeliefWeights(*map(Scorer.of_weights, (rotation, body, probability)))


@pytest.fixture(scope="module")
def mug():
    return load_object("mug")


@pytest.fixture(scope="module")
def episode(mug, render):
    """Views of the two mugs. Each view has hypotheses with right bodies; only the third has right handles."""
    rng, ambiguity, seen = np.random.default_rng(0), ambiguity_of(mug), []
    for number, index in enumerate(VIEWS):
        T_world_camera = SPHERE.pose(SPHERE.positions[index])
        T_camera_world = invert(T_world_camera)
        depth, _ = render(mug, T_camera_world @ TRUE, CAMERA)
        single = [render(mug, (T_camera_world @ T)[None], CAMERA)[0] for T in TRUE]
        segmentation = np.zeros(depth.shape, np.uint16)
        for label, own in enumerate(single, 1):
            segmentation[np.abs(own - depth) < 1e-6] = label
        # A floor below the mugs, along the ray of each pixel.
        floor = _floor_depth(T_world_camera)
        depth = np.where(np.isfinite(depth), depth, floor).astype(np.float32)
        wrong = ambiguity.rotations[rng.choice([9, 14, 20, 27], 2)] if number != 2 else np.eye(4)
        noise = make_transform(
            Rotation.from_rotvec(rng.normal(0, 0.01, (2, 3))).as_matrix(), rng.normal(0, 1e-3, (2, 3))
        )
        T = T_camera_world @ TRUE @ wrong @ noise
        hypotheses = Hypotheses.from_masks(T, rng.uniform(0.5, 0.9, 2), np.array([1, 2]), segmentation, depth)
        seen.append((1_000 * (number + 1), T_world_camera, hypotheses, np.full(2, 0.8), depth, CAMERA))
    return seen


def _floor_depth(T_world_camera: np.ndarray) -> np.ndarray:
    """(240, 320) depth of the plane z = 0 in the world."""
    v, u = np.mgrid[0:240, 0:320]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u, float)], axis=-1)
    return -T_world_camera[2, 3] / (rays @ T_world_camera[2, :3])


def fuse(mug, views, weights=None) -> AllViewsFusion:
    fusion = AllViewsFusion(mug, weights=weights or hand_set_weights(), tray=OPEN_TABLE)
    for view in views:
        fusion.add_view(*view)
    return fusion


def objects_of(fusion, view):
    return fusion.objects(view[0], view[1], view[-1])


def test_the_number_of_threads_changes_nothing(mug, episode, monkeypatch):
    found = []
    for threads in (1, 3):
        monkeypatch.setattr(parallel, "thread_count", lambda threads=threads: threads)
        found.append(objects_of(fuse(mug, episode), episode[-1]))
    np.testing.assert_array_equal(found[0].T_world_object, found[1].T_world_object)
    np.testing.assert_array_equal(found[0].probability, found[1].probability)


def test_all_views_together_know_the_handles(mug, episode):
    objects = objects_of(fuse(mug, episode), episode[-1])
    errors = e_add(mug, objects.T_world_object[:, None], TRUE).min(axis=0)
    assert len(objects) == 2
    assert errors.max() < 1e-3
    assert objects.probability.min() > 0.9
    np.testing.assert_array_equal(objects.support, [4, 4])


def test_rods_side_by_side_are_two_objects(render):
    """25 mm apart, an eighth of their length."""
    mesh = trimesh.creation.box((0.2, 0.02, 0.012))
    group = np.stack([np.diag(signs) for signs in ([1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1])]).astype(float)
    rod = ObjectModel("rod", mesh, float(np.linalg.norm(mesh.extents)), Symmetry(None, group), (1, 3), np.ones(3), {})
    true = make_transform(np.tile(np.eye(3), (2, 1, 1)), [[0.0, -0.0125, 0.006], [0.0, 0.0125, 0.006]])
    views = []
    for number, index in enumerate(VIEWS[:3]):
        T_world_camera = SPHERE.pose(SPHERE.positions[index])
        T = invert(T_world_camera) @ true
        depth = render(rod, T, CAMERA)[0]
        first = np.abs(render(rod, T[:1], CAMERA)[0] - depth) < 1e-6
        labels = np.where(np.isfinite(depth), np.where(first, 1, 2), 0).astype(np.uint16)
        depth = np.where(labels > 0, depth, _floor_depth(T_world_camera)).astype(np.float32)
        hypotheses = Hypotheses.from_masks(T, np.full(2, 0.9), np.array([1, 2]), labels, depth)
        views.append((1_000 * (number + 1), T_world_camera, hypotheses, np.full(2, 0.9), depth, CAMERA))
    objects = objects_of(fuse(rod, views), views[-1])
    np.testing.assert_allclose(np.sort(objects.T_world_object[:, 1, 3]), [-0.0125, 0.0125], atol=0.001)
    np.testing.assert_array_equal(objects.support, [3, 3])
    assert objects.probability.min() > 0.9


@pytest.mark.parametrize("scale", [0.5, 1.4])
def test_an_object_of_another_size_is_judged_like_one_of_usual_size(mug, episode, scale):
    mesh = mug.mesh.copy().apply_scale(scale)
    features = {name: scale * box for name, box in mug.features.items()}
    other = replace(mug, mesh=mesh, diameter=scale * mug.diameter, features=features, origin=scale * mug.origin)
    views = [resize(view, scale) for view in episode]
    expected, found = objects_of(fuse(mug, episode), episode[-1]), objects_of(fuse(other, views), views[-1])
    assert ambiguity_of(mug).scale == 1
    assert e_add(mug, resized(found.T_world_object, 1 / scale)[:, None], TRUE).min(axis=0).max() < 1e-3
    np.testing.assert_allclose(found.probability, expected.probability, atol=0.02)
    np.testing.assert_allclose(found.entropy, expected.entropy, atol=0.1)


def test_what_stands_in_a_wall_is_withdrawn_where_the_walls_are_known(mug, episode):
    for width, walled, found in ((0.12, False, 2), (0.12, True, 0), (0.5, True, 2)):
        # The mugs lie at x = -8 and 8 cm.
        fusion = AllViewsFusion(mug, weights=hand_set_weights(), tray=Tray(width, 1.0, 0.2), walled=walled)
        for view in episode:
            fusion.add_view(*view)
        objects = objects_of(fusion, episode[-1])
        assert (objects.probability > 0.5).sum() == found
        assert fusion.in_walls == (2 if width < 0.2 and walled else 0)


@pytest.mark.parametrize(("shift", "below"), [(0.05, 0), (-0.005, 0), (-0.03, 2)])
def test_objects_below_the_floor_are_counted(mug, episode, shift, below):
    fusion = AllViewsFusion(mug, weights=hand_set_weights())
    for stamp, T, *rest in episode:
        fusion.add_view(stamp, make_transform(np.eye(3), [0.0, 0.0, shift]) @ T, *rest)
    objects_of(fusion, episode[-1])
    assert fusion.below_floor == below


def test_the_container_is_in_the_world_and_not_in_the_first_views_frame(mug, episode, monkeypatch):
    before = fuse(mug, episode).evidence().bodies
    anchor = make_transform(np.eye(3), [0.0, 0.0, -0.03])
    monkeypatch.setattr(CameraAlignment, "T_world_anchor", property(lambda _: anchor))
    fusion = fuse(mug, episode)
    after = fusion.evidence().bodies
    np.testing.assert_array_equal(after.candidates.T_world_object, before.candidates.T_world_object)
    np.testing.assert_allclose(after.container[:, 1], before.container[:, 1] - 0.03, atol=1e-9)
    objects_of(fusion, episode[-1])
    assert fusion.below_floor == 2


def test_a_wall_of_height_0_is_none():
    rng = np.random.default_rng(0)
    T = make_transform(Rotation.random(20, rng=rng).as_matrix(), rng.uniform(-0.3, 0.3, (20, 3)))
    parts = T, np.eye(4)[None], rng.uniform(-0.05, 0.05, (30, 3))
    none, low = (against_container(*parts, tray, 1.0) for tray in (OPEN_TABLE, Tray(0.1, 0.1, 0.0)))
    np.testing.assert_array_equal(low, none)
    assert against_container(*parts, Tray(0.1, 0.1, 0.01), 1.0)[..., 2].max() > 0


@pytest.mark.parametrize("offset", [[0.6, 0.0, 0.001], [0.0, 0.5, 0.05], [-0.4, 0.4, 0.02]])
def test_a_camera_that_looks_past_an_object_says_little_of_it(mug, episode, offset):
    """No more than a camera as far away that looks at it and measures nothing."""
    depth, camera = episode[0][-2:]
    blank, none = np.full_like(depth, np.nan), Hypotheses.empty(*depth.shape)
    past, at = np.eye(4), np.eye(4)
    # The camera looks along z; the mug is beside it, hardly before the plane of the camera.
    past[:3, 3] = TRUE[0, :3, 3] - offset
    at[:3, 3] = TRUE[0, :3, 3] - [0.0, 0.0, np.linalg.norm(offset)]
    counts = []
    for T_world_camera in (past, at):
        view = measure_view(blank, camera, T_world_camera, none, ambiguity_of(mug))
        samples = ambiguity_of(mug).body_samples
        each = count_cases(TRUE[:1], np.eye(4)[None], ambiguity_of(mug).middle, 0.0, samples, view, 1.0)
        counts.append(each.reshape(WHAT, WHOSE)[NOT_MEASURED].sum())
    assert counts[0] < 2 * counts[1]


def resized(T, scale):
    moved = T.copy()
    moved[..., :3, 3] *= scale
    return moved


def resize(view, scale):
    """The same images of a world that is larger or smaller."""
    stamp, T_world_camera, hypotheses, verification, depth, camera = view
    other = replace(
        hypotheses,
        T_camera_object=resized(hypotheses.T_camera_object, scale),
        depth=scale * hypotheses.depth,
    )
    return stamp, resized(T_world_camera, scale), other, verification, np.float32(scale) * depth, camera


def test_no_hypothesis_needs_to_have_the_right_handle(mug, episode):
    guessed = [view for view in episode if view is not episode[2]]
    before = np.concatenate([T_world_camera @ h.T_camera_object for _, T_world_camera, h, *_ in guessed])
    assert e_add(mug, before[:, None], TRUE).min() > 0.03
    objects = objects_of(fuse(mug, guessed), guessed[-1])
    assert e_add(mug, objects.T_world_object[:, None], TRUE).min(axis=0).max() < 2e-3


def test_the_order_of_views_changes_nothing(mug, episode):
    expected = objects_of(fuse(mug, episode), episode[-1])
    shuffled = fuse(mug, [])
    for place in (2, 0, 3, 1):
        shuffled.add_view(*episode[place])
        objects_of(shuffled, episode[-1])  # what is remembered between views must not matter either
    found = objects_of(shuffled, episode[-1])
    for name, value in vars(expected).items():
        np.testing.assert_array_equal(getattr(found, name), value, err_msg=name)


def test_a_view_counts_once_and_can_be_forgotten(mug, episode):
    fusion = fuse(mug, episode[:2])
    expected = objects_of(fusion, episode[1])
    assert not fusion.add_view(*episode[0])
    again = objects_of(fusion, episode[1])
    np.testing.assert_array_equal(again.T_world_object, expected.T_world_object)
    assert fusion.add_view(*episode[2])
    fusion.forget_before(episode[2][0])
    alone = objects_of(fuse(mug, episode[2:3]), episode[2])
    left = objects_of(fusion, episode[2])
    np.testing.assert_array_equal(left.T_world_object, alone.T_world_object)
    fusion.reset()
    assert len(objects_of(fusion, episode[0])) == 0


def test_nothing_seen_is_nothing_found(mug, episode):
    stamp, T_world_camera, hypotheses, _, depth, camera = episode[0]
    fusion = fuse(mug, [])
    empty = Hypotheses.empty(*hypotheses.segmentation.shape)
    fusion.add_view(stamp, T_world_camera, empty, np.zeros(0), depth, camera)
    assert len(fusion.objects(stamp, T_world_camera, camera)) == 0


def test_another_view_computes_its_own_part_only(mug, episode, monkeypatch):
    from active6d_perception.scene import all_views_fusion

    fusion = fuse(mug, episode[:3])
    objects_of(fusion, episode[2])
    counted, count_cases = [], all_views_fusion.count_cases

    def count(T, *rest):
        counted.append((len(T), rest[-2]))
        return count_cases(T, *rest)

    monkeypatch.setattr(all_views_fusion, "count_cases", count)
    objects_of(fusion, episode[2])
    assert counted == []
    fusion.add_view(*episode[3])
    objects_of(fusion, episode[3])
    newest = fusion.views[episode[3][0]]
    of_newest = sum(poses for poses, view in counted if view is newest)
    # Poses that the new view moves are looked at again in the others.
    assert of_newest >= sum(poses for poses, _ in counted) / 4 > 0


def test_scattered_hypotheses_cost_no_more_than_their_number(mug, episode, monkeypatch):
    """Poses that are compared with depth images for one more view: twice as many after twice as many views."""
    compared = 0

    def counting(function):
        def count(T, *arguments):
            nonlocal compared
            compared += len(T)
            return function(T, *arguments)

        return count

    monkeypatch.setattr(body_candidates, "_MOST_CLUSTERS", 30)
    for module, name in ((all_views_fusion, "count_cases"), (body_refinement, "normal_equations")):
        monkeypatch.setattr(module, name, counting(getattr(module, name)))
    fusion, rng, of_view = fuse(mug, []), np.random.default_rng(0), {}
    for number in range(1, 17):
        _, T_world_camera, hypotheses, _, depth, camera = episode[number % len(episode)]
        T = make_transform(Rotation.random(10, rng=rng).as_matrix(), rng.uniform(-0.2, 0.2, (10, 3)) + [0, 0, 0.25])
        scattered = Hypotheses(
            invert(T_world_camera) @ T,
            rng.uniform(0.1, 0.9, 10),
            np.tile([0.4, 0.4, 0.6, 0.6], (10, 1)),
            np.full(10, 0.8),
            np.ones(10, np.uint16),
            hypotheses.segmentation,
        )
        fusion.add_view(number, T_world_camera, scattered, rng.uniform(-0.5, 0.9, 10), depth, camera)
        compared = 0
        fusion.objects(number, T_world_camera, camera)
        of_view[number] = compared
    assert of_view[16] < 2.2 * of_view[8]


def test_the_current_view_gives_boxes_where_it_has_hypotheses(mug, episode):
    stamp, T_world_camera, hypotheses, *_ = episode[1]
    fusion = fuse(mug, episode)
    objects = fusion.objects(stamp, T_world_camera, CAMERA)
    for box, depth in zip(objects.box, objects.depth, strict=True):
        own = np.abs(hypotheses.box - box).sum(axis=1).argmin()
        np.testing.assert_array_equal(box, hypotheses.box[own])
        assert depth == hypotheses.depth[own]
    beside = fusion.objects(77, T_world_camera, CAMERA)
    assert np.abs(beside.box - objects.box).max() > 1e-4
    np.testing.assert_allclose(beside.box, objects.box, atol=0.02)


def test_improbable_objects_are_withdrawn(mug, episode):
    weights = hand_set_weights()
    doubtful = replace(weights, probability=Scorer.of_weights(np.eye(len(OBJECT_COLUMNS))[0] * -10.0))
    assert len(objects_of(fuse(mug, episode, doubtful), episode[-1])) == 0
