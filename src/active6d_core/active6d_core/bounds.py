"""Bounds of values that come from outside: image sizes, distances, camera poses, tables of hypotheses and objects.

A number can be finite and of the right type and still be impossible: a depth of 100 km, a score of 7. Nodes and library
calls check the same bounds here, before any of it reaches an estimator, the fusion or a policy.
"""

import numpy as np

from active6d_core.hypotheses import Hypotheses, SceneObjects

#: Distances in metres along the optical axis that a depth sensor over a bin can measure.
PLAUSIBLE_DEPTH = (0.05, 20.0)
#: Pixels along the shorter and the longer side of an image.
IMAGE_SIDES = (16, 4096)
#: Pixels of an image, a little more than 2048 x 1536: estimators need some 300 bytes for each.
MOST_PIXELS = 3_200_000
#: Metres from the world's origin to anything that a graph deals with.
FARTHEST = 100.0
#: Views of one episode; the policy's largest budget of moves, and the first view.
MOST_VIEWS = 10_001
# Of a belief; it would need more poses than can be numbered.
_MOST_NATS = 100.0
#: Rounding of numbers that were float32 on their way.
_ROUNDING = 1e-4


def check_image_size(width: int, height: int) -> None:
    """Check the size of an image in pixels.

    Raises:
        ValueError: a side is too short or too long, or there are too many pixels.
    """
    low, high = IMAGE_SIDES
    if min(width, height) < low or max(width, height) > high or width * height > MOST_PIXELS:
        raise ValueError(
            f"image of {width}x{height} pixels; sides must be {low} to {high} pixels, and all in all "
            f"{MOST_PIXELS} pixels at most"
        )


def limit_depth(depth: np.ndarray, depth_range: tuple[float, float] = PLAUSIBLE_DEPTH) -> np.ndarray:
    """Make distances outside a range invalid.

    Args:
        depth: (H, W) metres along z, NaN invalid.
        depth_range: least and largest distance that is kept, metres.

    Returns:
        (H, W) with NaN for the others; the same array if there are none.

    Raises:
        ValueError: there are distances, but none of them is in the range.
    """
    low, high = depth_range
    outside = (depth < low) | (depth > high)
    if not outside.any():
        return depth
    limited = np.where(outside, np.float32(np.nan), depth)
    if np.isnan(limited).all():
        median = float(np.median(depth[outside]))
        nearest, farthest = PLAUSIBLE_DEPTH
        as_millimetres = median > farthest and nearest <= 1e-3 * median <= farthest
        cause = (
            "it looks like millimetres in a floating-point image" if as_millimetres else "check the range and the unit"
        )
        raise ValueError(f"no depth is within {low:g} to {high:g} m, the median is {median:.4g} m; {cause}")
    return limited


def check_camera_pose(T_world_camera: np.ndarray) -> None:
    """Check a (4, 4) pose of a camera over a bin, in the world with its origin on the bin's floor and z up.

    Raises:
        ValueError: the camera is too far away, or not above the bin's floor.
    """
    distance, height = float(np.linalg.norm(T_world_camera[:3, 3])), float(T_world_camera[2, 3])
    if distance > FARTHEST:
        raise ValueError(f"the camera is {distance:.4g} m from the world's origin; are its metres millimetres?")
    if height <= 0:
        raise ValueError(
            f"the camera is at z = {height:.4g} m, not above the bin's floor; is the pose inverted, or z not up?"
        )


def check_hypotheses(hypotheses: Hypotheses) -> None:
    """Check hypotheses of one view: scores, boxes, depths, places, labels of the mask.

    Raises:
        ValueError: a value is out of its bounds; the message names the column.
    """
    _check("score", hypotheses.score, 0.0, 1.0)
    _check("box", hypotheses.box, 0.0, 1.0)
    _check("depth", hypotheses.depth, 0.0, FARTHEST, least_included=False)
    _check("position", np.abs(hypotheses.T_camera_object[:, :3, 3]), 0.0, FARTHEST)
    present = np.zeros(2**16, bool)
    present[hypotheses.segmentation.ravel()] = True
    absent = hypotheses.label[~present[hypotheses.label]]
    if len(absent):
        raise ValueError(f"label {absent[0]} has no pixel in the segmentation")


def check_in_front(T_camera_object: np.ndarray) -> None:
    """Check that (k, 4, 4) poses in an optical frame are in front of the camera.

    Raises:
        ValueError: one is not.
    """
    _check("z", T_camera_object[:, 2, 3], 0.0, FARTHEST, least_included=False)


def check_objects(objects: SceneObjects) -> None:
    """Check accumulated objects.

    Raises:
        ValueError: a value is out of its bounds; the message names the column.
    """
    _check("verification", objects.verification, -1.0, 1.0)
    _check("score", objects.score, 0.0, 1.0)
    _check("box", objects.box, 0.0, 1.0)
    _check("depth", objects.depth, -FARTHEST, FARTHEST)
    _check("position", np.abs(objects.T_world_object[:, :3, 3]), 0.0, FARTHEST)
    _check("support", objects.support, 1, MOST_VIEWS)
    _check("spread", objects.spread, 0.0, FARTHEST)
    _check("probability", objects.probability, 0.0, 1.0)
    _check("entropy", objects.entropy, 0.0, _MOST_NATS)


def check_points(points: np.ndarray) -> None:
    """Check (k, 3) points in metres.

    Raises:
        ValueError: a point is too far away.
    """
    _check("position", np.abs(points), 0.0, FARTHEST)


def _check(name: str, values: np.ndarray, low: float, high: float, least_included: bool = True) -> None:
    """Raise ValueError unless all values are within low and high; NaN never is."""
    within = (values >= low - _ROUNDING) & (values <= high + _ROUNDING)
    if not least_included:
        within &= values > low
    if not np.all(within):
        worst = np.asarray(values)[~within].flat[0]
        raise ValueError(f"column '{name}' holds {worst:.4g}, expected {low:g} to {high:g}")
