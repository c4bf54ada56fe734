"""The figure of before, after, attention and path draws the numbers of the record."""

import io
from collections import defaultdict
from dataclasses import replace

import matplotlib
import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox
from PIL import Image
from recorded_mugs import make_record

from active6d_bringup.bags.reader import EpisodeRecord
from active6d_core.hypotheses import SceneObjects
from active6d_core.view_sphere import ViewSphere
from active6d_tools.report.analysis import analyse
from active6d_tools.report.panels import STYLE, clearest_projection
from active6d_tools.report.qualitative import qualitative_figure, render_qualitative

FOUND, WRONG = "#25d397", "#f53fae"


def with_attention(record: EpisodeRecord) -> EpisodeRecord:
    """Weights that differ from object to object and from move to move; each view shows its own grey."""
    steps = []
    for number, step in enumerate(record.steps):
        weights = np.arange(1.0, 1 + len(step.objects)) + number
        last = step.attention is None
        steps.append(
            replace(
                step,
                view=replace(step.view, color=np.full_like(step.view.color, 60 + 20 * number)),
                attention=None if last else weights / weights.sum(),
                attended=None if last else number,
            )
        )
    return replace(record, steps=steps)


def axes_of(figure: Figure) -> dict:
    return {axes.get_label(): axes for axes in figure.axes}


def bars(axes) -> tuple[np.ndarray, list[str]]:
    patches = [patch for container in axes.containers for patch in container]
    return np.array([patch.get_height() for patch in patches]), [to_hex(patch.get_facecolor()) for patch in patches]


def shaded(axes) -> list[float]:
    """Where the bars stand that have a background of their own."""
    in_bars = {patch for container in axes.containers for patch in container}
    return [patch.get_x() + patch.get_width() / 2 for patch in axes.patches if patch not in in_bars]


@pytest.mark.parametrize("truth", [True, False])
def test_bars_are_the_recorded_scores_and_weights(truth):
    record = with_attention(make_record(truth=truth))
    axes = axes_of(qualitative_figure(analyse(record)))
    assert {name for name in axes if name.startswith(("score", "attention"))} == {
        f"{what} {move}" for what in ("score", "attention") for move in (1, 2)
    }
    for move, step in enumerate(record.steps[:-1], start=1):
        order = np.argsort(step.objects.verification)
        scores, colors = bars(axes[f"score {move}"])
        assert scores == pytest.approx(step.objects.verification[order])
        weights, _ = bars(axes[f"attention {move}"])
        assert weights == pytest.approx(step.attention[order])
        place = [int(np.flatnonzero(order == step.attended)[0])]
        assert shaded(axes[f"score {move}"]) == shaded(axes[f"attention {move}"]) == pytest.approx(place)
        if truth:
            # Offsets below a tenth of the diameter, 13.8 mm, count as found; the last object is no true one.
            found = [[True, False, False], [True, True, True, False]][move - 1]
            assert colors == [FOUND if found[i] else WRONG for i in order]
    # One scale of attention, so that moves can be compared.
    assert axes["attention 1"].get_ylim() == axes["attention 2"].get_ylim()
    assert axes["attention 1"].get_ylim()[0] > record.steps[0].attention.max()


def test_images_are_of_the_first_and_last_view_with_what_was_known_then():
    record = with_attention(make_record())
    axes = axes_of(qualitative_figure(analyse(record)))
    for name, step, found, numbers in (
        ("before", record.steps[0], "1 of 4 found", ["1"]),
        ("after", record.steps[-1], "3 of 4 found", ["1", "2"]),
    ):
        assert np.array_equal(axes[name].images[0].get_array(), step.view.color)
        assert axes[name].get_title(loc="right") == found
        badges = axes[name].texts
        assert [text.get_text() for text in badges] == numbers
        # The badge of move n points at the object that view n - 1 attended to, by the pinhole model.
        for number, badge in enumerate(badges):
            T = record.steps[number].objects.T_world_object[record.steps[number].attended]
            x, y, z = (np.linalg.inv(step.view.T_world_camera) @ T)[:3, 3]
            camera = step.view.camera
            expected = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
            # A mug's silhouette reaches some 15 pixels from its frame's origin.
            assert badge.xy == pytest.approx(expected, abs=8)


def test_path_goes_through_the_recorded_positions():
    record = with_attention(make_record())
    path = axes_of(qualitative_figure(analyse(record)))["path"]
    texts = {text.get_text(): text for text in path.texts}
    assert set(texts) == {"0", "1", "2", "start", "end"}
    drawn = np.array([texts[str(number)].get_position() for number in range(3)])
    right, up, toward = clearest_projection(ViewSphere(), record.positions)
    assert np.stack([right, up, toward]) @ np.stack([right, up, toward]).T == pytest.approx(np.eye(3))
    assert np.cross(right, up) == pytest.approx(toward)
    assert drawn == pytest.approx(np.stack([record.positions @ right, record.positions @ up], axis=1))
    assert texts["start"].xy == pytest.approx(drawn[0])
    assert texts["end"].xy == pytest.approx(drawn[2])
    lines = np.concatenate([line.get_xydata() for line in path.lines])
    for position in drawn:
        assert np.nanmin(np.linalg.norm(lines - position, axis=1)) < 1e-9
    objects = record.steps[-1].objects.T_world_object[:, :3, 3]
    dots = path.collections[-1].get_offsets()
    expected = np.stack([objects @ right, objects @ up], axis=1)
    assert np.array(sorted(map(tuple, dots))) == pytest.approx(np.array(sorted(map(tuple, expected))))


def test_path_is_seen_from_where_its_views_are_apart():
    sphere = ViewSphere()
    # Seen along either of the two lines of sight, views on opposite azimuths would lie in a row.
    cameras = sphere.position(np.radians([0.0, 180.0, 90.0]), np.radians([45.0, 45.0, 15.0]))
    drawn = cameras @ clearest_projection(sphere, cameras)[:2].T
    gaps = [np.linalg.norm(drawn[a] - drawn[b]) for a, b in ((0, 1), (0, 2), (1, 2))]
    assert min(gaps) > 0.2 * sphere.radius


def test_of_many_moves_five_are_drawn():
    record = with_attention(make_record())
    steps = [record.steps[0], *record.steps[1:2] * 11, record.steps[2]]
    axes = axes_of(qualitative_figure(analyse(replace(record, steps=steps))))
    moves = sorted(int(name.split()[1]) for name in axes if name.startswith("score"))
    assert moves[0] == 1
    assert moves[-1] == 12
    assert len(moves) == 5


@pytest.mark.parametrize("case", ["no truth", "no object", "no attention", "one move", "no move", "dollars"])
def test_picture_of_bare_episodes(case):
    record = with_attention(make_record(truth=case != "no truth"))
    if case == "no object":
        none = {"objects": SceneObjects.empty(), "attention": np.zeros(0), "attended": None}
        record = replace(record, steps=[replace(step, **none) for step in record.steps])
    elif case == "no attention":
        record = replace(record, steps=[replace(step, attention=None, attended=None) for step in record.steps])
    elif case in ("one move", "no move"):
        record = replace(record, steps=record.steps[: 2 if case == "one move" else 1])
    elif case == "dollars":
        record = replace(record, info={**record.info, "scene": r"$\frac{", "policy": "$x_"})
    picture = Image.open(io.BytesIO(render_qualitative(analyse(record))))
    assert picture.width == 1200
    assert np.asarray(picture.convert("L")).std() > 10


def test_nothing_lies_upon_something_else_or_outside():
    with matplotlib.rc_context(STYLE):
        figure = qualitative_figure(analyse(with_attention(make_record())))
        figure.draw_without_rendering()
    # The bars of a move share their zero.
    places = defaultdict(list)
    for axes in figure.axes:
        places[axes.get_label().removeprefix("score ").removeprefix("attention ")].append(axes.get_tightbbox())
    boxes = [Bbox.union(together) for together in places.values()]
    boxes += [artist.get_window_extent() for artist in (*figure.texts, *figure.legends, *figure.artists)]
    width, height = figure.bbox.size
    for number, box in enumerate(boxes):
        assert -1 <= box.x0 < box.x1 <= width + 1
        assert -1 <= box.y0 < box.y1 <= height + 1
        for other in boxes[:number]:
            shared = Bbox.intersection(box, other)
            assert shared is None or min(shared.width, shared.height) <= 2
