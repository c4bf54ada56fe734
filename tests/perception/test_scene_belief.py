"""Belief over what is ambiguous: cases, solids, feasibility and probabilities against independent calculations."""

import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hand_made_scenes import make_model
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.numpy import load_file, save_file
from scipy.spatial.transform import Rotation
from scipy.special import expit, logsumexp

from active6d_core.camera import PinholeCamera
from active6d_core.hypotheses import Hypotheses
from active6d_core.object_model import load_object
from active6d_core.se3 import invert, make_transform, transform_points
from active6d_perception.model.ambiguity import ambiguity_of
from active6d_perception.model.solid import signed_distances, solid_of
from active6d_perception.model.visible_samples import VisibleSamples
from active6d_perception.scene import measured_cases as cases
from active6d_perception.scene.belief_training import LabelledPlaces, fit_belief, fit_probability
from active6d_perception.scene.belief_weights import BeliefWeights, Scorer, belief_path, load_belief
from active6d_perception.scene.expected_visibility import OPEN_TABLE, Tray
from active6d_perception.scene.feasibility import FREE, against_container, against_neighbour
from active6d_perception.scene.measured_view import NORMAL, MeasuredView, measure_view
from active6d_perception.scene.object_probability import OBJECT_COLUMNS
from active6d_perception.scene.rotation_belief import decide, posterior
from active6d_perception.scene.scene_evidence import BODY_COLUMNS, ROTATION_COLUMNS

CAMERA = PinholeCamera(320, 240, 277.0, 277.0, 159.5, 119.5)
IDENTITY = np.eye(4)[None]


def flat_view(behind: float, normal=(0.0, 0.0, -1.0), own=True) -> MeasuredView:
    """A wall 0.5 m away plus ``behind``, of one instance whose middle is there."""
    depth = np.full((240, 320), 0.5 + behind, np.float32)
    normals = np.broadcast_to(np.array(normal) * NORMAL, (240, 320, 3)).astype(np.int8)
    middles = np.array([[0.0, 0.0, 0.5 if own else 3.0]])
    return MeasuredView(depth, normals, np.zeros((240, 320), np.int16), middles, np.eye(4), 277.0, 277.0, 159.5, 119.5)


#: One square centimetre that faces the camera at 0.5 m.
PATCH = VisibleSamples(
    np.zeros((1, 3), np.float32),
    np.array([[0.0, 0.0, -1.0]], np.float32),
    np.zeros((1, 1), np.int64),
    np.ones(1, np.int64),
    np.full(1, 1e-4, np.float32),
    np.zeros((2, 2), np.int64),
)
AHEAD = make_transform(np.eye(3), [0.0, 0.0, 0.5])[None]


def count(view, T=AHEAD, rotations=IDENTITY):
    counted = cases.count_cases(T, rotations, np.zeros(3), 0.05, PATCH, view, 1.0)
    return counted.reshape(len(T), len(rotations), cases.WHAT, cases.WHOSE)


@pytest.mark.parametrize(
    ("view", "what", "whose"),
    [
        (flat_view(0.02), cases.LOOKED_THROUGH, 0),
        (flat_view(0.008), cases.LITTLE_BEHIND, 0),
        (flat_view(0.0), cases.FITTING, 0),
        (flat_view(0.0, own=False), cases.FITTING, 1),
        (flat_view(0.0, normal=(1.0, 0.0, 0.0)), cases.FACING_ELSEWHERE, 0),
        (flat_view(0.0, normal=(0.0, 0.0, 0.0)), cases.FACING_ELSEWHERE, 0),
        (flat_view(-0.008), cases.LITTLE_BEFORE, 0),
        (flat_view(-0.02), cases.HIDDEN, 0),
        (flat_view(np.nan), cases.NOT_MEASURED, 0),
        (flat_view(0.0)._replace(instance=np.full((240, 320), -1, np.int16)), cases.FITTING, 2),
    ],
)
def test_a_pixel_has_its_case(view, what, whose):
    counted = count(view)[0, 0]
    # A square centimetre at half a metre covers (277 * 0.01 / 0.5) squared pixels.
    assert counted[what, whose] == pytest.approx(cases.PER_PIXEL * (277 * 0.01 / 0.5) ** 2, abs=1)
    assert counted.sum() == counted[what, whose]


def test_surface_at_a_slant_covers_fewer_pixels_and_outside_of_the_image_none_is_measured():
    tilted = make_transform(Rotation.from_euler("y", 60, degrees=True).as_matrix(), np.zeros(3))[None]
    straight, slanted = count(flat_view(0.0))[0, 0], count(flat_view(0.0), rotations=tilted)[0, 0]
    assert slanted.sum() == pytest.approx(straight.sum() / 2, abs=1)
    outside = AHEAD.copy()
    outside[0, 0, 3] = 1.0
    assert count(flat_view(0.0), T=outside)[0, 0, cases.NOT_MEASURED, 2] > 0
    behind = AHEAD.copy()
    behind[0, 2, 3] = -0.5
    assert count(flat_view(0.0), T=behind).sum() == 0


def test_a_handle_fits_where_it_is_and_is_looked_through_elsewhere(render):
    """A mug seen from above: the handle's pixels fit at its rotation, and at opposite ones there is nothing."""
    mug = load_object("mug")
    ambiguity = ambiguity_of(mug)
    T = make_transform(Rotation.from_euler("x", 160, degrees=True).as_matrix(), [0.0, 0.0, 0.6])
    depth, _ = render(mug, T[None], CAMERA)
    floor = np.where(np.isfinite(depth), depth, 0.75).astype(np.float32)
    segmentation = np.isfinite(depth).astype(np.uint16)
    hypotheses = Hypotheses.from_masks(T[None], np.ones(1), np.ones(1), segmentation, floor)
    view = measure_view(floor, CAMERA, np.eye(4), hypotheses, ambiguity)
    counted = cases.count_cases(
        T[None], ambiguity.rotations, ambiguity.middle, 0.03, ambiguity.telling_samples, view, 1.0
    ).reshape(-1, cases.WHAT, cases.WHOSE)
    fitting, through = counted[:, cases.FITTING, 0], counted[:, cases.LOOKED_THROUGH, 2]
    assert fitting.argmax() == 0
    assert fitting[0] > 5 * fitting[9:27].max()
    assert through[9:27].min() > 5 * max(through[0], 1)


@pytest.fixture(scope="module")
def ball():
    """A ball of 4 cm radius and its solid."""
    model = make_model(trimesh.creation.icosphere(4, 0.04))
    return model, solid_of(model, IDENTITY)


@given(st.tuples(*[st.floats(-0.042, 0.042)] * 3))
@settings(max_examples=60, deadline=None)
def test_signed_distance_of_a_ball(ball, point):
    found, radius = signed_distances(np.array([point]), ball[1])[0], np.linalg.norm(point)
    # Between the corners of a cell, distance from the middle is not linear.
    assert found == pytest.approx(radius - 0.04, abs=4e-4 if radius > 0.02 else 2e-3)


def test_outside_of_its_grid_a_solid_is_infinitely_far(ball):
    assert signed_distances(np.array([[0.2, 0.0, 0.0]]), ball[1])[0] == np.inf


def test_what_is_solid_at_every_rotation_of_a_box_is_the_cylinder_in_it():
    model = make_model(trimesh.creation.box([0.08, 0.08, 0.1]))
    about_z = Rotation.from_euler("z", np.arange(0, 90, 5)[:, None], degrees=True).as_matrix()
    solid = solid_of(model, make_transform(about_z, np.zeros(3)))
    for angle in (0.0, 0.7):
        inside, outside = 0.037, 0.0445
        along = np.array([np.cos(angle), np.sin(angle), 0.0])
        within, beyond = signed_distances(np.array([inside, outside])[:, None] * along, solid)
        assert within < 0 < beyond


def test_container_columns_of_a_stick():
    """Eleven points along z from 0 to 10 cm, upright, 2 cm below the floor and 1 cm beyond a wall of each kind."""
    stick = np.column_stack([np.zeros(11), np.zeros(11), np.linspace(0, 0.1, 11)])
    T = make_transform(np.eye(3), [[0.0, 0.0, -0.02], [0.11, 0.0, 0.0], [0.0, -0.09, 0.0]])
    found = against_container(T, IDENTITY, stick, Tray(0.2, 0.16, 0.055), 1.0)[:, 0]
    np.testing.assert_allclose(found[0], [2 / 11, -0.02, 0, -0.08, 0.03], atol=1e-9)
    # Six of the points are below the top of the wall.
    np.testing.assert_allclose(found[1:], [[0, 0, 6 / 11, 0.01, 0.05]] * 2, atol=1e-9)
    open_table = against_container(T, IDENTITY, stick, OPEN_TABLE, 1.0)[:, 0]
    np.testing.assert_allclose(open_table[:, 2:4], [[0, -1]] * 3)
    np.testing.assert_array_equal(
        against_container(T, IDENTITY, np.zeros((0, 3)), OPEN_TABLE, 1.0), np.zeros((3, 1, 5))
    )


def test_neighbour_columns_are_those_of_a_ball(ball):
    _, solid = ball
    rng = np.random.default_rng(2)
    points = rng.uniform(-0.03, 0.03, (40, 3))
    rotations = make_transform(Rotation.from_euler("z", [[0], [50]], degrees=True).as_matrix(), np.zeros(3))
    T, N = (
        make_transform(Rotation.random(rng=rng).as_matrix(), [[x, 0.0, 0.1], [x + 5.0, 0.0, 0.1]]) for x in (0.0, 0.03)
    )
    T[1, 0, 3] = 0.0
    found = against_neighbour(T, N, rotations, points, solid, 1.0)
    for r, rotation in enumerate(rotations):
        local = transform_points(invert(N[0]) @ T[0] @ rotation, points)
        distance = np.linalg.norm(local, axis=1) - 0.04
        assert found[0, r, 0] == pytest.approx((distance < -0.0015).mean(), abs=0.03)
        if distance.min() < 0.004:
            assert found[0, r, 1] == pytest.approx(distance.min(), abs=2e-3)
    np.testing.assert_array_equal(found[1], [[0.0, FREE]] * 2)
    nothing = against_neighbour(T, N, rotations, np.zeros((0, 3)), solid, 1.0)
    np.testing.assert_array_equal(nothing, np.broadcast_to([0.0, FREE], (2, 2, 2)))


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_belief_is_that_of_brute_force(seed):
    rng = np.random.default_rng(seed)
    place, log_odds = rng.integers(0, 3, 7), rng.normal(0, 3, (7, 5))
    place = np.unique(place, return_inverse=True)[1]
    errors = np.abs(rng.normal(0, 1, (5, 5)))
    errors = errors + errors.T
    np.fill_diagonal(errors, 0.0)
    probability = posterior(log_odds, place)
    beliefs = decide(probability, place, errors, 1.0)
    for number in range(place.max() + 1):
        own = np.flatnonzero(place == number)
        expected = np.exp(log_odds[own] - logsumexp(log_odds[own]))
        np.testing.assert_allclose(probability[own], expected)
        worth = {
            (k, r): sum(p * max(0.0, 1 - errors[r, s] ** 2) for s, p in enumerate(expected[i]))
            for i, k in enumerate(own)
            for r in range(5)
        }
        best = max(worth, key=worth.get)
        assert (beliefs.candidate[number], beliefs.rotation[number]) == best
        within = expected[list(own).index(best[0])][errors[best[1]] < 1.0].sum()
        assert beliefs.mass[number] == pytest.approx(within)
        assert beliefs.entropy[number] == pytest.approx(-(expected * np.log(expected)).sum(), abs=1e-6)


def test_no_candidate_gives_no_belief():
    beliefs = decide(posterior(np.zeros((0, 4)), np.zeros(0, int)), np.zeros(0, int), np.zeros((4, 4)), 1.0)
    assert beliefs.weight.shape == (0, 4)
    assert len(beliefs.mass) == len(beliefs.entropy) == 0


def some_scorer(rng, columns: int, units: int) -> Scorer:
    shapes = (columns,), (columns,), (columns,), (columns, units), (units,), (units,)
    parts = [rng.normal(size=shape).astype(np.float32) for shape in shapes]
    return Scorer(parts[0], np.abs(parts[1]) + 1, *parts[2:])


def some_weights() -> BeliefWeights:
    rng = np.random.default_rng(0)
    columns = ROTATION_COLUMNS, BODY_COLUMNS, OBJECT_COLUMNS
    return BeliefWeights(*(some_scorer(rng, len(names), 4) for names in columns), {"scenes": 3})


def test_a_scorer_is_a_linear_function_and_rectified_units():
    rng = np.random.default_rng(1)
    scorer, columns = some_scorer(rng, 3, 2), rng.normal(size=(2, 4, 3)).astype(np.float32)
    found = scorer(columns)
    assert found.shape == (2, 4)
    x = (columns[1, 2] - scorer.mean) / scorer.scale
    units = [max(0.0, float(x @ scorer.hidden[:, unit] + scorer.offset[unit])) for unit in range(2)]
    assert found[1, 2] == pytest.approx(x @ scorer.linear + np.dot(units, scorer.out), abs=1e-5)
    linear = rng.normal(size=3)
    np.testing.assert_allclose(Scorer.of_weights(linear)(columns), columns @ linear, atol=1e-5)


def test_weights_come_back(tmp_path):
    weights = some_weights()
    weights.save(tmp_path / "mug_fusion.safetensors", "mug")
    back = load_belief(tmp_path / "mug_fusion.safetensors")
    for name in ("rotation", "body", "probability"):
        for part, values in vars(getattr(weights, name)).items():
            np.testing.assert_array_equal(getattr(getattr(back, name), part), values)
    assert back.provenance == {"scenes": 3}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda document, tensors: document.update(format=99), "format 99"),
        (lambda document, tensors: document["columns"]["body"].pop(), "'body' has other columns"),
        (lambda document, tensors: document.pop("columns"), "columns"),
        (lambda document, tensors: tensors.pop("body.out"), "out"),
        (lambda document, tensors: tensors.update({"body.out": np.zeros(3, np.float32)}), "'hidden' must be"),
        (lambda document, tensors: tensors["body.linear"].fill(np.nan), "finite"),
    ],
)
def test_damaged_weights_are_refused(tmp_path, change, message):
    path = tmp_path / "mug_fusion.safetensors"
    some_weights().save(path, "mug")
    document, tensors = json.loads(path.with_suffix(".json").read_text()), load_file(path)
    change(document, tensors)
    path.with_suffix(".json").write_text(json.dumps(document))
    save_file(tensors, path)
    with pytest.raises(ValueError, match=rf"mug_fusion\.safetensors: no weights of fusion .*{message}"):
        load_belief(path)


def test_what_is_no_file_of_weights_is_refused(tmp_path):
    path = tmp_path / "mug_fusion.safetensors"
    with pytest.raises(ValueError, match="active6d train fusion"):
        load_belief(path)
    some_weights().save(path, "mug")
    path.write_bytes(b"nothing")
    with pytest.raises(ValueError, match="no weights of fusion"):
        load_belief(path)


def test_weights_beside_an_object_come_first(tmp_path, monkeypatch):
    monkeypatch.setenv("ACTIVE6D_OBJECT_PATH", str(tmp_path))
    some_weights().save(tmp_path / "mug_fusion.safetensors", "mug")
    assert belief_path("mug").parent == tmp_path
    assert belief_path("unknown").name == "any_fusion.safetensors"


def places(rng, count: int) -> LabelledPlaces:
    """Two candidates with three rotations at each place; the right pose has the largest product of two columns."""
    rotations = rng.normal(size=(2 * count, 3, len(ROTATION_COLUMNS))).astype(np.float32)
    bodies = rng.normal(size=(2 * count, len(BODY_COLUMNS))).astype(np.float32)
    worth = (rotations[..., 0] + 2 * np.abs(rotations[..., 1]) + 2 * bodies[:, :1]).reshape(count, 6)
    right = (worth == worth.max(axis=1, keepdims=True)).reshape(2 * count, 3)
    return LabelledPlaces(rotations, bodies, np.repeat(np.arange(count), 2), right)


def test_the_belief_learns_what_tells_right_poses():
    rng = np.random.default_rng(0)
    rotation, body = fit_belief([places(rng, 300) for _ in range(3)])
    unseen = places(rng, 200)
    probability = posterior(rotation(unseen.rotations) + body(unseen.bodies)[:, None], unseen.place)
    chosen = probability.reshape(200, 6).argmax(axis=1)
    assert unseen.right.reshape(200, 6)[np.arange(200), chosen].mean() > 0.8
    again = fit_belief([places(np.random.default_rng(0), 300)]), fit_belief([places(np.random.default_rng(0), 300)])
    np.testing.assert_array_equal(again[0][0].hidden, again[1][0].hidden)


def test_objects_with_and_without_rotations_are_learned_together():
    rng = np.random.default_rng(0)
    mixed = places(rng, 300)
    alone = replace(mixed, rotations=mixed.rotations[:, :1], right=mixed.right[:, :1])
    kept = np.isin(alone.place, alone.place[alone.right[:, 0]])
    number = np.unique(alone.place[kept], return_inverse=True)[1]
    alone = replace(
        alone, rotations=alone.rotations[kept], bodies=alone.bodies[kept], place=number, right=alone.right[kept]
    )
    rotation, body = fit_belief([mixed, alone, *(places(rng, 300) for _ in range(2))])
    unseen = places(rng, 200)
    probability = posterior(rotation(unseen.rotations) + body(unseen.bodies)[:, None], unseen.place)
    chosen = probability.reshape(200, 6).argmax(axis=1)
    assert unseen.right.reshape(200, 6)[np.arange(200), chosen].mean() > 0.75


def test_numbers_of_rotations_that_do_not_divide_each_other_are_learned_together():
    """Repeating each rotation of one episode twice and of another three times says the same as not repeating them."""
    rng = np.random.default_rng(0)
    first, second = places(rng, 100), places(rng, 100)
    rows = np.arange(first.right.shape[1] - 1)
    second = replace(second, rotations=second.rotations[:, rows], right=second.right[:, rows])
    second.right[:, 0] |= ~second.right.any(axis=1)

    def repeated(episode, count):
        return replace(
            episode, rotations=np.tile(episode.rotations, (1, count, 1)), right=np.tile(episode.right, (1, count))
        )

    counts = first.right.shape[1], second.right.shape[1]
    assert np.gcd(*counts) == 1
    once = fit_belief([first, second])
    even = fit_belief([repeated(first, counts[1]), repeated(second, counts[0])])
    for a, b in zip(once, even, strict=True):
        np.testing.assert_array_equal(a.hidden, b.hidden)


def test_without_a_right_pose_nothing_can_be_learned():
    rng = np.random.default_rng(0)
    nothing = replace(places(rng, 1), place=np.zeros(0, int), right=np.zeros((0, 3), bool))
    with pytest.raises(ValueError, match="cannot be fitted to this estimator"):
        fit_belief([nothing])


def test_the_probability_of_objects_is_calibrated():
    rng = np.random.default_rng(0)
    description = rng.normal(size=(4000, len(OBJECT_COLUMNS)))
    description[:, 0] = 1.0
    true = expit(0.5 + 2.0 * description[:, 1] - description[:, 2])
    right = rng.random(4000) < true
    found = expit(fit_probability(description, right)(description.astype(np.float32)))
    assert np.abs(found - true).mean() < 0.04
    # The derivative by the offset is zero: the mean is that of the data.
    assert found.mean() == pytest.approx(right.mean(), abs=2e-3)
    with pytest.raises(ValueError, match="no object"):
        fit_probability(description[:0], right[:0])
