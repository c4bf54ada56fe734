"""The tables: boxes and depths measured from masks against a loop over labels."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from active6d_core.hypotheses import Hypotheses, SceneObjects


@given(seed=st.integers(0, 2**32 - 1), labels=st.integers(0, 6))
def test_from_masks_measures_boxes_and_depths(seed, labels):
    rng = np.random.default_rng(seed)
    height, width = 17, 23
    segmentation = rng.integers(0, labels + 1, (height, width)).astype(np.uint16)
    depth = rng.uniform(0.5, 1.0, (height, width)).astype(np.float32)
    depth[rng.random((height, width)) < 0.3] = np.nan
    present = np.setdiff1d(np.unique(segmentation), [0])
    label = rng.permutation(np.repeat(present, 2))
    T = np.tile(np.eye(4), (len(label), 1, 1))
    table = Hypotheses.from_masks(T, rng.random(len(label)), label, segmentation, depth)
    assert len(table) == len(label)
    for i, name in enumerate(label):
        rows, columns = np.nonzero(segmentation == name)
        expected = [columns.min() / width, rows.min() / height, (columns.max() + 1) / width, (rows.max() + 1) / height]
        np.testing.assert_allclose(table.box[i], expected)
        inside = depth[segmentation == name]
        expected_depth = np.nanmean(inside) if np.isfinite(inside).any() else T[i, 2, 3]
        assert table.depth[i] == pytest.approx(expected_depth, rel=1e-5)


def test_a_mask_without_depth_gets_the_poses_depth():
    T = np.eye(4)[None].copy()
    T[0, 2, 3] = 0.7
    table = Hypotheses.from_masks(T, [1.0], [3], np.full((2, 2), 3, np.uint16), np.full((2, 2), np.nan))
    assert table.depth[0] == 0.7
    np.testing.assert_array_equal(table.box[0], [0, 0, 1, 1])


def test_a_label_without_pixels_is_refused():
    segmentation = np.full((2, 2), 1, np.uint16)
    for label in (2, 9):
        with pytest.raises(ValueError, match="no pixel"):
            Hypotheses.from_masks(np.eye(4)[None], [1.0], [label], segmentation, np.ones((2, 2)))


def test_shapes_are_checked():
    with pytest.raises(ValueError, match=r"box has shape \(1, 3\), expected \(1, 4\)"):
        Hypotheses(
            np.zeros((1, 4, 4)), np.zeros(1), np.zeros((1, 3)), np.zeros(1), np.ones(1, np.uint16), np.zeros((2, 2))
        )
    with pytest.raises(ValueError, match="segmentation"):
        Hypotheses(np.zeros((1, 4, 4)), np.zeros(1), np.zeros((1, 4)), np.zeros(1), np.ones(1, np.uint16), np.zeros(2))
    with pytest.raises(ValueError, match="spread has shape"):
        SceneObjects(
            np.zeros((1, 4, 4)),
            np.zeros(1),
            np.zeros(1),
            np.zeros((1, 4)),
            np.zeros(1),
            np.zeros(1),
            np.zeros(2),
            np.zeros(1),
            np.zeros(1),
        )


def test_nothing_seen():
    nothing = Hypotheses.empty(4, 6)
    assert len(nothing) == 0
    assert nothing.segmentation.shape == (4, 6)
    assert len(SceneObjects.empty()) == 0
    assert SceneObjects.empty().features().shape == (0, 6)


def scene_objects(n):
    rng = np.random.default_rng(0)
    return SceneObjects(
        rng.random((n, 4, 4)),
        rng.random(n),
        rng.random(n),
        rng.random((n, 4)),
        rng.random(n),
        np.arange(n),
        rng.random(n),
        rng.random(n),
        rng.random(n),
    )


def test_features_are_box_depth_and_verification():
    """The tuple (b, d, c) of "Objects feature representation"."""
    objects = scene_objects(3)
    features = objects.features()
    np.testing.assert_array_equal(features[:, :4], objects.box)
    np.testing.assert_array_equal(features[:, 4], objects.depth)
    np.testing.assert_array_equal(features[:, 5], objects.verification)


@pytest.mark.parametrize("index", [np.array([2, 0]), np.array([True, False, True, False]), slice(1, 3)])
def test_take_selects_every_column(index):
    objects = scene_objects(4)
    taken = objects.take(index)
    for name in ("T_world_object", "verification", "score", "box", "depth", "support", "spread"):
        np.testing.assert_array_equal(getattr(taken, name), getattr(objects, name)[index])
