"""`fusion datasets check --alignment`: a claim of registration is held against the scene itself."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from shutil import copytree

import cv2
import numpy as np
import pytest

from fusion.cli.dataset_checks import Report, check
from fusion.manifest import load_manifest
from tests.worlds import read, textured


def wrong(report: Report) -> list[tuple[str, str]]:
    return [(finding.kind, finding.text) for finding in report.findings if finding.wrong]


def noted(report: Report, kind: str) -> list[str]:
    return [finding.text for finding in report.findings if not finding.wrong and finding.kind == kind]


def shifted(image: np.ndarray, dx: int) -> np.ndarray:
    return np.roll(image, dx, axis=1)


def scenes(count: int = 3) -> list[tuple[np.ndarray, np.ndarray]]:
    """Pairs of pictures with common edges and opposite contrast."""
    rng = np.random.default_rng(5)
    pairs = []
    for _ in range(count):
        field = np.zeros((192, 256), np.float64)
        for _ in range(40):
            x, y = rng.integers(0, 256), rng.integers(0, 192)
            w, h = rng.integers(10, 60, 2)
            field[y : y + h, x : x + w] = rng.random()
        smooth = cv2.GaussianBlur(field, (0, 0), 1.5) * 200
        rgb = np.dstack([smooth + 20 * textured(rng, 256, 192)] * 3).astype(np.uint8)
        pairs.append((rgb, (230 - smooth).astype(np.uint8)))
    return pairs


def in_places(root: Path, pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> None:
    for k, (rgb, fir) in enumerate(pairs):
        for folder, pixels in (("crop_LR_visible", rgb), ("cropinfrared", fir)):
            (root / folder).mkdir(parents=True, exist_ok=True)
            assert cv2.imwrite(str(root / folder / f"{k}.jpg"), pixels)


@pytest.mark.parametrize(("dx", "verdict"), [(0, "looks aligned"), (15, "does not look aligned")])
def test_a_claim_of_registration_is_held_against_the_scene(dx: int, verdict: str, tmp_path: Path) -> None:
    """15 of 256 pixels are 5.9 % of the width."""
    in_places(tmp_path, [(rgb, shifted(fir, dx)) for rgb, fir in scenes(1)])
    report = check(load_manifest("roadscene"), tmp_path, alignment=True)
    (said,) = [f for f in report.findings if f.kind == "alignment"]
    assert verdict in said.text
    assert report.ok is (dx == 0)
    unclaimed = load_manifest("roadscene").model_copy(update={"registered": False})
    assert check(unclaimed, tmp_path, alignment=True).ok
    if dx:  # the nearest step
        assert "moved by -6 % of the width, +0 % down" in said.text


def test_where_nothing_can_be_seen_nothing_is_claimed(tmp_path: Path) -> None:
    in_places(tmp_path, [(np.full((64, 64, 3), 90, np.uint8), np.full((64, 64), 90, np.uint8))] * 2)
    report = check(load_manifest("roadscene"), tmp_path, alignment=True)
    assert report.ok
    (text,) = noted(report, "alignment")
    assert "cannot be" in text


def test_noise_without_common_edges_proves_nothing(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    noise = [(rng.integers(0, 255, (96, 128, 3), np.uint8), rng.integers(0, 255, (96, 128), np.uint8))]
    in_places(tmp_path, noise)
    report = check(load_manifest("roadscene"), tmp_path, alignment=True)
    assert report.ok
    assert "cannot be told" in noted(report, "alignment")[0]


def test_real_pairs_look_aligned(shared_data: Path, tmp_path: Path) -> None:
    """As they are; and not, with a part of thermal's left side gone."""
    copytree(shared_data / "rgbt_pairs" / "MSRS", tmp_path / "test")
    report = check(load_manifest("msrs"), tmp_path, alignment=True)
    (said,) = noted(report, "alignment")
    assert said.startswith("looks aligned")
    assert wrong(report) == []
    for path in (tmp_path / "test" / "ir").iterdir():
        assert cv2.imwrite(str(path), shifted(read(path), 39))  # 6 % of the width
    report = check(load_manifest("msrs"), tmp_path, alignment=True)
    ((_, text),) = wrong(report)
    assert "thermal fits better moved by -6 % of the width, +0 % down" in text
