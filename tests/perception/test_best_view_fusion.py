"""Symmetric distance against brute force; fusion's order, repetition and choice of survivors."""

import numpy as np
import pytest
import trimesh
from hand_made_scenes import make_model
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from active6d_core.camera import DEFAULT_CAMERA
from active6d_core.hypotheses import Hypotheses
from active6d_core.object_model import load_object
from active6d_core.se3 import invert, make_transform, transform_points
from active6d_core.view_sphere import ViewSphere
from active6d_perception.model.model_views import model_views
from active6d_perception.model.symmetric_distance import SymmetricDistance
from active6d_perception.scene import hypothesis_table
from active6d_perception.scene.best_view_fusion import BestViewFusion, cluster, select
from active6d_perception.scene.clustering import cluster_groups
from active6d_perception.scene.fusion_parameters import FusionParameters
from active6d_perception.scene.object_features import project_features
from active6d_perception.suppression import suppress_neighbours

NAMES = ("coffee_cup", "bunny", "mug")
SPHERE = ViewSphere()


def random_poses(rng, count, extent=0.15):
    return make_transform(
        Rotation.random(count, rng=rng).as_matrix().reshape(-1, 3, 3), rng.uniform(-extent, extent, (count, 3))
    )


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_distance_is_the_sampled_one(name, seed):
    model = load_object(name)
    T_a, T_b = random_poses(np.random.default_rng(seed), 2)
    points = model.surface[0]
    symmetric = make_transform(T_b[:3, :3] @ model.symmetry.rotations(1.0), T_b[:3, 3])
    squares = ((transform_points(T_a, points) - transform_points(symmetric, points)) ** 2).sum(-1).mean(-1)
    closed = SymmetricDistance(model).between(T_a[None], T_b[None])[0, 0]
    # Half a degree of sampling at most 6 cm from the axis, and samples that are not exactly symmetric.
    assert closed == pytest.approx(np.sqrt(squares.min()), abs=1e-6 if model.symmetry.axis is None else 1e-3)


@pytest.mark.parametrize("name", NAMES)
def test_distance_is_a_metric_on_symmetric_poses(name):
    model = load_object(name)
    T = random_poses(np.random.default_rng(3), 6)
    between = SymmetricDistance(model).between
    d = between(T, T)
    np.testing.assert_allclose(np.diag(d), 0, atol=1e-6)
    np.testing.assert_allclose(d, d.T, atol=1e-6)
    turned = T @ make_transform(model.symmetry.rotations(37.0)[-1], np.zeros(3))
    np.testing.assert_allclose(between(T, turned), d, atol=1e-5)
    moved = make_transform(np.eye(3), [0.0, 0.03, 0.04]) @ T
    np.testing.assert_allclose(np.diag(between(T, moved)), 0.05, atol=1e-6)


def make_view(rng, T_world_camera, T_world_object):
    """Hypotheses of a few true objects, each a little off, with a box of their own in the label image."""
    count = len(T_world_object)
    noise = make_transform(
        Rotation.from_rotvec(rng.normal(0, 0.05, (count, 3))).as_matrix().reshape(-1, 3, 3),
        rng.normal(0, 0.002, (count, 3)),
    )
    segmentation = np.zeros((480, 640), np.uint16)
    for label in range(1, count + 1):
        segmentation[20 * label : 20 * label + 10, 30 : 60 + label] = label
    depth = np.full((480, 640), 0.5 + 0.1 * rng.random(), np.float32)
    hypotheses = Hypotheses.from_masks(
        invert(T_world_camera) @ T_world_object @ noise, rng.random(count), np.arange(1, count + 1), segmentation, depth
    )
    return hypotheses, rng.uniform(0.2, 1.0, count)


def make_episode(seed, views=5, objects=6):
    rng = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid(np.arange(3), np.arange(2)), -1).reshape(-1, 2)[:objects] * 0.15 - 0.15
    truth = random_poses(rng, objects)
    truth[:, :3, 3] = np.column_stack([grid, np.zeros(objects)])
    episode = []
    for stamp in range(1, views + 1):
        T_world_camera = SPHERE.pose(SPHERE.positions[rng.integers(len(SPHERE))])
        seen = rng.random(objects) < 0.7
        episode.append((stamp, T_world_camera, *make_view(rng, T_world_camera, truth[seen])))
    return truth, episode


def fuse(model, views, parameters=None):
    fusion = BestViewFusion(model, parameters)
    for stamp, T_world_camera, hypotheses, verification in views:
        fusion.add_view(stamp, T_world_camera, hypotheses, verification)
    return fusion


def assert_same(a, b):
    for name in ("T_world_object", "verification", "score", "box", "depth", "support", "spread"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


@pytest.mark.parametrize("name", ["coffee_cup", "mug"])
@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), order=st.permutations(range(5)), again=st.integers(0, 4))
def test_order_and_repetition_of_views_change_nothing(name, seed, order, again):
    model = load_object(name)
    _, episode = make_episode(seed)
    last_stamp, T_world_camera = episode[-1][:2]
    expected = fuse(model, episode).objects(last_stamp, T_world_camera, DEFAULT_CAMERA)
    shuffled = [episode[index] for index in order]
    fusion = fuse(model, shuffled)
    assert not fusion.add_view(*episode[again])
    assert_same(fusion.objects(last_stamp, T_world_camera, DEFAULT_CAMERA), expected)


@pytest.mark.parametrize("rank_by", ["evidence", "confidence", "verification", "score"])
@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_survivors_are_the_best_and_nothing_is_invented(rank_by, seed):
    truth, episode = make_episode(seed)
    model = load_object("bunny")
    stamp, T_world_camera = episode[-1][:2]
    objects = fuse(model, episode, FusionParameters(rank_by=rank_by)).objects(stamp, T_world_camera, DEFAULT_CAMERA)
    poses = np.concatenate([T @ hypotheses.T_camera_object for _, T, hypotheses, _ in episode])
    verification = np.concatenate([scores for *_, scores in episode])
    score = np.concatenate([hypotheses.score for _, _, hypotheses, _ in episode])
    confidence = (1 + verification) * score
    worth = {"verification": verification, "score": score}.get(rank_by, confidence)
    nearest = np.linalg.norm(poses[:, None, :3, 3] - truth[None, :, :3, 3], axis=-1).argmin(axis=1)
    clusters = [np.flatnonzero(nearest == index) for index in sorted(set(nearest))]
    rank = [(confidence[each] ** 2).sum() if rank_by == "evidence" else worth[each].max() for each in clusters]
    survivors = [
        each[worth[each].argmax()] for _, each in sorted(zip(rank, clusters, strict=True), key=lambda pair: -pair[0])
    ]
    np.testing.assert_array_equal(objects.verification, verification[survivors])
    np.testing.assert_array_equal(objects.score, score[survivors])
    np.testing.assert_array_equal(objects.support, [np.sum(nearest == nearest[index]) for index in survivors])
    np.testing.assert_allclose(objects.T_world_object, poses[survivors], atol=1e-12)


def test_features_come_from_the_current_view():
    model = load_object("mug")
    _, episode = make_episode(7)
    fusion = fuse(model, episode)
    for stamp, T_world_camera, hypotheses, verification in episode:
        objects = fusion.objects(stamp, T_world_camera, DEFAULT_CAMERA)
        T_world = T_world_camera @ hypotheses.T_camera_object
        own = SymmetricDistance(model).between(objects.T_world_object, T_world) < 0.03
        for row, seen in enumerate(own):
            if seen.any():
                best = np.flatnonzero(seen)[verification[seen].argmax()]
                np.testing.assert_allclose(objects.box[row], hypotheses.box[best])
                assert objects.depth[row] == hypotheses.depth[best]
        box, depth = project_features(
            model_views(model), invert(T_world_camera) @ objects.T_world_object[~own.any(axis=1)], DEFAULT_CAMERA
        )
        np.testing.assert_allclose(objects.box[~own.any(axis=1)], box)
        np.testing.assert_allclose(objects.depth[~own.any(axis=1)], depth)


@pytest.mark.parametrize("name", NAMES)
def test_projected_features_match_a_rendering(name, render, pose):
    model = load_object(name)
    T = np.concatenate([pose(seed) for seed in range(4)])
    box, depth = project_features(model_views(model), T, DEFAULT_CAMERA)
    for index in range(len(T)):
        rendered, _ = render(model, T[index : index + 1])
        rows, columns = np.nonzero(np.isfinite(rendered))
        expected = [columns.min() / 640, rows.min() / 480, (columns.max() + 1) / 640, (rows.max() + 1) / 480]
        np.testing.assert_allclose(box[index], expected, atol=2 / 480)
        assert depth[index] == pytest.approx(np.nanmean(rendered), abs=0.004)


def test_forgetting():
    model = load_object("bunny")
    _, episode = make_episode(5)
    fusion = fuse(model, episode)
    fusion.forget_before(4)
    stamp, T_world_camera = episode[-1][:2]
    assert_same(
        fusion.objects(stamp, T_world_camera, DEFAULT_CAMERA),
        fuse(model, episode[3:]).objects(stamp, T_world_camera, DEFAULT_CAMERA),
    )
    assert fusion.add_view(*episode[0])
    fusion.reset()
    assert len(fusion.objects(stamp, T_world_camera, DEFAULT_CAMERA)) == 0


def test_two_objects_cannot_share_a_place():
    labels = np.array([0, 1, 0, 3, 4])
    positions = np.array([[0.0, 0, 0], [0.01, 0, 0], [0, 0, 0], [0.03, 0, 0], [0.045, 0, 0]])
    np.testing.assert_array_equal(select(labels, None, positions, 0.02), [0, 3])
    np.testing.assert_array_equal(select(labels, None, positions, 0.0), [0, 1, 3, 4])


def test_rods_side_by_side_are_two_objects():
    """25 mm apart, an eighth of their length; each hypothesis is some millimetres off."""
    rng, rod = np.random.default_rng(0), make_model(trimesh.creation.box((0.2, 0.02, 0.02)))
    truth = make_transform(np.tile(np.eye(3), (2, 1, 1)), [[0.0, -0.0125, 0.0], [0.0, 0.0125, 0.0]])
    cameras = [SPHERE.pose(SPHERE.positions[index]) for index in range(5)]
    views = [(stamp, camera, *make_view(rng, camera, truth)) for stamp, camera in enumerate(cameras, 1)]
    objects = fuse(rod, views).objects(5, cameras[-1], DEFAULT_CAMERA)
    np.testing.assert_allclose(np.sort(objects.T_world_object[:, 1, 3]), [-0.0125, 0.0125], atol=0.006)
    np.testing.assert_array_equal(objects.support, [5, 5])


def test_views_that_agree_outvote_a_surer_one():
    labels = np.array([0, 1, 1, 3, 1])
    weight = np.array([1.0, 0.4, 0.4, 0.1, 0.3])
    positions = np.array([[0.0, 0, 0], [0.01, 0, 0], [0.01, 0, 0], [0.2, 0, 0], [0.01, 0, 0]])
    np.testing.assert_array_equal(select(labels, weight, positions, 0.02), [1, 3])
    np.testing.assert_array_equal(select(labels, None, positions, 0.02), [0, 3])
    np.testing.assert_array_equal(select(labels, weight, positions, 0.0), [1, 0, 3])


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_clusters_are_those_of_naive_agglomeration(seed):
    rng = np.random.default_rng(seed)
    points = rng.random((12, 2))
    distance = np.linalg.norm(points[:, None] - points[None], axis=-1)
    groups = [[index] for index in range(12)]
    while len(groups) > 1:
        pairs = [
            (distance[np.ix_(a, b)].mean(), i, j) for i, a in enumerate(groups) for j, b in enumerate(groups) if i < j
        ]
        height, i, j = min(pairs)
        if height > 0.25:
            break
        groups[i] += groups.pop(j)
    labels = cluster(distance, 0.25)
    assert {frozenset(group) for group in groups} == {
        frozenset(np.flatnonzero(labels == label)) for label in set(labels)
    }


def test_a_large_group_is_clustered_alike():
    points = np.random.default_rng(5).random((400, 3)) * [20.0, 1.0, 1.0]
    distance = np.round(np.linalg.norm(points[:, None] - points[None], axis=-1), 7)
    labels = cluster(distance, 0.6)
    np.testing.assert_array_equal(labels, cluster_groups(distance[None], np.ones((1, 400), bool), 0.6)[0])
    assert 20 < len(set(labels)) < 400


def test_scattered_hypotheses_without_end_keep_their_cost(monkeypatch):
    monkeypatch.setattr(hypothesis_table, "MOST_HYPOTHESES", 100)
    fusion, T_world_camera = BestViewFusion(load_object("mug")), ViewSphere().pose(ViewSphere().positions[40])
    rng, best = np.random.default_rng(0), 0.0
    for stamp in range(1, 21):
        T = make_transform(np.tile(np.eye(3), (20, 1, 1)), [0, 0, 0.8] + rng.uniform(-0.15, 0.15, (20, 3)))
        box, mask = np.tile([0.2, 0.2, 0.4, 0.4], (20, 1)), np.ones((4, 4), np.uint16)
        hypotheses = Hypotheses(T, rng.random(20), box, np.full(20, 0.8), np.ones(20, np.uint16), mask)
        fusion.add_view(stamp, T_world_camera, hypotheses, np.full(20, 0.5))
        best = max(best, hypotheses.score.max())
    objects = fusion.objects(20, T_world_camera, DEFAULT_CAMERA)
    assert len(fusion._known.distances) == 100
    assert objects.score.max() == best  # the best are kept, whenever they came


def test_bad_parameters_and_scores_are_named():
    with pytest.raises(ValueError, match="cut must be positive"):
        FusionParameters(cut=0.0)
    with pytest.raises(ValueError, match="rank_by must be one of evidence, confidence, verification, score"):
        FusionParameters(rank_by="noise-resampling")
    with pytest.raises(ValueError, match="min_verification"):
        FusionParameters(min_verification=2.0)
    _, episode = make_episode(0)
    stamp, T, hypotheses, verification = episode[0]
    with pytest.raises(ValueError, match="verification scores for"):
        BestViewFusion(load_object("mug")).add_view(stamp, T, hypotheses, verification[:-1])


def test_an_exclusion_of_0_keeps_objects_at_the_same_place():
    """Rounding made their squared distance negative, and closer than 0."""
    positions = np.random.default_rng(0).uniform(-1, 1, (200, 1, 3)).repeat(2, axis=1)
    assert suppress_neighbours(positions, np.ones((200, 2), bool), 0.0).all()
    assert suppress_neighbours(positions, np.ones((200, 2), bool), 1e-3).sum() == 200
