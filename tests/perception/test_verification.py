"""Equation 1 against closed form and against a rendering of every hypothesis."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from active6d_core.camera import DEFAULT_CAMERA, backproject
from active6d_core.hypotheses import Hypotheses
from active6d_core.object_model import load_object
from active6d_core.se3 import make_transform
from active6d_perception.scene.verification import Verifier, local_fit, points_and_normals

EPSILON = 0.010


def whole_mask(T_camera_object, depth):
    """One hypothesis whose mask is every pixel with depth."""
    return Hypotheses.from_masks(T_camera_object, np.ones(1), np.ones(1), np.isfinite(depth).astype(np.uint16), depth)


@pytest.fixture(scope="module")
def slab():
    """A verifier whose object is a large plane z = 0 of the object's frame, facing its +z."""
    xy = np.stack(np.meshgrid(*[np.arange(-0.1, 0.1, 0.002)] * 2), axis=-1).reshape(-1, 2)
    points = np.column_stack([xy, np.zeros(len(xy))])
    tree = cKDTree(points)

    def nearest_visible(q, direction, bound):
        distance, found = tree.query(q, distance_upper_bound=bound)
        return distance, np.where(np.isfinite(distance), found, -1)

    views = SimpleNamespace(
        points=points,
        normals=np.tile([0.0, 0.0, 1.0], (len(points), 1)),
        spacing=0.0015,
        nearest_visible=nearest_visible,
        nearest_direction=lambda T: np.zeros(len(T), int),
    )
    verifier = Verifier(load_object("mug"), EPSILON)
    verifier.views = views
    return verifier


# The plane's +z faces the camera: the object frame is the optical frame turned half about x.
FACING = make_transform(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 0.5])


@pytest.mark.parametrize("offset", [-0.0095, -0.005, 0.0, 0.001, 0.004, 0.0099])
def test_plane_offset_has_the_closed_form(slab, offset):
    depth = np.full((480, 640), 0.5 + offset, np.float32)
    mask = np.zeros((480, 640), np.uint16)
    mask[200:280, 280:360] = 1
    hypotheses = Hypotheses.from_masks(FACING[None], np.ones(1), np.ones(1), mask, depth)
    expected = (1 - abs(offset) / EPSILON) / 2 + 1 / 2
    assert slab.score(depth, DEFAULT_CAMERA, hypotheses)[0] == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("offset", [0.0101, -0.02, 0.3])
def test_beyond_the_threshold_is_zero(slab, offset):
    depth = np.full((480, 640), 0.5 + offset, np.float32)
    assert slab.score(depth, DEFAULT_CAMERA, whole_mask(FACING[None], depth))[0] == 0.0


def test_the_mean_is_over_all_points_of_the_mask(slab):
    depth = np.full((480, 640), 0.5, np.float32)
    depth[:, 320:] = 0.7
    mask = np.zeros((480, 640), np.uint16)
    mask[200:280, 300:340] = 1
    hypotheses = Hypotheses.from_masks(FACING[None], np.ones(1), np.ones(1), mask, depth)
    assert slab.score(depth, DEFAULT_CAMERA, hypotheses)[0] == pytest.approx(0.5, abs=0.02)


def test_flipped_normals_cancel_the_distance_term(slab):
    points = np.array([[0.01, 0.02, 0.5]])
    for normal, expected in (([0.0, 0.0, -1.0], 1.0), ([0.0, 0.0, 1.0], 0.0), ([0.0, 0.0, 0.0], 0.5)):
        assert slab.fits(points, np.array([normal]), FACING[None], np.zeros(1, int))[0] == pytest.approx(
            expected, abs=1e-9
        )


def test_local_fit_is_equation_1():
    rng = np.random.default_rng(0)
    distance, product = rng.uniform(0, 0.02, 500), rng.uniform(-1, 1, 500)
    expected = [
        0.5 * (1 - d / EPSILON) + 0.5 * n if d < EPSILON else 0.0 for d, n in zip(distance, product, strict=True)
    ]
    np.testing.assert_allclose(local_fit(distance, product, EPSILON), expected, atol=1e-12)


@pytest.mark.parametrize("name", ["coffee_cup", "bunny", "mug"])
def test_agrees_with_a_true_rendering(name, render, pose):
    """p among the pixels of a three times finer rendering of each hypothesis, instead of the precomputed views."""
    model = load_object(name)
    verifier = Verifier(model, EPSILON, samples=256)
    fine = DEFAULT_CAMERA.scaled(3)
    rng = np.random.default_rng(1)
    for seed in range(2):
        true = pose(seed)
        depth, _ = render(model, true)
        hypotheses = whole_mask(true, depth)
        pixels, _ = verifier.mask_pixels(depth, hypotheses)
        q, n_q = points_and_normals(depth, DEFAULT_CAMERA, pixels, verifier.reach)
        turn = make_transform(Rotation.from_rotvec(rng.normal(0, 0.1, 3)).as_matrix(), rng.normal(0, 0.003, 3))
        for guess in (true, true @ turn):
            moved = whole_mask(guess, depth)
            model_depth, model_normals = render(model, guess, fine)
            seen = np.isfinite(model_depth)
            distance, nearest = cKDTree(backproject(model_depth, fine)[seen]).query(q)
            product = np.einsum("ni,ni->n", model_normals[seen][nearest], n_q)
            expected = local_fit(distance, product, EPSILON).mean()
            assert verifier.score(depth, DEFAULT_CAMERA, moved)[0] == pytest.approx(expected, abs=0.02)


def score_one(verifier, depth, hypotheses, index):
    """Equation 1 of one hypothesis, point by point, every visible sample tried; with the documented disc per sample."""
    views, epsilon = verifier.views, verifier.epsilon
    T = hypotheses.T_camera_object[index]
    inside = np.flatnonzero((hypotheses.segmentation == hypotheses.label[index]) & np.isfinite(depth))
    if len(inside) > verifier.samples:
        inside = inside[[i * (len(inside) - 1) // (verifier.samples - 1) for i in range(verifier.samples)]]
    if not len(inside):
        return 0.0
    q, n_q = points_and_normals(depth, DEFAULT_CAMERA, inside, verifier.reach)
    visible = np.flatnonzero(views.visible[np.argmax(views.directions @ (-T[:3, :3].T @ T[:3, 3]))])
    p, n_p = views.points[visible] @ T[:3, :3].T + T[:3, 3], views.normals[visible] @ T[:3, :3].T
    fits = []
    for point, normal in zip(q, n_q, strict=True):
        nearest = np.linalg.norm(p - point, axis=1).argmin()
        offset = point - p[nearest]
        off_plane = offset @ n_p[nearest]
        beside = np.linalg.norm(offset - off_plane * n_p[nearest])
        distance = np.hypot(off_plane, max(beside - views.spacing, 0.0))
        fits.append(0.5 * (1 - distance / epsilon) + 0.5 * n_p[nearest] @ normal if distance < epsilon else 0.0)
    return np.mean(fits)


@pytest.mark.parametrize("name", ["coffee_cup", "bunny", "mug"])
def test_all_at_once_is_one_by_one(name, render, pose):
    """Hypotheses near and far, masks large, small, shared, empty of depth: as if each were verified alone."""
    model, rng = load_object(name), np.random.default_rng(4)
    verifier = Verifier(model, EPSILON, samples=64)
    depth, _ = render(model, pose(0))
    depth = depth + rng.normal(0.0, 0.001, depth.shape).astype(np.float32)
    rows, columns = np.nonzero(np.isfinite(depth))
    mask = np.zeros(depth.shape, np.uint16)
    mask[rows, columns] = 1 + (columns > np.median(columns))
    mask[rows[:40], columns[:40]] = 3
    mask[:5, :5] = 4
    label = np.array([1, 2, 3, 4, 1, 2, 3, 1, 2])
    turns = Rotation.from_rotvec(rng.normal(0, 0.2, (len(label), 3))).as_matrix()
    off = make_transform(turns, rng.normal(0, [0.006], (len(label), 3)))
    off[-2:, :3, 3] += 0.5
    hypotheses = Hypotheses.from_masks(pose(0) @ off, np.ones(len(label)), label, mask, depth)
    scores = verifier.score(depth, DEFAULT_CAMERA, hypotheses)
    expected = [score_one(verifier, depth, hypotheses, index) for index in range(len(label))]
    np.testing.assert_allclose(scores, expected, atol=1e-6)
    assert scores[[3, 7, 8]].tolist() == [0.0, 0.0, 0.0]
    assert (scores[[0, 1, 4, 5]] > 0.1).all()


def test_scene_normals_do_not_reach_across_an_edge():
    depth = np.full((480, 640), 0.6, np.float32)
    depth[:, 320:] = 0.9
    pixels = 240 * 640 + np.arange(310, 330)
    _, normals = points_and_normals(depth, DEFAULT_CAMERA, pixels, 3)
    np.testing.assert_allclose(normals, np.tile([0, 0, -1], (20, 1)), atol=1e-6)


def test_missing_depth(render, pose):
    model = load_object("mug")
    depth, _ = render(model, pose(0))
    hypotheses = whole_mask(pose(0), depth)
    verifier = Verifier(model)
    assert verifier.score(depth, DEFAULT_CAMERA, hypotheses)[0] > 0.9
    assert verifier.score(np.full_like(depth, np.nan), DEFAULT_CAMERA, hypotheses)[0] == 0.0
    with pytest.raises(ValueError, match="depth image is"):
        verifier.score(depth[:-1], DEFAULT_CAMERA, hypotheses)
    with pytest.raises(ValueError, match="epsilon must be positive"):
        Verifier(model, epsilon=0.0)
