"""Orientation channels: blind to contrast and its sign, to empty borders, and not to structure."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from calib.align.channels import channels, grey, resized, warped
from fusion.errors import InputError


def _scene(seed: int = 0, shape: tuple[int, int] = (96, 128)) -> np.ndarray:
    noise = np.random.default_rng(seed).uniform(0, 1, shape)
    smooth = cv2.GaussianBlur(noise, (0, 0), 4)
    return np.floor(255 * (smooth - smooth.min()) / np.ptp(smooth)).astype(np.uint8)


def _alike(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.vdot(a, b) / np.sqrt(np.vdot(a, a) * np.vdot(b, b)))


def test_a_negative_has_the_same_channels():
    scene = _scene()
    np.testing.assert_allclose(channels(grey(255 - scene)), channels(grey(scene)), atol=1e-3)


def test_sixteen_bits_of_weak_contrast_look_like_eight_bits():
    scene = _scene()
    weak = (30000 + scene.astype(np.uint16)).astype(np.uint16)
    assert _alike(channels(grey(weak)), channels(grey(scene))) > 0.999


def test_a_dead_pixel_does_not_set_the_window():
    scene = _scene().astype(np.uint16)
    spoilt = scene.copy()
    spoilt[5, 5] = 65535
    assert _alike(channels(grey(spoilt))[:, 20:], channels(grey(scene))[:, 20:]) > 0.99


def test_other_scenes_have_other_channels():
    assert abs(_alike(channels(grey(_scene(0))), channels(grey(_scene(1))))) < 0.2


def test_the_empty_wedges_of_a_warped_image_are_not_seen():
    scene = np.maximum(_scene(), 1)
    turn = cv2.getRotationMatrix2D((64, 48), 10, 1.0)
    made = cv2.warpAffine(scene, turn, (128, 96), flags=cv2.INTER_NEAREST)
    truth = cv2.warpAffine(np.full_like(scene, 255), turn, (128, 96), flags=cv2.INTER_NEAREST)
    assert (grey(made).seen == truth).mean() > 0.999
    rim = cv2.dilate(255 - truth, np.ones((5, 5), np.uint8)) > 0
    assert np.abs(channels(grey(made))[:, truth == 0]).max() < np.abs(channels(grey(made))[:, ~rim]).max() / 5


def test_a_cold_sky_over_roofs_is_seen():
    scene = np.maximum(_scene(), 1)
    roofs = 30 + (np.arange(128) % 40 > 20) * 20
    scene[np.arange(96)[:, None] < roofs[None]] = 0
    assert (grey(scene).seen == 255).all()


def test_resizing_says_where_pixels_go():
    image = grey(_scene(shape=(90, 120)))
    small, matrix = resized(image, 0.5)
    assert small.shape == (45, 60)
    np.testing.assert_allclose(matrix @ [-0.5, -0.5, 1], [-0.5, -0.5, 1])
    np.testing.assert_allclose(matrix @ [119.5, 89.5, 1], [59.5, 44.5, 1])


def test_warped_pixels_lie_where_the_matrix_says():
    image = grey(_scene())
    moved = warped(image, np.array([[1, 0, 7.0], [0, 1, 3], [0, 0, 1]]), (128, 96))
    np.testing.assert_allclose(moved.pixels[3:, 7:], image.pixels[:-3, :-7], atol=1e-6)
    assert (moved.seen[:, :7] == 0).all()
    assert (moved.seen[3:, 7:] == 255).all()


def test_an_image_of_one_value_shows_nothing():
    with pytest.raises(InputError, match="shows nothing: every pixel is 7"):
        grey(np.full((40, 40), 7, np.uint8))


@pytest.mark.parametrize(
    "image", [np.zeros((4, 4), np.float32), np.zeros((4, 4, 2), np.uint8), np.zeros(4, np.uint8)]
)
def test_other_arrays_are_refused(image):
    with pytest.raises(ValueError, match="expected"):
        grey(image)


def test_no_input_is_changed():
    scene = _scene()
    before = scene.copy()
    channels(grey(scene))
    np.testing.assert_array_equal(scene, before)
