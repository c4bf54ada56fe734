"""Images of every kind as colours or depth, against what they were made of."""

import numpy as np
import pytest
from PIL import Image

from active6d_core.images import read_color, read_depth

COLOR = np.dstack([np.tile(np.arange(0, 240, 4, dtype=np.uint8), (40, 1))] * 3)
COLOR[..., 1] = COLOR[::-1, ::-1, 1] // 2
GREY = np.asarray(Image.fromarray(COLOR).convert("L"))


def save(path, array_or_image):
    image = array_or_image if isinstance(array_or_image, Image.Image) else Image.fromarray(array_or_image)
    image.save(path)
    return path


@pytest.mark.parametrize("ending", ["png", "tif", "bmp"])
def test_colours_are_kept(tmp_path, ending):
    path = save(tmp_path / f"a.{ending}", COLOR)
    np.testing.assert_array_equal(read_color(path), COLOR)
    np.testing.assert_array_equal(read_color(path.read_bytes()), COLOR)


def test_alpha_is_dropped_and_grey_repeated(tmp_path):
    rgba = np.dstack([COLOR, np.full(GREY.shape, 7, np.uint8)])
    np.testing.assert_array_equal(read_color(save(tmp_path / "rgba.png", rgba)), COLOR)
    for mode in ("L", "LA"):
        grey = read_color(save(tmp_path / f"{mode}.png", Image.fromarray(COLOR).convert(mode)))
        np.testing.assert_array_equal(grey, np.repeat(GREY[..., None], 3, axis=2))


def test_palettes_give_their_colours_and_not_their_indices(tmp_path):
    few = (COLOR // 64 * 64).astype(np.uint8)
    path = save(tmp_path / "p.png", Image.fromarray(few).convert("P", palette=Image.Palette.ADAPTIVE, colors=256))
    assert Image.open(path).mode == "P"
    np.testing.assert_allclose(read_color(path).astype(int), few, atol=2)


@pytest.mark.parametrize("bits", [8, 10, 12, 16])
def test_grey_of_more_bits_keeps_its_brightness(tmp_path, bits):
    values = (GREY.astype(np.uint16) << (bits - 8)) | ((1 << (bits - 8)) - 1)
    values[0, 0] = (1 << bits) - 1
    found = read_color(save(tmp_path / "grey.png", values))
    assert (found[..., 0] == values >> (bits - 8)).all()


@pytest.mark.parametrize("ending", ["png", "tif"])
def test_depth_keeps_its_steps(tmp_path, ending):
    steps = np.arange(2400, dtype=np.uint16).reshape(40, 60) * 27
    np.testing.assert_array_equal(read_depth(save(tmp_path / f"d.{ending}", steps)), steps)


def test_floating_point_depth_is_read(tmp_path):
    metres = np.linspace(0, 2, 2400, dtype=np.float32).reshape(40, 60)
    np.testing.assert_array_equal(read_depth(save(tmp_path / "d.tif", metres)), metres)


@pytest.mark.parametrize(
    ("read", "image", "words"),
    [
        (read_depth, GREY, "is a 8-bit grey image, depth needs 16-bit"),
        (read_depth, COLOR, "is a colour image"),
        (read_color, np.ones((4, 4), np.float32), "is it a depth image"),
    ],
)
def test_what_has_no_clear_meaning_is_refused(tmp_path, read, image, words):
    path = save(tmp_path / "a.tif", image)
    with pytest.raises(ValueError, match=words):
        read(path)


def test_damaged_and_missing_files_name_themselves(tmp_path):
    path = save(tmp_path / "a.png", COLOR)
    path.write_bytes(path.read_bytes()[:80])
    with pytest.raises(ValueError, match=r"a.png: not a readable image"):
        read_color(path)
    with pytest.raises(ValueError, match="no such file"):
        read_depth(tmp_path / "b.png")
