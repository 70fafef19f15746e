"""Registrations read, written, fitted to planted points, and judged."""

from __future__ import annotations

import io
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from fusion import registration as reg
from fusion.errors import UsageError
from fusion.warp import Warp

FIR, RGB = (640, 480), (800, 600)
PLANTED = np.array([[1.1, 0.05, 12.0], [-0.03, 1.2, -8.0], [1e-4, -5e-5, 1.0]])
CORNERS = np.array([[0, 0], [639, 0], [639, 479], [0, 479.0]])


def mapped(H: NDArray, xy: NDArray) -> NDArray:
    out = [H @ [x, y, 1.0] for x, y in xy]
    return np.array([[p[0] / p[2], p[1] / p[2]] for p in out])


def spread(rng: np.random.Generator, count: int) -> NDArray:
    return rng.uniform((0, 0), FIR, (count, 2))


# ---------------------------------------------------------------- points


def corner_sigma(H: NDArray, xy: NDArray, noise: float) -> NDArray:
    """Standard deviation (px) of each corner, from the noise alone: linear propagation through the
    least-squares fit, every derivative a central difference of the model."""

    def model(h: NDArray, points: NDArray) -> NDArray:
        return mapped(np.append(h, 1.0).reshape(3, 3), points).ravel()

    h = H.ravel()[:8]
    steps = np.diag(np.maximum(np.abs(h), 1e-4) * 1e-5)

    def slope(points: NDArray) -> NDArray:
        columns = [(model(h + s, points) - model(h - s, points)) / (2 * s.sum()) for s in steps]
        return np.stack(columns, axis=1)

    at_points, at_corners = slope(xy), slope(CORNERS)
    scale = np.abs(at_points).max(axis=0)  # eight numbers of very different size
    spread_h = np.linalg.inv((at_points / scale).T @ (at_points / scale)) * noise**2
    variance = np.diag((at_corners / scale) @ spread_h @ (at_corners / scale).T)
    return np.sqrt(variance.reshape(-1, 2).sum(axis=1))


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize(("noise", "share"), [(0.3, 0.2), (0.5, 0.3)])
def test_planted_homography_returns_from_noise_and_outliers(seed: int, noise: float, share: float) -> None:
    rng = np.random.default_rng(seed)
    fir = spread(rng, 40)
    rgb = mapped(PLANTED, fir) + rng.normal(0, noise, (40, 2))
    bad = np.sort(rng.choice(40, int(share * 40), replace=False))
    rgb[bad] += rng.uniform(15, 200, (len(bad), 2)) * rng.choice([-1, 1], (len(bad), 2))
    found = reg.fit_points(fir, rgb)
    fit = found.fit
    assert fit is not None
    assert (fit.count, fit.inliers) == (40, 40 - len(bad))
    assert fit.outlier_rows == tuple(bad)
    # Four standard deviations of what the inliers' noise leaves undetermined: 64 corners are tried.
    error = np.linalg.norm(mapped(found.H_rgb_fir, CORNERS) - mapped(PLANTED, CORNERS), axis=1)
    assert (error < 4 * corner_sigma(PLANTED, np.delete(fir, bad, axis=0), noise)).all()
    # 2 N noisy numbers, 8 fitted: the expected square sum is noise^2 (2 N - 8).
    expected = noise * np.sqrt((2 * fit.inliers - 8) / fit.inliers)
    assert 0.6 * expected < fit.rms_px < 1.4 * expected
    assert fit.rms_px <= fit.max_px < 3.0
    assert ", ".join(str(row + 1) for row in bad) in found.notes[0]


def test_least_squares_has_its_least_in_the_rgb_image() -> None:
    rng = np.random.default_rng(5)
    fir = spread(rng, 25)
    rgb = mapped(PLANTED, fir) + rng.normal(0, 0.5, fir.shape)
    H = reg.fit_points(fir, rgb).H_rgb_fir

    def cost(matrix: NDArray) -> float:
        return float(np.sum((mapped(matrix, fir) - rgb) ** 2))

    for k in range(8):
        for sign in (-1, 1):
            moved = H.copy()
            moved.flat[k] += sign * 1e-5 * max(abs(H.flat[k]), 1e-3)
            assert cost(moved) > cost(H)


def test_leave_one_out_is_what_refitting_without_each_pair_gives() -> None:
    rng = np.random.default_rng(6)
    for count in (6, 12, 30):
        fir = spread(rng, count)
        rgb = mapped(PLANTED, fir) + rng.normal(0, 0.3, fir.shape)
        fit = reg.fit_points(fir, rgb, threshold_px=50).fit
        assert fit is not None
        misses = []
        for k in range(count):
            rest = np.delete(np.arange(count), k)
            H = reg.fit_points(fir[rest], rgb[rest], threshold_px=50).H_rgb_fir
            misses.append(np.linalg.norm(mapped(H, fir[k : k + 1]) - rgb[k]))
        assert fit.leave_one_out_px == pytest.approx(np.median(misses), rel=0.1)  # linearised
        assert fit.leave_one_out_px is not None
        H = reg.fit_points(fir, rgb, threshold_px=50).H_rgb_fir
        assert fit.leave_one_out_px > np.median(np.linalg.norm(mapped(H, fir) - rgb, axis=1))


@settings(max_examples=40, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(4, 30),
    st.floats(-3.1, 3.1),
    st.floats(0.2, 5),
    st.tuples(st.floats(-4e-4, 4e-4), st.floats(-4e-4, 4e-4)),
)
def test_exact_points_return_exactly(
    seed: int, count: int, angle: float, scale: float, tilt: tuple[float, float]
) -> None:
    rng = np.random.default_rng(seed)
    fir = np.vstack([CORNERS + rng.uniform(-20, 20, (4, 2)), spread(rng, count - 4)])
    c, s = scale * np.cos(angle), scale * np.sin(angle)
    H = np.array([[c, -s, 40.0], [s, c, 25.0], [*tilt, 1.0]])
    found = reg.fit_points(fir, mapped(H, fir))
    assert np.abs(mapped(found.H_rgb_fir, CORNERS) - mapped(H, CORNERS)).max() < 1e-6
    assert found.fit is not None
    assert found.fit.max_px < 1e-6
    assert found.H_rgb_fir[2, 2] == 1


def test_four_points_are_met_and_said_to_prove_nothing() -> None:
    moved = np.array([[0, 0], [0, 0], [3, -4], [0, 0]])
    found = reg.fit_points(CORNERS, mapped(PLANTED, CORNERS) + moved)
    assert found.fit is not None
    assert found.fit.leave_one_out_px is None
    assert found.fit.max_px < 1e-6
    assert any("no redundancy" in note for note in found.notes)
    twice = reg.fit_points(np.vstack([CORNERS, CORNERS]), np.vstack([CORNERS, CORNERS]) + 7)
    assert any("no redundancy" in note for note in twice.notes)  # the same pair again is no evidence


def test_the_same_points_give_the_same_bits_whatever_the_global_seed() -> None:
    import cv2

    rng = np.random.default_rng(7)
    fir = spread(rng, 30)
    rgb = mapped(PLANTED, fir) + rng.normal(0, 1, fir.shape)
    rgb[:9] += 60
    results = []
    for seed in (0, 99):
        cv2.setRNGSeed(seed)
        results.append(reg.fit_points(fir, rgb))
    assert np.array_equal(results[0].H_rgb_fir, results[1].H_rgb_fir)
    assert results[0].fit == results[1].fit


def _line(count: int) -> NDArray:
    t = np.linspace(0, 1, count)[:, None]
    return t * [500, 300] + [20, 30]


@pytest.mark.parametrize(
    ("fir", "message"),
    [
        (CORNERS[:3], "3 different point pairs"),
        (np.repeat(CORNERS[:1], 6, axis=0), "1 different"),
        (np.repeat(CORNERS[:3], 3, axis=0), "3 different"),
        (_line(4), "too many on one line"),
        (_line(9), "too many on one line"),
        (np.vstack([_line(3), [[100, 400.0]]]), "too many on one line"),
        (np.vstack([_line(8), [[100, 400.0]]]), "too many on one line"),
        (CORNERS + 1e9, "coordinates must be pixels"),
        (np.where(CORNERS > 0, CORNERS, np.nan), "coordinates must be pixels"),
    ],
)
def test_points_that_determine_nothing_are_refused(fir: NDArray, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        reg.fit_points(fir, fir * 1.25 + 3)


def test_jitter_does_not_hide_that_points_lie_on_a_line() -> None:
    rng = np.random.default_rng(8)
    fir = _line(12) + rng.normal(0, 0.3, (12, 2))
    with pytest.raises(UsageError, match="on one line"):
        reg.fit_points(fir, fir + 5 + rng.normal(0, 0.3, (12, 2)))


def test_points_of_one_image_all_the_same_are_refused() -> None:
    with pytest.raises(UsageError, match="are the same"):
        reg.fit_points(CORNERS, np.full((4, 2), 9.0))


def test_rows_in_another_order_are_refused() -> None:
    rng = np.random.default_rng(9)
    fir = spread(rng, 24)
    with pytest.raises(UsageError, match="of 24 point pairs agree"):
        reg.fit_points(fir, rng.permutation(mapped(PLANTED, fir)))
    with pytest.raises(UsageError, match="inside out"):
        reg.fit_points(CORNERS, CORNERS[[0, 2, 1, 3]])  # a bow tie


def test_one_wild_point_of_five_cannot_be_told() -> None:
    fir = np.vstack([CORNERS, [[200, 100.0]]])
    rgb = fir + np.array([[0, 0], [0, 0], [0, 0], [0, 0], [40, 0]])
    with pytest.raises(UsageError, match="only 4 of 5"):
        reg.fit_points(fir, rgb)


@pytest.mark.parametrize("threshold", [0.0, -1.0, float("nan"), float("inf")])
def test_a_threshold_that_is_none_is_refused(threshold: float) -> None:
    with pytest.raises(UsageError, match="threshold"):
        reg.fit_points(CORNERS, CORNERS, threshold_px=threshold)


@pytest.mark.parametrize("number", [1, 7])
def test_published_landmarks_give_the_published_transform(shared_data: Path, number: int) -> None:
    """The file's T is for row vectors, and its landmarks are T's own: they must return T."""
    from scipy.io import loadmat

    file = loadmat(shared_data / "rgbt_landmarks" / f"VIS_IR_{number}.mat", squeeze_me=True)
    rgb, fir = file["Landmarks"].item()
    size_wh = file["I_move"].shape[1::-1]
    found = reg.fit_points(fir, rgb)
    assert found.fit is not None
    assert found.fit.outlier_rows == ()
    np.testing.assert_allclose(found.H_rgb_fir, file["T"].T, atol=1e-8)
    assert reg.check(found, size_wh, size_wh) == []
    with pytest.raises(UsageError, match="MATLAB: transpose it"):
        reg.check(reg.Registration(file["T"], "homography"), size_wh, size_wh)


# ---------------------------------------------------------------- files

matrices = st.lists(
    st.floats(allow_nan=False, allow_infinity=False, min_value=-1e6, max_value=1e6), min_size=8, max_size=8
).map(lambda values: np.array([*values, 1.0]).reshape(3, 3))
maybe_size = st.none() | st.tuples(st.integers(1, 10**6), st.integers(1, 10**6))


@settings(max_examples=60, deadline=None)
@given(matrices, maybe_size, maybe_size)
def test_native_file_returns_every_bit(
    tmp_path_factory: pytest.TempPathFactory,
    H: NDArray,
    fir: tuple[int, int] | None,
    rgb: tuple[int, int] | None,
) -> None:
    path = tmp_path_factory.mktemp("h") / "H.toml"
    reg.write_homography(path, reg.Registration(H, "points", fir, rgb, notes=("two\nlines = 1",)))
    back = reg.read_homography(path)
    assert back.H_rgb_fir.tobytes() == H.tobytes()
    assert (back.fir_size_wh, back.rgb_size_wh, back.kind) == (fir, rgb, "homography")
    assert [p.name for p in path.parent.iterdir()] == ["H.toml"]


def test_native_file_keeps_its_evidence_for_the_reader(tmp_path: Path) -> None:
    fir = spread(np.random.default_rng(1), 9)
    reg.write_homography(tmp_path / "H.toml", reg.fit_points(fir, mapped(PLANTED, fir)))
    text = (tmp_path / "H.toml").read_text()
    assert text.startswith("# kind: points\n# 9 of 9 point pairs")


def test_a_matrix_without_meaning_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="NaN"):
        reg.write_homography(tmp_path / "H.toml", reg.Registration(np.full((3, 3), np.nan), "homography"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "text",
    [
        "2 0 4\n0 2 6\n0 0 2\n",
        "# thermal to RGB\n2, 0, 4\n0, 2, 6 # second\n0, 0, 2",
        "2;0;4\r\n0;2;6\r\n0;0;2\r\n",
        "2 0 4; 0 2 6; 0 0 2",
        "\ufeff2\t0\t4\n\n0\t2e0\t6\n0\t0\t2",
        'format = "fusion-homography/1"\nH_rgb_fir = [[2, 0, 4], [0, 2.0, 6], [0, 0, 2]]\n',
    ],
)
@pytest.mark.parametrize("name", ["H.txt", "H", "матрица с пробелом.csv"])
def test_text_forms_are_read_and_normalised(tmp_path: Path, text: str, name: str) -> None:
    (tmp_path / name).write_text(text, encoding="utf-8", newline="")
    found = reg.read_homography(tmp_path / name)
    assert found.H_rgb_fir.tolist() == [[1, 0, 2], [0, 1, 3], [0, 0, 1]]
    assert not found.H_rgb_fir.flags.writeable


@pytest.mark.parametrize("dtype", ["<f8", ">f4", "i2", "u1"])
def test_npy_is_read(tmp_path: Path, dtype: str) -> None:
    np.save(tmp_path / "H.npy", np.array([[2, 0, 4], [0, 2, 6], [0, 0, 2]], dtype=dtype))
    assert reg.read_homography(tmp_path / "H.npy").H_rgb_fir.tolist() == [[1, 0, 2], [0, 1, 3], [0, 0, 1]]


def npy(array: NDArray, *, cut: int = 0) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=True)
    return buffer.getvalue()[: len(buffer.getvalue()) - cut]


GOOD_TOML = 'format = "fusion-homography/1"\nH_rgb_fir = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\n'
BAD_HOMOGRAPHIES = {
    "empty": (b"", "empty"),
    "blank": (b" \n\n", "empty"),
    "eight": (b"1 0 0 0 1 0 0 0", "8 numbers instead of 9"),
    "ten": (b"1 0 0 0 1 0 0 0 1 1", "10 numbers"),
    "word": (b"1 0 0\n0 one 0\n0 0 1", "line 2: 'one' is not a number"),
    "nan": (b"1 0 0 0 nan 0 0 0 1", "NaN"),
    "overflow": (b"1 0 0 0 1e999 0 0 0 1", "infinity"),
    "binary": (bytes(range(128, 256)), "no homography"),
    "decimal comma": (b"1,5 0 0\n0 1,5 0\n0 0 1,0", "12 numbers"),
    "no format": (b"H_rgb_fir = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]", "format"),
    "other format": (GOOD_TOML.replace("/1", "/9").encode(), "format"),
    "unknown key": (GOOD_TOML.encode() + b"scale = 2\n", "scale"),
    "two rows": (GOOD_TOML.replace(", [0, 0, 1]", "").encode(), "H_rgb_fir"),
    "ragged": (GOOD_TOML.replace("[0, 0, 1]", "[0, 0]").encode(), r"H_rgb_fir\.2"),
    "text number": (GOOD_TOML.replace("1, 0, 0", '"1", 0, 0').encode(), r"H_rgb_fir\.0\.0"),
    "toml nan": (GOOD_TOML.replace("1, 0, 0", "nan, 0, 0").encode(), r"H_rgb_fir\.0\.0"),
    "zero size": (GOOD_TOML.encode() + b"fir_size_wh = [0, 480]\n", r"fir_size_wh\.0"),
    "torn toml": (GOOD_TOML[:-4].encode(), "no homography"),
    "npy shape": (npy(np.eye(4)), r"\(4, 4\)"),
    "npy words": (npy(np.full((3, 3), "a")), "real numbers"),
    "npy complex": (npy(np.eye(3) * 1j), "real numbers"),
    "npy nan": (npy(np.full((3, 3), np.nan)), "NaN"),
    "npy torn": (npy(np.eye(3), cut=8), "no homography"),
    "npy pickle": (npy(np.array([[object] * 3] * 3)), "pickle"),
    "npy huge claim": (
        npy(np.eye(3)).replace(b"(3, 3), }        ", b"(99999999, 99999), }")[:128],
        "no homography",
    ),
}


@pytest.mark.parametrize("case", BAD_HOMOGRAPHIES)
def test_bad_homography_files_get_one_clear_line(tmp_path: Path, case: str) -> None:
    data, message = BAD_HOMOGRAPHIES[case]
    path = tmp_path / "my homography.txt"
    path.write_bytes(data)
    with pytest.raises(UsageError, match=message) as caught:
        reg.read_homography(path)
    assert str(path) in str(caught.value)
    assert "H_rgb_fir = [[" in str(caught.value)  # what a good file looks like
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("read", [reg.read_homography, reg.read_points])
def test_what_is_no_small_file_is_refused(tmp_path: Path, read: object) -> None:
    assert callable(read)
    (tmp_path / "big").write_bytes(b"1 " * 500_001)
    for path, message in ((tmp_path, "not a regular file"), (tmp_path / "no", "no such file")):
        with pytest.raises(UsageError, match=message):
            read(path)
    with pytest.raises(UsageError, match="too large"):
        read(tmp_path / "big")


POINTS = "fir_x,fir_y,rgb_x,rgb_y\n1,2,3,4\n5,6,7,8\n9,10,11,12\n13,14,15.5,-16\n"
EXPECTED = [[1, 2, 3, 4], [5, 6, 7, 8], [9, 10, 11, 12], [13, 14, 15.5, -16]]


@pytest.mark.parametrize(
    "text",
    [
        POINTS,
        POINTS.replace(",", ";"),
        POINTS.replace(",", "\t").replace("\n", "\r\n"),
        "\ufeff" + POINTS.replace("\n", "\n\n"),
        " FIR_X , fir_y, rgb_x ,rgb_y\n" + POINTS.partition("\n")[2],
        'name,rgb_y,rgb_x,fir_y,fir_x\na,4,3,2,1\n"b, c",8,7,6,5\nd,12,11,10,9\n,-16,15.5,14,13\n',
    ],
)
def test_points_are_read_in_any_order_of_columns(tmp_path: Path, text: str) -> None:
    (tmp_path / "p.csv").write_text(text, encoding="utf-8", newline="")
    fir, rgb = reg.read_points(tmp_path / "p.csv")
    assert np.hstack([fir, rgb]).tolist() == EXPECTED
    assert fir.dtype == rgb.dtype == np.float64


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "empty"),
        ("1,2,3,4\n" * 6, "column fir_x is missing in the header '1,2,3,4'"),
        (POINTS.replace("rgb_y", "rgb_z"), "column rgb_y is missing"),
        (POINTS.replace("fir_y", "fir_x"), "column fir_x is named twice"),
        (POINTS.replace("10", "ten"), "line 4, column fir_y: 'ten' is not a number"),
        (POINTS.replace("11", ""), "line 4, column rgb_x: '' is not a number"),
        (POINTS.replace("11", "nan"), "line 4, column rgb_x: 'nan' is no pixel"),
        (POINTS.replace(",8", ""), "line 3, column rgb_y: '' is not a number"),
        (POINTS.replace("3,4", "3,4,5"), "line 2: 5 cells under 4 columns"),
        (POINTS.replace("13,14,15.5,-16\n", ""), "3 point pairs: a homography needs 4"),
        ("fir_x,fir_y,rgb_x,rgb_y", "0 point pairs"),
        (POINTS + '"1,2,3,4', "no usable point pairs"),
        (POINTS.replace("5", "\x00"), "no usable point pairs"),
    ],
)
def test_bad_points_files_name_line_and_column(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "p.csv"
    path.write_text(text)
    with pytest.raises(UsageError, match=re.escape(message)) as caught:
        reg.read_points(path)
    assert str(path) in str(caught.value)
    assert "fir_x,fir_y,rgb_x,rgb_y" in str(caught.value)


def test_points_in_another_encoding_are_refused(tmp_path: Path) -> None:
    (tmp_path / "p.csv").write_bytes(POINTS.encode("utf-16"))
    with pytest.raises(UsageError, match="no usable point pairs"):
        reg.read_points(tmp_path / "p.csv")


# ---------------------------------------------------------------- judgement


def judged(H: object, fir: tuple[int, int] = FIR, rgb: tuple[int, int] = RGB) -> list[str]:
    return reg.check(reg.Registration(np.array(H, float), "homography"), fir, rgb)


def test_sound_registrations_pass_without_a_word() -> None:
    assert judged(PLANTED) == []
    assert reg.check(reg.identity(FIR), FIR, FIR) == []
    assert reg.check(reg.scale_to_fit(FIR, RGB), FIR, RGB) == []
    assert judged(-5 * PLANTED) == []


@pytest.mark.parametrize("fir", [(640, 480), (1, 1), (7, 3000)])
@pytest.mark.parametrize("rgb", [(1280, 960), (5, 9)])
def test_scale_to_fit_carries_edges_to_edges(fir: tuple[int, int], rgb: tuple[int, int]) -> None:
    found = reg.scale_to_fit(fir, rgb)
    ends = mapped(found.H_rgb_fir, np.array([[-0.5, -0.5], [fir[0] - 0.5, fir[1] - 0.5]]))
    np.testing.assert_allclose(ends, [[-0.5, -0.5], [rgb[0] - 0.5, rgb[1] - 0.5]], rtol=1e-12)
    assert found.notes[0].startswith("NOT REGISTERED")


@pytest.mark.parametrize(
    ("H", "message"),
    [
        (np.full((3, 3), np.nan), "NaN"),
        ([[1, 0, np.inf], [0, 1, 0], [0, 0, 1]], "infinity"),
        (np.zeros((3, 3)), "singular"),
        ([[1, 2, 0], [2, 4, 0], [0, 0, 1]], "singular"),
        ([[1, 0, 5], [0, 1, 0], [1, 0, 0]], "folds"),  # no last element to scale by
        ([[1, 0, 0], [0, 1, 0], [-0.002, 0, 1]], "folds"),  # horizon at x = 500
        ([[1, 0, 0], [0, 1, 0], [-1 / 640, 0, 1]], "folds"),  # w falls to 1/1000 of its largest
        ([[1, 0, 0], [0, 1, 0], [0, -0.0021, 1]], "folds"),
        ([[200, 0, 0], [0, 200, 0], [0, 0, 1]], "absurd scale"),
        ([[0.005, 0, 50], [0, 0.005, 50], [0, 0, 1]], "absurd scale"),
        ([[1, 0, 900], [0, 1, 0], [0, 0, 1]], "no overlap"),
        ([[1e200, 0, 0], [0, 1e-200, 0], [0, 0, 1]], "singular"),
    ],
)
def test_absurd_homographies_are_refused(H: object, message: str) -> None:
    with pytest.raises(UsageError, match=message) as caught:
        judged(H)
    assert "\n" not in str(caught.value)


def test_an_inverted_or_transposed_matrix_is_recognised() -> None:
    fir, rgb = (160, 120), (1280, 960)
    H = np.array([[8, 0, 200.0], [0, 8, 150], [0, 0, 1]])
    assert judged(H, fir, rgb) == []
    with pytest.raises(UsageError, match=r"no overlap.*it seems to map RGB to thermal: invert it"):
        judged(np.linalg.inv(H), fir, rgb)
    with pytest.raises(UsageError, match=r"folds.*row vectors, as in MATLAB: transpose it"):
        judged(H.T, fir, rgb)
    with pytest.raises(UsageError, match="transpose and invert it"):
        judged(np.linalg.inv(H).T, fir, rgb)


def test_little_coverage_is_a_note() -> None:
    corner = judged([[1, 0, 700], [0, 1, 500], [0, 0, 1]])  # 100 x 100 of 800 x 600
    assert corner == ["thermal covers only 2.08% of RGB"]
    inverse = judged([[0.1, 0, 0], [0, 0.1, 0], [0, 0, 1]])
    assert len(inverse) == 1
    assert inverse[0].startswith("thermal covers only 0.")
    assert "invert it" in inverse[0]
    assert judged([[0.5, 0, 0], [0, 0.5, 0], [0, 0, 1]]) == []  # 16 %


def test_mirrored_is_a_note() -> None:
    notes = judged([[-1, 0, 639], [0, 1, 0], [0, 0, 1]], FIR, FIR)
    assert notes == ["the homography mirrors the thermal image"]


def test_sizes_other_than_those_of_the_file_are_refused() -> None:
    found = reg.Registration(PLANTED, "homography", FIR, RGB)
    assert reg.check(found, FIR, RGB) == []
    with pytest.raises(UsageError, match="made for thermal 640x480, the images are 320x240"):
        reg.check(found, (320, 240), RGB)
    with pytest.raises(UsageError, match="made for RGB 800x600, the images are 640x480"):
        reg.check(found, FIR, FIR)


entries = st.floats(-1e3, 1e3) | st.floats(-1e-2, 1e-2) | st.sampled_from([0.0, 1.0, 1e300, 5e-324, np.nan])


@settings(max_examples=200, deadline=None)
@given(st.dictionaries(st.integers(0, 8), entries, max_size=9))
def test_what_passes_the_check_can_be_warped(changed: dict[int, float]) -> None:
    """Any nine numbers are refused in words, or make a warp: no warning, no other exception."""
    H = np.eye(3)
    H.flat[list(changed)] = list(changed.values())
    found = reg.Registration(H, "homography")
    fir, rgb = (24, 18), (30, 20)
    try:
        reg.check(found, fir, rgb)
    except UsageError:
        return
    warp = Warp(found.H_rgb_fir, fir, rgb)
    assert warp.apply(np.full((18, 24), 5, np.uint8)).tolist() == np.full((20, 30), 5).tolist()
    assert warp.coverage > 0


def test_registrations_are_frozen_and_keep_their_own_matrix() -> None:
    H = PLANTED * 2
    found = reg.Registration(H, "homography")
    H[:] = 0
    assert np.array_equal(found.H_rgb_fir, PLANTED)
    with pytest.raises(ValueError, match="read-only"):
        found.H_rgb_fir[0, 0] = 1
    with pytest.raises(ValueError, match="3x3"):
        reg.Registration(np.eye(4), "homography")
