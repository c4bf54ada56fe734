"""The estimator benchmark: its table against counts by hand, its views against the simulator, resuming, the peers."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from active6d_core.hypotheses import Hypotheses
from active6d_core.metrics import e_add
from active6d_core.object_model import load_object
from active6d_core.se3 import invert, make_transform, transform_points
from active6d_core.view_sphere import ViewSphere
from active6d_perception.estimators.geometric.foreground import measure_surface
from active6d_perception.estimators.registry import register_estimator
from active6d_perception.estimators.single_view_evaluation import EstimatorResult, ViewResult
from active6d_sim.rendering.active_stereo import ActiveStereo
from active6d_sim.rendering.renderer import SceneRenderer
from active6d_sim.rendering.simulator import Simulator
from active6d_sim.scenes.scene import Bin, Scene
from active6d_tools.benchmark import estimator_views as benchmark
from active6d_tools.benchmark import peers
from active6d_tools.benchmark.estimator_plots import draw_ambiguity, draw_verification
from active6d_tools.benchmark.estimator_summary import summarise
from active6d_tools.benchmark.grid_views import GridViews, feature_seen, feature_surface
from active6d_tools.benchmark.records import Records
from active6d_tools.cli import app

POSES = make_transform(np.eye(3), np.array([(-0.1, 0.0, 0.06), (0.1, 0.0, 0.06)]))
SPHERE = ViewSphere()


@register_estimator("half-blind")
class HalfBlind:
    """Finds the first true object and nothing else."""

    views = 0

    def __init__(self, model) -> None:
        self._model = model

    def estimate(self, view):
        HalfBlind.views += 1
        segmentation = np.zeros(view.depth.shape, np.uint16)
        segmentation[200:280, 280:360] = 1
        pose = invert(view.T_world_camera) @ POSES[:1]
        return Hypotheses.from_masks(pose, np.ones(1), np.ones(1, np.uint16), segmentation, view.depth)


def two_objects(name):
    return Scene(name, f"{name}/test/0", 0, POSES, Bin(0.4, 0.3, 0.05), np.full((100, 2), 0.8))


@pytest.fixture
def two_scenes(monkeypatch):
    """Two stored scenes that are the same, with two bunnies each."""
    scene = two_objects("bunny")
    monkeypatch.setattr(benchmark, "SPLITS", {"test": 2})
    monkeypatch.setattr(benchmark, "load_scene", lambda *name: scene)
    HalfBlind.views = 0


def view_result(visible, seen, score, pairs, seconds=0.1):
    """``pairs`` has rows of hypothesis, object, e_ADD and ADD-S in metres, rotation in degrees."""
    hypothesis, true, add, adds, rotation = np.array(pairs, float).reshape(-1, 5).T
    return ViewResult(
        visible_fraction=np.array(visible),
        feature_seen=np.array(seen),
        score=np.array(score),
        certainty=np.array(score),
        verification=np.array(score),
        hypothesis=hypothesis.astype(int),
        object=true.astype(int),
        add=add,
        adds=adds,
        mssd=add,
        mspd=1000 * add,
        rotation=rotation,
        width=640,
        seconds=seconds,
        cpu_seconds=seconds / 2,
        stage_ms={"only": 1e3 * seconds},
    )


def mug_result():
    """Four mugs in two views: found, turned wrongly, found twice and missed, and one hypothesis at nothing."""
    first = view_result([0.9, 0.6], [0.4, 0.0], [0.9, 0.7], [(0, 0, 0.002, 0.001, 5), (1, 1, 0.03, 0.003, 90)])
    second = view_result(
        [0.3, 0.05], [0.2, 0.2], [0.8, 0.6, 0.1], [(0, 0, 0.004, 0.002, 8), (1, 0, 0.005, 0.003, 9)], seconds=0.3
    )
    return EstimatorResult(load_object("mug").diameter, (first, second))


def test_summary_counts_by_visible_fraction_and_handle():
    row = summarise(load_object("mug"), mug_result(), [0, 1])
    rates = {kind: {least: row[kind][least]["rate"] for least in ("0.5", "0.1")} for kind in ("add", "adds")}
    assert rates == {
        "add": {"0.5": 0.5, "0.1": pytest.approx(2 / 3)},
        "adds": {"0.5": 1.0, "0.1": 1.0},
    }
    assert row["feature_seen"]["add"]["0.5"] == {"rate": 1.0, "low": 1.0, "high": 1.0, "of": 1}
    assert [entry["of"] for entry in row["add"]["bins"]] == [1, 0, 0, 1, 0, 0, 1, 0, 0, 1]
    # A mug's handle may hide, so that its precision is by ADD-S; what finds a found object again is wrong.
    assert row["precision"]["rate"] == row["precision_adds"]["rate"] == 3 / 5
    assert row["precision_add"]["rate"] == 2 / 5
    assert row["hypotheses_per_view"] == 2.5
    assert row["time"]["all"]["total"]["median_ms"] == pytest.approx(200.0)
    assert row["time"]["all"]["cpu"]["p95_ms"] == pytest.approx(145.0)
    assert row["time"]["all"]["stages"]["only"]["median_ms"] == pytest.approx(200.0)
    assert "crowded" not in row["time"]
    # The mug is 131 mm: 30 mm are wrong up to the threshold of 20 % and right from 25 % on.
    assert row["mssd"]["recalls"] == pytest.approx([2 / 3] * 4 + [1.0] * 6)
    assert row["mssd"]["average_recall"]["rate"] == pytest.approx(np.mean(row["mssd"]["recalls"]))
    study = row["verification"]
    assert (study["hypotheses"], study["wrong_add"], study["wrong_adds"]) == (5, 2, 1)
    assert study["equation_1"]["auc_adds"] == 1.0
    assert study["equation_1"]["auc_add"] == pytest.approx(5 / 6)
    ambiguity = row["ambiguity"]
    assert ambiguity["told_by"] == "certainty"
    assert (ambiguity["seen"]["hypotheses"], ambiguity["seen"]["right_turn"]) == (3, 1.0)
    assert (ambiguity["hidden"]["hypotheses"], ambiguity["hidden"]["right_turn"]) == (1, 0.0)
    json.dumps(row, allow_nan=False)


def test_an_estimator_that_finds_nothing_has_a_row():
    nothing = EstimatorResult(0.1, (view_result([0.9], [np.nan], [], []),))
    row = summarise(load_object("bunny"), nothing, [0])
    assert row["add"]["0.5"]["rate"] == 0.0
    assert row["precision"]["rate"] is None
    assert row["average_precision"]["pose"] == 0.0
    json.dumps(row, allow_nan=False)


def test_plots_are_drawn(tmp_path):
    draw_verification(tmp_path / "new" / "verification.png", "mug", mug_result())
    draw_ambiguity(tmp_path / "ambiguity.png", "mug", load_object("mug"), mug_result())
    for path in (tmp_path / "new" / "verification.png", tmp_path / "ambiguity.png"):
        assert path.read_bytes().startswith(b"\x89PNG")


def test_views_are_those_of_the_simulator():
    scene = two_objects("bunny")
    views = GridViews(load_object("bunny"), [scene], seed=3)
    for noise in (1.0, 2.0):
        view = views.capture(0, 40, noise).view
        simulator = Simulator(scene, noise=ActiveStereo().scaled(noise), seed=3)
        expected = simulator.capture(SPHERE.pose(SPHERE.positions[40]), view.stamp)
        np.testing.assert_array_equal(view.depth, expected.depth)
        np.testing.assert_array_equal(view.color, expected.color)
    assert np.isnan(views.capture(0, 40, 0.0).feature_seen).all()


def crossed(eye, points, triangles):
    """(p,) bool: does any (t, 3, 3) triangle cut the way from the eye to 99.9 % of the way to a point?"""
    a, edges = triangles[:, 0], triangles[:, 1:] - triangles[:, :1]
    answer = []
    for point in points:
        columns = np.stack([edges[:, 0], edges[:, 1], np.broadcast_to(eye - point, a.shape)], axis=2)
        determinant = np.linalg.det(columns)
        regular = np.abs(determinant) > 1e-15
        u, v, t = np.linalg.solve(columns[regular], (eye - a[regular])[..., None])[..., 0].T
        answer.append(((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < 0.999)).any())
    return np.array(answer)


@pytest.mark.parametrize("number", [20, 60])
def test_seen_handle_is_what_no_triangle_hides(number):
    model = load_object("mug")
    poses = POSES.copy()
    poses[:, 2, 3] = 0.2  # well above the floor, which then hides nothing
    scene = Scene("mug", "mug/test/0", 0, poses, Bin(0.4, 0.3, 0.0), np.ones((100, 2)))
    T_world_camera = SPHERE.pose(SPHERE.positions[number])
    points, normals = feature_surface(model, 60)
    seen = feature_seen(SceneRenderer(scene), (points, normals), T_world_camera)
    triangles = np.concatenate([transform_points(T, np.asarray(model.mesh.triangles)) for T in poses])
    eye = T_world_camera[:3, 3]
    for index, T in enumerate(poses):
        there = transform_points(T, points)
        facing = ((eye - there) * (normals @ T[:3, :3].T)).sum(axis=1) > 0
        expected = facing & ~crossed(eye, there, triangles)
        assert 0.0 < expected.mean() < 0.7
        assert seen[index] == pytest.approx(expected.mean(), abs=0.02)


def test_records_go_on_where_they_were_stopped(tmp_path):
    path, header = tmp_path / "deep" / "records.jsonl", {"object": "mug"}
    result = mug_result().views[0]
    Records(path, header).add(("dense 1", 1.0, 2, 3), result)
    with path.open("a") as file:
        file.write('{"key": ["dense 1", 1.0, 2')
    again = Records(path, header)
    assert ("dense 1", 1.0, 2, 3) in again
    assert ("dense 1", 1.0, 2, 4) not in again
    read = again["dense 1", 1.0, 2, 3]
    for name in ("score", "add", "hypothesis", "feature_seen"):
        np.testing.assert_array_equal(getattr(read, name), getattr(result, name))
    assert read.stage_ms == result.stage_ms
    again.add(("dense 1", 1.0, 2, 4), result)
    assert ("dense 1", 1.0, 2, 4) in Records(path, header)
    with pytest.raises(ValueError, match=r"records.jsonl: .* choose another file"):
        Records(path, {"object": "bunny"})
    path.write_text(json.dumps({"key": [1], "score": [0.5] * 100}) + "\n")
    with pytest.raises(ValueError, match=r"its first line does not hold the settings; choose another file") as refused:
        Records(path, {"object": "bunny"})
    assert len(str(refused.value)) < 250  # the line itself is not repeated
    path.write_text("no records\n")
    with pytest.raises(ValueError, match=r"records.jsonl: cannot continue"):
        Records(path, header)


def test_every_estimator_sees_the_same_views(two_scenes, tmp_path):
    model, told = load_object("bunny"), []
    contenders = benchmark.enlist(model, ["half-blind", "half-blind"])
    options = {"sample": 3, "noises": (1.0, 0.0), "records": tmp_path / "records.jsonl"}
    measured = benchmark.measure_estimators(
        "bunny", "test", contenders, **options, moves=1, on_progress=lambda *what: told.append(what)
    )
    assert measured.document["views"] == 3
    assert measured.document["peak_memory_mib"] > 50
    rows = measured.document["noise"]
    assert list(rows) == ["1", "0"]
    for row in (rows["1"]["half-blind"], rows["0"]["half-blind"]):
        assert row["add"]["0.5"]["rate"] == row["add"]["0.1"]["rate"] == 0.5
        assert row["precision"]["rate"] == 1.0
    assert rows["1"]["half-blind"]["fused"] == [0.5, 0.5]
    assert told[0][1:] == (0, 6)
    assert told[-1][1:] == (6, 6)
    assert HalfBlind.views == 6 + 4
    again = benchmark.measure_estimators("bunny", "test", contenders, **options)
    assert HalfBlind.views == 6 + 4
    for key in ("add", "adds", "precision", "mssd", "mspd", "average_precision", "time"):
        assert again.document["noise"]["0"]["half-blind"][key] == rows["0"]["half-blind"][key]


def test_the_command_prints_writes_and_draws(two_scenes, tmp_path):
    arguments = ["--object", "bunny", "--estimator", "half-blind", "--sample", "2", "--noise", "0"]
    outputs = ["--json", str(tmp_path / "a.json"), "--plots", str(tmp_path)]
    result = CliRunner().invoke(app, ["benchmark", "estimator", *arguments, *outputs])
    assert result.exit_code == 0, result.output
    assert "average recall, MSSD" in result.output
    assert json.loads((tmp_path / "a.json").read_text())["noise"]["0"]["half-blind"]["add"]["0.5"]["rate"] == 0.5
    assert (tmp_path / "verification_bunny_half-blind_noise0.png").is_file()


@pytest.fixture(scope="module")
def lone_bunny():
    scene = Scene("bunny", "bunny/test/0", 0, POSES[:1], Bin(0.4, 0.3, 0.05), np.full((100, 1), 1.0))
    return Simulator(scene).capture(SPHERE.pose(SPHERE.positions[60]), 1)


@pytest.mark.parametrize(
    ("peer", "settings"),
    [(peers.FeatureMatching, {"crops": 6}), (peers.PointPairFeatures, {"sampling": 0.12, "refined": 10})],
)
def test_a_peer_finds_a_lone_object(lone_bunny, peer, settings):
    if peer is peers.PointPairFeatures and not hasattr(pytest.importorskip("cv2"), "ppf_match_3d"):
        pytest.skip("OpenCV without its contrib modules")
    model = load_object("bunny")
    found = peer(model, **settings).estimate(lone_bunny)
    truth = invert(lone_bunny.T_world_camera) @ POSES[0]
    assert len(found) == 1
    assert e_add(model, found.T_camera_object[0], truth) < 0.1 * model.diameter
    assert (found.segmentation > 0).sum() > 500


def test_depth_check_accepts_the_truth_and_nothing_beside_it(lone_bunny):
    model = load_object("bunny")
    truth = invert(lone_bunny.T_world_camera) @ POSES[0]
    shifted = np.repeat(truth[None], 4, axis=0)
    shifted[1:3, :3, 3] += np.array([(0.03, 0.0, 0.0), (0.0, 0.0, -0.03)])
    surface = measure_surface(lone_bunny.depth, lone_bunny.camera, model.diameter)
    found = peers.DepthCheck(model).report(shifted, surface, lone_bunny)
    assert len(found) == 1  # the truth, given twice
    np.testing.assert_allclose(found.T_camera_object[0], truth)


def test_clusters_become_rotations():
    rng = np.random.default_rng(0)
    R = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    R *= np.linalg.det(R)
    T = make_transform(0.8 * R, np.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(peers._projected(T), make_transform(R, T[:3, 3]), atol=1e-12)


def test_peers_say_what_to_install(monkeypatch):
    monkeypatch.setattr(peers, "import_module", lambda name: object())
    with pytest.raises(ValueError, match="pip install opencv-contrib-python-headless"):
        benchmark.enlist(load_object("bunny"), [], peers=True)
