"""The whole way on a made-up rig, and on real pairs where they are there."""

from __future__ import annotations

import sys
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from calib.align import Alignment, align
from calib.align.judge import LARGEST_GAP, LEAST_SCORE, judged_frames, verdict
from calib.align.models import Matches, corner_gap
from calib.align.picture import overlay_picture
from fusion.errors import InputError, UsageError
from fusion.registration import read_homography, write_homography

H_TRUE = np.array([[0.82, -0.06, 40.0], [0.06, 0.82, 12.0], [0, 0, 1]])
FIR_WH = (200, 160)


def _scene(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """RGB and thermal of one flat world of polygons: same outlines, other brightness, and noise."""
    rng = np.random.default_rng(seed)
    rgb, heat = np.full((200, 260), 90, np.uint8), np.full((200, 260), 120, np.uint8)
    for _ in range(45):
        middle, radius = rng.uniform([0, 0], [260, 200]), rng.uniform(8, 30)
        angles = np.sort(rng.uniform(0, 2 * np.pi, 4))
        ring = middle + radius * np.stack([np.cos(angles), np.sin(angles)], -1)
        for image in (rgb, heat):
            cv2.fillPoly(image, [ring.round().astype(np.int32)], int(rng.integers(0, 256)))
    return rgb, heat


def _pair(seed: int, noise: float = 3.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed + 100)
    rgb, heat = _scene(seed)
    fir = cv2.warpPerspective(heat, H_TRUE, FIR_WH, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    counts = 8000 + 3.0 * (255 - cv2.GaussianBlur(fir, (0, 0), 0.8).astype(float))
    noisy = counts + rng.normal(0, 3 * noise, counts.shape)
    bgr = np.clip(rgb[..., None] + rng.normal(0, noise, (*rgb.shape, 3)), 0, 255)
    return bgr.astype(np.uint8), noisy.round().astype(np.uint16)


@lru_cache(maxsize=1)
def _found() -> Alignment:
    return align([_pair(0)])


def test_a_known_map_is_found_within_a_pixel():
    found = _found()
    assert found.accepted
    assert not found.reason
    assert not found.flip
    assert corner_gap(found.H_rgb_fir, H_TRUE, FIR_WH[::-1]) < 1.0
    assert found.score >= LEAST_SCORE
    assert found.gap_share <= LARGEST_GAP
    assert found.gap_px == pytest.approx(found.gap_share * FIR_WH[0])
    assert (found.rgb_size_wh, found.fir_size_wh) == ((260, 200), FIR_WH)


def test_it_is_written_for_the_blend_and_read_back(tmp_path: Path):
    write_homography(tmp_path / "h.toml", _found().registration())
    again = read_homography(tmp_path / "h.toml")
    np.testing.assert_array_equal(again.H_rgb_fir, _found().registration().H_rgb_fir)
    assert again.fir_size_wh == FIR_WH
    assert "found without a board by channels on 1 frame(s)" in (tmp_path / "h.toml").read_text()


def test_frames_of_one_rig_are_pooled_and_the_stranger_is_named():
    stranger = (_pair(2)[0], _pair(3)[1])
    told: list[str] = []
    found = align([_pair(1), _pair(2), stranger], progress=told.append)
    assert found.accepted, found.reason
    assert corner_gap(found.H_rgb_fir, H_TRUE, FIR_WH[::-1]) < 1.0
    assert [bool(frame.outlier) for frame in found.frames] == [False, False, True]
    assert any("frame 2 does not fit the others" in note for note in found.registration().notes)
    assert told[:3] == ["frame 0 read", "frame 1 read", "frame 2 read"]


def test_a_mirrored_thermal_stream_is_found_and_said():
    rgb, fir = _pair(0)
    found = align([(rgb, np.ascontiguousarray(fir[:, ::-1]))])
    assert not found.accepted
    assert "the thermal stream is mirrored left-right" in found.reason
    undo = np.array([[-1, 0, FIR_WH[0] - 1.0], [0, 1, 0], [0, 0, 1]])
    np.testing.assert_allclose(found.H_rgb_fir, _found().H_rgb_fir @ undo, atol=1e-6)


def test_images_of_different_places_are_refused():
    found = align([(_pair(4)[0], _pair(5)[1])])
    assert not found.accepted
    assert "correlation" in found.reason
    with pytest.raises(InputError, match="could not be aligned: the edges agree too little"):
        found.registration()


def test_the_judge_refuses_what_it_cannot_tell():
    assert verdict(LEAST_SCORE, LARGEST_GAP) == ""
    assert "correlation 0.29" in verdict(0.29, 0)
    assert "differ by 1.0% of the width" in verdict(0.5, 0.01)
    assert verdict(float("nan"), float("nan")).count(";") == 1


def test_a_frame_without_matches_is_an_outlier():
    none = Matches(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))
    fir = np.random.default_rng(0).uniform(0, 100, (50, 2))
    good = Matches(fir + 1, fir, np.ones(50))
    shift = np.array([[1, 0, 1.0], [0, 1, 1], [0, 0, 1]])
    results = judged_frames(["a", "b"], [0.5, 0.5], [good, none], shift, (100, 100), 1.0, 100)
    assert results[0].outlier == ""
    assert results[0].gap_px < 1e-6
    assert "elsewhere" in results[1].outlier


@pytest.mark.parametrize(
    ("pairs", "words"),
    [
        ([], "no pair of images"),
        ([(np.zeros((50, 50), np.uint8), np.eye(50, dtype=np.uint8))], "RGB: the image shows nothing"),
        ([(np.eye(50, dtype=np.uint8), np.eye(8, dtype=np.uint8))], "thermal: 8x8 pixels are too few"),
        ([(np.eye(50, dtype=np.uint8),) * 2, (np.eye(60, dtype=np.uint8),) * 2], "frame 1: RGB 60x60"),
    ],
)
def test_frames_that_cannot_be_used_are_named(pairs, words):
    with pytest.raises(InputError, match=words):
        align(pairs)


def test_an_unknown_matcher_is_refused_before_anything_is_read():
    with pytest.raises(UsageError, match=r"unknown matcher 'nobody'.*one of: channels"):
        align(iter(()), matcher="nobody")


@pytest.fixture
def foreign(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """An installed package that offers the matcher "grid", and a way to set what it answers."""
    info = tmp_path / "extra_matcher-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: extra-matcher\nVersion: 1\n")
    (info / "entry_points.txt").write_text("[fusion.matchers]\ngrid = extra_matcher:match\n")
    (tmp_path / "extra_matcher.py").write_text(
        "ANSWER = {}\ndef match(rgb, fir):\n    return ANSWER['f'](rgb, fir)\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    import extra_matcher  # pyright: ignore[reportMissingImports]

    yield extra_matcher.ANSWER
    sys.modules.pop("extra_matcher", None)


def test_an_installed_matcher_is_asked_both_ways_and_judged_the_same(foreign):
    def match(rgb, fir):
        assert rgb.dtype == fir.dtype == np.uint8
        forward = fir.shape == FIR_WH[::-1]
        H = H_TRUE if forward else np.linalg.inv(H_TRUE)
        xy = np.random.default_rng(0).uniform(0, 150, (200, 2))
        return cv2.perspectiveTransform(xy[None], H)[0], xy, np.full(200, 0.7)

    foreign["f"] = match
    found = align([_pair(0)], matcher="grid", model="affine")
    assert found.accepted
    assert found.matcher == "grid"
    assert found.model == "affine"
    assert corner_gap(found.H_rgb_fir, H_TRUE, FIR_WH[::-1]) < 1e-6


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        ((np.zeros((3, 2)), np.zeros((2, 2)), np.ones(3)), "expected"),
        ((np.full((3, 2), np.nan), np.zeros((3, 2)), np.ones(3)), "NaN"),
        ((np.zeros((3, 2)), np.zeros((3, 2)), -np.ones(3)), "negative confidence"),
    ],
)
def test_nonsense_of_an_installed_matcher_is_its_fault(foreign, answer, words):
    foreign["f"] = lambda rgb, fir: answer
    with pytest.raises(UsageError, match=words):
        align([_pair(0)], matcher="grid")


def test_an_installed_matcher_that_finds_nothing_is_refused_in_words(foreign):
    foreign["f"] = lambda rgb, fir: (np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))
    found = align([_pair(0)], matcher="grid")
    assert not found.accepted
    assert "0 matches determine no similarity" in found.reason


def test_the_picture_shows_what_moved():
    rgb, fir = _pair(0)
    good = overlay_picture(rgb, fir, H_TRUE, "right")
    bad = overlay_picture(rgb, fir, np.eye(3), "wrong")
    assert good.dtype == np.uint8
    assert good.shape == bad.shape
    assert good.shape[1] == 3 * 640
    before, after = np.s_[34:, :640], np.s_[34:, 640:1280]
    np.testing.assert_array_equal(good[before], bad[before])
    assert (good[after] != bad[after]).mean() > 0.05


def test_real_warped_pairs_are_registered(shared_data: Path):
    folder = shared_data / "rgbt_warped" / "RoadScene"
    if not folder.is_dir():
        pytest.skip("rgbt_warped is not there")
    from scipy.io import loadmat

    rgb = np.asarray(cv2.imread(str(folder / "vi" / "24.png")))
    fir = np.asarray(cv2.imread(str(folder / "ir_warp" / "24.png"), cv2.IMREAD_GRAYSCALE))
    flow = loadmat(folder / "flow" / "24.png.mat")["flow"][0].astype(float)
    h, w = fir.shape
    truth = (flow + 1) / 2 * [w - 1, h - 1]
    valid = ((truth >= 0) & (truth <= [w - 1, h - 1])).all(axis=-1)
    found = align([(rgb, fir)])
    at = np.stack(np.meshgrid(np.arange(w), np.arange(h)), -1).astype(float)
    mapped = cv2.perspectiveTransform(at, found.H_rgb_fir)
    assert found.accepted
    assert np.linalg.norm(mapped - truth, axis=-1)[valid].mean() < 2.7
