"""Who saw the board at once: by stamp, by name, by order; and what is said of the others."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib.moments import Shot, nearest_one_to_one, pair, pair_rows
from calib.observations import Detection, Refusal
from fusion.errors import InputError, UsageError

SIZE = (640, 480)
T0 = 1_700_000_000_000_000_000


def shot(name: str, time_s: float | None = None, *, seen: bool = True, size: tuple[int, int] = SIZE) -> Shot:
    found = Detection(np.arange(4), np.zeros((4, 2)), "test") if seen else Refusal("too dark")
    return Shot(name, f"{name}.png", None if time_s is None else T0 + round(time_s * 1e9), size, found)


def moments_of(pairing) -> set[frozenset[str]]:
    groups: dict[str, set[str]] = {}
    for view in pairing.views:
        groups.setdefault(view.moment, set()).add(view.file)
    return {frozenset(files) for files in groups.values()}


times = st.lists(st.integers(0, 10_000), max_size=40, unique=True).map(sorted)


@given(times, times)
def test_nearest_pairs_are_each_others_nearest_and_in_order(a, b):
    """Against all distances: nobody in a pair has a nearer partner, and no mutual nearest is forgotten."""
    x, y = np.array(a, float) + 0.25, np.array(b, float)  # a quarter off: no ties
    found = nearest_one_to_one(x, y)
    away = np.abs(x[:, None] - y[None])
    expected = [
        (i, j)
        for i in range(len(x))
        for j in range(len(y))
        if away[i, j] == away[i].min() == away[:, j].min()
    ]
    assert found == expected
    assert all(i < k and j < m for (i, j), (k, m) in pairwise(found))


def test_by_stamp_unsorted_with_offset_and_missing():
    rgb = [shot(f"r{k}", 0.1 * k) for k in (2, 0, 3, 1)]
    fir = [shot(f"f{k}", 0.1 * k - 5.0 + 0.004) for k in (3, 1, 0)]
    found = pair({"rgb": rgb, "fir": fir}, offset_s={"fir": 5.0}, tolerance_s=0.01)
    assert found.by == "stamp"
    expected = [{"r0.png", "f0.png"}, {"r1.png", "f1.png"}, {"r2.png"}, {"r3.png", "f3.png"}]
    assert moments_of(found) == {frozenset(group) for group in expected}
    (row,) = found.pairs
    assert row.shared == 3
    assert [(camera, file) for camera, file, _ in row.left] == [("rgb", "r2.png")]
    assert row.median_s == pytest.approx(0.004, abs=1e-6)
    lag = {view.file: view.lag_s for view in found.views}
    assert lag["r1.png"] == 0.0
    assert lag["f1.png"] == pytest.approx(0.004 - 5.0, abs=1e-6)  # the stamps' own difference, no offset


def test_the_tolerance_that_the_report_names_works():
    rgb, fir = [shot(f"r{k}", 1.0 * k) for k in range(9)], [shot(f"f{k}", k + 0.08) for k in range(9)]
    (row,) = pair({"rgb": rgb, "fir": fir}).pairs
    assert row.shared == 0
    assert row.nearest_s == pytest.approx(0.08, abs=1e-6)
    assert row.tolerance_s is not None
    assert 0.08 < row.tolerance_s < 0.1
    assert f"{1e3 * row.tolerance_s:g} ms" in str(row)
    (again,) = pair({"rgb": rgb, "fir": fir}, tolerance_s=row.tolerance_s).pairs
    assert again.shared == 9


def test_no_tolerance_is_named_where_it_would_pair_at_random():
    rgb, fir = [shot(f"r{k}", 0.1 * k) for k in range(9)], [shot(f"f{k}", 0.1 * k + 50) for k in range(9)]
    (row,) = pair({"rgb": rgb, "fir": fir}).pairs
    assert row.shared == 0
    assert row.tolerance_s is None


def test_three_cameras_pairs_beside_the_first():
    """fir and nir share a moment that rgb did not see."""
    streams = {
        "rgb": [shot("r0", 0.0)],
        "fir": [shot("f0", 0.001), shot("f1", 1.0)],
        "nir": [shot("n1", 1.002)],
    }
    found = pair(streams)
    assert moments_of(found) == {frozenset({"r0.png", "f0.png"}), frozenset({"f1.png", "n1.png"})}
    assert {(row.a, row.b): row.shared for row in found.pairs} == {
        ("rgb", "fir"): 1,
        ("rgb", "nir"): 0,
        ("fir", "nir"): 1,
    }


def test_images_without_board_are_named_and_hold_their_place():
    rgb = [shot("a"), shot("b", seen=False), shot("c")]
    fir = [shot("a"), shot("b"), shot("c", seen=False)]
    by_name, by_order = pair({"rgb": rgb, "fir": fir}), pair({"rgb": rgb, "fir": fir}, by="order")
    for found in (by_name, by_order):
        assert found.pairs[0].shared == 1
        assert found.without_board == (("rgb", "b.png", "too dark"), ("fir", "c.png", "too dark"))
        assert {(c, f, r) for c, f, r in found.pairs[0].left} == {
            ("fir", "b.png", "no board in b.png"),
            ("rgb", "c.png", "no board in c.png"),
        }
        assert not found.moment_ns


def test_by_order_refuses_streams_of_different_length():
    with pytest.raises(InputError, match="by order: 2 of rgb, 1 of fir"):
        pair({"rgb": [shot("a"), shot("b")], "fir": [shot("a")]}, by="order")


def test_by_stamp_refuses_images_without_one():
    with pytest.raises(InputError, match="fir: images without a time stamp"):
        pair({"rgb": [shot("a", 1.0)], "fir": [shot("a")]}, by="stamp")


def test_by_name_refuses_names_that_are_there_twice():
    with pytest.raises(InputError, match="rgb: 1 names are there twice, such as 'a'"):
        pair({"rgb": [shot("a"), shot("a")]})


def test_mixed_sizes_name_the_odd_ones():
    odd = [shot(f"odd{k}", size=(320, 240)) for k in range(2)]
    with pytest.raises(InputError) as error:
        pair({"rgb": [shot(f"a{k}") for k in range(5)] + odd})
    assert (
        "rgb: images of different sizes: 5 of 7 are 640x480, but not odd0.png (320x240), odd1.png (320x240)"
        in str(error.value)
    )


@pytest.mark.parametrize("tolerance_s", [0.0, -1.0, float("nan"), float("inf")])
def test_a_tolerance_is_a_positive_number(tolerance_s):
    with pytest.raises(UsageError, match="tolerance"):
        pair({"rgb": [shot("a", 0.0)]}, tolerance_s=tolerance_s)


def test_rows_from_views_agree_with_the_pairing():
    rgb, fir = [shot(f"r{k}", 1.0 * k) for k in range(5)], [shot(f"f{k}", k + 0.0207) for k in range(1, 5)]
    found = pair({"rgb": rgb, "fir": fir})
    (row,), (again,) = found.pairs, pair_rows(found.views, found.moment_ns)
    assert again.shared == row.shared == 4
    assert again.median_s == pytest.approx(row.median_s)
    assert again.tolerance_s == pytest.approx(row.tolerance_s)


def test_nothing_at_all():
    found = pair({"rgb": [], "fir": [shot("a", 0.0)]})
    assert len(found.views) == 1
    assert found.pairs[0].shared == 0
