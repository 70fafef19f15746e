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
WINDOW = 100, 75  # what is enlarged, px of the frame
NEAR_M, FAR_M = 4.0, 8.0
WAYS = {
    "one homography, right at 5 m": ("--homography", "mine/truth/homography_5m.toml"),
    "calibrated rig, 5 m": ("--rig", "rig.toml", "--distance", "5"),
    "calibrated rig and LiDAR depth": ("--rig", "rig.toml", "--depth", "depth/depth"),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path, help="the picture to write")
    parser.add_argument("--poses", type=int, default=30)
    parser.add_argument(
        "--work", type=Path, help="keep what the commands made here, and do not make it again"
    )
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = options.work or Path(name)
        if not (folder / f"fused{len(WAYS) - 1}").exists():
            folder.mkdir(parents=True, exist_ok=True)
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
        run(folder, "blend", "mine/rgb", "mine/fir", "-o", f"fused{number}", *pair, *way, "--alpha", "0.5")


def run(folder: Path, *arguments: str) -> None:
    print("fusion", *arguments, file=sys.stderr, flush=True)
    subprocess.run([sys.executable, "-m", "fusion", *arguments], cwd=folder, check=True)


def sheet(folder: Path) -> Picture:
    """A column for each way: the frame, and below it a near and a far part, enlarged."""
    stems = set.intersection(*({p.name for p in fused(folder, k).iterdir()} for k in range(len(WAYS))))
    stem = sorted(stems)[len(stems) // 2]
    frames = [np.array(read(fused(folder, k) / stem)) for k in range(len(WAYS))]
    windows = parts(folder, stem, frames)
    columns = []
    for title, frame in zip(WAYS, frames, strict=True):
        shown = [
            cv2.resize(cut(frame, at), None, fx=3.2, fy=3.2, interpolation=cv2.INTER_CUBIC) for at in windows
        ]
        for at in windows:
            cv2.rectangle(frame, at, (at[0] + WINDOW[0], at[1] + WINDOW[1]), (255, 255, 255), 1)
        columns.append(np.vstack([titled(frame, title), np.hstack(shown)]))
    return np.hstack(columns)


def fused(folder: Path, way: int) -> Path:
    return folder / f"fused{way}" / "fused"


def read(path: Path) -> NDArray[Any]:
    return decode_image(path.read_bytes(), str(path))


def parts(folder: Path, stem: str, frames: list[NDArray[Any]]) -> list[tuple[int, int]]:
    """Top left corners of a near and a far window: those in which the first and the last way differ most."""
    maps = sorted((folder / "depth" / "depth").iterdir())
    counts = read(min(maps, key=lambda path: abs(int(path.stem) - int(Path(stem).stem))))
    masks = [read(folder / f"fused{k}" / "mask" / stem) > 0 for k in range(len(WAYS))]
    seen = (counts > 0) & np.logical_and.reduce(masks)
    metres = np.where(seen, counts / 256.0, np.nan)
    differ = np.where(seen, np.abs(frames[0].astype(float) - frames[-1]).sum(-1), 0.0)
    best: dict[str, tuple[float, tuple[int, int]]] = {}
    for y in range(0, metres.shape[0] - WINDOW[1], 8):
        for x in range(0, metres.shape[1] - WINDOW[0], 8):
            inside = np.s_[y : y + WINDOW[1], x : x + WINDOW[0]]
            if np.isfinite(metres[inside]).mean() < 0.7:
                continue
            middle, score = float(np.nanmedian(metres[inside])), float(differ[inside].mean())
            name = "near" if middle < NEAR_M else "far" if middle > FAR_M else ""
            if name and score > best.get(name, (0.0, (0, 0)))[0]:
                best[name] = score, (x, y)
    return [best[name][1] for name in ("near", "far") if name in best]


def cut(frame: Picture, at: tuple[int, int]) -> Picture:
    return frame[at[1] : at[1] + WINDOW[1], at[0] : at[0] + WINDOW[0]]


def titled(frame: Picture, title: str) -> Picture:
    band = np.full((28, frame.shape[1], 3), 255, np.uint8)
    cv2.putText(band, title, (6, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (0, 0, 0), 1, cv2.LINE_AA)
    return np.vstack([band, frame])


if __name__ == "__main__":
    main()
