"""Votes of point pairs against a count by array operations, and poses from the votes of an object's own points."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from active6d_core.metrics import add_s, e_add
from active6d_core.object_model import load_object
from active6d_core.se3 import make_transform, transform_points
from active6d_perception.estimators.geometric import pair_voting
from active6d_perception.estimators.geometric.pair_voting import PairVoting


def seen_points(model, T, count, rng):
    """Points of the model in the camera's frame, and their normals, of the side that faces the camera."""
    points, normals = model.surface
    points, normals = transform_points(T, points), normals @ T[:3, :3].T
    facing = np.flatnonzero((points * normals).sum(axis=1) < 0)
    chosen = rng.choice(facing, count, replace=False)
    return points[chosen], normals[chosen]


def counted_votes(voting, points, normals, reference):
    """(references of the model, bins) votes for one reference point."""
    table, diameter = voting._table, voting._table.diameter
    d = points - points[reference]
    length = np.linalg.norm(d, axis=1)
    kept = (length > 0.05 * diameter) & (length < diameter)
    d, length, n2, q = d[kept] / length[kept, None], length[kept], normals[kept], points[kept]
    n1 = normals[reference]
    feature = (length * (20 / diameter)).astype(int)
    for cosine in (d @ n1, (d * n2).sum(axis=1), n2 @ n1):
        feature = feature * 15 + np.minimum((np.arccos(np.clip(cosine, -1, 1)) * (15 / np.pi)).astype(int), 14)
    frame = pair_voting._frames(points[reference][None], n1[None])[0]
    local = transform_points(frame, q)
    rotation = np.arctan2(local[:, 2], local[:, 1])
    votes = np.zeros((table.references, 30))
    for each, angle in zip(feature, rotation, strict=True):
        match = slice(table.starts[each], table.starts[each + 1])
        turn = np.floor((angle - table.rotation[match]) * (30 / (2 * np.pi))).astype(int) % 30
        np.add.at(votes, (table.reference[match], turn), 1)
    return votes


def test_the_most_voted_cells_are_those_of_a_plain_count():
    model, rng = load_object("mug"), np.random.default_rng(0)
    voting = PairVoting(model)
    T = make_transform(Rotation.random(rng=rng).as_matrix(), np.array([0.02, -0.03, 0.7]))
    points, normals = seen_points(model, T, 150, rng)
    references = np.array([0, 40, 90])
    frames = pair_voting._frames(points[references], normals[references])
    best = pair_voting._vote(points, normals, references, frames, voting._table, 3)
    for reference, cells in zip(references, best, strict=True):
        votes = counted_votes(voting, points, normals, reference)
        smooth = (votes + 0.5 * (np.roll(votes, 1, axis=1) + np.roll(votes, -1, axis=1))).ravel()
        assert smooth[cells] == pytest.approx(np.sort(smooth)[::-1][:3])
        assert len(set(cells)) == 3


@pytest.mark.parametrize(("name", "error"), [("bunny", e_add), ("coffee_cup", e_add), ("mug", add_s)])
def test_votes_propose_the_pose_of_an_object(name, error):
    model, rng = load_object(name), np.random.default_rng(1)
    T = make_transform(Rotation.random(rng=rng).as_matrix(), np.array([0.05, 0.0, 0.6]))
    points, normals = seen_points(model, T, 300, rng)
    poses = PairVoting(model).candidates(points, normals, np.arange(0, 300, 10), peaks=3)
    assert len(poses) == 90
    assert min(error(model, pose, T) for pose in poses) < 0.15 * model.diameter
