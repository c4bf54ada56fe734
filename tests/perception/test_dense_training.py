"""The learned estimator learns: targets, files of views, losses, training, resuming, and what comes out of it."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from active6d_core.camera import DEFAULT_CAMERA, View, backproject
from active6d_core.metrics import e_add
from active6d_core.object_model import load_object
from active6d_core.se3 import invert, look_at, make_transform, transform_points
from active6d_core.training_view import TrainingView
from active6d_perception.estimators.dense.canonical_frame import AxisRotation, canonical_frame_of
from active6d_perception.estimators.dense.dense_estimator import DenseEstimator, DenseParameters, log_odds
from active6d_perception.estimators.dense.network import HEADS, DenseNetwork, NetworkSize, split
from active6d_perception.estimators.dense.network_input import output_camera, ray_frames, ray_rotation, reduction
from active6d_perception.estimators.dense.sphere_bins import CENTRES
from active6d_perception.estimators.dense.trained_network import (
    CERTAINTY_FEATURES,
    SCORE_FEATURES,
    TrainedNetwork,
    load_network,
    save_network,
    save_score,
)
from active6d_perception.estimators.dense.training.augmentation import augment, crop
from active6d_perception.estimators.dense.training.batches import TrainingViews, batches, input_tensor
from active6d_perception.estimators.dense.training.loop import TrainingOptions, _Run, train
from active6d_perception.estimators.dense.training.losses import LossWeights, loss_terms, total
from active6d_perception.estimators.dense.training.samples import make_sample, read_shard, write_shard
from active6d_perception.estimators.dense.training.targets import make_targets
from active6d_perception.estimators.dense.training.validation import validate
from active6d_perception.estimators.registry import create_estimator, list_estimators
from active6d_perception.estimators.score_model import ScoreModel
from active6d_sim.datasets.training_views import FIRST_SEED, random_camera, training_scene
from active6d_sim.rendering.renderer import SceneRenderer
from active6d_sim.scenes.scene import Bin, Scene

SMALL = NetworkSize((8, 12, 16, 24), 16)
OBJECTS = ("coffee_cup", "mug", "bunny")


EYE = np.array([0.25, -0.4, 0.6])
PLACES = np.array([[-1, -1, 0], [-1, 1, 0], [1, -1, 0], [1, 1, 0]]) * 0.09 + [0, 0, 0.07]


def view_of(name, seed=0, camera=DEFAULT_CAMERA, rotations=None):
    """A sample of four well visible objects that lie nowhere near each other, and its view."""
    model, rng = load_object(name), np.random.default_rng(seed)
    rotations = Rotation.random(4, rng=rng).as_matrix() if rotations is None else rotations
    poses = make_transform(rotations, PLACES)
    scene = Scene(name, f"{name}/seed/0", 0, poses, Bin(0.4, 0.4, 0.05), np.ones((1, 4)))
    renderer = SceneRenderer(scene, model=model, threads=1)
    T_world_camera = look_at(EYE, np.zeros(3))
    seen = renderer.render(T_world_camera, camera)
    truth = renderer.render(T_world_camera, camera.scaled(0.5 / reduction(camera)), shaded=False)
    view = View(0, seen.color, seen.depth, camera, T_world_camera)
    item = TrainingView(view, truth.depth, truth.instance, invert(T_world_camera) @ poses, np.ones(4))
    return make_sample(item), view


@pytest.fixture(scope="module")
def mug_view():
    return view_of("mug")


def right_answer(sample, targets):
    """What a perfect network would say."""
    h, w = sample.surface_depth.shape
    answer = np.zeros((sum(HEADS.values()), h, w), np.float32)
    parts = split(answer, axis=0)
    parts["mask"][0] = np.where(targets.mask > 0, 6, -6)
    for name in ("centre", "axis"):
        parts[name].reshape(3, -1)[:, targets.pixel] = getattr(targets, name).T
    axis = targets.axis.T
    parts["axis_line"].reshape(6, -1)[:, targets.pixel] = [*axis**2, *(axis * np.roll(axis, -1, axis=0))]
    parts["direction"].reshape(len(CENTRES), -1)[:, targets.pixel] = np.log(targets.direction.T + 1e-6)
    return answer


@pytest.mark.parametrize("name", OBJECTS)
def test_targets_agree_with_the_renderer(name):
    sample, _ = view_of(name)
    model = load_object(name)
    canonical_frame = canonical_frame_of(model)
    targets = make_targets(sample, canonical_frame, model.diameter)
    instance = sample.instance.ravel()[targets.pixel]
    # Votes, axes and directions, each undone by hand.
    camera = output_camera(sample.view.camera)
    points = backproject(sample.surface_depth, camera).reshape(-1, 3)[targets.pixel]
    R = ray_frames(camera).reshape(-1, 3, 3)[targets.pixel]
    votes = points + model.diameter * np.einsum("pij,pj->pi", R, targets.centre)
    origin = transform_points(sample.T_camera_object, canonical_frame.T_object_axis[None, :3, 3])[:, 0]
    assert np.allclose(votes, origin[instance], atol=1e-5)
    frames = ray_rotation(origin)
    axis = (sample.T_camera_object[:, :3, :3] @ canonical_frame.T_object_axis[:3, 2])[instance]
    assert np.allclose(np.einsum("pij,pj->pi", frames[instance], targets.axis), axis, atol=1e-5)
    if canonical_frame.axis_rotation is AxisRotation.INVISIBLE:
        assert not targets.direction.any()
    else:
        x = np.einsum(
            "nij,nj->ni",
            frames.swapaxes(1, 2),
            sample.T_camera_object[:, :3, :3] @ canonical_frame.T_object_axis[:3, 0],
        )
        assert (targets.direction.argmax(axis=1) == (x @ CENTRES.T).argmax(axis=1)[instance]).all()
        assert np.allclose(targets.direction.sum(axis=1), 1, atol=1e-5)
    assert targets.weight.mean() == pytest.approx(1, abs=1e-5)


@pytest.mark.parametrize("name", OBJECTS)
def test_a_right_answer_gives_right_poses(name):
    sample, _ = view_of(name)
    model = load_object(name)
    canonical_frame = canonical_frame_of(model)
    answer = right_answer(sample, make_targets(sample, canonical_frame, model.diameter))
    trained = TrainedNetwork(DenseNetwork(SMALL), canonical_frame, name, model.diameter, SMALL)
    estimator = DenseEstimator(model, trained)
    estimator.ask = lambda view: answer
    poses, label = estimator.locate(sample.view)
    assert len(poses.score) == 4
    errors = e_add(model, poses.T_camera_object[:, None], sample.T_camera_object[None])
    assert errors.min(axis=0).max() < 0.03 * model.diameter
    nearest = errors.argmin(axis=1)
    # Labels name the right pixels.
    fine = sample.instance.repeat(2, axis=0).repeat(2, axis=1)
    for index, instance in enumerate(poses.instance):
        assert (fine[label == instance + 1] == nearest[index]).mean() > 0.97
    assert (poses.score > 0.5).all()


def test_a_hidden_handle_is_told():
    model = load_object("mug")
    canonical_frame = canonical_frame_of(model)
    away = (PLACES - EYE) / np.linalg.norm(PLACES - EYE, axis=1, keepdims=True)
    beside = np.cross(away, [0, 0, 1])
    beside /= np.linalg.norm(beside, axis=1, keepdims=True)
    towards = np.stack([away[0], beside[1], away[2], beside[3]])  # where the handles point
    up = np.cross(away, beside)
    rotations = np.stack([towards, np.cross(up, towards), up], axis=-1) @ canonical_frame.T_object_axis[:3, :3].T
    sample, _ = view_of("mug", rotations=rotations)
    for network_knows in (False, True):
        answer = right_answer(sample, make_targets(sample, canonical_frame, model.diameter))
        if not network_knows:
            split(answer, axis=0)["direction"][:] = 0
        estimator = DenseEstimator(
            model, TrainedNetwork(DenseNetwork(SMALL), canonical_frame, "mug", model.diameter, SMALL)
        )
        estimator.ask = lambda view, answer=answer: answer
        poses, _ = estimator.locate(sample.view)
        errors = e_add(model, poses.T_camera_object[:, None], sample.T_camera_object[None])
        true = np.linalg.norm(poses.T_camera_object[:, None, :3, 3] - sample.T_camera_object[:, :3, 3], axis=-1).argmin(
            1
        )
        assert sorted(true) == [0, 1, 2, 3]
        seen = np.isin(true, [1, 3])
        assert errors[seen, true[seen]].max() < 0.03 * model.diameter
        assert poses.certainty[seen].min() > 0.95
        # All four are there; the score is how sure that is, times how sure the turn.
        presence = poses.score / poses.certainty
        assert ((presence > 0.95) & (presence <= 1)).all()
        if not network_knows:
            assert poses.certainty[~seen].max() < 0.9
            assert poses.score[seen].min() > poses.score[~seen].max()
            several = DenseEstimator(model, estimator._trained, DenseParameters(alternatives=3))
            several.ask = estimator.ask
            more, label = several.locate(sample.view)
            assert len(more.score) > 4
            assert sorted(set(more.instance)) == [0, 1, 2, 3]
            assert label.max() == 4
            # Further turns of one instance share its centre; their certainties add up to one at most.
            assert (np.bincount(more.instance, more.certainty) <= 1 + 1e-9).all()


def test_shards_come_back(tmp_path, mug_view):
    sample, _ = mug_view
    write_shard(tmp_path / "a.npz", [sample, sample])
    back = read_shard(tmp_path / "a.npz")
    assert len(back) == 2
    assert (back[1].view.color == sample.view.color).all()
    assert np.allclose(back[1].view.depth, sample.view.depth, atol=5.1e-5, equal_nan=True)
    assert np.allclose(back[1].surface_depth, sample.surface_depth, atol=5.1e-5, equal_nan=True)
    assert (back[1].instance == sample.instance).all()
    assert (back[1].T_camera_object == sample.T_camera_object).all()
    assert back[1].view.camera == sample.view.camera
    (tmp_path / "b.npz").write_bytes((tmp_path / "a.npz").read_bytes()[:1000])
    with pytest.raises(ValueError, match=r"b\.npz: not a file of training views"):
        read_shard(tmp_path / "b.npz")


def test_depth_beyond_what_a_shard_holds_is_missing(tmp_path, mug_view):
    sample, far = mug_view[0], mug_view[0].view.depth.copy()
    far[:10] = 12.0
    write_shard(tmp_path / "a.npz", [replace(sample, view=replace(sample.view, depth=far))])
    (back,) = read_shard(tmp_path / "a.npz")
    assert np.isnan(back.view.depth[:10]).all()


def test_truth_of_another_size_is_refused(mug_view):
    sample, view = mug_view
    with pytest.raises(ValueError, match="truth of a training view must be"):
        make_sample(replace(sample, view=view, surface_depth=np.ones((10, 10))))


def test_augmentation_keeps_the_truth_and_never_mirrors(mug_view):
    view, colorless = mug_view[0].view, 0
    for seed in range(30):
        changed = augment(view, np.random.default_rng(seed))
        both = np.isfinite(changed.depth) & np.isfinite(view.depth)
        assert both.mean() > 0.8
        assert np.abs(changed.depth - view.depth)[both].max() < 0.008
        gray, before = changed.color.mean(axis=-1).ravel(), view.color.mean(axis=-1).ravel()
        if gray.std() < 10:  # no colour but noise
            colorless += 1
        else:
            assert np.corrcoef(gray, before)[0, 1] > 0.85
    assert 2 <= colorless <= 12  # a fifth


def test_a_crop_has_the_targets_of_the_whole(mug_view):
    sample, _ = mug_view
    model = load_object("mug")
    cropped = crop(sample, 96, 128, np.random.default_rng(3))
    assert cropped.view.depth.shape == (96, 128)
    assert cropped.instance.shape == (48, 64)
    camera, whole = cropped.view.camera, sample.view.camera
    top, left = round(whole.cy - camera.cy), round(whole.cx - camera.cx)
    assert (cropped.view.color == sample.view.color[top : top + 96, left : left + 128]).all()
    part, full = (make_targets(item, canonical_frame_of(model), model.diameter) for item in (cropped, sample))
    row, column = np.divmod(part.pixel, 64)
    place = np.searchsorted(full.pixel, (row + top // 2) * 160 + column + left // 2)
    for name in ("centre", "axis", "direction"):
        assert np.allclose(getattr(part, name), getattr(full, name)[place], atol=1e-5)


def test_heaps_to_learn_from_share_no_seed_with_stored_scenes():
    from active6d_sim.scenes.scene_store import SPLIT_SEEDS, SPLITS

    assert all(SPLIT_SEEDS[split] + count <= FIRST_SEED for split, count in SPLITS.items())
    with pytest.raises(ValueError, match="seeds from"):
        training_scene(load_object("mug"), SPLIT_SEEDS["test"])


def test_random_cameras_look_at_the_bin_from_above():
    rng = np.random.default_rng(0)
    for _ in range(200):
        _, T = random_camera(rng)
        assert 0.5 < np.linalg.norm(T[:3, 3]) < 1.1
        assert T[2, 3] > 0.05
        assert T[:3, 2] @ -T[:3, 3] / np.linalg.norm(T[:3, 3]) > np.cos(np.radians(25))


def test_loss_is_least_at_the_right_answer(mug_view):
    sample, _ = mug_view
    model = load_object("mug")
    targets = make_targets(sample, canonical_frame_of(model), model.diameter)
    right = torch.from_numpy(right_answer(sample, targets))[None]
    best = loss_terms(right, [targets])
    for name, part in split(torch.arange(right.shape[1])[None]).items():
        if name.endswith("scale"):
            continue
        worse = right.clone()
        worse[:, part[0]] += 0.3 * torch.randn(worse[:, part[0]].shape, generator=torch.Generator().manual_seed(0))
        assert loss_terms(worse, [targets])[name] > best[name] + 1e-4
    assert float(best["axis"]) == pytest.approx(0, abs=1e-5)
    assert torch.isfinite(total(best, LossWeights()))


def test_scale_is_learned_from_the_error(mug_view):
    """The likelihood is largest where the scale is the mean error over three."""
    sample, _ = mug_view
    model = load_object("mug")
    targets = make_targets(sample, canonical_frame_of(model), model.diameter)
    answer = torch.from_numpy(right_answer(sample, targets))[None]
    parts = split(answer)
    parts["centre"][:, 0] += 0.3
    losses = []
    for scale in (0.05, 0.1, 0.2):
        parts["centre_scale"][:] = np.log(scale)
        losses.append(float(loss_terms(answer, [targets])["scale"]))
    assert losses[1] < min(losses[0], losses[2])


@pytest.mark.slow
def test_a_small_network_learns_a_view_by_heart(mug_view):
    """Every head's loss falls, and the axes and centres come out of a few hundred steps on one view."""
    torch.manual_seed(0)
    torch.set_num_threads(1)
    sample, view = view_of("coffee_cup", camera=DEFAULT_CAMERA.scaled(0.3))
    model = load_object("coffee_cup")
    canonical_frame = canonical_frame_of(model)
    targets = make_targets(sample, canonical_frame, model.diameter)
    inputs = input_tensor(sample.view, model.diameter)[None].contiguous(memory_format=torch.channels_last)
    size = NetworkSize((16, 24, 32, 48), 24)
    network = DenseNetwork(size).to(memory_format=torch.channels_last)
    optimizer = torch.optim.AdamW(network.parameters(), lr=4e-3)
    losses = []
    for _ in range(250):
        loss = total(loss_terms(network(inputs), [targets]), LossWeights())
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.3 * losses[0]
    estimator = DenseEstimator(model, TrainedNetwork(network, canonical_frame, model.name, model.diameter, size))
    hypotheses = estimator.estimate(view)
    errors = e_add(model, hypotheses.T_camera_object[:, None], sample.T_camera_object[None])
    assert len(hypotheses) == 4
    assert (errors.min(axis=0) < 0.1 * model.diameter).all()
    assert hypotheses.segmentation.shape == view.depth.shape
    assert set(estimator.stage_ms) == {"input", "network", "decoding", "detail", "surface", "poses", "judging", "masks"}


def quick(**changes):
    options = {"steps": 4, "batch": 2, "checkpoint_every": 2, "validate_every": 4, "workers": 0, "size": SMALL}
    return TrainingOptions(**{**options, **changes})


@pytest.fixture(scope="module")
def trained(tmp_path_factory, mug_view):
    torch.set_num_threads(1)
    folder = tmp_path_factory.mktemp("training")
    write_shard(folder / "views.npz", [mug_view[0]] * 2)
    best = train(load_object("mug"), [folder / "views.npz"], [mug_view[0]], folder / "run", quick())
    return folder, best


def test_training_writes_weights_and_curves(trained):
    folder, best = trained
    history = json.loads((folder / "run" / "curves.json").read_text())
    assert [entry["step"] for entry in history] == [4]
    assert (folder / "run" / "curves.png").read_bytes().startswith(b"\x89PNG")
    loaded = load_network(best, load_object("mug"))
    assert loaded.training["validation"]["step"] == 4
    assert not loaded.network.training


def test_training_goes_on_where_it_stopped(tmp_path, trained, mug_view, monkeypatch):
    folder, _ = trained
    shards, model = [folder / "views.npz"], load_object("mug")
    steps = []

    def interrupt(report):
        steps.append(report.step)
        if report.step == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(model, shards, [mug_view[0]], tmp_path, quick(), on_step=interrupt)
    train(model, shards, [mug_view[0]], tmp_path, quick(), on_step=lambda report: steps.append(report.step))
    assert steps == [1, 2, 3, 3, 4]  # the checkpoint is of step 2
    steps.clear()
    monkeypatch.setattr("active6d_core.files.Checkpoints.due", lambda self: True)
    with pytest.raises(KeyboardInterrupt):
        train(model, shards, [mug_view[0]], tmp_path / "slow", quick(), on_step=interrupt)
    train(model, shards, [mug_view[0]], tmp_path / "slow", quick(), on_step=lambda report: steps.append(report.step))
    assert steps == [1, 2, 3, 4]
    with pytest.raises(ValueError, match="other options"):
        train(model, shards, [mug_view[0]], tmp_path, quick(learning_rate=1e-4))
    (tmp_path / "state.safetensors").write_bytes(b"broken")
    with pytest.raises(ValueError, match=r"state\.safetensors: cannot resume"):
        train(model, shards, [mug_view[0]], tmp_path, quick())


def test_the_learning_rate_of_a_resumed_training_follows_the_schedule(tmp_path, trained, mug_view):
    folder, _ = trained
    options = quick(steps=8, checkpoint_every=3, validate_every=9, warmup=5)

    def interrupt(report):
        if report.step == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(load_object("mug"), [folder / "views.npz"], [mug_view[0]], tmp_path, options, on_step=interrupt)
    expected = [2e-3 * min(1, (step + 1) / 5) * 0.5 * (1 + np.cos(np.pi * step / 8)) for step in (0, 3)]
    for where, rate in zip((tmp_path / "none", tmp_path), expected, strict=True):
        assert _Run(load_object("mug"), where, options, "cpu")._optimizer.param_groups[0]["lr"] == pytest.approx(rate)


def test_averaged_weights_follow_the_current_ones(mug_view, tmp_path):
    run = _Run(load_object("mug"), tmp_path, quick(warmup=1), "cpu")
    model = load_object("mug")
    item = mug_view[0]
    inputs = input_tensor(item.view, model.diameter)[None]
    targets = [make_targets(item, canonical_frame_of(model), model.diameter)]
    expected = None
    for step in range(1, 4):
        run.advance(inputs, targets)
        current = run._network.answer[1].bias.detach().clone()
        keep = min(0.998, step / (step + 10))
        expected = current if expected is None else keep * expected + (1 - keep) * current
    averaged = run.averaged_on_cpu()
    assert torch.allclose(averaged.answer[1].bias, expected, atol=1e-7)
    assert not torch.allclose(expected, current, atol=1e-4)
    assert averaged.down0[0][1].num_batches_tracked == 3


def test_a_training_starts_from_trained_weights(tmp_path, trained):
    start = load_network(trained[1], load_object("mug")).network
    options = quick(start=str(trained[1]))
    network = _Run(load_object("mug"), tmp_path, options, "cpu").averaged_on_cpu()
    inputs = torch.rand(1, 16, 32, 48, generator=torch.Generator().manual_seed(0))
    ours, theirs = (split(item.eval()(inputs)) for item in (network, start))
    for name in HEADS:
        assert torch.allclose(ours[name], theirs[name], atol=1e-5)
    with pytest.raises(ValueError, match="cannot start from these weights"):
        _Run(load_object("mug"), tmp_path / "other", quick(start=str(trained[1]), size=NetworkSize()), "cpu")


def test_a_fitted_score_is_kept_beside_the_weights(tmp_path, trained):
    model = load_object("mug")
    for suffix in (".safetensors", ".json"):
        (tmp_path / f"copy{suffix}").write_bytes(trained[1].with_suffix(suffix).read_bytes())
    path = tmp_path / "copy.safetensors"
    assert load_network(path, model).score is None
    weights, features = np.linspace(-2.0, 3.0, len(SCORE_FEATURES)), np.linspace(0.0, 1.0, len(SCORE_FEATURES))
    save_score(path, ScoreModel(SCORE_FEATURES, weights, -4.0))
    expected = sum(float(weight * feature) for weight, feature in zip(weights, features, strict=True)) - 4.0
    score = load_network(path, model).score
    assert score.probability(features) == pytest.approx(1 / (1 + np.exp(-expected)), rel=1e-3)
    assert load_network(path, model).certainty is None
    save_score(path, ScoreModel(SCORE_FEATURES, weights, -4.0), ScoreModel(CERTAINTY_FEATURES, np.array([0.5]), -1.0))
    certainty = load_network(path, model).certainty
    assert certainty.probability(log_odds(np.array([0.9]))[:, None])[0] == pytest.approx(3 / (3 + np.e))
    save_score(path, ScoreModel(("other",), np.ones(1), 0.0))
    with pytest.raises(ValueError, match="not a score model: it is for the features other"):
        load_network(path, model)


def test_an_output_of_another_width_is_refused():
    with pytest.raises(ValueError, match="7 channels"):
        split(np.zeros((1, 7)))


def test_validation_rates_a_perfect_network(mug_view, monkeypatch):
    sample, _ = mug_view
    model = load_object("mug")
    canonical_frame = canonical_frame_of(model)
    answer = right_answer(sample, make_targets(sample, canonical_frame, model.diameter))
    monkeypatch.setattr(DenseEstimator, "ask", lambda self, view: answer)
    rates = validate(
        model, TrainedNetwork(DenseNetwork(SMALL).eval(), canonical_frame, "mug", model.diameter, SMALL), [sample]
    )
    assert rates["add_half"] == rates["add_tenth"] == rates["adds_half"] == rates["precision"] == 1.0


def test_no_views_is_said(tmp_path):
    with pytest.raises(ValueError, match="no training views"):
        next(batches(TrainingViews([], canonical_frame_of(load_object("mug")), 0.14, (0,)), 1, 0))


def test_dense_is_registered_and_takes_weights(trained):
    _, best = trained
    assert "dense" in list_estimators()
    view = View(
        0, np.zeros((480, 640, 3), np.uint8), np.full((480, 640), np.nan, np.float32), DEFAULT_CAMERA, np.eye(4)
    )
    assert len(create_estimator("dense", load_object("mug"), weights=str(best)).estimate(view)) == 0


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda path: path.unlink(), "no such file of weights"),
        (lambda path: path.with_suffix(".json").unlink(), "no such file of weights"),
        (lambda path: path.write_bytes(path.read_bytes()[:5000]), "damaged"),
        (lambda path: path.with_suffix(".json").write_text("{"), "damaged"),
        (lambda path: change(path, object="bunny"), "made for bunny"),
        (lambda path: change(path, diameter=0.5), "made for mug"),
        (lambda path: change(path, heads={"mask": 1}), "another version"),
        (lambda path: change(path, size={"widths": [8, 8, 8, 8], "last": 8}), "not the weights"),
        (lambda path: change(path, size={"widths": [8, 8], "last": 8}), "bad description"),
        (lambda path: change(path, T_object_axis=[[1, 2], [3, 4]]), "bad description"),
    ],
)
def test_bad_weights_give_one_clear_line(tmp_path, trained, damage, message):
    model = load_object("mug")
    path = tmp_path / "mug.safetensors"
    save_network(path, load_network(trained[1], model))
    load_network(path, model)
    damage(path)
    with pytest.raises(ValueError, match=message) as caught:
        create_estimator("dense", model, weights=str(path))
    assert "\n" not in str(caught.value)
    assert str(tmp_path) in str(caught.value)


def change(path, **keys):
    described = path.with_suffix(".json")
    described.write_text(json.dumps({**json.loads(described.read_text()), **keys}))


@pytest.mark.parametrize("setting", [{"min_score": 2.0}, {"alternatives": 0}])
def test_bad_settings_are_named(setting):
    with pytest.raises(ValueError, match=next(iter(setting))):
        DenseParameters(**setting)
