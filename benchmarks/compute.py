"""Blend compute: thermal counts and RGB pixels in memory to fused pixels in memory, on one thread."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from content import CASES, Case, pairs_of
from numpy.typing import NDArray
from table import Row, Section, at_least, at_most, milliseconds
from timing import interleaved, repeated

from fusion.blend import blender
from fusion.colormaps import colormap_bgr
from fusion.kernels import index_counts
from fusion.warp import Warp

ALPHA = 0.85
PART, WHOLE = 0.9, 1.15  # size of the thermal image on the RGB grid: it covers a part of it, or all of it
AGREE = 1.0  # grey levels of mean difference that the other implementations may show

TEXT = """\
Windowing (`index_counts`), warping by a homography (`Warp.apply`: turned by 1.5 degrees, slightly tilted)
and blending into RGB, in memory, on one thread (`cv2.setNumThreads(1)`), output allocated anew for each
frame as the pipeline does. *Part* means that thermal covers {part:.0%} of the RGB grid and the rest is
kept by the mask (the default policy), *all* that it covers everything. *Copy* is `numpy.copyto` of the RGB
frame's bytes and of the thermal frame's bytes into arrays that exist already. *Floats* is
`cv2.warpPerspective` of the counts, then window, colour table and blend in numpy float64, rounded. *OpenCV*
is `LUT` (16-bit: `subtract` and `convertScaleAbs`), `warpPerspective`, `applyColorMap`, `addWeighted` and a
masked copy, no line of ours. Each was checked to give our pixels to
within {agree:g} grey level on average."""


def registration(size_wh: tuple[int, int], scale: float) -> NDArray[np.float64]:
    """Thermal to RGB pixels: about the centre, a little turned and tilted, `scale` times as large."""
    w, h = size_wh
    turn = np.deg2rad(1.5)
    c, s = scale * np.cos(turn), scale * np.sin(turn)
    tilt = np.array([[1, 0, 0], [0, 1, 0], [0.03 / w, -0.02 / h, 1]])
    to_centre = np.array([[1, 0, -(w - 1) / 2], [0, 1, -(h - 1) / 2], [0, 0, 1]])
    return np.linalg.inv(to_centre) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ tilt @ to_centre


class Jobs:
    """The same job done in several ways on the first pair of a case."""

    def __init__(self, case: Case, scale: float) -> None:
        self.case = case
        ((self.bgr, self.counts),) = pairs_of(case, 1)
        self.H = registration(case.size_wh, scale)
        self.warp = Warp(self.H, case.size_wh, case.size_wh)
        self.mask = None if self.warp.full else self.warp.mask
        self.outside = self.warp.mask == 0
        self.table = colormap_bgr("hsv-cold-hot")
        self.table_float = self.table.astype(np.float64)
        self.table_cv = np.ascontiguousarray(self.table[:, None])
        self.lut = index_counts(np.arange(256, dtype=np.uint8)[None], *WINDOW_8)[0].reshape(-1)
        self.blend = blender("alpha")
        self.copies = np.empty_like(self.bgr), np.empty_like(self.counts)

    def ours(self) -> NDArray[np.uint8]:
        index, _, _ = index_counts(self.counts, *self.case.window)
        return self.blend(self.bgr, self.warp.apply(index), self.table, ALPHA, self.mask)

    def copy(self) -> None:
        np.copyto(self.copies[0], self.bgr)
        np.copyto(self.copies[1], self.counts)

    def floats(self) -> NDArray[np.uint8]:
        lo, hi = self.case.window
        warped = cv2.warpPerspective(self.counts, self.H, self.case.size_wh, borderMode=cv2.BORDER_REPLICATE)
        stretched = np.clip((warped.astype(np.float64) - lo) / (hi - lo), 0, 1)
        colour = self.table_float[np.floor(255 * stretched + 0.5).astype(np.uint8)]
        fused = np.floor(ALPHA * self.bgr + (1 - ALPHA) * colour + 0.5).astype(np.uint8)
        if self.mask is not None:
            fused[self.outside] = self.bgr[self.outside]
        return fused

    def opencv(self) -> NDArray[np.uint8]:
        lo, hi = self.case.window
        if self.case.bits == 8:
            index = cv2.LUT(self.counts, self.lut)
        else:
            index = cv2.convertScaleAbs(cv2.subtract(self.counts, float(lo)), alpha=255 / (hi - lo))  # type: ignore[call-overload]
        warped = cv2.warpPerspective(index, self.H, self.case.size_wh, borderMode=cv2.BORDER_REPLICATE)
        fused = cv2.addWeighted(self.bgr, ALPHA, cv2.applyColorMap(warped, self.table_cv), 1 - ALPHA, 0)
        if self.mask is not None:
            cv2.copyTo(self.bgr, cv2.bitwise_not(self.warp.mask), fused)
        return np.asarray(fused, np.uint8)

    def check(self) -> None:
        """All ways give the same pixels, but for rounding."""
        ours = self.ours().astype(np.int16)
        for way in (self.floats, self.opencv):
            apart = float(np.abs(way() - ours).mean())
            if apart > AGREE:
                raise AssertionError(
                    f"{self.case.name}: {way.__name__} differs by {apart:.2f} grey levels on average"
                )


WINDOW_8 = Case((1, 1), 8).window


def measure(rounds: int) -> Section:
    section = Section("Blend compute", "", ("ours, a frame", "other, a frame"))
    covered = 1.0
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        for case in CASES:
            for name, scale in (("part", PART), ("all", WHOLE)):
                jobs = Jobs(case, scale)
                covered = min(covered, jobs.warp.coverage)
                section.rows += _rows(jobs, f"{case.name}, {name}", rounds)
    finally:
        cv2.setNumThreads(before)
    section.text = TEXT.format(part=covered, agree=AGREE)
    return section


def _rows(jobs: Jobs, name: str, rounds: int) -> list[Row]:
    jobs.check()
    ways: dict[str, Callable[[], object]] = {
        "ours": jobs.ours,
        "copy": jobs.copy,
        "floats": jobs.floats,
        "opencv": jobs.opencv,
    }
    times = {"ours": 20, "copy": 100, "floats": 2, "opencv": 10}
    taken = interleaved({way: repeated(call, times[way]) for way, call in ways.items()}, rounds)
    ours = milliseconds(taken["ours"])
    return [
        Row(
            f"{name}: ours / copy",
            ours,
            milliseconds(taken["copy"]),
            taken["ours"].over(taken["copy"]),
            at_most(8),
        ),
        Row(
            f"{name}: floats / ours",
            ours,
            milliseconds(taken["floats"]),
            taken["floats"].over(taken["ours"]),
            at_least(12),
        ),
        Row(
            f"{name}: OpenCV / ours", ours, milliseconds(taken["opencv"]), taken["opencv"].over(taken["ours"])
        ),
    ]
