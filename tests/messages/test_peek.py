"""The head of a picture against what OpenCV wrote, and bytes that are none."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fusion.messages.peek import peek


def encoded(form, pixels):
    return cv2.imencode(form, pixels)[1].tobytes()


@pytest.mark.parametrize(
    ("form", "shape", "dtype", "word"),
    [
        (".png", (7, 5), np.uint8, "mono8"),
        (".png", (7, 5), np.uint16, "mono16"),
        (".png", (7, 5, 3), np.uint8, "bgr8"),
        (".png", (7, 5, 4), np.uint8, "bgra8"),
        (".png", (7, 5, 3), np.uint16, "bgr16"),
        (".jpg", (7, 5), np.uint8, "mono8"),
        (".jpg", (700, 5, 3), np.uint8, "bgr8"),
    ],
)
def test_forms(form, shape, dtype, word):
    head = peek(encoded(form, np.zeros(shape, dtype)))
    assert head is not None
    assert (head.encoding, head.size_wh) == (word, (shape[1], shape[0]))
    assert head.form == {".png": "png", ".jpg": "jpeg"}[form]


@given(st.binary(max_size=80))
def test_what_is_no_picture_is_none(data):
    assert peek(data) is None or data[:2] in (b"\x89P", b"\xff\xd8")
    peek(b"\xff\xd8" + data)
    peek(b"\x89PNG\r\n\x1a\n" + data)


@given(st.integers(0, 200))
def test_cut_off_anywhere(count):
    data = encoded(".jpg", np.zeros((8, 8, 3), np.uint8))
    head = peek(data[:count])
    assert head is None or head.size_wh == (8, 8)


def test_nothing_but_empty_segments_ends_soon():
    empty, frame = b"\xff\xe0\x00\x02", b"\xff\xc0\x00\x11\x08\x00\x05\x00\x07\x03"
    assert peek(b"\xff\xd8" + empty * 100 + frame) is not None
    assert peek(b"\xff\xd8" + empty * 100_000 + frame) is None
