"""Calibrations of messages as cameras, against OpenCV's projection."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from fusion.errors import FrameError
from fusion.geometry import FisheyeCamera, PinholeCamera
from fusion.messages.base import CameraInfo, Header
from fusion.messages.cameras import camera_of

K = np.array([[500.0, 0, 320], [0, 510, 256], [0, 0, 1]])
RATIONAL = (0.3, -0.1, 0.001, -0.002, 0.02, 0.4, -0.05, 0.01)


def info(
    model: str, D: tuple[float, ...], K: np.ndarray = K, size: tuple[int, int] = (640, 512)
) -> CameraInfo:
    return CameraInfo(Header(), *size, model, D, K, np.eye(3), np.hstack([K, np.zeros((3, 1))]))


@pytest.mark.parametrize(
    ("model", "D", "lens"),
    [
        ("plumb_bob", (), PinholeCamera),
        ("plumb_bob", (0.0,) * 5, PinholeCamera),
        ("", (), PinholeCamera),
        ("plumb_bob", (0.1, -0.2, 0.001, 0.002), PinholeCamera),
        ("plumb_bob", (0.1, -0.2, 0.001, 0.002, 0.05), PinholeCamera),
        ("rational_polynomial", RATIONAL, PinholeCamera),
        ("rational_polynomial", (*RATIONAL, 0.0, 0.0, 0.0, 0.0), PinholeCamera),
        ("equidistant", (0.01, -0.02, 0.003, 0.001), FisheyeCamera),
        ("kannala_brandt", (0.01, -0.02, 0.003, 0.0), FisheyeCamera),
    ],
)
def test_models(model: str, D: tuple[float, ...], lens: type) -> None:
    camera = camera_of(info(model, D))
    assert type(camera) is lens
    assert camera.size_wh == (640, 512)
    xyz = np.array([[0.1, 0.2, 1.0], [-0.3, 0.1, 2.0], [0.0, 0.0, 1.0]])
    zero = np.zeros(3)
    if lens is FisheyeCamera:
        expected, _ = cv2.fisheye.projectPoints(xyz[:, None], zero, zero, K, np.array(D))
    else:
        expected, _ = cv2.projectPoints(xyz, zero, zero, K, np.array(D) if D else None)
    assert np.allclose(camera.project(xyz)[0], expected[:, 0], atol=1e-9)


SKEWED = np.array([[500.0, 3, 320], [0, 510, 256], [0, 0, 1]])


@pytest.mark.parametrize(
    ("there", "words"),
    [
        (info("plumb_bob", (), np.zeros((3, 3))), "uncalibrated"),
        (info("", (), np.diag([0.0, 5, 1])), "uncalibrated"),
        (info("plumb_bob", (), SKEWED), "no camera matrix"),
        (info("plumb_bob", (), np.full((3, 3), np.nan)), "no camera matrix"),
        (info("plumb_bob", (), np.diag([-5.0, 5, 1])), "focal lengths"),
        (info("plumb_bob", (), size=(0, 0)), "0x0"),
        (info("plumb_bob", (np.nan,) * 5), "distortion out of all bounds"),
        (info("plumb_bob", RATIONAL), "8 coefficients of the model plumb_bob"),
        (info("rational_polynomial", (*RATIONAL, 0.1)), "9 coefficients"),
        (info("equidistant", (0.1,) * 5), "5 coefficients"),
        (info("omni", (0.1,)), "'omni' is not known"),
        (info("", (0.1, 0.2, 0.0, 0.0)), "'' is not known"),
    ],
)
def test_what_is_no_camera_is_refused(there: CameraInfo, words: str) -> None:
    with pytest.raises(FrameError) as raised:
        camera_of(there, where="/info")
    assert words in str(raised.value)
    assert str(raised.value).startswith("/info: ")
