"""Where the thermal image lies on the RGB image: homographies read, fitted to points, and judged.

`H_rgb_fir` takes thermal pixel coordinates to RGB pixel coordinates; pixel (0, 0) is the centre of the
top-left pixel.
"""

from __future__ import annotations

import csv
import io
import math
import re
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, PositiveInt, ValidationError

from fusion.errors import UsageError
from fusion.files import replace_file
from fusion.homography import DegenerateError, Floats, PointFit, fit_homography
from fusion.warp import Size, coverage, fault_of

Kind = Literal["homography", "points", "identity", "scale"]
FORMAT = "fusion-homography/1"
COLUMNS = ("fir_x", "fir_y", "rgb_x", "rgb_y")
_LARGEST_FILE_BYTES = 1_000_000
_GOOD_MATRIX = (
    f'a TOML with format = "{FORMAT}" and H_rgb_fir = [[a, b, c], [d, e, f], [g, h, 1.0]],'
    " a text file with these nine numbers row by row, or a 3x3 .npy"
)
_GOOD_POINTS = f"a CSV whose first line is {','.join(COLUMNS)} and then one pair of pixels a line"
_LARGEST_COORDINATE = 1e7
_LEAST_COVERAGE = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """A homography from thermal to RGB pixels, and where it comes from.

    `H_rgb_fir` is (3, 3) float64, read-only, scaled so that its last element is 1 (left as it came
    where that cannot be: `check` refuses such a matrix). The sizes are those for which it holds, None
    where nobody said. `fit` tells how well points agree; `notes` are for the user to read.
    """

    H_rgb_fir: Floats
    kind: Kind
    fir_size_wh: Size | None = None
    rgb_size_wh: Size | None = None
    fit: PointFit | None = None
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        matrix = np.array(self.H_rgb_fir, dtype=np.float64)
        if matrix.shape != (3, 3):
            raise ValueError(f"expected a 3x3 matrix, got {matrix.shape}")
        if matrix[2, 2] != 0 and np.isfinite(matrix).all():
            with np.errstate(over="ignore"):
                matrix /= matrix[2, 2]
        matrix.setflags(write=False)
        object.__setattr__(self, "H_rgb_fir", matrix)


def identity(size_wh: Size) -> Registration:
    """Both images on one grid already: what aligned data sets are."""
    return Registration(np.eye(3), "identity", size_wh, size_wh)


def scale_to_fit(fir_size_wh: Size, rgb_size_wh: Size) -> Registration:
    """The thermal image stretched over the RGB image, (u + 0.5) s - 0.5 each way. Not a registration."""
    sx, sy = rgb_size_wh[0] / fir_size_wh[0], rgb_size_wh[1] / fir_size_wh[1]
    matrix = np.array([[sx, 0, 0.5 * sx - 0.5], [0, sy, 0.5 * sy - 0.5], [0, 0, 1]])
    note = (
        f"NOT REGISTERED: thermal {_wh(fir_size_wh)} is only stretched over RGB {_wh(rgb_size_wh)};"
        " give a homography or point pairs to align them"
    )
    return Registration(matrix, "scale", fir_size_wh, rgb_size_wh, notes=(note,))


def fit_points(fir_xy: Floats, rgb_xy: Floats, *, threshold_px: float = 3.0) -> Registration:
    """The homography that takes `fir_xy` to `rgb_xy`, both (N, 2) float64 pixels, N >= 4.

    Four pairs are met exactly; of more, those further than `threshold_px` (RGB pixels) from the fit are
    left out, and the rest fitted by least squares of the distance in the RGB image. The same points
    give the same matrix. Raises `UsageError` for points that determine no homography, or of which only
    half, or only four (as any four do), agree with one.
    """
    fir_xy, rgb_xy = np.asarray(fir_xy, np.float64), np.asarray(rgb_xy, np.float64)
    if fir_xy.shape != rgb_xy.shape or fir_xy.ndim != 2 or fir_xy.shape[1] != 2:
        raise UsageError(f"expected two (N, 2) lists of pixels, got {fir_xy.shape} and {rgb_xy.shape}")
    if not all((np.abs(xy) < _LARGEST_COORDINATE).all() for xy in (fir_xy, rgb_xy)):  # NaN fails too
        raise UsageError(f"point pairs: coordinates must be pixels, below {_LARGEST_COORDINATE:,.0f}")
    if not 0 < threshold_px < math.inf:
        raise UsageError(f"the threshold must be positive pixels, got {threshold_px}")
    try:
        matrix, fit = fit_homography(fir_xy, rgb_xy, threshold_px)
    except DegenerateError as error:
        hint = "give four or more pairs spread over the image, the same spot in the same row"
        raise UsageError(str(error), where="point pairs", hint=hint) from None
    return Registration(matrix, "points", fit=fit, notes=_fit_notes(fit))


def _fit_notes(fit: PointFit) -> tuple[str, ...]:
    if fit.leave_one_out_px is None:
        return (f"{fit.inliers} points: no redundancy, their error cannot be known",)
    if not fit.outlier_rows:
        return ()
    rows = ", ".join(str(row + 1) for row in fit.outlier_rows[:20])
    more = ", …" if len(fit.outlier_rows) > 20 else ""
    return (f"{len(fit.outlier_rows)} of {fit.count} point pairs left out as outliers: pairs {rows}{more}",)


# ---------------------------------------------------------------- files


class _HomographyFile(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)

    format: Literal["fusion-homography/1"]
    H_rgb_fir: Annotated[
        list[Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]],
        Field(min_length=3, max_length=3),
    ]
    fir_size_wh: Annotated[list[PositiveInt], Field(min_length=2, max_length=2)] | None = None
    rgb_size_wh: Annotated[list[PositiveInt], Field(min_length=2, max_length=2)] | None = None


def read_homography(path: Path | str) -> Registration:
    """Read a homography: native TOML, nine numbers as text, or .npy. Raises `UsageError` naming the file.

    Text may hold spaces, commas or semicolons between numbers, and comments after #.
    """
    data = _read_small(path, _GOOD_MATRIX)
    try:
        if data.startswith(b"\x93NUMPY"):
            return Registration(_npy(data), "homography")
        text = data.decode("utf-8-sig")
        if Path(path).suffix.lower() == ".toml" or "=" in re.sub(r"#.*", "", text):
            return _toml(text)
        return Registration(_nine_numbers(text), "homography")
    except ValueError as error:  # also UnicodeDecodeError, TOMLDecodeError
        raise UsageError(
            f"no homography in this file: {error}", where=path, hint=f"expected {_GOOD_MATRIX}"
        ) from None


def _npy(data: bytes) -> Floats:
    try:
        matrix = np.load(io.BytesIO(data), allow_pickle=False)
    except (OSError, EOFError, MemoryError) as error:
        raise ValueError(f"damaged .npy: {error}") from None
    if matrix.shape != (3, 3) or matrix.dtype.kind not in "fiu":
        raise ValueError(f"the array is {matrix.shape} {matrix.dtype}, not 3x3 real numbers")
    return _finite(matrix.astype(np.float64))


def _toml(text: str) -> Registration:
    try:
        file = _HomographyFile.model_validate(tomllib.loads(text))
    except ValidationError as error:
        faults = (f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors())
        raise ValueError("; ".join(faults)) from None
    fir, rgb = ((s[0], s[1]) if s else None for s in (file.fir_size_wh, file.rgb_size_wh))
    return Registration(np.array(file.H_rgb_fir), "homography", fir, rgb)


def _nine_numbers(text: str) -> Floats:
    numbers: list[float] = []
    for line, content in enumerate(text.splitlines(), start=1):
        for token in re.findall(r"[^\s,;]+", content.partition("#")[0]):
            try:
                numbers.append(float(token))
            except ValueError:
                raise ValueError(f"line {line}: {token[:40]!r} is not a number") from None
    if len(numbers) != 9:
        raise ValueError(f"{len(numbers)} numbers instead of 9")
    return _finite(np.array(numbers).reshape(3, 3))


def _finite(matrix: Floats) -> Floats:
    if not np.isfinite(matrix).all():
        raise ValueError("it holds NaN or infinity")
    return matrix


def write_homography(path: Path | str, registration: Registration) -> None:
    """Write the native TOML, whole or not at all; matrix and sizes come back bit for bit.

    How it was found (kind, fit, notes) stands in comments. Raises `UsageError` for a matrix that is
    not finite and `OutputError` where the file cannot be written.
    """
    if not np.isfinite(registration.H_rgb_fir).all():
        raise UsageError("a homography with NaN or infinity is not written", where=path)
    replace_file(Path(path), homography_toml(registration).encode())


def homography_toml(registration: Registration) -> str:
    """The text of `write_homography`'s file."""
    import tomlkit

    document = tomlkit.document()
    for line in (f"kind: {registration.kind}", *_fit_lines(registration.fit), *registration.notes):
        document.add(tomlkit.comment(" ".join(line.split())))
    document.add("format", tomlkit.item(FORMAT))
    document.add("H_rgb_fir", tomlkit.item(registration.H_rgb_fir.tolist()))
    for name in ("fir_size_wh", "rgb_size_wh"):
        size_wh = getattr(registration, name)
        if size_wh is not None:
            document.add(name, tomlkit.item([int(n) for n in size_wh]))
    return tomlkit.dumps(document)


def _fit_lines(fit: PointFit | None) -> list[str]:
    if fit is None:
        return []
    line = f"{fit.inliers} of {fit.count} point pairs, rms {fit.rms_px:.3f} px, largest {fit.max_px:.3f} px"
    left_out = fit.leave_one_out_px
    return [line + (f", each left out in turn {left_out:.3f} px (median)" if left_out is not None else "")]


def read_points(path: Path | str) -> tuple[Floats, Floats]:
    """Read point pairs: (fir_xy, rgb_xy), both (N, 2) float64 pixels, in the file's order.

    The header names the columns fir_x, fir_y, rgb_x, rgb_y in any order among others; comma, semicolon
    or tab separate. Raises `UsageError` naming file, line and column.
    """
    try:
        text = _read_small(path, _GOOD_POINTS).decode("utf-8-sig")
        rows = _point_rows(text)
        if len(rows) < 4:
            raise ValueError(f"{len(rows)} point pairs: a homography needs 4 or more")
    except (ValueError, csv.Error) as error:
        raise UsageError(
            f"no usable point pairs: {error}", where=path, hint=f"expected {_GOOD_POINTS}"
        ) from None
    points = np.array(rows)
    return points[:, :2], points[:, 2:]


def _point_rows(text: str) -> list[list[float]]:
    """The four numbers of each pair, in the order of `COLUMNS`."""
    header = text.partition("\n")[0]
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=max(",;\t", key=header.count), strict=True)
    names = [name.strip().lower() for name in next(reader, [])]
    for column in COLUMNS:
        if names.count(column) != 1:
            fault = "is named twice in" if column in names else "is missing in"
            raise ValueError(f"column {column} {fault} the header {','.join(names)[:80]!r}")
    places = [names.index(column) for column in COLUMNS]
    rows = []
    for cells in reader:
        if any(cell.strip() for cell in cells):
            if len(cells) > len(names):
                raise ValueError(f"line {reader.line_num}: {len(cells)} cells under {len(names)} columns")
            rows.append([_number(cells, place, names[place], reader.line_num) for place in places])
    return rows


def _number(cells: list[str], place: int, column: str, line: int) -> float:
    cell = cells[place].strip() if place < len(cells) else ""
    try:
        value = float(cell)
    except ValueError:
        raise ValueError(f"line {line}, column {column}: {cell[:40]!r} is not a number") from None
    if not math.isfinite(value):
        raise ValueError(f"line {line}, column {column}: {cell!r} is no pixel coordinate")
    return value


def _read_small(path: Path | str, good: str) -> bytes:
    path, hint = Path(path), f"expected {good}"
    try:
        if not path.exists():
            raise UsageError("no such file", where=path, hint=hint)
        if not path.is_file():
            raise UsageError("not a regular file", where=path, hint=hint)
        if path.stat().st_size > _LARGEST_FILE_BYTES:
            raise UsageError(f"{path.stat().st_size} bytes, far too large", where=path, hint=hint)
        data = path.read_bytes()
    except OSError as error:
        raise UsageError(f"cannot be read: {error.strerror or error}", where=path) from None
    if not data.strip():
        raise UsageError("the file is empty", where=path, hint=hint)
    return data


# ---------------------------------------------------------------- judgement


def check(registration: Registration, fir_size_wh: Size, rgb_size_wh: Size) -> list[str]:
    """Judge a registration for images of these sizes; returns notes for the user.

    Raises `UsageError` when it cannot be right: sizes other than those it was made for, not finite,
    singular, folding (its denominator reaches zero on the thermal image), an absurd scale, no overlap.
    The inverse needs no test of its own: where the thermal image lands, its denominator is 1 / w > 0.
    """
    H = registration.H_rgb_fir
    for role, here, made in (
        ("thermal", fir_size_wh, registration.fir_size_wh),
        ("RGB", rgb_size_wh, registration.rgb_size_wh),
    ):
        if made is not None and tuple(made) != tuple(here):
            raise UsageError(f"the registration was made for {role} {_wh(made)}, the images are {_wh(here)}")
    fault = fault_of(H, fir_size_wh, rgb_size_wh)
    share = 0.0 if fault else coverage(H, fir_size_wh, rgb_size_wh)
    if not fault and share == 0:
        fault = "the homography puts the thermal image outside the RGB image: no overlap"
    advice = _advice(H, fir_size_wh, rgb_size_wh, share) if share < _LEAST_COVERAGE else ""
    if fault:
        default = "H_rgb_fir takes thermal pixel coordinates to RGB pixel coordinates"
        raise UsageError(fault, where="registration", hint=advice or default)
    notes = []
    if np.linalg.det(H) < 0:
        notes.append("the homography mirrors the thermal image")
    if share < _LEAST_COVERAGE:
        notes.append(
            f"thermal covers only {share:.2%} of RGB" + (f"; if more is meant: {advice}" if advice else "")
        )
    return notes


def _advice(H: Floats, fir_size_wh: Size, rgb_size_wh: Size, share: float) -> str:
    """The usual mix-ups, where undoing one makes sense of the matrix; empty where none does."""
    if not np.isfinite(H).all() or np.linalg.matrix_rank(H) < 3:
        return ""
    for other, words in (
        (np.linalg.inv(H), "it seems to map RGB to thermal: invert it"),
        (H.T, "it seems to be written for row vectors, as in MATLAB: transpose it"),
        (
            np.linalg.inv(H.T),
            "it seems to be written for row vectors and to map RGB to thermal: transpose and invert it",
        ),
    ):
        candidate = Registration(np.asarray(other, np.float64), "homography").H_rgb_fir
        if not fault_of(candidate, fir_size_wh, rgb_size_wh):
            gained = coverage(candidate, fir_size_wh, rgb_size_wh)
            if gained >= max(10 * share, _LEAST_COVERAGE):
                return words
    return ""


def _wh(size_wh: Size) -> str:
    return f"{size_wh[0]}x{size_wh[1]}"
