"""Bodies from all views: samples, memory, equations and refinement against brute force and rendered truth."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from active6d_core.camera import PinholeCamera, backproject, normals_from_points
from active6d_core.hypotheses import Hypotheses
from active6d_core.object_model import load_object
from active6d_core.se3 import invert, make_transform, rotation_angle, transform_points
from active6d_core.view_sphere import ViewSphere
from active6d_perception.model.ambiguity import ambiguity_of
from active6d_perception.model.model_views import model_views
from active6d_perception.model.visible_samples import direction_of, nearest_direction, visible_samples
from active6d_perception.scene.body_candidates import BodyCandidates, gather_candidates, merge_duplicates, number_places
from active6d_perception.scene.body_refinement import BodyRefinement, normal_equations
from active6d_perception.scene.measured_view import NORMAL, measure_view
from active6d_perception.scene.memo import Memo, ViewSums
from active6d_perception.scene.pose_lattice import round_poses

SPHERE = ViewSphere()
CAMERA = PinholeCamera(320, 240, 277.0, 277.0, 159.5, 119.5)
POSE = make_transform(Rotation.from_euler("xyz", [70, 20, 40], degrees=True).as_matrix(), [0.02, -0.03, 0.05])


@pytest.fixture(scope="module")
def mug():
    return load_object("mug")


@pytest.fixture(scope="module")
def views_of_mug(mug, render):
    """What two cameras measure of one mug, without hypotheses."""
    ambiguity, views = ambiguity_of(mug), []
    for index in (20, 65):
        T_world_camera = SPHERE.pose(SPHERE.positions[index])
        depth, _ = render(mug, (invert(T_world_camera) @ POSE)[None], CAMERA)
        views.append(measure_view(depth, CAMERA, T_world_camera, Hypotheses.empty(240, 320), ambiguity))
    return views


def pose_error(T, T_true):
    return np.linalg.norm(T[:3, 3] - T_true[:3, 3]), np.degrees(rotation_angle(T[:3, :3], T_true[:3, :3]))


@given(st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda d: np.linalg.norm(d) > 0.1))
@settings(max_examples=100, deadline=None)
def test_nearest_direction_is_that_of_brute_force_up_to_a_cell(direction):
    views = model_views(load_object("mug"))
    samples = visible_samples(views, np.ones(len(views.points), bool), 8, 1.0)
    found = views.directions[nearest_direction(*direction, samples.nearest)]
    unit = np.array(direction) / np.linalg.norm(direction)
    best = np.degrees(np.arccos(np.clip((views.directions @ unit).max(), -1, 1)))
    assert np.degrees(np.arccos(np.clip(found @ unit, -1, 1))) <= best + 6.0  # from the middle of a cell, and back


def test_samples_are_visible_ones_of_the_part_and_share_its_area(mug):
    views = model_views(mug)
    part = mug.feature_mask("handle", views.points)
    samples = visible_samples(views, part, 16, mug.mesh.area)
    for direction in (0, 200, 641):
        chosen = samples.chosen[direction, : samples.number[direction]]
        seen = np.flatnonzero(views.visible[direction] & part)
        assert len(chosen) == min(16, len(seen))
        assert set(chosen) <= set(seen)
        total = samples.area[direction] * samples.number[direction]
        assert total == pytest.approx(mug.mesh.area * len(seen) / len(views.points), rel=1e-5)
    T = make_transform(np.eye(3), [0.0, 0.0, 0.8])
    assert views.directions[direction_of(T, samples.nearest)] @ [0, 0, -1] > np.cos(np.radians(9))


def test_a_measured_view_is_the_organised_cloud_of_its_depth(mug, render, pose):
    depth, _ = render(mug, pose(3), CAMERA)
    segmentation = np.where(np.isfinite(depth), 7, 0).astype(np.uint16)
    T_world_camera = SPHERE.pose(SPHERE.positions[4])
    hypotheses = Hypotheses.from_masks(pose(3), np.ones(1), np.array([7]), segmentation, depth)
    ambiguity = ambiguity_of(mug)
    view = measure_view(depth, CAMERA, T_world_camera, hypotheses, ambiguity)
    points = backproject(depth, CAMERA)
    np.testing.assert_array_equal(view.depth, depth)
    expected = normals_from_points(points, reach=1)
    np.testing.assert_array_equal((view.normals == 0).all(axis=-1), np.isnan(expected).any(axis=-1))
    alike = np.einsum("hwi,hwi->hw", view.normals / NORMAL, expected)
    assert np.nanmin(alike) > 0.99
    np.testing.assert_array_equal(view.instance, np.where(segmentation == 7, 0, -1))
    np.testing.assert_allclose(view.middles, transform_points(T_world_camera @ pose(3), ambiguity.middle[None])[:, 0])


def test_a_large_view_is_reduced(mug):
    camera = PinholeCamera(640, 480, 554.0, 554.0, 319.5, 239.5)
    view = measure_view(
        np.full((480, 640), 0.8, np.float32), camera, np.eye(4), Hypotheses.empty(480, 640), ambiguity_of(mug)
    )
    assert view.instance.shape == (240, 320)
    assert (view.fx, view.cx) == (277.0, 159.5)


def test_images_of_different_sizes_are_refused(mug):
    with pytest.raises(ValueError, match=r"depth image is \(240, 320\), masks are \(4, 6\)"):
        measure_view(np.zeros((240, 320), np.float32), CAMERA, np.eye(4), Hypotheses.empty(4, 6), ambiguity_of(mug))


def test_sums_over_views_ask_a_new_view_for_every_key_and_the_others_for_new_keys():
    asked, sums = [], ViewSums()

    def power(missing, view):
        asked.append((view, sorted(keys[index] for index in missing)))
        return np.array([[float(keys[index]) ** view] for index in missing])

    def total(views, known):
        nonlocal keys
        keys = known
        sums.follow(views)
        asked.clear()
        return sums.sums(keys, power, np.zeros(1))[:, 0].tolist()

    keys, one, two, three = [], 1, 2, 3  # powers stand for views
    assert total([one, two], [3, 5, 3]) == [12, 30, 12]
    assert asked == [(1, [3, 5]), (2, [3, 5])]
    sums.sweep()
    assert total([one, two, three], [3, 2]) == [39, 14]
    assert asked == [(1, [2]), (2, [2]), (3, [2, 3])]
    sums.sweep()
    sums.sweep()
    assert total([one, two, three], [3]) == [39]
    assert asked == [(1, [3]), (2, [3]), (3, [3])]
    assert total([two, three], [3]) == [36], "a view that is gone does not count"


def test_a_memo_computes_each_row_once_until_it_is_not_asked_for():
    asked = []

    def square(missing):
        asked.append(missing.tolist())
        return np.array([[keys[index] ** 2] for index in missing])

    memo, keys = Memo(), [3, 1, 3]
    np.testing.assert_array_equal(memo.rows(keys, square)[:, 0], [9, 1, 9])
    assert [sorted(keys[index] for index in each) for each in asked] == [[1, 3]]
    memo.sweep()
    keys = [1, 2]
    np.testing.assert_array_equal(memo.rows(keys, square)[:, 0], [1, 4])
    assert [keys[index] for index in asked[1]] == [2]
    memo.sweep()
    assert len(memo) == 2
    keys = [3]
    memo.rows(keys, square)
    assert len(asked) == 3


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_rounding_moves_a_pose_little_and_near_poses_alike(seed):
    rng = np.random.default_rng(seed)
    T = make_transform(Rotation.random(5, rng=rng).as_matrix(), rng.uniform(-0.3, 0.3, (5, 3)))
    origin = make_transform(Rotation.random(5, rng=rng).as_matrix(), rng.uniform(-0.3, 0.3, (5, 3)))
    rounded, keys = round_poses(T, origin, 0.001)
    assert np.abs((invert(origin) @ rounded - invert(origin) @ T)[:, :3, 3]).max() <= 0.5e-3 + 1e-12
    assert np.degrees(rotation_angle(rounded[:, :3, :3], T[:, :3, :3])).max() < 0.5
    np.testing.assert_allclose(round_poses(origin, origin, 0.001)[0], origin, atol=1e-12)
    near = invert(origin) @ T
    near[:, :3, 3] = (invert(origin) @ rounded)[:, :3, 3] + rng.uniform(-4e-4, 4e-4, (5, 3))
    assert round_poses(origin @ near, origin, 0.001)[1] == keys
    assert set(round_poses(T, T, 0.001)[1]).isdisjoint(keys)


def brute_force_equations(T, samples, view, gate, search):
    """Equations of one pose by a loop over samples and all pixels, or over the samples' own pixels."""
    T_camera_object = view.T_camera_world @ T
    direction = direction_of(T_camera_object, samples.nearest)
    A, g, count = np.zeros((6, 6)), np.zeros(6), 0
    R_world_camera = view.T_camera_world[:3, :3].T
    camera = PinholeCamera(view.depth.shape[1], view.depth.shape[0], view.fx, view.fy, view.cx, view.cy)
    cloud = backproject(view.depth, camera).reshape(-1, 3)
    for s in samples.chosen[direction, : samples.number[direction]]:
        p = T_camera_object[:3, :3] @ samples.points[s] + T_camera_object[:3, 3]
        n = T_camera_object[:3, :3] @ samples.normals[s]
        distance = np.linalg.norm(cloud - p, axis=1)
        u, v = (np.rint(f * p[i] / p[2] + c) for i, f, c in ((0, view.fx, view.cx), (1, view.fy, view.cy)))
        nearest = np.nanargmin(distance) if search else int(v) * view.depth.shape[1] + int(u)
        if not distance[nearest] < gate or not view.normals.reshape(-1, 3)[nearest] @ n > 0.5 * NORMAL:
            continue
        n_world = R_world_camera @ n
        arm = R_world_camera @ (p - T_camera_object[:3, 3])
        J = np.concatenate([np.cross(arm, n_world), n_world])
        A += np.outer(J, J)
        g += J * ((cloud[nearest] - p) @ n)
        count += 1
    return np.concatenate([A[np.triu_indices(6)], g, [count]])


@pytest.mark.parametrize("search", [True, False])
def test_equations_are_those_of_brute_force(mug, views_of_mug, search):
    samples = visible_samples(model_views(mug), ~ambiguity_of(mug).telling, 24, mug.mesh.area)
    T = POSE @ make_transform(Rotation.from_rotvec([0.02, -0.01, 0.03]).as_matrix(), [0.001, 0.002, -0.001])
    found = normal_equations(T[None], samples, views_of_mug[0], 0.008, search)[0]
    expected = brute_force_equations(T, samples, views_of_mug[0], 0.008, search)
    assert found[-1] == expected[-1] > 8
    np.testing.assert_allclose(found, expected, atol=1e-5)


def over(views):
    sums = ViewSums()
    sums.follow(views)
    return sums


def test_refinement_finds_the_pose_and_more_views_find_it_better(mug, views_of_mug):
    refinement = BodyRefinement(ambiguity_of(mug).all_samples, 5 * (0.008,) + 5 * (0.004,), 0.001)
    rng, starts = np.random.default_rng(1), []
    for _ in range(8):
        turn = Rotation.from_rotvec(rng.normal(0, 0.04, 3)).as_matrix()
        starts.append(POSE @ make_transform(turn, rng.normal(0, 0.002, 3)))
    both, one = (
        [pose_error(T, POSE)[0] for T in refinement.refine(np.array(starts), over(views))]
        for views in (views_of_mug, views_of_mug[:1])
    )
    assert np.median(both) < 0.4e-3
    assert np.median(both) < np.median(one)


def test_what_is_remembered_changes_nothing(mug, views_of_mug):
    refinement = BodyRefinement(ambiguity_of(mug).body_samples, (0.008, 0.004), 0.002)
    T = POSE @ make_transform(np.eye(3), [0.002, 0.001, 0.0])
    fresh = refinement.refine(T[None], over(views_of_mug))
    used = over(views_of_mug[:1])
    refinement.refine(T[None], used)
    used.follow(views_of_mug)
    np.testing.assert_array_equal(refinement.refine(T[None], used), fresh)


def test_a_pose_without_measurements_stays(mug, views_of_mug):
    far = make_transform(np.eye(3), [0.0, 0.0, 0.6])[None]
    refined = BodyRefinement(ambiguity_of(mug).body_samples, (0.008,), 0.001).refine(far, over(views_of_mug[:1]))
    np.testing.assert_array_equal(refined, far)


def test_body_distance_ignores_the_handle_only(mug):
    ambiguity = ambiguity_of(mug)
    rotated = POSE @ ambiguity.rotations
    assert len(rotated) == 36
    assert ambiguity.body_distance.between(POSE[None], rotated).max() < 1e-3
    moved = make_transform(np.eye(3), [0.0, 0.01, 0.0]) @ POSE
    assert ambiguity.body_distance.between(POSE[None], moved[None])[0, 0] == pytest.approx(0.01, abs=1e-4)
    handle = mug.feature_mask("handle", ambiguity.views.points)
    assert ambiguity.telling[handle].mean() > 0.95
    assert ambiguity.telling[~handle].mean() < 0.02


@pytest.mark.parametrize(("name", "rotations", "twins"), [("coffee_cup", 1, 2), ("bunny", 1, 1), ("mug", 36, 2)])
def test_ambiguity_is_found_from_the_mesh(name, rotations, twins):
    ambiguity = ambiguity_of(load_object(name))
    assert (len(ambiguity.rotations), len(ambiguity.twins)) == (rotations, twins)
    middles = transform_points(ambiguity.rotations, ambiguity.middle[None])[:, 0]
    np.testing.assert_allclose(middles, np.tile(ambiguity.middle, (rotations, 1)), atol=1e-4)


def test_mean_rotation_lies_between(mug):
    ambiguity = ambiguity_of(mug)
    weight = np.zeros((1, 36))
    weight[0, [0, 1]] = 0.5
    mean = ambiguity.mean_rotation(weight)[0]
    np.testing.assert_allclose(invert(mean) @ ambiguity.rotations[1], mean, atol=1e-9)


def test_candidates_are_clusters_with_their_twins_at_numbered_places(mug):
    ambiguity = ambiguity_of(mug)
    far = make_transform(np.eye(3), [0.2, 0.0, 0.0]) @ POSE
    flipped = POSE @ ambiguity.twins[1]
    T = np.stack([POSE, far, POSE @ ambiguity.rotations[5], flipped])
    labels, evidence = np.array([0, 1, 0, 3]), np.array([1.0, 3.0, 1.0, 0.5])
    found = gather_candidates(labels, T, evidence, ambiguity)
    np.testing.assert_array_equal(found.place, [0, 1, 1, 0, 1, 1])
    np.testing.assert_array_equal(found.evidence, [3.0, 2.0, 0.5, 0.0, 0.0, 0.0])
    np.testing.assert_array_equal(found.twin, [False, False, False, True, True, True])
    np.testing.assert_array_equal(found.heads(), [0, 1])
    merged = merge_duplicates(found, ambiguity)
    # The twin of the flipped mug is the first again, and that one's twin is the flipped mug.
    np.testing.assert_array_equal(merged.evidence, [3.0, 2.0, 0.5, 0.0])
    np.testing.assert_array_equal(merged.twin, [False, False, False, True])


def test_a_place_keeps_its_most_evident_bodies(mug):
    T = np.tile(POSE, (9, 1, 1))
    found = gather_candidates(np.arange(9), T, np.arange(9.0), ambiguity_of(mug))
    assert found.evidence[~found.twin].tolist() == [8, 7, 6, 5]


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_places_are_those_of_brute_force(seed):
    middles = np.random.default_rng(seed).uniform(0, 0.2, (12, 3))
    heads, expected = [], []
    for middle in middles:
        near = [number for number, head in enumerate(heads) if np.linalg.norm(middles[head] - middle) < 0.08]
        expected.append(near[0] if near else len(heads))
        if not near:
            heads.append(len(expected) - 1)
    np.testing.assert_array_equal(number_places(middles, 0.08), expected)


def test_no_hypothesis_gives_no_candidate(mug):
    found = gather_candidates(np.zeros(0, int), np.zeros((0, 4, 4)), np.zeros(0), ambiguity_of(mug))
    assert isinstance(found, BodyCandidates)
    assert len(found.heads()) == len(merge_duplicates(found, ambiguity_of(mug)).place) == 0
