"""Images of camera drivers, raw or compressed, as arrays: more encodings than the graph itself uses."""

import struct
from typing import Any

import cv2
import numpy as np

from active6d_core.images import read_color, read_depth, upper_bits
from active6d_core.ros.conversions import COLOR_ENCODINGS, MessageError, image_to_color, image_to_pixels

#: ROS encoding to channels and OpenCV's conversion to RGB, None for none.
_CONVERSIONS = {
    "mono8": (1, cv2.COLOR_GRAY2RGB),
    "8UC1": (1, cv2.COLOR_GRAY2RGB),
    "8UC3": (3, cv2.COLOR_BGR2RGB),
    "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": (2, cv2.COLOR_YUV2RGB_YUY2),
    # OpenCV names Bayer patterns by their second row and column.
    "bayer_rggb8": (1, cv2.COLOR_BayerBG2RGB),
    "bayer_bggr8": (1, cv2.COLOR_BayerRG2RGB),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGR2RGB),
    "bayer_grbg8": (1, cv2.COLOR_BayerGB2RGB),
}
#: The same for 16 bits a channel, of which the upper ones are kept.
_CONVERSIONS_16 = {
    "mono16": (1, cv2.COLOR_GRAY2RGB),
    "rgb16": (3, None),
    "bgr16": (3, cv2.COLOR_BGR2RGB),
    "rgba16": (4, cv2.COLOR_RGBA2RGB),
    "bgra16": (4, cv2.COLOR_BGRA2RGB),
    "bayer_rggb16": (1, cv2.COLOR_BayerBG2RGB),
    "bayer_bggr16": (1, cv2.COLOR_BayerRG2RGB),
    "bayer_gbrg16": (1, cv2.COLOR_BayerGR2RGB),
    "bayer_grbg16": (1, cv2.COLOR_BayerGB2RGB),
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
    sixteen = message.encoding in _CONVERSIONS_16
    if not sixteen and message.encoding not in _CONVERSIONS:
        usable = ", ".join([*COLOR_ENCODINGS, *_CONVERSIONS, *_CONVERSIONS_16])
        raise MessageError(f"colour encoding '{message.encoding}' is not one of {usable}")
    channels, conversion = (_CONVERSIONS_16 if sixteen else _CONVERSIONS)[message.encoding]
    pixels = image_to_pixels(message, np.dtype("u2" if sixteen else "u1"), channels)
    if sixteen:
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
