"""Every manifest and every command of docs/add-a-dataset.md, in order, on files laid out as it draws them."""

from __future__ import annotations

import re
import shlex
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from fusion.cli.main import datasets, main
from fusion.clouds import write_pcd
from fusion.frames import PointCloud
from fusion.geometry import PinholeCamera
from fusion.rig import Rig, save_rig
from tests.bags import bag

PAGE = (Path(__file__).parents[2] / "docs" / "add-a-dataset.md").read_text(encoding="utf-8")
SIZES = {"visible": (64, 48), "thermal": (64, 48), "rgb": (64, 48), "fir": (32, 24)}


def blocks(language: str) -> list[str]:
    fenced = re.findall(r"^```(\w*)\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    return [text for word, text in fenced if word == language]


def draw(path: Path) -> None:
    """One of the files that the page shows."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".pcd":
        write_pcd(path, PointCloud(np.random.default_rng(0).normal(0, 3, (30, 3)).astype(np.float32)))
        return
    if path.suffix == ".bag":
        bag(path, {"/cam/image_raw": ("bgr8", 64, 48, 3), "/thermal/image_raw": ("mono16", 32, 24, 2)})
        return
    if path.name == "rig.toml":
        cameras = {
            name: PinholeCamera(SIZES[name], 60.0, 60.0, SIZES[name][0] / 2, SIZES[name][1] / 2)
            for name in ("rgb", "fir")
        }
        T = np.eye(4)
        T[0, 3] = 0.05
        save_rig(path, Rig(cameras, {"T_rgb_fir": T, "T_rgb_lidar": T}))
        return
    width, height = SIZES[path.parent.name]
    ramp = np.arange(width * height).reshape(height, width)
    thermal = path.parent.name in ("thermal", "fir")
    pixels = (7000 + ramp).astype(np.uint16) if thermal else np.dstack([ramp % 200] * 3).astype(np.uint8)
    assert cv2.imwrite(str(path), pixels)


def write_manifests(folder: Path) -> list[str]:
    names = []
    for text in blocks("toml"):
        (name,) = re.findall(r'^name = "(.*)"$', text, re.MULTILINE)
        (folder / f"{name}.toml").write_text(text, encoding="utf-8")
        names.append(name)
    return names


def test_the_page_is_true_from_top_to_bottom(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if "check" not in [name for name in datasets if not name.startswith("-")]:
        datasets.command("fusion.cli.datasets:check_dataset", name="check")
    for place in re.findall(r"\S+", "\n".join(blocks("text"))):
        draw(tmp_path / place)
    assert write_manifests(tmp_path) == ["my_drives", "my_flight", "my_campaign"]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FUSION_DATASETS", str(tmp_path))
    lines = [line for block in blocks("") for line in block.splitlines()]
    assert len(lines) >= 9
    for line in lines:
        monkeypatch.setattr(sys, "argv", shlex.split(line))
        with pytest.raises(SystemExit) as ended:
            main()
        assert ended.value.code in (0, None), (line, capsys.readouterr())
    assert len(list((tmp_path / "fused" / "fused").rglob("*.png"))) == 3
    assert len(list((tmp_path / "fused_flight" / "fused").rglob("*.png"))) == 2


def test_what_the_page_says_of_states_is_so() -> None:
    from fusion.manifest import list_manifests

    states = {item.manifest.state for item in list_manifests() if item.manifest is not None}
    assert set(re.findall(r"\*\*([a-z ]+)\*\*:", PAGE)) == states
