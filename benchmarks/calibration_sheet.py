"""`python benchmarks/calibration_sheet.py docs/images/calibration.jpg`: simulate, calibrate, blend, and
show it.

Runs the commands of docs/calibration.md on a simulated session and a slow flight (so that RGB, thermal and
LiDAR show one moment), and puts the same frame side by side: thermal by one homography, by the calibrated
rig at a fixed distance, and by the rig and LiDAR depth, with a near and a far part enlarged.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion.codecs import decode_image

Picture = NDArray[np.uint8]
SLOW = """format = "fusion-mine/1"
[flight]
speed_m_s = 0.1
max_rate_deg_s = 5.0
sway_m = 0.0
turbulence = 0.0
jerks_per_s = 0.0
"""
WINDOW = 200, 150  # what is enlarged, px of the frame
WAYS = {
    "one homography, right at 5 m": ("--homography", "mine/truth/homography_5m.toml"),
    "calibrated rig, 5 m": ("--rig", "rig.toml", "--distance", "5"),
    "calibrated rig and LiDAR depth": ("--rig", "rig.toml", "--depth", "depth/depth"),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--poses", type=int, default=30)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        prepare(folder, options.poses)
        options.out.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(options.out), sheet(folder), [cv2.IMWRITE_JPEG_QUALITY, 88])


def prepare(folder: Path, poses: int) -> None:
    """Everything that the picture needs, by the command line."""
    (folder / "slow.toml").write_text(SLOW, encoding="utf-8")
    run(folder, "simulate", "session", "session", "--poses", str(poses))
    run(folder, "simulate", "mine", "mine", "--config", "slow.toml", "--duration", "0.5")
    board = ("--board", "session/truth/board.toml")
    run(folder, "calibrate", "stereo", "session/rgb", "session/fir", *board, "-o", "cameras.toml")
    lidar = ("session/rgb", "session/lidar", "--fir", "session/fir", *board, "--rig", "cameras.toml")
    run(folder, "calibrate", "lidar", *lidar, "-o", "rig.toml")
    run(folder, "depth", "mine/lidar", "-o", "depth", "--rig", "rig.toml", "--quiet")
    for number, way in enumerate(WAYS.values()):
        pair = ("--pair", "stamp", "--tolerance-ms", "60", "--quiet")
        run(folder, "blend", "mine/rgb", "mine/fir", "-o", f"fused{number}", *pair, *way, "--alpha", "0.6")


def run(folder: Path, *arguments: str) -> None:
    print("fusion", *arguments, file=sys.stderr, flush=True)
    subprocess.run([sys.executable, "-m", "fusion", *arguments], cwd=folder, check=True)


def sheet(folder: Path) -> Picture:
    """A column for each way: the frame, and below it a near and a far part twice as large."""
    stems = set.intersection(
        *({p.name for p in (folder / f"fused{k}" / "fused").iterdir()} for k in range(len(WAYS)))
    )
    stem = sorted(stems)[len(stems) // 2]
    frames = [np.array(read(folder / f"fused{k}" / "fused" / stem)) for k in range(len(WAYS))]
    depth = read(depth_of(folder, stem))
    near, far = parts(folder, stem, depth)
    columns = []
    for title, frame in zip(WAYS, frames, strict=True):
        parts_shown = [
            cv2.resize(cut(frame, at), None, fx=1.6, fy=1.6, interpolation=cv2.INTER_CUBIC)
            for at in (near, far)
        ]
        for at in (near, far):
            cv2.rectangle(frame, at, (at[0] + WINDOW[0], at[1] + WINDOW[1]), (255, 255, 255), 1)
        columns.append(np.vstack([titled(frame, title), np.hstack(parts_shown)]))
    return np.hstack(columns)


def depth_of(folder: Path, stem: str) -> Path:
    """The depth map of the nearest stamp."""
    maps = sorted((folder / "depth" / "depth").iterdir())
    return min(maps, key=lambda path: abs(int(path.stem) - int(Path(stem).stem)))


def read(path: Path) -> NDArray[Any]:
    return decode_image(path.read_bytes(), str(path))


def parts(folder: Path, stem: str, depth: NDArray[Any]) -> tuple[tuple[int, int], tuple[int, int]]:
    """Top left corners of the windows with the nearest and the farthest depth, where thermal is seen."""
    mask = read(folder / "fused2" / "mask" / stem)
    metres = np.where((depth > 0) & (mask > 0), depth / 256.0, np.nan)
    h, w = metres.shape
    best: list[tuple[float, tuple[int, int]]] = []
    for y in range(0, h - WINDOW[1], 15):
        for x in range(0, w - WINDOW[0], 20):
            window = metres[y : y + WINDOW[1], x : x + WINDOW[0]]
            if np.isfinite(window).mean() > 0.85:
                best.append((float(np.nanmedian(window)), (x, y)))
    return min(best)[1], max(best)[1]


def cut(frame: Picture, at: tuple[int, int]) -> Picture:
    return frame[at[1] : at[1] + WINDOW[1], at[0] : at[0] + WINDOW[0]]


def titled(frame: Picture, title: str) -> Picture:
    band = np.full((28, frame.shape[1], 3), 255, np.uint8)
    cv2.putText(band, title, (6, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (0, 0, 0), 1, cv2.LINE_AA)
    return np.vstack([band, frame])


if __name__ == "__main__":
    main()
