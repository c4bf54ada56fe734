"""Compiled loops against plain ones, and when they are compiled."""

import numba
import numpy as np
import pytest

from active6d_core.camera import DEFAULT_CAMERA, PinholeCamera
from active6d_core.hypotheses import Hypotheses
from active6d_core.object_model import load_object
from active6d_core.view_sphere import ViewSphere
from active6d_perception.compiled import compiled
from active6d_perception.model import model_views
from active6d_perception.scene import (
    all_views_fusion,
    best_view_fusion,
    body_refinement,
    camera_alignment,
    feasibility,
    measured_cases,
    measured_view,
    pose_lattice,
    verification,
)
from active6d_perception.scene import expected_visibility as visibility
from active6d_perception.scene import observed_surface as surface

ALL_VIEWS = (body_refinement, camera_alignment, feasibility, measured_cases, measured_view, pose_lattice)
MODULES = (best_view_fusion, model_views, surface, verification, visibility, *ALL_VIEWS)


def versions():
    """Number of argument types that each compiled function was compiled for."""
    functions = {name: each for module in MODULES for name, each in vars(module).items()}
    return {
        name: len(each.signatures)
        for name, each in functions.items()
        if isinstance(each, numba.core.dispatcher.Dispatcher)
    }


def test_no_view_waits_for_the_compiler(render, pose):
    """Neither the first one nor one with read-only images."""
    model = load_object("mug")
    verifier, scene = verification.Verifier(model), surface.ObservedSurface(model)
    visible = visibility.ExpectedVisibility(model)
    best, every = best_view_fusion.BestViewFusion(model), all_views_fusion.AllViewsFusion(model)
    compiled = versions()
    assert sum(compiled.values()) >= 8
    depth = render(model, pose(0))[0].copy()
    T_world_camera = ViewSphere().pose(ViewSphere().positions[3])
    for writable in (True, False):
        depth.flags.writeable = writable
        mask = np.isfinite(depth).astype(np.uint16)
        mask.flags.writeable = writable
        hypotheses = Hypotheses.from_masks(pose(0), np.ones(1), np.ones(1), mask, depth)
        assert verifier.score(depth, DEFAULT_CAMERA, hypotheses) > 0.9
        scene.add_view(1, depth, DEFAULT_CAMERA, T_world_camera)
        best.add_view(int(writable), T_world_camera, hypotheses, np.ones(1))
        assert len(best.objects(int(writable), T_world_camera, DEFAULT_CAMERA)) == 1
        every.add_view(int(writable), T_world_camera, hypotheses, np.ones(1), depth, DEFAULT_CAMERA)
        assert len(every.objects(int(writable), T_world_camera, DEFAULT_CAMERA)) == 1
        T_world_object = T_world_camera @ pose(0)
        scene.unexplained(T_world_object)
        for tray in (None, visibility.Tray.for_model(model)):
            visible.shares(T_world_object, ViewSphere().positions, tray, hiding=0)
    assert versions() == compiled


@pytest.mark.parametrize("bound", [0.002, 0.012, 0.05])
def test_the_nearest_visible_sample_is_found(bound):
    """Near the surface, around it, and far away, where none is within the bound."""
    views, rng = model_views.model_views(load_object("bunny")), np.random.default_rng(0)
    near = views.points[rng.integers(len(views.points), size=300)] + rng.normal(0, 0.004, (300, 3))
    points = np.concatenate([near, rng.uniform(-0.2, 0.2, (100, 3)), [[5.0, 0.0, 0.0]]])
    direction = rng.integers(len(views.directions), size=len(points))
    distance, found = views.nearest_visible(points, direction, bound)
    every = np.linalg.norm(points[:, None] - views.points, axis=-1)
    every[~views.visible[direction]] = np.inf
    reached = every.min(axis=1) < bound
    np.testing.assert_array_equal(found, np.where(reached, every.argmin(axis=1), -1))
    np.testing.assert_allclose(distance, np.where(reached, every.min(axis=1), np.inf), atol=1e-7)
    assert 0.05 < reached.mean() < 0.95


def test_cells_are_counted_as_a_histogram():
    """Points on all sides of the grid, on its faces, and missing ones."""
    rng, shape = np.random.default_rng(1), (5, 4, 3)
    along = rng.uniform(-1.5, 6.5, (3, 4000)).astype(np.float32)
    along[:, :50], along[0, 50:60] = np.nan, 0.0
    expected, _ = np.histogramdd(along.T[50:], [np.arange(count + 1) for count in shape])
    np.testing.assert_array_equal(surface._count(along, shape), expected.ravel())


def test_silhouettes_hide_what_lies_behind_them():
    """One object before another: every point of the outline looked up by itself, in double precision."""
    model = load_object("mug")
    visible, eyes = visibility.expected_visibility(model), ViewSphere().positions[::7]
    T = np.tile(np.eye(4), (2, 1, 1))
    T[1, :3, 3] = [0.03, -0.02, 0.12]
    stand = visible._stand(T, eyes.astype(np.float32))
    silhouettes = visible._silhouettes
    shares = []
    for view, eye in enumerate(eyes):
        towards = (eye - T[1, :3, 3]) / np.linalg.norm(eye - T[1, :3, 3])
        nearest = (visible._directions @ towards).argmax()
        right = visible._right[nearest] - visible._right[nearest] @ towards * towards
        right /= np.linalg.norm(right)
        frame = np.stack([right, np.cross(towards, right), towards])
        assert stand.nearest[1, view] == nearest
        axes = stand.right[0, view], stand.up[0, view], eye / np.linalg.norm(eye)
        points = visible._disc.T @ np.stack(axes)
        across, along, nearer = frame @ (points - T[1, :3, 3]).T
        distance = np.linalg.norm(eye - T[1, :3, 3])
        row, column = np.array([across, along]) * silhouettes.pixels_per_metre * distance / (distance - nearer) + 12
        inside = (row >= 0) & (row < 24) & (column >= 0) & (column < 24)
        pixel = np.where(inside, row.astype(int) * 24 + column.astype(int) + 1, 0)
        hidden = silhouettes.front[nearest, pixel] > nearer + silhouettes.clearance
        shares.append(1 - hidden.mean())
    np.testing.assert_allclose(visible.shares(T, eyes)[0], shares, atol=1e-12)
    assert min(shares) < 0.3
    assert max(shares) > 0.9


def test_what_is_not_a_number_is_nowhere():
    """Indices are not checked, so it must not become one."""
    bad = np.array([[np.nan, 0.0, 0.0], [0.0, np.inf, 0.0], [0.0, 0.0, -np.inf], [np.nan] * 3, [1e30, -1e30, 0.0]])
    model = load_object("mug")
    distance, found = model_views.model_views(model).nearest_visible(bad, np.zeros(len(bad), int), 0.01)
    assert np.isinf(distance).all()
    assert (found == -1).all()
    assert not surface._count(bad.T.astype(np.float32), (5, 4, 3)).any()
    assert not surface.explainer(model, 0.08).explains(bad, np.eye(4)[None]).any()
    nowhere = np.full((2, 4, 4), np.nan)
    assert visibility.expected_visibility(model).shares(nowhere, ViewSphere().positions).shape == (2, 100)
    depth = np.full((8, 8), 0.5, np.float32)
    mask = np.ones(depth.shape, np.uint16)
    lost = Hypotheses(nowhere, np.ones(2), np.full((2, 4), np.nan), np.ones(2), np.ones(2, np.uint16), mask)
    assert not verification.Verifier(model).score(depth, PinholeCamera(8, 8, 8.0, 8.0, 3.5, 3.5), lost).any()


def test_without_a_folder_for_the_cache_code_is_compiled_without(monkeypatch):
    original = numba.njit

    def njit(*, cache=False, **options):
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return original(**options)

    monkeypatch.setattr(numba, "njit", njit)
    assert compiled(lambda number: number + 1)(2) == 3
