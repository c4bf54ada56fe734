"""The learned estimator's geometry, without learning: canonical_frames, input, bins, votes, rigid fits, turns."""

import time

import numpy as np
import open3d as o3d
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.special import softmax

from active6d_core.camera import (
    DEFAULT_CAMERA,
    PinholeCamera,
    View,
    backproject,
    normals_from_points,
    pixel_rays,
    pool_depth,
)
from active6d_core.object_model import load_object
from active6d_core.se3 import invert, look_at, make_transform, transform_points
from active6d_perception.estimators.dense.axis_rotation import AxisRotationSearch, likely_axis_rotations
from active6d_perception.estimators.dense.canonical_frame import (
    AXIS_ANGLES,
    AxisRotation,
    canonical_frame_of,
    facing_camera,
    rotation_about_z,
)
from active6d_perception.estimators.dense.measured_surface import MeasuredSurface
from active6d_perception.estimators.dense.network import DIRECTION_BINS, HEADS, DenseNetwork, NetworkSize, fused, split
from active6d_perception.estimators.dense.network_input import (
    CHANNELS,
    network_input,
    output_camera,
    pad,
    ray_rotation,
    reduce_view,
)
from active6d_perception.estimators.dense.sphere_bins import CENTRES, density, kernel
from active6d_perception.estimators.dense.votes import cluster_votes
from active6d_perception.estimators.measured_image import measure_image

OBJECTS = {"coffee_cup": AxisRotation.INVISIBLE, "mug": AxisRotation.SHOWN_BY_FEATURE, "bunny": AxisRotation.VISIBLE}


def random_poses(count, seed=0, distance=0.8):
    rng = np.random.default_rng(seed)
    positions = np.column_stack([rng.uniform(-0.2, 0.2, (count, 2)), np.full(count, distance)])
    return make_transform(Rotation.random(count, rng=rng).as_matrix(), positions)


@pytest.mark.parametrize(("name", "expected"), OBJECTS.items())
def test_canonical_frame_is_found_from_the_description(name, expected):
    assert canonical_frame_of(load_object(name)).axis_rotation is expected


def test_axis_of_the_mug_is_the_axis_of_its_inner_wall():
    model = load_object("mug")
    canonical_frame = canonical_frame_of(model)
    assert np.allclose(canonical_frame.T_object_axis[:3, 2], [0, 0, 1])
    # The body is as wide as it is deep, and the handle sticks out towards +y only.
    low, high = model.mesh.bounds
    radius = (high[0] - low[0]) / 2
    assert np.allclose(canonical_frame.T_object_axis[:2, 3], [low[0] + radius, low[1] + radius], atol=2e-4)
    handle = np.asarray(model.mesh.vertices)[model.feature_mask("handle", np.asarray(model.mesh.vertices))].mean(axis=0)
    towards = (handle - canonical_frame.T_object_axis[:3, 3])[:2]
    assert canonical_frame.T_object_axis[:2, 0] @ towards / np.linalg.norm(towards) > 0.999


@pytest.mark.parametrize("name", OBJECTS)
def test_a_frame_that_faces_the_camera_sees_it_in_its_xz_half_plane(name):
    canonical_frame, poses = canonical_frame_of(load_object(name)), random_poses(50)
    canonical = facing_camera(canonical_frame.axis_pose(poses))
    eye = invert(canonical)[:, :3, 3]
    assert np.allclose(eye[:, 1], 0, atol=1e-9)
    assert (eye[:, 0] > 0).all()
    assert np.allclose(canonical[:, :3, 2], canonical_frame.axis_pose(poses)[:, :3, 2])


def test_a_frame_that_faces_the_camera_forgets_the_turn_of_a_cup():
    canonical_frame, poses = canonical_frame_of(load_object("coffee_cup")), random_poses(20)
    turned = poses @ rotation_about_z(np.linspace(0, 6, 20))
    ours, theirs = (facing_camera(canonical_frame.axis_pose(each)) for each in (poses, turned))
    assert np.allclose(ours, theirs)


@pytest.mark.parametrize("name", OBJECTS)
def test_axis_pose_and_object_pose_are_inverse(name):
    canonical_frame, poses = canonical_frame_of(load_object(name)), random_poses(5)
    assert np.allclose(canonical_frame.object_pose(canonical_frame.axis_pose(poses)), poses)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_ray_rotation_is_the_shortest_turn(seed):
    direction = np.random.default_rng(seed).normal(size=(4, 3))
    direction[:, 2] = np.abs(direction[:, 2]) + 0.1
    unit = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    R = ray_rotation(direction)
    for i in range(4):
        axis = np.cross([0, 0, 1], unit[i])
        angle = np.arctan2(np.linalg.norm(axis), unit[i, 2])
        expected = Rotation.from_rotvec(axis / max(np.linalg.norm(axis), 1e-12) * angle).as_matrix()
        assert np.allclose(R[i], expected, atol=1e-5)


def test_pooled_depth_stays_on_the_nearest_surface():
    depth = np.array([[1.0, 1.002, 2.0, np.nan], [1.5, np.nan, 2.01, 2.0]], np.float32)
    pooled = pool_depth(depth, 2)
    assert pooled[0, 0] == pytest.approx((1.0 + 1.002) / 2)
    assert pooled[0, 1] == pytest.approx((2.0 + 2.01 + 2.0) / 3)
    assert np.isnan(pool_depth(np.full((4, 4), np.nan, np.float32), 2)).all()


def test_input_is_translation_free_and_sized_by_distance():
    camera = PinholeCamera.from_field_of_view(640, 480, 60.0)
    color = np.full((480, 640, 3), 128, np.uint8)
    inputs = []
    for distance in (0.6, 1.2):
        view = reduce_view(View(0, color, np.full((480, 640), distance, np.float32), camera, np.eye(4)))
        inputs.append(network_input(view, 0.14))
    assert inputs[0].shape == (CHANNELS, 240, 320)
    assert np.isfinite(inputs[0]).all()
    # A plane across the camera: level against its surroundings, its normal against each ray.
    assert np.abs(inputs[0][6:8]).max() < 1e-5
    centre = inputs[0][3:6, 120, 160]
    assert np.allclose(centre, [0, 0, -1], atol=0.01)
    rays = pixel_rays(view.camera)
    cosine = 1 / np.linalg.norm(rays, axis=-1)
    assert np.allclose(-inputs[0][5, 5:-5, 5:-5], cosine[5:-5, 5:-5], atol=1e-3)
    assert np.allclose(inputs[0][9] / inputs[1][9], 2.0, rtol=1e-5)
    assert pad(inputs[0][:, :-3, :-5]).shape == inputs[0].shape


def test_view_without_depth_gives_a_finite_input():
    view = View(
        0, np.zeros((480, 640, 3), np.uint8), np.full((480, 640), np.nan, np.float32), DEFAULT_CAMERA, np.eye(4)
    )
    assert np.isfinite(network_input(reduce_view(view), 0.14)).all()


def test_odd_sizes_are_cut_alike():
    camera = PinholeCamera(645, 483, 500, 500, 320, 240)
    view = reduce_view(View(0, np.zeros((483, 645, 3), np.uint8), np.ones((483, 645), np.float32), camera, np.eye(4)))
    assert view.color.shape[:2] == view.depth.shape == (view.camera.height, view.camera.width) == (241, 322)
    assert (output_camera(view.camera).height, output_camera(view.camera).width) == (120, 161)
    # The ray through a reduced pixel is the mean of those that it came from.
    assert np.allclose(pixel_rays(view.camera)[7, 9], pixel_rays(camera)[14:16, 18:20].mean(axis=(0, 1)), atol=1e-6)


def test_sphere_bins_are_even_and_keep_directions():
    nearest = np.sort(np.arccos(np.clip(CENTRES @ CENTRES.T, -1, 1)), axis=1)[:, 1]
    assert len(CENTRES) == DIRECTION_BINS
    assert nearest.min() > 0.6 * np.sqrt(4 * np.pi / DIRECTION_BINS)
    directions = Rotation.random(100, rng=np.random.default_rng(0)).as_matrix()[:, 0]
    share = kernel(directions)
    assert np.allclose(share.sum(axis=1), 1, atol=1e-6)
    mean = share @ CENTRES
    assert (np.einsum("ni,ni->n", mean / np.linalg.norm(mean, axis=1, keepdims=True), directions) > np.cos(0.12)).all()
    grid = np.broadcast_to(directions, (100, 100, 3))
    found = directions[density(share, grid).argmax(axis=1)]
    assert np.einsum("ni,ni->n", found, directions).min() > np.cos(0.3)


def test_split_takes_every_channel_once():
    answer = np.arange(sum(HEADS.values()))[None]
    assert np.concatenate(list(split(answer).values()), axis=1).tolist() == answer.tolist()


def test_fused_network_answers_alike():
    torch.manual_seed(0)
    network = DenseNetwork(NetworkSize((4, 6, 8, 10), 6)).train()
    inputs = torch.randn(2, CHANNELS, 32, 48)
    for _ in range(3):
        network(inputs)  # fills the running means
    merged = fused(network)
    assert not any(isinstance(module, torch.nn.BatchNorm2d) for module in merged.modules())
    with torch.inference_mode():
        assert torch.allclose(network.eval()(inputs), merged(inputs), atol=1e-4)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_clusters_of_votes_are_the_objects(seed):
    rng = np.random.default_rng(seed)
    diameter = 0.14
    grid = np.stack(np.meshgrid(*[np.arange(3)] * 3), axis=-1).reshape(-1, 3) * 0.5 * diameter
    centres = grid[rng.permutation(27)[: rng.integers(1, 20)]]
    owner = np.repeat(np.arange(len(centres)), rng.integers(30, 300, len(centres)))
    votes = centres[owner] + 0.004 * rng.normal(size=(len(owner), 3))
    stray = rng.uniform(-1, 1, (20, 3))
    clusters = cluster_votes(np.concatenate([votes, stray]), np.ones(len(owner) + 20), diameter)
    assert len(clusters.centre) == len(centres)
    distance = np.linalg.norm(clusters.centre[:, None] - centres, axis=-1)
    matched = distance.argmin(axis=0)
    # The mean of n votes is off by 4 mm over the root of n in each direction; six times that is beyond chance.
    assert (distance.min(axis=0) < 6 * 0.004 / np.sqrt(np.bincount(owner))).all()
    assert (clusters.label[: len(owner)] == matched[owner]).mean() > 0.99


def test_no_votes_no_clusters():
    clusters = cluster_votes(np.zeros((3, 3)), np.ones(3), 0.14)
    assert len(clusters.centre) == 0
    assert (clusters.label == -1).all()


def test_votes_that_agree_on_nothing_cost_little():
    votes = np.random.default_rng(0).uniform(-2, 2, (20_000, 3))
    started = time.process_time()
    cluster_votes(votes, np.ones(len(votes)), 0.14)
    assert time.process_time() - started < 5


def mug_alone(T_camera_mug, camera=PinholeCamera.from_field_of_view(320, 240, 60.0), wall=None):
    """Ray-cast depth of a mug alone before a wall 1.5 m away; also beside or behind another mesh."""
    scene = o3d.t.geometry.RaycastingScene()
    placed = [(load_object("mug").mesh, T_camera_mug)] + ([(wall, np.eye(4))] if wall is not None else [])
    for mesh, T in placed:
        scene.add_triangles(transform_points(T, np.asarray(mesh.vertices)).astype(np.float32), np.uint32(mesh.faces))
    rays = np.concatenate([np.zeros((240, 320, 3), np.float32), pixel_rays(camera)], axis=-1)
    hit = scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()
    return np.minimum(hit, 1.5).astype(np.float32), camera


def axis_rotation_likelihood(T_camera_axis, depth, camera, owner=None):
    model = load_object("mug")
    points = backproject(depth, camera)
    owner = np.where(depth < 1.5, 0, -1) if owner is None else owner
    normals, detail = normals_from_points(points, reach=1), measure_image(depth, camera)
    surface = MeasuredSurface(depth, points, normals, owner, camera, detail, owner.max() + 1)
    return AxisRotationSearch(model, canonical_frame_of(model)).log_likelihood(T_camera_axis[None], surface)[0]


def upright_mug(azimuth, elevation=35.0):
    """Pose of a mug's axis frame at 0.8 m whose handle points ``azimuth`` degrees away from the camera's side."""
    a, e = np.radians([azimuth, elevation])
    eye = 0.8 * np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
    return invert(look_at(eye, np.zeros(3)))


@pytest.mark.parametrize("azimuth", [0, 50, 90, 135, -60, -110])
def test_turn_search_finds_a_visible_handle(azimuth):
    canonical_frame = canonical_frame_of(load_object("mug"))
    T_camera_axis = upright_mug(azimuth)
    depth, camera = mug_alone(canonical_frame.object_pose(T_camera_axis[None])[0])
    # The search is told the pose with its turn forgotten.
    forgotten = np.random.default_rng(azimuth % 7).uniform(0, 2 * np.pi)
    found = axis_rotation_likelihood(T_camera_axis @ rotation_about_z(forgotten), depth, camera)
    error = (AXIS_ANGLES[found.argmax()] + forgotten + np.pi) % (2 * np.pi) - np.pi
    assert np.degrees(abs(error)) < 10
    turns, certainty = likely_axis_rotations(softmax(found)[None], 1)
    assert turns[0, 0] == found.argmax()
    assert certainty[0, 0] > 0.99


def test_turn_search_tells_that_a_handle_is_hidden():
    canonical_frame = canonical_frame_of(load_object("mug"))
    T_camera_axis = upright_mug(180, elevation=5.0)
    depth, camera = mug_alone(canonical_frame.object_pose(T_camera_axis[None])[0])
    probability = softmax(axis_rotation_likelihood(T_camera_axis, depth, camera))
    # It is behind the mug, and where behind is anybody's guess.
    behind = np.abs((AXIS_ANGLES + np.pi) % (2 * np.pi) - np.pi) < np.radians(50)
    assert probability[behind].sum() > 0.9
    assert probability.max() < 0.25


def test_a_handle_may_be_behind_what_hides_it_and_not_where_the_camera_looked_through():
    canonical_frame = canonical_frame_of(load_object("mug"))
    T_camera_axis = upright_mug(90)
    box = trimesh.creation.box((0.05, 0.2, 0.01))
    uncovered, camera = mug_alone(canonical_frame.object_pose(T_camera_axis[None])[0])
    x = (T_camera_axis @ [0.06, 0, 0, 1])[0]
    box.apply_translation([np.sign(x) * 0.07 * 0.6 / 0.8, 0, 0.6])
    covered, _ = mug_alone(canonical_frame.object_pose(T_camera_axis[None])[0], wall=box)
    owner = np.where(np.abs(covered - uncovered) < 1e-4, 0, -1)
    probability = softmax(axis_rotation_likelihood(T_camera_axis, covered, camera, owner))
    _, certainty = likely_axis_rotations(probability[None], 1)
    true_side = np.abs((AXIS_ANGLES + np.pi) % (2 * np.pi) - np.pi) < np.radians(40)
    other_side = np.abs(AXIS_ANGLES - np.pi) < np.radians(40)
    assert certainty[0, 0] < 0.8
    assert probability[true_side].sum() > 30 * probability[other_side].sum()


def test_a_network_with_the_wrong_owner_does_not_hide_the_handle():
    # All pixels off the body went to a neighbour; they are still nobody else's body.
    model, canonical_frame = load_object("mug"), canonical_frame_of(load_object("mug"))
    T_camera_axis = upright_mug(90)
    depth, camera = mug_alone(canonical_frame.object_pose(T_camera_axis[None])[0])
    points = backproject(depth, camera)
    local = transform_points(invert(T_camera_axis), points)
    handle = (depth < 1.5) & (np.hypot(local[..., 0], local[..., 1]) > 0.046)
    assert handle.sum() > 40
    owner = np.where(handle, 1, np.where(depth < 1.5, 0, -1))
    normals, detail = normals_from_points(points, reach=1), measure_image(depth, camera)
    surface = MeasuredSurface(depth, points, normals, owner, camera, detail, owner.max() + 1)
    elsewhere = T_camera_axis.copy()
    elsewhere[0, 3] += 0.3
    found = AxisRotationSearch(model, canonical_frame).log_likelihood(np.stack([T_camera_axis, elsewhere]), surface)[0]
    assert np.degrees(abs((AXIS_ANGLES[found.argmax()] + np.pi) % (2 * np.pi) - np.pi)) < 10
    assert likely_axis_rotations(softmax(found)[None], 1)[1] > 0.9


def test_turns_of_many_mugs_are_those_of_each_alone():
    model, canonical_frame = load_object("mug"), canonical_frame_of(load_object("mug"))
    T_camera_axis = np.stack([upright_mug(90), upright_mug(-60) @ rotation_about_z(1.0)])
    depth, camera = mug_alone(canonical_frame.object_pose(T_camera_axis[:1])[0])
    points = backproject(depth, camera)
    owner = np.where(depth < 1.5, 0, -1)
    normals, detail = normals_from_points(points, reach=1), measure_image(depth, camera)
    surface = MeasuredSurface(depth, points, normals, owner, camera, detail, owner.max() + 1)
    search = AxisRotationSearch(model, canonical_frame)
    together = search.log_likelihood(T_camera_axis, surface)
    assert np.allclose(together[0], search.log_likelihood(T_camera_axis[:1], surface)[0])
    # Starting from another turn shifts the answer and changes nothing else.
    step = 2 * np.pi / len(AXIS_ANGLES)
    shifted = search.log_likelihood(T_camera_axis[:1] @ rotation_about_z(7 * step), surface)[0]
    assert np.allclose(np.roll(shifted, 7), together[0], atol=1.5)


def test_likely_turns_lie_apart():
    probability = np.exp(-(np.minimum(AXIS_ANGLES, 2 * np.pi - AXIS_ANGLES) ** 2) * 20)
    probability += 0.5 * np.roll(probability, 30)
    turns, certainty = likely_axis_rotations((probability / probability.sum())[None], 2)
    assert turns.tolist() == [[0, 30]]
    assert np.allclose(certainty, [[2 / 3, 1 / 3]], atol=0.02)


def test_backprojection_of_the_output_camera_hits_the_same_points():
    depth = np.ones((240, 320), np.float32)
    camera = DEFAULT_CAMERA.scaled(0.5)
    coarse = backproject(pool_depth(depth, 2), output_camera(camera))
    fine = backproject(depth, camera)
    assert np.allclose(coarse[3, 5], fine[6:8, 10:12].mean(axis=(0, 1)), atol=1e-6)
