"""Registration without a board on real pairs: exact warps, landmarks, and pairs of different places."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat
from table import at_most, grid

from calib.align import align

Doubles = NDArray[np.float64]
Image = NDArray[np.uint8]
Register = Callable[[Image, Image], "Doubles | None"]
# Median over the images, in RGB pixels, that was asked for; the mean over valid pixels, or over corners.
WANTED = {"warps": 2.7, "landmarks": 3.5}
OURS = "`fusion calibrate align`"
WITHIN_PX = (3, 5, 10)
_FEATURES, _TOLERANCE_PX, _LEAST = 4000, 3.0, 8

TEXT = """\
Error in RGB pixels, median over the pairs, and how many pairs lie under {within} px; seconds of one thread
a pair (median). *Warps*: {warps} MSRS and RoadScene pairs whose thermal image was bent by a known dense flow
with an elastic part that no affine map holds; mean over the pixels whose truth lies inside. *Landmarks*:
{landmarks} unaligned pairs with a map from landmarks; mean over the corners. Wanted: {wanted}."""


@dataclass(frozen=True, slots=True)
class Pair:
    """`error` gives the mean distance of a map from the truth, in RGB pixels."""

    name: str
    rgb: Image
    fir: Image
    error: Callable[[Doubles], float]


def markdown(data: Path) -> str:
    """The section of the page; a word where the data is not there."""
    cases = {"warps": list(_warps(data)), "landmarks": list(_landmarks(data))}
    if not any(cases.values()):
        return "### Without a board\n\nNot measured: the pairs were not there."
    lines = [_line(name, register, cases) for name, register in METHODS.items()]
    said = ", ".join(f"{case} {most:g} px" for case, most in WANTED.items())
    text = TEXT.format(
        within=" / ".join(map(str, WITHIN_PX)),
        warps=len(cases["warps"]),
        landmarks=len(cases["landmarks"]),
        wanted=said,
    )
    return "\n\n".join(
        [
            "### Without a board",
            text,
            grid(["method", *cases, "s", "verdict"], lines),
            _refusals([*cases["warps"], *cases["landmarks"]]),
        ]
    )


def _line(name: str, register: Register, cases: Mapping[str, Sequence[Pair]]) -> list[str]:
    cells, seconds, verdict = [], [], []
    for case, pairs in cases.items():
        errors = []
        for pair in pairs:
            began = time.thread_time()
            matrix = register(pair.rgb, pair.fir)
            seconds.append(time.thread_time() - began)
            errors.append(np.inf if matrix is None else pair.error(matrix))
        cells.append(_errors(errors))
        if errors and not at_most(WANTED[case]).met(float(np.median(errors))):
            verdict.append(case)
    word = "" if name != OURS else f"**missed**: {', '.join(verdict)}" if verdict else "met"
    return [name, *cells, f"{np.median(seconds):.1f}", word]


def _errors(errors: Sequence[float]) -> str:
    if not errors:
        return "not there"
    middle = float(np.median(errors))
    under = " / ".join(str(sum(error < most for error in errors)) for most in WITHIN_PX)
    return f"{middle:.2f}; {under}" if middle < 1000 else f"fails; {under}"


def _refusals(pairs: Sequence[Pair]) -> str:
    """Every RGB image with the thermal image of the next pair, which shows another place."""
    others = [*pairs[1:], *pairs[:1]]
    found = [align([(a.rgb, b.fir)]) for a, b in zip(pairs, others, strict=True)]
    refused = sum(not one.accepted for one in found)
    true = sum(align([(pair.rgb, pair.fir)]).accepted for pair in pairs)
    return (
        f"Of {len(pairs)} true pairs {true} were accepted, of {len(pairs)} mismatched ones {refused} refused."
    )


# ---------------------------------------------------------------- methods


def _identity(rgb: Image, fir: Image) -> Doubles:
    sx, sy = rgb.shape[1] / fir.shape[1], rgb.shape[0] / fir.shape[0]
    return np.array([[sx, 0, 0.5 * sx - 0.5], [0, sy, 0.5 * sy - 0.5], [0, 0, 1]])


def _features(detector: cv2.Feature2D, norm: int) -> Register:
    def register(rgb: Image, fir: Image) -> Doubles | None:
        (a, da), (b, db) = (detector.detectAndCompute(_grey(image), None) for image in (rgb, fir))  # type: ignore[call-overload]
        if da is None or db is None or min(len(a), len(b)) < _LEAST:
            return None
        pairs = cv2.BFMatcher(norm, crossCheck=True).match(db, da)
        if len(pairs) < _LEAST:
            return None
        src = np.array([b[m.queryIdx].pt for m in pairs])
        dst = np.array([a[m.trainIdx].pt for m in pairs])
        matrix, _ = cv2.findHomography(src, dst, cv2.USAC_MAGSAC, _TOLERANCE_PX)
        return None if matrix is None else np.asarray(matrix, np.float64)

    return register


def _ecc(rgb: Image, fir: Image) -> Doubles | None:
    """ECC on gradient magnitudes, affine, from coarse to fine."""
    move = np.eye(2, 3, dtype=np.float32)
    base = _identity(rgb, fir)
    moved = np.asarray(cv2.warpPerspective(_grey(fir), base, (rgb.shape[1], rgb.shape[0])), np.uint8)
    for scale in (0.125, 0.25, 0.5, 1.0):
        a, b = (_gradient(image, scale) for image in (_grey(rgb), moved))
        full = np.full(a.shape, 255, np.uint8)
        move[:, 2] *= scale
        try:
            _, found = cv2.findTransformECC(a, b, move, cv2.MOTION_AFFINE, (3, 50, 1e-4), full, 5)
        except cv2.error:
            return None
        move = np.asarray(found, np.float32)
        move[:, 2] /= scale
    return np.asarray(np.linalg.inv(np.vstack([move, [0, 0, 1]])) @ base, np.float64)


def _gradient(image: Image, scale: float) -> NDArray[np.float32]:
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA).astype(np.float32)
    x, y = cv2.Sobel(small, cv2.CV_32F, 1, 0), cv2.Sobel(small, cv2.CV_32F, 0, 1)
    return np.asarray(cv2.magnitude(x, y), np.float32)


def _grey(image: Image) -> Image:
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)


def _ours(rgb: Image, fir: Image) -> Doubles:
    return align([(rgb, fir)]).H_rgb_fir


METHODS: dict[str, Register] = {
    "identity": _identity,
    "ORB + MAGSAC": _features(cv2.ORB.create(_FEATURES), cv2.NORM_HAMMING),
    "SIFT + MAGSAC": _features(cv2.SIFT.create(_FEATURES), cv2.NORM_L2),
    "ECC on gradients, pyramid": _ecc,
    OURS: _ours,
}


# ---------------------------------------------------------------- pairs


def _warps(data: Path) -> Iterator[Pair]:
    for rgb in sorted((data / "rgbt_warped").glob("*/vi/*.png")):
        folder = rgb.parent.parent
        flow = loadmat(folder / "flow" / f"{rgb.name}.mat")["flow"][0].astype(np.float64)
        fir = _grey(_read(folder / "ir_warp" / rgb.name))
        yield Pair(rgb.stem, _read(rgb), fir, _flow_error(flow))


def _flow_error(flow: Doubles) -> Callable[[Doubles], float]:
    """`flow` (H, W, 2) in [-1, 1] says where each pixel of the bent image lies on the grid of RGB."""
    h, w = flow.shape[:2]
    truth = (flow + 1) / 2 * [w - 1, h - 1]
    valid = ((truth >= 0) & (truth <= [w - 1, h - 1])).all(axis=-1)
    at = np.stack(np.meshgrid(np.arange(w), np.arange(h)), axis=-1).astype(np.float64)

    def error(matrix: Doubles) -> float:
        mapped = cv2.perspectiveTransform(at, matrix)
        return float(np.linalg.norm(mapped - truth, axis=-1)[valid].mean())

    return error


def _landmarks(data: Path) -> Iterator[Pair]:
    for path in sorted((data / "rgbt_landmarks").glob("VIS_IR_*.mat")):
        stem = path.stem.replace("VIS_IR", "VI")
        rgb, fir = (_read(path.parent / f"{stem}_{side}.png") for side in "ab")
        yield Pair(stem, rgb, _grey(fir), _corner_error(loadmat(path)["T"].T, fir.shape))


def _corner_error(truth: Doubles, shape: tuple[int, ...]) -> Callable[[Doubles], float]:
    h, w = shape[:2]
    corners = np.array([[[0, 0], [w - 1, 0], [w - 1, h - 1], [0, h - 1]]], np.float64)

    def error(matrix: Doubles) -> float:
        gap = cv2.perspectiveTransform(corners, matrix) - cv2.perspectiveTransform(corners, truth)
        return float(np.linalg.norm(gap, axis=-1).mean())

    return error


def _read(path: Path) -> Image:
    return np.asarray(cv2.imread(str(path)), np.uint8)
