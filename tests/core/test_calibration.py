"""The pinhole camera of rectified images from what drivers publish: K or P, regions and binning."""

from types import SimpleNamespace

import numpy as np
import pytest

from active6d_core.calibration import Calibration
from active6d_core.camera import PinholeCamera

K = np.array([[600.0, 0.0, 319.5], [0.0, 610.0, 239.5], [0.0, 0.0, 1.0]])
P = np.hstack([K * np.array([[0.9], [0.9], [1.0]]), np.zeros((3, 1))])


def test_p_counts_and_k_where_it_is_empty():
    assert Calibration(640, 480, K, P=P).rectified_camera() == PinholeCamera(640, 480, 540, 549, 287.55, 215.55)
    assert Calibration(640, 480, K).rectified_camera() == PinholeCamera(640, 480, 600, 610, 319.5, 239.5)
    assert Calibration(640, 480, np.eye(3), P=P).rectified_camera().fx == 540
    assert Calibration(640, 480, K, P=P).matrices_differ
    assert not Calibration(640, 480, np.eye(3), P=P).matrices_differ


def test_neither_known_is_refused():
    with pytest.raises(ValueError, match="neither P nor K"):
        Calibration(640, 480, np.eye(3)).rectified_camera()


def test_a_calibration_of_another_size_is_refused():
    with pytest.raises(ValueError, match="another image size"):
        Calibration(160, 120, K).rectified_camera()


def test_a_region_may_be_beside_the_centre():
    camera = Calibration(640, 480, K, region=(400, 0, 200, 480)).rectified_camera()
    assert (camera.width, camera.cx) == (200, K[0, 2] - 400)
    with pytest.raises(ValueError, match="another image size"):
        Calibration(640, 480, K - [[0, 0, 5000], [0, 0, 0], [0, 0, 0]], region=(400, 0, 200, 480)).rectified_camera()


def test_region_and_binning_move_every_ray_with_its_pixel():
    """A pixel of the image sees what the same place of the full resolution sees."""
    calibration = Calibration(640, 480, K, binning=(2, 2), region=(100, 60, 400, 300))
    assert calibration.image_size == (200, 150)
    camera = calibration.rectified_camera()
    for u, v in ((0, 0), (40, 30), (199, 149)):
        # the centre of a 2 x 2 block of pixels
        full_u, full_v = 100 + 2 * u + 0.5, 60 + 2 * v + 0.5
        assert (u - camera.cx) / camera.fx == pytest.approx((full_u - K[0, 2]) / K[0, 0])
        assert (v - camera.cy) / camera.fy == pytest.approx((full_v - K[1, 2]) / K[1, 1])


def test_camera_info_of_ros_1_and_2_are_read():
    region = SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0)
    shared = {"width": 640, "height": 480, "distortion_model": "plumb_bob", "binning_x": 0, "binning_y": 0}
    two = SimpleNamespace(k=K.ravel(), d=[0.0] * 5, r=np.zeros(9), p=P.ravel(), roi=region, **shared)
    one = SimpleNamespace(K=K.ravel(), D=[0.0] * 5, R=np.zeros(9), P=P.ravel(), roi=region, **shared)
    for message in (one, two):
        calibration = Calibration.from_info(message)
        assert not calibration.distorted  # a rotation of zeros means none
        assert calibration.rectified_camera().fx == 540
    two.k = np.full(9, np.nan)
    with pytest.raises(ValueError, match="k of camera_info holds a number that is not finite"):
        Calibration.from_info(two)
