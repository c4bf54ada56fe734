"""Images of camera drivers, raw or compressed, as arrays: more encodings than the graph itself uses."""

import struct
from typing import Any

import cv2
import numpy as np

from active6d_core.images import read_color, read_depth, upper_bits
from active6d_core.ros.conversions import COLOR_ENCODINGS, MessageError, image_to_color, image_to_pixels

# OpenCV names Bayer patterns by their second row and column.
_BAYER = {
    "rggb": cv2.COLOR_BayerBG2RGB,
    "bggr": cv2.COLOR_BayerRG2RGB,
    "gbrg": cv2.COLOR_BayerGR2RGB,
    "grbg": cv2.COLOR_BayerGB2RGB,
}
#: ROS encoding to the type of its numbers, its channels, and OpenCV's conversion to RGB, None for none.
_CONVERSIONS = {
    "mono8": ("u1", 1, cv2.COLOR_GRAY2RGB),
    "8UC1": ("u1", 1, cv2.COLOR_GRAY2RGB),
    "8UC3": ("u1", 3, cv2.COLOR_BGR2RGB),
    "yuv422": ("u1", 2, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": ("u1", 2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": ("u1", 2, cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": ("u1", 2, cv2.COLOR_YUV2RGB_YUY2),
    "mono16": ("u2", 1, cv2.COLOR_GRAY2RGB),
    "rgb16": ("u2", 3, None),
    "bgr16": ("u2", 3, cv2.COLOR_BGR2RGB),
    "rgba16": ("u2", 4, cv2.COLOR_RGBA2RGB),
    "bgra16": ("u2", 4, cv2.COLOR_BGRA2RGB),
    **{f"bayer_{pattern}8": ("u1", 1, conversion) for pattern, conversion in _BAYER.items()},
    **{f"bayer_{pattern}16": ("u2", 1, conversion) for pattern, conversion in _BAYER.items()},
}
_DEPTH_TYPES = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4", "64FC1": "f8"}
_PNG = b"\x89PNG"
_HEADER = struct.Struct("<iff")
_MILLIMETRES = 1e-3


def decode_color(message: Any) -> np.ndarray:
    """An Image or a CompressedImage to (H, W, 3) uint8 RGB.

    Raises:
        MessageError: an encoding without a clear meaning, or damaged data.
    """
    if hasattr(message, "format"):
        return _refused_as_message(lambda: read_color(bytes(message.data)), message.format)
    if message.encoding in COLOR_ENCODINGS:
        return image_to_color(message)
    if message.encoding not in _CONVERSIONS:
        usable = ", ".join([*COLOR_ENCODINGS, *_CONVERSIONS])
        raise MessageError(f"colour encoding '{message.encoding}' is not one of {usable}")
    kind, channels, conversion = _CONVERSIONS[message.encoding]
    pixels = image_to_pixels(message, np.dtype(kind), channels)
    if kind == "u2":
        pixels = upper_bits(pixels)
    return pixels if conversion is None else cv2.cvtColor(pixels, conversion)


def decode_depth(message: Any, scale: float = 0.0) -> np.ndarray:
    """An Image or a CompressedImage to (H, W) float32 metres, NaN unless positive and finite.

    Args:
        message: raw, a PNG, or ``compressedDepth``.
        scale: metres per unit; 0 for what REP-118 says: millimetres for integers, metres for floating point.

    Raises:
        MessageError: an encoding without a clear meaning, or damaged data.
    """
    if hasattr(message, "format"):
        values = _decode_compressed_depth(message)
    elif message.encoding in _DEPTH_TYPES:
        values = image_to_pixels(message, np.dtype(_DEPTH_TYPES[message.encoding]), 1)
    else:
        raise MessageError(f"depth encoding '{message.encoding}' is not one of {', '.join(_DEPTH_TYPES)}")
    unit = scale or (_MILLIMETRES if values.dtype.kind in "iu" else 1.0)
    metres = values.astype(np.float32) * np.float32(unit)
    return np.where((metres > 0) & np.isfinite(metres), metres, np.float32(np.nan))


def _decode_compressed_depth(message: Any) -> np.ndarray:
    """(H, W) uint16 or float32 depth in the units of the image that was compressed."""
    data, text = bytes(message.data), message.format
    start = data.find(_PNG, 0, _HEADER.size + len(_PNG))
    if start < 0:
        raise MessageError(
            f"depth of format '{text}' is not a PNG image; set the driver's compressedDepth.format to png"
        )
    values = _refused_as_message(lambda: read_depth(data[start:]), text)
    if not text.startswith("32FC1") or start != _HEADER.size:
        return values
    # compressed_depth_image_transport stores floating-point depth as quantised inverse depth: a / (value - b).
    _, a, b = _HEADER.unpack_from(data)
    if not (np.isfinite([a, b]).all() and a > 0):
        raise MessageError(f"compressedDepth has the quantisation {a:g}, {b:g}, which is none")
    with np.errstate(divide="ignore"):
        return np.where(values > 0, a / (values - np.float32(b)), np.nan).astype(np.float32)


def _refused_as_message(decode: Any, text: str) -> np.ndarray:
    try:
        return decode()
    except ValueError as error:
        raise MessageError(f"image of format '{text}' cannot be read: {error}") from error
