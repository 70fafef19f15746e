"""Text, page and JSON of findings whose names are hostile; commands as a shell reads them."""

from __future__ import annotations

import base64
import json
import re
import shlex
import subprocess
from html.parser import HTMLParser

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fusion.frames import PointCloud
from fusion.inspect.base import Finding, Looked, Picture, Step, Stream
from fusion.inspect.measure import PixelTally, times_of
from fusion.inspect.page import page_of
from fusion.inspect.pictures import histogram, strip, thumbnail, top_view
from fusion.inspect.record import json_of
from fusion.inspect.text import command_of, quoted, rows_of, text_of

EVIL = "<script>alert(1)</script>\x1b[31m\n\u202e'\"&"


def hostile() -> Finding:
    stamps = np.array([0, 1, 2, 3, 30], np.int64) * 10**8
    times = times_of(stamps.tolist(), "log", Looked(5, 5, "messages"))
    streams = (
        Stream(EVIL, EVIL, "image", 5, EVIL, Looked(2, 5, "messages"), {EVIL: EVIL}, times, (EVIL,), stamps),
        Stream(EVIL, EVIL, ""),
    )
    picture = thumbnail(EVIL, np.zeros((4, 4), np.uint8))
    step = Step(("fusion", "inspect", EVIL), EVIL)
    facts = {"bad": float("nan"), "list": [EVIL]}
    return Finding(EVIL, "recording", EVIL, facts, streams, None, (EVIL,), (EVIL,), (step,), (picture,))


class Tags(HTMLParser):
    def __init__(self):
        super().__init__()
        self.tags, self.links = [], []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.links += [value for name, value in attrs if name in ("src", "href")]


def test_the_page_escapes_and_stands_alone():
    page = page_of(hostile()).decode()
    parser = Tags()
    parser.feed(page)
    assert "script" not in parser.tags
    assert "\x1b" not in page
    assert "\u202e" not in page
    assert parser.links
    assert all(link.startswith("data:image/") for link in parser.links)
    assert "http" not in re.sub(r"data:image/[^\"]*", "", page)


def red_in(page: bytes) -> bool:
    strips = re.findall(rb'alt="times of [^>]*base64,([^"]+)"', page)
    (data,) = [base64.b64decode(found) for found in strips]
    bgr = decoded(data).astype(int)
    return bool((bgr[..., 2] - bgr[..., 0] > 100).any())


def test_gaps_are_drawn_only_where_every_message_was_seen():
    stamps = np.array([0, 1, 2, 3, 30], np.int64) * 10**8
    for of, red in ((5, True), (500, False)):
        times = times_of(stamps.tolist(), "log", Looked(5, of, "messages"))
        stream = Stream("/a", "t", "image", of, times=times, stamps_ns=stamps)
        assert red_in(page_of(Finding("p", "recording", "t", streams=(stream,)))) is red


def test_the_text_cannot_drive_a_terminal():
    lines = text_of(hostile())
    assert all(line.isprintable() for line in lines)


def test_the_json_is_json():
    record = json.loads(json_of(hostile()))
    assert record["facts"]["bad"] is None
    assert record["path"] == EVIL
    assert record["streams"][0]["times"]["gap_count"] == 1


@given(st.text(st.characters(min_codepoint=32, max_codepoint=0x2FFF, exclude_categories=["Cs"]), min_size=1))
def test_commands_are_read_as_they_were_meant(word):
    if word.isprintable():
        assert shlex.split(command_of(Step(("fusion", word, "-o"), ""))) == ["fusion", word, "-o"]


@pytest.mark.parametrize("word", [EVIL, "a b", "$(reboot)", "`x`", "\\", "it's", "!", "é\x07", "*", "-o", ""])
def test_a_real_shell_gets_the_same_bytes(word):
    script = f"printf '%s' {quoted(word)}"
    done = subprocess.run(["bash", "-c", script], capture_output=True, check=True)
    assert done.stdout == word.encode()
    assert script.isprintable()


def test_units_stand_with_their_values():
    facts = {
        "duration_s": 1.5,
        "size_wh": [640, 480],
        "file_bytes": 1500,
        "range_m": {"least": 1.0, "most": 2.0},
    }
    rows = dict(rows_of(facts))
    assert rows["duration"] == "1.5 s"
    assert rows["size"] == "640x480"
    assert rows["file"] == "1.5 kB (1,500 bytes)"
    assert rows["range"] == "least 1 m, most 2 m"
    assert dict(rows_of({"extent_m": {"x": [-1.0, 3.5]}}))["extent"] == "x -1 m to 3.5 m"
    assert dict(rows_of({"first_ns": 1_700_000_000 * 10**9}))["first"] == "2023-11-14 22:13:20.000000"
    assert dict(rows_of({"points": [5, 5]}))["points"] == "5"


def decoded(picture: Picture | bytes | None) -> np.ndarray:
    import cv2

    data = picture if isinstance(picture, bytes) else picture.data if picture else b""
    return np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED))


def test_a_thumbnail_is_small_and_stretched():
    counts = np.linspace(7000, 7400, 1000 * 800).reshape(800, 1000).astype(np.uint16)
    made = decoded(thumbnail("t", counts))
    assert made.shape == (360, 450)
    assert made[0].mean() < 5
    assert made[-1].mean() > 250


def test_a_histogram_is_as_high_as_counts_are_many():
    tally = PixelTally()
    tally.add(np.repeat(np.array([10, 11], np.uint16), [30, 60]).reshape(9, 10))
    dark = decoded(histogram("h", tally))[..., 2] < 200
    left, right = dark[:, 10].sum(), dark[:, -10].sum()
    assert right == pytest.approx(2 * left, abs=2)
    assert histogram("h", PixelTally()) is None


def test_the_view_from_above_has_x_up_and_y_left():
    ahead, left = [[9, 0, 0]], [[0, 5, 0]]
    xyz = np.array(ahead * 50 + left * 50 + [[-9, 0, 0]] * 50 + [[0, -9, 0]] * 50, np.float32)
    made = decoded(top_view("v", PointCloud(xyz))).astype(int)
    grey = (made.max(axis=2) - made.min(axis=2) == 0) & (made[..., 0] < 250)  # points; cross and bar are red
    rows, cols = np.nonzero(grey)
    middle = len(made) / 2
    scale = (middle - rows.min()) / 9  # pixels a metre, by what lies ahead
    assert any((abs(rows - middle) < 2) & (abs(cols - (middle - 5 * scale)) < 2))
    assert not any((abs(rows - middle) < 2) & (abs(cols - (middle + 5 * scale)) < 2))
    assert top_view("v", PointCloud(np.empty((0, 3), np.float32))) is None


def test_gaps_are_red_where_they_are():
    stamps = np.array([0, 10, 20, 80, 90, 100], np.int64)
    made = decoded(strip(stamps, (0, 100), ((20, 80),))).astype(int)
    red = (made[8, :, 2] - made[8, :, 0]) > 100
    columns = np.flatnonzero(red)
    assert columns.min() == pytest.approx(0.2 * 719, abs=3)
    assert columns.max() == pytest.approx(0.8 * 719, abs=3)
