"""Rectification, registration, decoding and the choice of frames, against independent calculations. No ROS graph."""

import struct
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from simulated_driver import look

from active6d_bringup.camera import preflight
from active6d_bringup.camera.depth_registration import register_depth
from active6d_bringup.camera.driver_images import decode_color, decode_depth
from active6d_bringup.camera.rectification import RECTIFIED, Rectifier, are_rectified
from active6d_bringup.camera.stream import SECOND, ArrivalGate, FrameMatcher, GateLimits, PoseHistory, Verdict
from active6d_core.calibration import Calibration
from active6d_core.camera import PinholeCamera, backproject
from active6d_core.ros.conversions import MessageError, color_to_image
from active6d_core.se3 import make_transform
from active6d_core.view_sphere import ViewSphere

CAMERA = PinholeCamera(160, 120, 150.0, 152.0, 78.0, 61.0)
SPHERE = ViewSphere()
POSE = SPHERE.pose(SPHERE.positions[63])


def fisheye(x, y, d):
    """The equidistant model by its definition."""
    r = np.hypot(x, y)
    theta = np.arctan(r)
    bent = theta * (1 + d[0] * theta**2 + d[1] * theta**4 + d[2] * theta**6 + d[3] * theta**8)
    factor = np.where(r > 0, bent / np.where(r > 0, r, 1), 1)
    return x * factor, y * factor


def rational(x, y, d):
    """Brown's model with a denominator, by its definition; d = k1 k2 p1 p2 k3 k4 k5 k6."""
    k1, k2, p1, p2, k3, k4, k5, k6 = [*d, *[0.0] * (8 - len(d))]
    r2 = x * x + y * y
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


MODELS = {
    # Drivers fill up with zeros, and give a lens of eight coefficients the name of five.
    "": (rational, [-0.12, 0.05, 0.002, -0.001, 0.01]),
    "brown_conrady": (rational, [0.3, -0.2, 0.001, 0.001, 0.05, 0.35, -0.15, 0.02]),
    "plumb_bob": (rational, [-0.12, 0.05, 0.002, -0.001, 0.01]),
    "rational_polynomial": (rational, [0.3, -0.2, 0.001, 0.001, 0.05, 0.35, -0.15, 0.02]),
    "equidistant": (fisheye, [-0.02, 0.01, -0.005, 0.001]),
}


@pytest.mark.parametrize(
    ("name", "of", "filled"),
    [("plumb_bob", "rational_polynomial", 0), ("plumb_bob", "plumb_bob", 3), ("equidistant", "equidistant", 4)],
)
def test_coefficients_of_a_longer_model_and_zeros_at_the_end_are_taken(name, of, filled):
    d = np.array(MODELS[of][1])
    longer = Rectifier(Calibration(160, 120, CAMERA.matrix, np.append(d, np.zeros(filled)), model=name))
    image = np.random.default_rng(0).integers(0, 256, (120, 160, 3)).astype(np.uint8)
    expected = Rectifier(Calibration(160, 120, CAMERA.matrix, d, model=of)).color(image)
    np.testing.assert_array_equal(longer.color(image), expected)


def distorted_image(model, R=np.eye(3)):
    """What a distorting camera sees of the floor: each pixel's ray found by Newton's method on the model."""
    distort, d = MODELS[model]
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    target = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy])
    found = target.copy()
    for _ in range(50):
        found -= np.stack(distort(*found, d)) - target
    assert np.abs(np.stack(distort(*found, d)) - target).max() < 1e-9
    T_world_raw = POSE @ make_transform(R, np.zeros(3))
    return look(np.moveaxis(np.concatenate([found, np.ones((1, *u.shape))]), 0, -1), T_world_raw)


@pytest.mark.parametrize("model", MODELS)
def test_rectified_images_are_those_of_a_pinhole_camera(model):
    color, depth = distorted_image(model)
    P = np.hstack([CAMERA.matrix * np.array([[0.95], [0.95], [1]]), np.zeros((3, 1))])
    rectifier = Rectifier(Calibration(160, 120, CAMERA.matrix, np.array(MODELS[model][1]), P=P, model=model))
    expected_color, expected_depth = look(backproject(np.ones((120, 160), np.float32), rectifier.camera), POSE)
    found_color, found_depth = rectifier.color(color), rectifier.depth(depth)
    # At the border a colour is mixed with the black beyond it.
    valid = cv2.erode(np.pad(np.isfinite(found_depth), 1).astype(np.uint8), np.ones((3, 3)))[1:-1, 1:-1] > 0
    assert valid.mean() > 0.8
    assert np.abs(found_color[valid].astype(int) - expected_color[valid]).max() <= 3
    assert np.abs(found_depth - expected_depth)[valid].max() < 0.012  # half a pixel on a slanted floor
    assert np.abs(color.astype(int) - expected_color)[valid].max() > 20  # else the test would show nothing


def test_a_rotated_camera_measures_depth_along_its_new_axis():
    angle = np.radians(4)
    R = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    model = "plumb_bob"
    _, depth = distorted_image(model, R)
    rectifier = Rectifier(Calibration(160, 120, CAMERA.matrix, np.array(MODELS[model][1]), R=R, model=model))
    _, expected = look(backproject(np.ones((120, 160), np.float32), rectifier.camera), POSE)
    found = rectifier.depth(depth)
    assert np.nanmax(np.abs(found - expected)) < 0.012
    assert np.isfinite(found).mean() > 0.8


def test_images_without_distortion_and_rectified_ones_pass_unchanged():
    image = np.zeros((120, 160, 3), np.uint8)
    K = CAMERA.matrix
    assert Rectifier(Calibration(160, 120, K)).color(image) is image
    bent = Calibration(
        160, 120, K, np.array(MODELS["plumb_bob"][1]), P=np.hstack([K * [[0.9], [0.9], [1]], np.zeros((3, 1))])
    )
    assert Rectifier(bent, rectified=True).color(image) is image
    assert Rectifier(bent, rectified=True).camera.fx == pytest.approx(135)


@pytest.mark.parametrize(
    ("topic", "rectified"),
    [
        ("/camera/image_rect", True),
        ("/camera/image_rect_color/compressed", True),
        ("camera/rgb/image_rectified", True),
        ("/zed/rgb/color/rect/image", True),
        ("rect", True),
        ("/camera/color/image_raw", False),
        ("/camera/image_color_corrected", False),
        ("/camera/direct_image", False),
        ("/camera/direct/image_raw/compressed", False),
    ],
)
def test_the_word_rect_in_a_topics_name_says_that_its_images_are_rectified(topic, rectified):
    assert are_rectified(RECTIFIED["auto"], topic) == rectified
    assert are_rectified(RECTIFIED["yes"], topic)
    assert not are_rectified(RECTIFIED["no"], topic)


@pytest.mark.parametrize(
    ("model", "coefficients", "words"),
    [("thin_prism", 5, "distortion model 'thin_prism' is not one of"), ("equidistant", 5, "has 4 coefficients")],
)
def test_models_that_opencv_lacks_are_refused(model, coefficients, words):
    with pytest.raises(ValueError, match=words):
        Rectifier(Calibration(160, 120, CAMERA.matrix, np.full(coefficients, 0.1), model=model))


def test_registered_depth_is_what_the_colour_camera_would_measure():
    depth_camera = PinholeCamera(212, 120, 105.0, 105.0, 105.5, 59.5)
    T_color_depth = make_transform(np.eye(3), np.array([-0.05, 0.002, 0.001]))
    _, depth = look(backproject(np.ones((120, 212), np.float32), depth_camera), POSE @ T_color_depth)
    found = register_depth(depth, depth_camera, CAMERA, T_color_depth)
    _, expected = look(backproject(np.ones((120, 160), np.float32), CAMERA), POSE)
    assert np.isfinite(found).mean() > 0.97
    assert np.nanmax(np.abs(found - expected)) < 0.02


def test_the_nearest_surface_wins_where_two_project_to_one_pixel():
    depth = np.full((120, 160), 1.0, np.float32)
    depth[:, 80:] = 0.5
    T_color_depth = make_transform(np.eye(3), np.array([-0.1, 0.0, 0.0]))
    found = register_depth(depth, CAMERA, CAMERA, T_color_depth)
    # brute force: every pixel by itself
    expected = np.full((120, 160), np.inf)
    for v in range(120):
        for u in range(160):
            z = depth[v, u]
            moved = u - 0.1 * CAMERA.fx / z
            column = round(moved)
            if 0 <= column < 160:
                expected[v, column] = min(expected[v, column], z)
    both = np.isfinite(expected) & np.isfinite(found)
    assert both.mean() > 0.6
    assert (found == expected)[both].mean() > 0.98


def compressed(text, data):
    return SimpleNamespace(format=text, data=data)


def test_floating_point_compressed_depth_is_read_by_its_quantisation():
    depth = np.linspace(0.3, 2.0, 4800).reshape(60, 80)
    a, b = 1000.0, 20.0
    steps = np.rint(a / depth + b).astype(np.uint16)
    steps[0, 0] = 0
    data = struct.pack("<iff", 0, a, b) + cv2.imencode(".png", steps)[1].tobytes()
    found = decode_depth(compressed("32FC1; compressedDepth png", data))
    assert np.isnan(found[0, 0])
    np.testing.assert_allclose(found.ravel()[1:], depth.ravel()[1:], rtol=2e-3)


@pytest.mark.parametrize("header", [b"", bytes(12)])
def test_integer_depth_is_read_from_png(header):
    steps = np.arange(4800, dtype=np.uint16).reshape(60, 80)
    message = compressed("16UC1; compressedDepth png", header + cv2.imencode(".png", steps)[1].tobytes())
    np.testing.assert_allclose(np.nan_to_num(decode_depth(message)), steps * 1e-3, rtol=1e-6)
    np.testing.assert_allclose(np.nan_to_num(decode_depth(message, 1e-4)), steps * 1e-4, rtol=1e-6)


@pytest.mark.parametrize(
    ("text", "data", "words"),
    [
        ("16UC1; compressedDepth rvl", bytes(40), "is not a PNG image; set the driver's compressedDepth.format to png"),
        ("16UC1; compressedDepth png", bytes(12) + b"\x89PNGtorn", "not a readable image"),
        ("16UC1; png compressed", cv2.imencode(".png", np.zeros((4, 4, 3), np.uint8))[1].tobytes(), "colour image"),
    ],
)
def test_depth_that_cannot_be_read_names_its_cause(text, data, words):
    with pytest.raises(MessageError, match=words):
        decode_depth(compressed(text, data))


def test_colours_come_right_from_every_encoding():
    color = np.zeros((40, 60, 3), np.uint8)
    color[:, :30], color[:, 30:] = (200, 40, 20), (30, 60, 220)
    yuyv = cv2.cvtColor(color, cv2.COLOR_RGB2YUV_YUY2)
    # RGGB: red at (0, 0), blue at (1, 1)
    bayer = color[..., 1].copy()
    bayer[::2, ::2], bayer[1::2, 1::2] = color[::2, ::2, 0], color[1::2, 1::2, 2]
    cases = {"yuv422_yuy2": yuyv, "8UC3": color[..., ::-1], "bayer_rggb8": bayer}
    for encoding, pixels in cases.items():
        message = color_to_image(np.ascontiguousarray(pixels), 1, "f")
        message.encoding = encoding
        found = decode_color(message)
        inner = np.abs(found.astype(int) - color)[4:-4, [*range(4, 26), *range(34, 56)]]
        assert inner.max() <= 8, encoding
    for ending in (".jpg", ".png"):
        data = cv2.imencode(ending, color[..., ::-1])[1].tobytes()
        found = decode_color(compressed("rgb8; compressed bgr8", data))
        assert np.abs(found.astype(int) - color)[:, [*range(26), *range(34, 60)]].max() <= 8


# The choice of frames


def test_frames_are_paired_within_the_tolerance_and_each_used_once():
    pairs = []
    matcher = FrameMatcher(6_000_000, lambda stamp, color, depth: pairs.append((color, depth)))
    for index in range(20):
        matcher.add("color", index * 66_000_000, index)
        if index != 5:
            matcher.add("depth", index * 66_000_000 + 5_000_000, index)
    assert pairs == [(index, index) for index in range(20) if index != 5]
    assert matcher.unmatched == 1
    assert preflight.check_skew(matcher.skew, 6_000_000) == ""


def test_a_skew_beyond_the_tolerance_is_measured():
    matcher = FrameMatcher(6_000_000, lambda *pair: pytest.fail("paired"))
    for index in range(20):
        matcher.add("color", index * 66_000_000, index)
        matcher.add("depth", index * 66_000_000 + 12_000_000, index)
    expected = "stamps of colour and depth differ by 12 ms: set stamp_tolerance to 0.013"
    assert preflight.check_skew(matcher.skew, 6_000_000) == expected


@pytest.mark.parametrize(
    ("lag", "full", "said"),
    [
        (40 * SECOND, False, True),  # a camera that is triggered: few images wait
        (SECOND // 2, True, True),  # poses come too late for a fast stream
        (SECOND // 8, False, False),  # between two poses
        (SECOND // 100, True, False),
    ],
)
def test_poses_behind_the_images_are_said_when_images_wait_in_vain(lag, full, said):
    assert ("their clocks differ" in preflight.check_pose_lag(lag, 50_000_000, full)) == said


class Counting(int):
    """A stamp that counts how often it is compared or subtracted."""

    looks = 0

    def _look(self, other, calculate):
        Counting.looks += 1
        return calculate(self, other)

    def __lt__(self, other):
        return self._look(other, int.__lt__)

    def __gt__(self, other):
        return self._look(other, int.__gt__)

    def __le__(self, other):
        return self._look(other, int.__le__)

    def __sub__(self, other):
        return self._look(other, int.__sub__)


def test_a_pose_of_a_long_recording_is_found_without_looking_at_all():
    rng = np.random.default_rng(3)
    stamps = np.cumsum(rng.integers(0, 20, 5000)).tolist()  # some repeat
    history = PoseHistory(keep=None)
    for number, stamp in enumerate(stamps):
        history.add(Counting(stamp), np.full((4, 4), number))
    Counting.looks = 0
    for stamp in rng.integers(-50, stamps[-1] + 50, 100).tolist():
        at, T = history.nearest(stamp)
        assert abs(at - stamp) == min(abs(each - stamp) for each in stamps)
        assert stamps[int(T[0, 0])] == at
        found = [int(T[0, 0]) for T in history.between(stamp, stamp + 100)]
        assert found == [number for number, each in enumerate(stamps) if stamp <= each <= stamp + 100]
    assert Counting.looks < 100 * 100
    assert PoseHistory().nearest(0) is None
    assert PoseHistory().between(0, 1) == []


def test_a_live_history_keeps_the_last_poses_and_begins_again_when_the_clock_goes_back():
    history = PoseHistory(keep=3)
    for stamp in range(5):
        history.add(stamp, np.full((4, 4), stamp))
    assert (len(history), history.oldest, history.newest, history.nearest(0)[0]) == (4, 1, 4, 1)
    history.add(0, np.eye(4))
    assert (len(history), history.newest) == (1, 0)


def test_fast_poses_are_kept_as_long_as_slow_ones():
    history = PoseHistory()
    for stamp in range(0, 5 * SECOND, SECOND // 1000):
        history.add(stamp, np.eye(4))
    assert history.nearest(2 * SECOND)[0] == 2 * SECOND


class Arm:
    """A camera that moves to where it is sent in one second, seen by a gate at 30 Hz."""

    def __init__(self, **limits):
        self.poses = PoseHistory()
        self.gate = ArrivalGate(GateLimits(**limits), self.poses)
        self.stamp, self.T = 50 * SECOND, SPHERE.pose(SPHERE.positions[0])

    def go(self, T, seconds=1.0):
        """Where the camera is at each stamp of a straight move."""
        start = self.T
        for share in np.linspace(0, 1, round(30 * seconds)):
            position = start[:3, 3] + share * (T[:3, 3] - start[:3, 3])
            yield SPHERE.pose(position) if share < 1 else T

    def see(self, T):
        self.stamp, self.T = self.stamp + SECOND // 30, T
        self.poses.add(self.stamp, T)
        return self.gate.judge(self.stamp)

    def stand(self, seconds):
        return [self.see(self.T) for _ in range(round(30 * seconds))]


def decided(verdicts):
    return [(index, *verdict) for index, verdict in enumerate(verdicts) if verdict[0] is not Verdict.WAIT]


def test_the_first_view_comes_when_the_camera_stands():
    arm = Arm()
    moving = [arm.see(T) for T in arm.go(SPHERE.pose(SPHERE.positions[40]))]
    assert decided(moving) == []
    ((index, verdict, _),) = decided(arm.stand(2.0))
    assert verdict is Verdict.TAKE
    assert 8 <= index <= 10  # 0.3 s at 30 Hz


def test_one_image_on_request_is_enough_where_poses_come_meanwhile():
    """Such a camera takes no image before it stands."""
    arm, goal = Arm(), SPHERE.pose(SPHERE.positions[40])

    def settle(T):
        for _ in range(60):
            arm.stamp += SECOND // 50
            arm.poses.add(arm.stamp, T)
        return arm.gate.judge(arm.stamp)[0]

    assert settle(arm.T) is Verdict.TAKE
    arm.gate.ask(goal)
    assert arm.gate.judge(arm.stamp)[0] is Verdict.WAIT  # of before the goal
    assert settle(goal) is Verdict.TAKE


def test_a_goal_is_answered_once_after_arrival_and_not_on_the_way():
    arm = Arm()
    goal = SPHERE.pose(SPHERE.positions[40])
    arm.stand(1.0)
    arm.gate.ask(goal)
    assert decided(arm.stand(0.5)) == []  # the controller has not begun yet
    assert decided([arm.see(T) for T in arm.go(goal)]) == []
    assert [verdict for _, verdict, _ in decided(arm.stand(2.0))] == [Verdict.TAKE]
    assert decided(arm.stand(3.0)) == []


def test_a_camera_that_need_not_move_gives_a_fresh_image():
    arm = Arm()
    arm.stand(1.0)
    asked = arm.stamp
    arm.gate.ask(arm.T)
    ((index, verdict, _),) = decided(arm.stand(1.0))
    assert verdict is Verdict.TAKE
    assert arm.stamp - (29 - index) * (SECOND // 30) > asked


def test_a_camera_that_stops_elsewhere_is_said():
    arm = Arm()
    arm.stand(1.0)
    goal, elsewhere = SPHERE.pose(SPHERE.positions[40]), SPHERE.pose(SPHERE.positions[41])
    arm.gate.ask(goal)
    assert decided([arm.see(T) for T in arm.go(elsewhere)]) == []
    ((_, verdict, reason),) = decided(arm.stand(4.0))
    assert verdict is Verdict.REFUSE
    distance = np.linalg.norm(goal[:3, 3] - elsewhere[:3, 3])
    assert reason.startswith(f"the camera stopped {distance:.3f} m and ")


def test_a_goal_that_moves_nobody_is_given_up():
    arm = Arm(goal_seconds=5.0)
    arm.stand(1.0)
    arm.gate.ask(SPHERE.pose(SPHERE.positions[40]))
    ((_, verdict, reason),) = decided(arm.stand(8.0))
    assert verdict is Verdict.REFUSE
    assert reason.startswith("the camera has not moved after 5 s")


def test_a_trembling_camera_is_not_still():
    arm = Arm()
    base = arm.T
    for index in range(60):
        T = base.copy()
        T[0, 3] += 0.003 * (index % 2)
        assert arm.see(T)[0] is Verdict.WAIT


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (1000, "looks like millimetres"),
        (10, "is 10 times what it can be"),
        (0.1, "multiply depth_scale by 10"),
        (1, ""),
    ],
)
def test_units_of_depth_are_judged_by_the_bins_distance(factor, words):
    message = preflight.check_depth_unit(np.full((10, 10), 0.8 * factor, np.float32), 0.8)
    assert words in message
    assert bool(message) == bool(words)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda T: T @ make_transform(np.diag([1.0, -1.0, -1.0]), np.zeros(3)), "looks past the bin"),
        (lambda T: make_transform(T[:3, :3], 1000 * T[:3, 3]), "in millimetres"),
        (lambda T: make_transform(T[:3, :3], [1.0, 1.0, -1.0] * T[:3, 3]), "below the bin"),
        (lambda T: T, ""),
    ],
)
def test_poses_that_cannot_be_in_front_of_a_bin_are_named(change, words):
    message = preflight.check_distance(change(POSE)) or preflight.check_pose(change(POSE))
    assert words in message
    assert bool(message) == bool(words)
