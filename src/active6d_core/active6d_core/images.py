"""Decoding of image files and of compressed images: one reader for data sets, the command line and messages."""

import io
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

from active6d_core.files import refuse_special

#: Formats that are read. Pillow knows others, some of which run other programs.
_FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "PPM", "WEBP")
#: Pixels of an image, before any of them is decoded.
_MOST_PIXELS = 50_000_000
#: Bits of grey images that 16-bit files carry: cameras fill the low bits.
_GREY_BITS = (8, 10, 12, 14, 16)
_SIXTEEN_BIT = {"I;16", "I;16L", "I;16B", "I;16N", "I"}


def read_color(source: Path | bytes) -> np.ndarray:
    """An image file, or its content, as (H, W, 3) uint8 RGB.

    Grey, palette, alpha, CMYK and 16-bit images are converted. A grey image of 10 to 16 bits keeps its highest eight
    bits, counted from the smallest usual bit depth that holds its brightest pixel. Transparency is ignored.

    Raises:
        ValueError: no image, a damaged one, or one whose values have no clear meaning as colours.
    """
    with _open(source) as image:
        if image.mode in _SIXTEEN_BIT:
            grey = np.asarray(image)
            if grey.min(initial=0) < 0 or grey.max(initial=0) >= 1 << 16:
                raise ValueError(f"{_name(source)}: a grey image of more than 16 bits cannot be used as colours")
            return np.repeat(upper_bits(grey)[..., None], 3, axis=2)
        if image.mode == "F":
            raise ValueError(f"{_name(source)}: floating-point values cannot be used as colours; is it a depth image?")
        # Pillow would blend a transparent palette entry; the alpha channel is dropped instead.
        return np.asarray(image.convert("RGBA").convert("RGB") if image.mode == "P" else image.convert("RGB"))


def read_depth(source: Path | bytes) -> np.ndarray:
    """An image file, or its content, as (H, W) depth in the file's units: uint16, int32 or float32.

    Raises:
        ValueError: no image, a damaged one, or one with 8 bits or several channels.
    """
    with _open(source) as image:
        if image.mode not in _SIXTEEN_BIT | {"F"}:
            kind = {"L": "8-bit grey", "RGB": "colour", "RGBA": "colour", "P": "palette"}.get(image.mode, image.mode)
            raise ValueError(f"{_name(source)}: is a {kind} image, depth needs 16-bit grey or floating point")
        depth = np.asarray(image)
        return depth.astype(np.uint16) if image.mode.startswith("I;16") else depth


def upper_bits(image: np.ndarray) -> np.ndarray:
    """The upper eight bits of an integer image of at most 16 bits, as uint8.

    Bits are counted from the smallest usual bit depth that holds the brightest pixel: cameras fill the low ones.
    """
    bits = next(bits for bits in _GREY_BITS if image.max(initial=0) < 1 << bits)
    return (image >> (bits - 8)).astype(np.uint8)


def _open(source: Path | bytes) -> Image.Image:
    if isinstance(source, Path):
        refuse_special(source)
    try:
        image = Image.open(io.BytesIO(source) if isinstance(source, bytes) else source, formats=_FORMATS)
        if image.width * image.height > _MOST_PIXELS:
            raise ValueError(f"{image.width}x{image.height} pixels are too many")
        image.load()
    except FileNotFoundError as error:
        raise ValueError(f"{_name(source)}: no such file") from error
    except UnidentifiedImageError as error:
        raise ValueError(f"{_name(source)}: not a readable image of the formats {', '.join(_FORMATS)}") from error
    # Pillow's decoders raise many kinds of errors on damaged files, including SyntaxError.
    except Exception as error:
        raise ValueError(f"{_name(source)}: not a readable image ({error})") from error
    return image


def _name(source: Path | bytes) -> str:
    return str(source) if isinstance(source, Path) else "compressed image"
