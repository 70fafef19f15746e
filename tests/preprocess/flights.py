"""A small flight through the mine: what the tests of campaigns read."""

from __future__ import annotations

from pathlib import Path

import pytest

from fusion.simulate.mine.config import MineConfig
from fusion.simulate.mine.recording import make_mine


@pytest.fixture(scope="session")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three seconds: RGB at 10, thermal at 20 (frozen for a while), LiDAR at 10 a second; small pictures."""
    out = tmp_path_factory.mktemp("flight") / "mine"
    config = MineConfig.of(
        duration_s=3.0,
        truth=False,
        rgb={"camera": {"size_wh": (128, 96)}, "rate_hz": 10},
        thermal={
            "camera": {"size_wh": (96, 80)},
            "rate_hz": 20,
            "ffc_interval_s": 1.6,
            "ffc_freeze_s": 0.4,
        },
        lidar={"rings": 16, "columns": 256},
    )
    make_mine(out, config, threads=2)
    return out


def tree(folder: Path) -> dict[str, bytes]:
    """All files below a folder, by name."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }
