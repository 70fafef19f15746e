"""Warps from a rig: fixed maps and each pixel's depth, in memory, on one thread and on two."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
from numpy.typing import NDArray
from table import Row, Section, at_least, milliseconds
from timing import Job, interleaved, repeated

from fusion.geometry import FisheyeCamera, PinholeCamera, pose
from fusion.rig import Rig, RigCamera
from fusion.rig_warp import DepthWarp, RigWarp

RGB = PinholeCamera((640, 480), 355, 355, 322.9, 234.3, (-0.19, 0.035, 4e-4, -3e-4, 0.0))
FIR = PinholeCamera((640, 512), 474, 474, 315.4, 258.2, (-0.24, 0.07, -5e-4, 6e-4, 0.0))
FISHEYE_FIR = FisheyeCamera((640, 512), 474, 474, 315.4, 258.2, (-0.02, 0.004, 0.0, 0.0))
THREADS, FRAMES = 2, 24

TEXT = """\
An RGB camera of 640x480 and a thermal one of 640x512, both with distortion, 78 mm apart. The depth map is a
drift with boxes in it, known at every pixel; each frame's points are placed, its z-buffer made, its hidden
pixels masked and thermal resampled. *{threads} threads* share the warp and take frames in turn, as `fusion
blend` does. *Fixed* is the map of one distance, computed once. OpenCV's is `remap` of the same positions
as fixed-point maps, which masks nothing."""


def measure(rounds: int) -> Section:
    depth_m, index = drift_depth(), np.random.default_rng(0).integers(0, 256, (512, 640), dtype=np.uint8)
    fixed = RigWarp.fixed(rig_of(FIR), FIR.size_wh, RGB.size_wh, "distance", 5.0)
    warps = {
        "depth": DepthWarp(rig_of(FIR), FIR.size_wh, RGB.size_wh),
        "fisheye": DepthWarp(rig_of(FISHEYE_FIR), FIR.size_wh, RGB.size_wh),
        "undistort": DepthWarp(rig_of(FIR), FIR.size_wh, RGB.size_wh, undistort=True),
    }
    first, second = cv2.convertMaps(np.nan_to_num(fixed.positions()).astype(np.float32), None, cv2.CV_16SC2)  # type: ignore[call-overload]
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with ThreadPoolExecutor(THREADS) as pool:
            jobs: dict[str, Job] = {
                "fixed": repeated(lambda: fixed.apply(index), 20),
                "opencv": repeated(lambda: cv2.remap(index, first, second, cv2.INTER_LINEAR), 20),
                "one": repeated(lambda: warps["depth"].apply(index, depth_m), 5),
                **{
                    name: _shared(pool, lambda warp=warp: warp.apply(index, depth_m))
                    for name, warp in warps.items()
                },
            }
            taken = interleaved(jobs, rounds)
    finally:
        cv2.setNumThreads(before)
    rows = [
        Row(
            "fixed map: OpenCV / ours",
            milliseconds(taken["fixed"]),
            milliseconds(taken["opencv"]),
            taken["opencv"].over(taken["fixed"]),
        ),
        Row("by depth, one thread", milliseconds(taken["one"]), note="for information"),
    ]
    for name, what in (("depth", ""), ("fisheye", ", thermal a fisheye"), ("undistort", ", undistorted")):
        target = at_least(60, " frames/s")
        rows.append(
            Row(
                f"by depth{what}, {THREADS} threads",
                milliseconds(taken[name]),
                "",
                taken[name].rate(1),
                target,
            )
        )
    return Section(
        "Warps from a rig", TEXT.format(threads=THREADS), ("ours, a frame", "other, a frame"), rows
    )


def _shared(pool: ThreadPoolExecutor, work: Callable[[], object]) -> Job:
    """The seconds a frame when `FRAMES` of them are shared out among the pool's threads."""

    def job() -> float:
        began = time.perf_counter()
        for done in [pool.submit(work) for _ in range(FRAMES)]:
            done.result()
        return (time.perf_counter() - began) / FRAMES

    return job


def rig_of(fir: RigCamera) -> Rig:
    turn = np.asarray(cv2.Rodrigues(np.array([0.014, -0.021, 0.0106]))[0])
    return Rig({"rgb": RGB, "fir": fir}, {"T_rgb_fir": pose(turn, (0.075, -0.02, -0.01))})


def drift_depth() -> NDArray[np.float32]:
    """Floor, roof, walls and end of a straight drift, and boxes standing in it: H x W metres."""
    v, u = np.mgrid[:480, :640]
    ray = RGB.unproject(np.stack([u.ravel(), v.ravel()], -1).astype(np.float64))
    x, y = (ray[:, :2] / ray[:, 2:]).T
    with np.errstate(divide="ignore"):
        z = np.minimum.reduce(
            [np.where(x > 0, 2.3, -2.3) / x, np.where(y > 0, 1.5, -2.5) / y, np.full(len(x), 30)]
        )
    for away, left, right, top, bottom in (
        (1.2, -0.9, -0.4, -0.2, 0.5),
        (2.5, 0.3, 0.9, -0.5, 0.6),
        (5, -1, 1, 0, 1.5),
    ):
        box = (x * away > left) & (x * away < right) & (y * away > top) & (y * away < bottom)
        z = np.where(box & (away < z), away, z)
    return z.reshape(480, 640).astype(np.float32)
