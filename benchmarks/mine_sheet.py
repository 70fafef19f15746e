"""`python benchmarks/mine_sheet.py docs/images/mine.jpg`: the mine by every sensor and preset."""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion.clouds import clouds_in, read_cloud
from fusion.colormaps import colormap_bgr
from fusion.geometry import Floats
from fusion.kernels import index_counts
from fusion.lidar.lane import DepthLane
from fusion.lidar.project import z_buffer
from fusion.report.depth_picture import coloured
from fusion.simulate.mine.config import MineConfig
from fusion.simulate.mine.recording import World, make_mine, world_of
from fusion.simulate.mine.truth import Truth

WIDTH, LABEL = 400, 24
SHOW_M = (1.0, 15.0)
JERKED = {"max_rate_deg_s": 300.0, "yaw_deg": 45.0, "turbulence": 1.0, "jerks_per_s": 2.0}
ROWS: tuple[tuple[str, float, dict[str, Any]], ...] = (
    ("clear", 3.0, {}),
    ("clear", 16.0, {}),
    ("dark", 8.0, {}),
    ("dusty", 3.0, {}),
    ("dusty", 16.0, {}),
    ("over-exposed", 12.0, {}),
    (
        "clear",
        9.6,
        {"flight": {"max_rate_deg_s": 300.0, "yaw_deg": 45.0, "turbulence": 1.0, "jerks_per_s": 2.0}},
    ),
)


@dataclass(frozen=True, slots=True)
class Later:
    """A flight from some moment on."""

    path: Any
    start_s: float

    def pose_at(self, t_s: ArrayLike) -> Floats:
        return self.path.pose_at(np.asarray(t_s) + self.start_s)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    sheet = np.vstack([_row(preset, start, more, options.seed) for preset, start, more in ROWS])
    if not cv2.imwrite(str(options.out), sheet, [cv2.IMWRITE_JPEG_QUALITY, 85]):
        raise OSError(f"{options.out} cannot be written")


def _row(preset: str, start_s: float, more: dict[str, Any], seed: int) -> NDArray[np.uint8]:
    config = MineConfig.of({"preset": preset, "seed": seed, "duration_s": 0.35, **more})
    world = world_of(config)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "mine"
        make_mine(out, config, world=World(world.scene, Later(world.path, start_s)))
        truth, depth = Truth(out), DepthLane(rig=Truth(out).rig)
        stamp = truth.stamps("rgb")[1]
        bgr = cv2.imread(str(out / "rgb" / f"{stamp}.jpg"))
        fir = np.asarray(
            cv2.imread(str(out / "fir" / f"{truth.stamps('fir')[1]}.png"), cv2.IMREAD_UNCHANGED), np.uint16
        )
        samples = depth.of_cloud(read_cloud(next(iter(clouds_in(out / "lidar"))))).sparse
        pictures = [
            bgr,
            _thermal(fir),
            _dots(z_buffer(samples)),
            coloured(truth.depth_m("rgb", stamp), "jet", SHOW_M),
        ]
    names = (f"{preset}{', jerked' if more else ''}", "thermal", "LiDAR on RGB's grid", "true depth")
    return np.hstack([_panel(np.asarray(p, np.uint8), name) for p, name in zip(pictures, names, strict=True)])


def _thermal(counts: NDArray[np.uint16]) -> NDArray[np.uint8]:
    lo, hi = np.percentile(counts, [0.5, 99.5])
    return colormap_bgr("inferno")[index_counts(counts, lo, max(hi, lo + 1))[0]]


def _dots(image_m: NDArray[np.float32]) -> NDArray[np.uint8]:
    large = cv2.dilate(image_m, np.ones((2, 2), np.uint8))
    bgr = coloured(np.asarray(large, np.float32), "jet", SHOW_M)
    bgr[large == 0] = 0
    return bgr


def _panel(bgr: NDArray[np.uint8], name: str) -> NDArray[np.uint8]:
    height = WIDTH * 3 // 4
    small = cv2.resize(bgr, (WIDTH, height), interpolation=cv2.INTER_AREA)
    framed = cv2.copyMakeBorder(small, LABEL, 0, 0, 4, cv2.BORDER_CONSTANT, value=(255, 255, 255))
    cv2.putText(framed, name, (4, 17), (32, 32, 32), cv2.FontFace("sans"), 14)
    return np.asarray(framed, np.uint8)


if __name__ == "__main__":
    main()
