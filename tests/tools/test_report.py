"""The report against numbers that are known by construction, and against a bag that wishes it ill."""

import io
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from recorded_mugs import CAMERA, OFFSETS, make_record

from active6d_bringup.bags.reader import EpisodeRecord, RecordedStep
from active6d_core.camera import PinholeCamera
from active6d_core.hypotheses import SceneObjects
from active6d_core.object_model import ObjectModel, Symmetry
from active6d_core.se3 import invert, make_transform
from active6d_tools.cli.report import print_summary
from active6d_tools.report.analysis import analyse
from active6d_tools.report.drawing import ScoreScale, depth_to_color, outline_step
from active6d_tools.report.figure import render_png
from active6d_tools.report.html_page import render_html
from active6d_tools.report.silhouette import SilhouetteDrawer

HOSTILE = '"><script>alert(1)</script><img src=x onerror=alert(2)>{{ 7 * 7 }}'
VOID = {"meta", "img", "input", "br", "link"}


class Page(HTMLParser):
    """Collects text and attributes; refuses tags that do not close in order."""

    def __init__(self, html: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str]]] = []
        self.texts: list[str] = []
        self.scene = ""
        self.feed(html)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "script" and self.tags[-1][1].get("id") == "scene":
            self.scene = data
        elif not self.open or self.open[-1] not in ("script", "style"):
            self.texts.append(data.strip())

    @property
    def text(self) -> str:
        return " ".join(text for text in self.texts if text)


def charged(offsets: list[float | None]) -> float:
    return float(np.mean([50.0 if offset is None else offset for offset in offsets]))


def test_analysis_scores_every_step():
    analysis = analyse(make_record())
    for step, offsets in zip(analysis.steps, OFFSETS, strict=True):
        found = [offset is not None and offset < analysis.threshold_mm for offset in offsets]
        assert step.truth.detection_rate == pytest.approx(np.mean(found))
        assert step.truth.mean_e_add_mm == pytest.approx(charged(offsets), abs=1e-6)
        known = [offset for offset in offsets if offset is not None]
        assert [row.e_add_mm for row in step.rows] == pytest.approx([*known, None])
        assert [row.detected for row in step.rows] == [offset < analysis.threshold_mm for offset in known] + [False]
    # Two arcs of 60 degrees of azimuth at 45 degrees of elevation: the haversine of each is (1/2) sin(30 degrees)^2.
    arc = 0.8 * 2 * np.arcsin(np.cos(np.radians(45)) * np.sin(np.radians(30)))
    assert analysis.distance_m == pytest.approx(2 * arc, abs=1e-9)
    assert [(step.azimuth, step.elevation) for step in analysis.steps] == [
        pytest.approx((60.0 * number, 45.0)) for number in range(3)
    ]
    assert analysis.steps[0].attended.index == 2
    assert analysis.steps[-1].attended is None


def test_confirmed_objects_and_the_wrong_ones_among_them_are_counted():
    """By their probability, at every step; the page and the summary say how many are wrong."""
    record = make_record()
    steps = []
    for step in record.steps:
        probability = np.array([0.9, *np.zeros(len(step.objects) - 2), 0.5])
        steps.append(replace(step, objects=replace(step.objects, probability=probability)))
    analysis = analyse(replace(record, steps=steps))
    for step, row in zip(analysis.steps, analysis.summary()["steps"], strict=True):
        assert [each.index for each in step.confirmed] == [0, len(step.rows) - 1]
        # The last object of every step is none of the true ones.
        expected = 1 + (not step.rows[0].detected)
        assert (step.wrong, row["confirmed"], row["wrong"]) == (expected, 2, expected)
    html = render_html(analysis)
    page = Page(html).text
    assert f"confirmed 2, {analysis.steps[-1].wrong} wrong" in page
    assert "90 %" in page
    # Drawn faintly.
    assert len(re.findall(r'class="object[^"]* doubtful"', html)) == sum(len(step.rows) - 2 for step in analysis.steps)
    bare = analyse(replace(record, steps=steps, ground_truth=None))
    assert bare.steps[-1].wrong is None
    assert "confirmed 2 attends" in Page(render_html(bare)).text


@pytest.mark.parametrize(
    ("settings", "threshold"), [({}, 0.5), ({"confirmed": 0.8}, 0.8), ({"confirmed": "high"}, 0.5)]
)
def test_the_threshold_is_that_of_the_recording(settings, threshold):
    record = replace(make_record(), settings={"hypothesis_fusion": settings})
    analysis = analyse(record)
    for step in analysis.steps:
        assert len(step.confirmed) == np.count_nonzero(step.objects.probability >= threshold)
    assert f"at least {100 * threshold:.0f} %" in render_html(analysis)


def test_objects_are_drawn_in_the_corrected_camera():
    """A camera 10 cm to the side of where it was said to be shows an object that is not in its picture's middle."""
    record = make_record()
    step = record.steps[0]
    aside = step.view.T_world_camera @ make_transform(np.eye(3), np.array([0.1, 0.0, 0.0]))
    drawer = SilhouetteDrawer(analyse(record).model)

    def centres(corrected):
        steps = [replace(step, T_world_corrected=corrected), *record.steps[1:]]
        analysis = analyse(replace(record, steps=steps))
        outlines = outline_step(drawer, analysis.steps[0], None).objects
        return {number: outline.center for number, outline in enumerate(outlines) if outline.center is not None}

    depth = (invert(step.view.T_world_camera) @ step.objects.T_world_object)[:, 2, 3]
    given, corrected = centres(None), centres(aside)
    assert given.keys() & corrected.keys()
    for number in given.keys() & corrected.keys():
        assert given[number][0] - corrected[number][0] == pytest.approx(CAMERA.fx * 0.1 / depth[number], abs=2.0)


def test_analysis_takes_the_median_time_of_each_node():
    times = analyse(make_record()).node_times
    assert [(time.node, time.views, time.median_ms, time.longest_ms) for time in times] == [
        ("pose_estimator", 3, 110.0, 120.0),
        ("hypothesis_fusion", 3, 5.0, 5.0),
    ]


def test_summary_is_json():
    summary = json.loads(json.dumps(analyse(make_record()).summary(), allow_nan=False))
    assert [step["detection_rate"] for step in summary["steps"]] == [0.25, 0.75, 0.75]
    assert summary["objects_true"] == 4
    assert analyse(make_record(truth=False)).summary()["steps"][0]["e_add_mm"] is None


@pytest.mark.parametrize(("info", "word"), [({}, "--object"), ({"object": "../../etc/passwd"}, "not among")])
def test_analysis_refuses_a_bag_without_a_known_object(info, word):
    with pytest.raises(ValueError, match=word):
        analyse(make_record(info=info))
    assert analyse(make_record(info=info), "mug").model.name == "mug"


def test_page_is_whole_and_needs_nothing_else():
    html = render_html(analyse(make_record()))
    page = Page(html)
    for tag, attributes in page.tags:
        assert tag not in ("link", "iframe", "object", "base")
        assert "href" not in attributes
        assert attributes.get("src", "data:image/").startswith("data:image/")
        if tag == "script":
            assert "src" not in attributes
    assert "url(" not in html
    assert "@import" not in html
    assert "http" not in html.replace("http-equiv", "")


def test_page_says_the_numbers():
    page = Page(render_html(analyse(make_record())))
    assert "3 of 4" in page.text
    assert f"{charged(OFFSETS[-1]):.1f} mm" in page.text
    for offsets, found in zip(OFFSETS, (1, 3, 3), strict=True):
        assert f"found {found} of 4 · ADD {charged(offsets):.1f} mm" in page.text
    assert "110.0 ms" in page.text
    assert "budget of 2 moves spent" in page.text
    assert "no such object" in page.text
    assert sum(tag == "section" and "step" in attributes.get("class", "") for tag, attributes in page.tags) == 3
    # The first view: 3 rows in its table, one of them attended, and an outline for each that lies in the picture.
    rows = [attributes for tag, attributes in page.tags if tag == "tr" and "data-row" in attributes]
    assert len(rows) == 3 + 4 + 5
    assert sum(attributes.get("class") == "attended" for attributes in rows) == 2


def test_page_carries_the_path():
    record = make_record()
    scene = json.loads(Page(render_html(analyse(record))).scene)
    assert np.allclose(scene["cameras"], record.positions, atol=1e-4)
    assert len(scene["objects"]) == 5
    assert scene["radius"] == pytest.approx(0.8)


def test_page_without_truth_objects_or_diagnostics():
    record = make_record(truth=False)
    bare = [RecordedStep(step.view, objects=SceneObjects.empty()) for step in record.steps[:1]]
    page = Page(render_html(analyse(EpisodeRecord(record.folder, record.info, bare, None, None, "world"))))
    assert "no ground truth" in page.text
    assert "the recording ended before the episode" in page.text
    assert "no diagnostics" in page.text
    assert "no object yet" in page.text
    assert "ADD mm" not in page.text


def test_page_escapes_what_the_bag_says():
    told = {"object": "mug", "scene": HOSTILE, "policy": HOSTILE, HOSTILE: HOSTILE, "seed": HOSTILE}
    record = make_record(info=told, node=HOSTILE)
    record = EpisodeRecord(Path(HOSTILE), told, record.steps, record.ground_truth, HOSTILE, "world")
    page = Page(render_html(analyse(record)))
    assert sum(tag == "script" for tag, _ in page.tags) == 2
    assert not any(name.startswith("on") for _, attributes in page.tags for name in attributes)
    assert HOSTILE in page.text
    assert "49" not in page.text.split("Time per node")[0].split("found")[0]


def test_picture_of_one_view_and_of_many():
    record = make_record()
    for steps in (record.steps[:1], record.steps, record.steps * 4):
        again = EpisodeRecord(record.folder, record.info, steps, record.ground_truth, None, "world")
        picture = Image.open(io.BytesIO(render_png(analyse(again))))
        assert picture.width > 1.8 * picture.height
        assert np.asarray(picture.convert("L")).std() > 10


@pytest.fixture(scope="module")
def ball() -> ObjectModel:
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=0.05)
    return ObjectModel("ball", mesh, 0.1, Symmetry(None, np.eye(3)[None]), (1, 1), np.ones(3), {})


def area(polygons: list[np.ndarray]) -> float:
    return sum(abs(0.5 * np.sum(x * np.roll(y, 1) - y * np.roll(x, 1))) for x, y in (p.T for p in polygons))


def test_silhouette_of_a_ball_is_its_disc(ball):
    camera = PinholeCamera.from_field_of_view(640, 480, 60.0)
    T = make_transform(np.eye(3), (0.0, 0.0, 0.8))
    # The cone that touches a ball of radius r at distance z meets the picture in a disc of radius f r / sqrt(z² - r²).
    expected = np.pi * (camera.fx * 0.05 / np.sqrt(0.8**2 - 0.05**2)) ** 2
    outline = SilhouetteDrawer(ball).outline(T, camera)
    assert area(outline.full) == pytest.approx(expected, rel=0.02)
    assert outline.center == pytest.approx([camera.cx, camera.cy], abs=0.5)
    assert outline.visible_fraction == 1.0
    tip = outline.axes[1] - outline.axes[0]
    assert tip == pytest.approx([camera.fx * 0.4 * 0.1 / 0.8, 0.0])


def test_silhouette_is_cut_by_the_measured_depth(ball):
    camera = PinholeCamera.from_field_of_view(640, 480, 60.0)
    T = make_transform(np.eye(3), (0.0, 0.0, 0.8))
    measured = np.full((480, 640), np.nan, np.float32)
    measured[:, :320] = 0.5
    outline = SilhouetteDrawer(ball).outline(T, camera, measured)
    assert outline.visible_fraction == pytest.approx(0.5, abs=0.01)
    assert min(polygon[:, 0].min() for polygon in outline.visible) > 318
    assert area(outline.visible) == pytest.approx(0.5 * area(outline.full), rel=0.03)
    hidden = SilhouetteDrawer(ball).outline(T, camera, np.full((480, 640), 0.5, np.float32))
    assert hidden.visible_fraction == 0.0
    assert hidden.visible == []
    assert area(hidden.full) > 0


@pytest.mark.parametrize("position", [(0.0, 0.0, -0.8), (5.0, 0.0, 0.8), (0.0, 0.0, 0.02)])
def test_silhouette_outside_the_picture_is_empty(ball, position):
    outline = SilhouetteDrawer(ball).outline(make_transform(np.eye(3), position), CAMERA)
    assert outline.full == outline.visible == []
    assert outline.center is None


def test_colors():
    scale = ScoreScale.around(np.array([0.42, 0.61, 0.77, np.nan]))
    assert (scale.low, scale.high) == (pytest.approx(0.4), pytest.approx(0.8))
    assert scale.color(0.1) == scale.color(0.4) != scale.color(0.8) == scale.color(0.9)
    assert scale.color(float("nan")) == "#9aa0a6"
    assert ScoreScale.around(np.zeros(0)) == ScoreScale(0.0, 1.0)
    assert ScoreScale.around(np.full(3, 0.5)).high > 0.5
    depth = np.array([[np.nan, 0.5], [0.75, 1.0]], np.float32)
    picture, (near, far) = depth_to_color(depth)
    assert picture[0, 0].tolist() == [0, 0, 0]
    assert 0.5 <= near < far <= 1.0
    assert picture[0, 1].sum() > picture[1, 0].sum() > picture[1, 1].sum() > 0
    assert depth_to_color(np.full((2, 2), np.nan, np.float32))[1] == (0.0, 0.0)


def test_a_bag_of_images_only_says_that_nothing_was_estimated(capsys):
    record = make_record()
    images = replace(record, folder=Path("bags/other"), steps=[RecordedStep(step.view) for step in record.steps])
    analysis = analyse(images, "mug")
    command = "active6d replay bags/other --object mug --as-fast --bag other_replayed"
    assert command in render_html(analysis)
    print_summary(analysis)
    printed = capsys.readouterr().out
    assert command in printed
    assert "no hypotheses and no objects in the recording" in printed
    assert not analyse(record, "mug").without_results
