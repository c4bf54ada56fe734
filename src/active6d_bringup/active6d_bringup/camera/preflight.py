"""What is wrong with a camera's data, once and in words, and which setting helps."""

import numpy as np

from active6d_core.bounds import PLAUSIBLE_DEPTH
from active6d_core.calibration import Calibration

#: The median depth of a bin cannot be further from the camera's distance to it than this factor.
_SCALE_FACTOR = 3.0
_FARTHEST_CAMERA = 20.0
#: Cosine of the angle between the camera's axis and the way to the bin, below which it looks past the bin.
_TOWARDS_BIN = 0.5
#: Nanoseconds by which no driver's poses come after its images.
_LATEST_POSE = 10**9


def check_depth_unit(depth: np.ndarray, distance: float | None = None) -> str:
    """Whether depth can be metres; empty if so.

    Args:
        depth: (H, W) metres, NaN where invalid.
        distance: metres from the camera to the bin, None where it is not known.
    """
    if not np.isfinite(depth).any():
        return "depth has no valid pixel: is the lens covered, the bin out of range, or the projector off?"
    median = float(np.nanmedian(depth))
    low, high = PLAUSIBLE_DEPTH
    if distance is not None and distance > low:
        low, high = max(low, distance / _SCALE_FACTOR), min(high, distance * _SCALE_FACTOR)
    if low <= median <= high:
        return ""
    measured = f"median {median:.4g} m" + (f", the bin is {distance:.2f} m away" if distance is not None else "")
    if low <= median * 1e-3 <= high:
        return f"depth looks like millimetres that are read as metres ({measured}): set depth_scale to 0.001"
    for unit in (0.1, 0.01, 10.0):
        if low <= median * unit <= high:
            return (
                f"depth is {1 / unit:g} times what it can be ({measured}): multiply depth_scale by {unit:g} (unset, it "
                "is 0.001 for integers)"
            )
    return f"depth cannot be metres ({measured}): set depth_scale, or the pose is not the camera's"


def check_sizes(calibration: Calibration, color: np.ndarray) -> str:
    """Whether camera_info belongs to (H, W, 3) colour images; empty if so."""
    size = color.shape[1], color.shape[0]
    if calibration.image_size == size:
        return ""
    return (
        f"camera_info is for {calibration.image_size[0]}x{calibration.image_size[1]} images, these are "
        f"{size[0]}x{size[1]}: set info_topic to the camera_info of this stream"
    )


def check_matrices(calibration: Calibration, rectified: bool) -> str:
    """Whether camera_info leaves no doubt that images are raw, or rectified; empty if so."""
    if not rectified and calibration.distorted:
        return "camera_info has distortion, so images are rectified here: if they are already, say so (rectified)"
    if rectified or not calibration.matrices_differ:
        return ""
    focal = f"fx {calibration.K[0, 0]:.1f} and {calibration.P[0, 0]:.1f}"
    return f"K and P of camera_info differ ({focal}) without distortion: P is used, as for rectified images"


def check_skew(skew: int | None, tolerance: int) -> str:
    """Whether colour and depth come together; empty if so.

    Args:
        skew: smallest difference (ns) of stamps among the images without a partner, None where nothing is wrong.
        tolerance: what is accepted, ns.
    """
    if skew is None or skew <= tolerance:
        return ""
    if skew > 10**9:
        return f"stamps of colour and depth are {skew * 1e-9:.1f} s apart: their clocks differ"
    fitting = np.ceil(skew * 1e-6 + 1.0) * 1e-3
    return f"stamps of colour and depth differ by {skew * 1e-6:.0f} ms: set stamp_tolerance to {fitting:.3f}"


def check_pose_stamp(nearest: int | None, stamp: int, tolerance: int) -> str:
    """Whether there is a camera pose at an image's stamp; empty if so. All in nanoseconds."""
    if nearest is None:
        return "no camera pose has come"
    difference = abs(nearest - stamp)
    if difference <= tolerance:
        return ""
    if difference > 10**9:
        return f"the nearest camera pose is {difference * 1e-9:.1f} s from the image: do both use the same clock?"
    return (
        f"the nearest camera pose is {difference * 1e-6:.0f} ms from the image: set pose_tolerance or publish it faster"
    )


def check_pose_lag(lag: int, tolerance: int, full: bool) -> str:
    """Whether images wait for camera poses in vain; empty if not.

    Args:
        lag: from the newest pose to the newest image that waits for one, ns.
        tolerance: what is accepted, ns.
        full: whether so many images wait that the oldest ones are dropped.
    """
    # Between two poses every image waits for a moment.
    if lag <= tolerance or not (full or lag > _LATEST_POSE):
        return ""
    return (
        f"the newest camera pose is {lag * 1e-9:.1f} s older than the newest image: their clocks differ, or poses come "
        "late or no more; let both use the same clock, and publish poses sooner"
    )


def check_pose_rate(poses: int, still_seconds: float) -> str:
    """Whether enough poses come to tell that the camera stands; ``poses`` are those of the last ``still_seconds``."""
    if poses > 1:
        return ""
    return f"fewer than two camera poses in {still_seconds:g} s: publish them faster, or set still_seconds higher"


def check_pose(T_world_camera: np.ndarray) -> str:
    """Whether a camera pose can be one in front of a bin; empty if so."""
    position = T_world_camera[:3, 3]
    distance = float(np.linalg.norm(position))
    if position[2] <= 0:
        return (
            f"the camera is {-position[2]:.2f} m below the bin: world's z must point up, its origin is the bin's centre"
        )
    if T_world_camera[:3, 2] @ position > -_TOWARDS_BIN * distance:
        return (
            "the camera looks past the bin: is the pose that of the optical frame (z forward), not of its body (x "
            "forward), and world's origin the bin?"
        )
    return ""


def check_distance(T_world_camera: np.ndarray) -> str:
    """Whether the camera is near enough to the bin for its position to be metres; empty if so."""
    distance = float(np.linalg.norm(T_world_camera[:3, 3]))
    if distance <= _FARTHEST_CAMERA:
        return ""
    return f"the camera's pose is {distance:.0f} m from the world's origin: is it in millimetres?"
