"""Pairing: every entry is in one pair or unmatched with a reason; nothing is decided by chance."""

from __future__ import annotations

import json
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fusion.errors import InputError, UsageError
from fusion.pairing import Pairing, PairingRule, pair, report_lines, stamp_in_name, stamps_of
from fusion.sources.base import Entry


def entries(*stems: str, folder: str = "in", suffix: str = ".png") -> list[Entry]:
    return [Entry(stem, f"{folder}/{stem}{suffix}") for stem in stems]


def clocked(stamps: Iterable[int], name: str = "clip.mp4") -> list[Entry]:
    return [Entry(f"{k:06d}", f"{name} frame {k}", stamp) for k, stamp in enumerate(stamps)]


def stems(pairing: Pairing, rgb: list[Entry], fir: list[Entry]) -> list[tuple[str, str]]:
    return [(rgb[p.rgb].stem, fir[p.fir].stem) for p in pairing.pairs]


def assert_partition(pairing: Pairing, rgb: list[Entry], fir: list[Entry]) -> None:
    """Every entry is in exactly one pair or exactly once among the unmatched."""
    for k, (role, side) in enumerate((("rgb", rgb), ("fir", fir))):
        paired = [side[(p.rgb, p.fir)[k]].where for p in pairing.pairs]
        left = [u.where for u in pairing.unmatched if u.role == role]
        assert sorted(paired + left) == sorted(e.where for e in side)
    assert all(u.reason for u in pairing.unmatched)


def reasons(pairing: Pairing, role: str) -> dict[str, str]:
    return {u.where: u.reason for u in pairing.unmatched if u.role == role}


# --- stem and index -------------------------------------------------------------------------------


def test_stem_pairs_equal_names_and_explains_the_rest() -> None:
    rgb, fir = entries("a", "b", "ü 1"), entries("ü 1", "b", "c", folder="th")
    got = pair(rgb, fir)
    assert got.rule_by == "stem"
    assert stems(got, rgb, fir) == [("b", "b"), ("ü 1", "ü 1")]
    assert reasons(got, "rgb") == {"in/a.png": "no thermal image with key 'a'"}
    assert reasons(got, "fir") == {"th/c.png": "no RGB image with key 'c'"}
    assert [p.dt_ns for p in got.pairs] == [None, None]


def test_stem_transform_by_keys_may_keep_the_folder_and_change_the_ends() -> None:
    rgb = entries("train/vi/1_eo", "test/vi/1_eo", "test/vi/2_xx")
    fir = entries("test/ir/1_thermal", "train/ir/1_thermal")
    got = pair(rgb, fir, PairingRule("stem", r"(.*)/vi/(.*)_eo$", r"(.*)/ir/(.*)_thermal$"))
    assert stems(got, rgb, fir) == [
        ("train/vi/1_eo", "train/ir/1_thermal"),
        ("test/vi/1_eo", "test/ir/1_thermal"),
    ]
    assert "does not match" in reasons(got, "rgb")["in/test/vi/2_xx.png"]


def test_key_without_groups_is_the_match_itself() -> None:
    rgb, fir = entries("L-07-x", "L-08-x"), entries("R-08-y", "R-07-y")
    got = pair(rgb, fir, PairingRule("stem", "[0-9]+", "[0-9]+"))
    assert stems(got, rgb, fir) == [("L-07-x", "R-07-y"), ("L-08-x", "R-08-y")]


def test_index_is_the_last_number_and_leading_zeros_do_not_count() -> None:
    rgb = entries("2020/cam1_0007_eo", "2020/cam1_0010_eo", "none")
    fir = entries("cam2_7", "cam2_000010", "cam2_11")
    got = pair(rgb, fir, PairingRule("index"))
    assert stems(got, rgb, fir) == [("2020/cam1_0007_eo", "cam2_7"), ("2020/cam1_0010_eo", "cam2_000010")]
    assert reasons(got, "rgb") == {"in/none.png": "no number in its name"}


def test_index_with_a_key_compares_its_groups_as_numbers() -> None:
    rgb, fir = entries("s1_f002_x9", "s2_f002_x9"), entries("S01-2", "S02-2")
    got = pair(rgb, fir, PairingRule("index", r"s(\d+)_f(\d+)", r"S(\d+)-(\d+)"))
    assert stems(got, rgb, fir) == [("s1_f002_x9", "S01-2"), ("s2_f002_x9", "S02-2")]


def test_numbers_beyond_any_integer_type_still_pair() -> None:
    long = "9" * 6000
    rgb, fir = entries(f"a{long}"), entries(f"b{long}", "b1")
    assert pair(rgb, fir, PairingRule("index")).pairs[0][:2] == (0, 0)


def test_duplicates_are_ambiguous_and_none_is_chosen() -> None:
    rgb = [*entries("a", "b"), *entries("a", suffix=".jpg")]
    fir = entries("a", "b", folder="th")
    got = pair(rgb, fir)
    assert stems(got, rgb, fir) == [("b", "b")]
    assert reasons(got, "rgb") == {
        "in/a.png": "same key 'a' as in/a.jpg: ambiguous",
        "in/a.jpg": "same key 'a' as in/a.png: ambiguous",
    }
    assert reasons(got, "fir") == {"th/a.png": "its key 'a' belongs to 2 RGB images (in/a.png, in/a.jpg)"}
    assert_partition(got, rgb, fir)


def test_names_that_differ_only_in_case_pair_exactly_with_a_note() -> None:
    rgb, fir = entries("A", "a", "c"), entries("a", "A", "c")
    got = pair(rgb, fir)
    assert stems(got, rgb, fir) == [("A", "A"), ("a", "a"), ("c", "c")]
    assert len(got.notes) == 1
    assert got.notes[0].startswith("2 RGB names differ only in upper and lower case")
    assert not pair(entries("a", "b"), entries("a", "b")).notes


@given(st.lists(st.sampled_from("abcdeABC"), min_size=1), st.lists(st.sampled_from("abcdeABC"), min_size=1))
def test_stem_against_brute_force(left: list[str], right: list[str]) -> None:
    rgb = [Entry(s, f"rgb {k}") for k, s in enumerate(left)]
    fir = [Entry(s, f"fir {k}") for k, s in enumerate(right)]
    want = [(i, right.index(s)) for i, s in enumerate(left) if left.count(s) == 1 and right.count(s) == 1]
    if not want:
        with pytest.raises(InputError, match="no pair by stem"):
            pair(rgb, fir, PairingRule("stem"))
        return
    got = pair(rgb, fir, PairingRule("stem"))
    assert [p[:2] for p in got.pairs] == want
    assert_partition(got, rgb, fir)


# --- time -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("stem", "want"),
    [
        ("1623423423", 1623423423_000000000),
        ("1623423423123", 1623423423_123000000),
        ("img_1623423423123456", 1623423423_123456000),
        ("cam0/left_1623423423123456789", 1623423423_123456789),
        ("cam0_1623423423123456789_raw", 1623423423_123456789),
        ("1623423423.123456", 1623423423_123456000),
        ("1623423423.5", 1623423423_500000000),
        ("1623423423_000000001", 1623423423_000000001),
        ("1623423423_123456", 1623423423_123456000),
        ("9999999999999999999", 9999999999_999999999),  # beyond int64
        ("1623423423_12", None),  # a stamp and a counter, or a fraction: not certain
        ("1623423423.1234567890", None),
        ("20210611_123456", None),
        ("000012", None),
        ("frame", None),
    ],
)
def test_stamp_in_name_is_exact_or_none(stem: str, want: int | None) -> None:
    assert stamp_in_name(stem) == want


@pytest.mark.parametrize(
    ("key", "want"),
    [
        (r"(\d{10})_(\d+)_", 1570722156_952630420),
        (r"t(\d{10})", 1570722156_000000000),
        (r"\d{10}_\d{8}", None),
        (r"nothing", None),
    ],
)
def test_a_key_points_at_the_stamp(key: str, want: int | None) -> None:
    assert stamp_in_name("fl_t1570722156_95263042_7", key) == want


def brute_mutual(a: list[int], b: list[int], limit: int) -> list[tuple[int, int]]:
    """Mutual nearest neighbours over all pairs; ties: the earlier of `b` for a, the later of `a` for b."""
    to_b = [min(range(len(b)), key=lambda j, t=t: (abs(b[j] - t), b[j])) for t in a]
    to_a = [min(range(len(a)), key=lambda i, u=u: (abs(a[i] - u), -a[i])) for u in b]
    return [(i, j) for i, j in enumerate(to_b) if to_a[j] == i and abs(b[j] - a[i]) <= limit]


TIMES = st.lists(st.integers(0, 60), min_size=1, max_size=25, unique=True)


@given(TIMES, TIMES, st.integers(0, 20), st.sampled_from([0, 10**18 * 17 + 1]))
def test_stamp_against_brute_force(a: list[int], b: list[int], limit: int, start: int) -> None:
    """Unsorted streams, small and beyond int64: one-to-one, order kept, within tolerance, none missed."""
    a, b = [t + start for t in a], [t + start for t in b]
    rgb, fir = clocked(a, "rgb"), clocked(b, "fir")
    want = brute_mutual(a, b, limit)
    if not want:
        with pytest.raises(InputError, match="no pair by stamp"):
            pair(rgb, fir, PairingRule("stamp", tolerance_ns=limit))
        return
    got = pair(rgb, fir, PairingRule("stamp", tolerance_ns=limit))
    assert [p[:2] for p in got.pairs] == want
    assert [p.dt_ns for p in got.pairs] == [b[j] - a[i] for i, j in want]
    in_time = [b[p.fir] for p in sorted(got.pairs, key=lambda p: a[p.rgb])]
    assert all(s < t for s, t in pairwise(in_time))  # one-to-one and in order
    assert_partition(got, rgb, fir)


def test_default_tolerance_is_half_the_median_interval_of_the_denser_stream() -> None:
    rgb = clocked(range(0, 1000, 100))
    fir = clocked([0, 33, 66, 100, 133, 166, 500, 533])  # steps 33 33 34 33 33 334 33
    got = pair(rgb, fir)
    assert got.rule_by == "stamp"
    assert got.tolerance_ns == 16
    assert [(p.rgb, p.fir) for p in got.pairs] == [(0, 0), (1, 3), (5, 6)]


def test_streams_half_an_interval_apart_still_pair() -> None:
    got = pair(clocked(range(0, 100, 10)), clocked(range(5, 105, 10)))
    assert len(got.pairs) >= 9
    assert got.tolerance_ns == 5


def test_reasons_in_time_name_distance_tolerance_and_rival() -> None:
    ms = 10**6
    rgb = clocked([0, 100 * ms, 112 * ms], "rgb")
    fir = clocked([1 * ms, 111 * ms, 192 * ms], "fir")
    got = pair(rgb, fir, PairingRule("stamp", tolerance_ns=16_700_000))
    assert reasons(got, "rgb") == {
        "rgb frame 1": "its nearest thermal image fir frame 1 is nearer to rgb frame 2"
    }
    assert reasons(got, "fir") == {"fir frame 2": "nearest RGB is 80.0 ms away, tolerance 16.7 ms"}


def test_a_gap_that_rounds_to_the_tolerance_is_printed_to_the_nanosecond() -> None:
    got = pair(clocked([0, 50]), clocked([0, 70]), PairingRule("stamp", tolerance_ns=19))
    assert reasons(got, "rgb") == {
        "clip.mp4 frame 1": "nearest thermal is 0.000020 ms away, tolerance 0.000019 ms"
    }


def test_repeated_stamps_are_ambiguous() -> None:
    rgb, fir = clocked([0, 10, 10, 20], "rgb"), clocked([0, 10, 20], "fir")
    got = pair(rgb, fir)
    assert [p[:2] for p in got.pairs] == [(0, 0), (3, 2)]
    assert reasons(got, "rgb")["rgb frame 1"] == "same time stamp as rgb frame 2: ambiguous"
    assert_partition(got, rgb, fir)


def test_stamps_in_names_pair_by_time_and_strays_are_reported() -> None:
    rgb = entries("1600000000", "1600000001", "readme")
    fir = entries("1600000000.010", "1600000001.020")
    got = pair(rgb, fir, PairingRule("stamp", tolerance_ns=50 * 10**6))
    assert [p.dt_ns for p in got.pairs] == [10 * 10**6, 20 * 10**6]
    assert "no time stamp" in reasons(got, "rgb")["in/readme.png"]
    assert stamps_of(rgb) == [1600000000 * 10**9, 1600000001 * 10**9, None]


def test_names_without_any_stamp_are_refused_with_the_forms_that_are_read() -> None:
    with pytest.raises(InputError, match=r"no RGB image has a time stamp.*10, 13, 16 or 19 digits"):
        pair(entries("20210611_123456"), entries("1600000000"), PairingRule("stamp"))


def test_no_pair_in_time_says_a_tolerance_that_would_work() -> None:
    rgb, fir = clocked(range(0, 10**9, 10**8)), clocked(range(3 * 10**7, 10**9, 10**8))
    with pytest.raises(InputError, match=r"--tolerance-ms 30\.000000 would match 10\b"):
        pair(rgb, fir, PairingRule("stamp", tolerance_ns=10**6))
    assert len(pair(rgb, fir, PairingRule("stamp", tolerance_ns=30_000_000)).pairs) == 10


def test_clocks_that_do_not_overlap_are_called_so() -> None:
    with pytest.raises(InputError, match=r"do not overlap in time, they are 5\.000 s apart"):
        pair(clocked([0, 10**9]), clocked([6 * 10**9, 7 * 10**9]))


def test_one_stamp_each_gives_no_default_tolerance() -> None:
    with pytest.raises(UsageError, match="give --tolerance-ms"):
        pair(clocked([5]), clocked([9]), PairingRule("stamp"))
    assert pair(clocked([5]), clocked([9]), PairingRule("stamp", tolerance_ns=4)).pairs[0].dt_ns == 4


# --- order and auto -------------------------------------------------------------------------------


def test_order_wants_equal_counts_and_gives_both() -> None:
    assert [p[:2] for p in pair(entries("a", "b"), entries("x", "y"), PairingRule("order")).pairs] == [
        (0, 0),
        (1, 1),
    ]
    with pytest.raises(InputError, match="2 RGB and 3 thermal"):
        pair(entries("a", "b"), entries("x", "y", "z"), PairingRule("order"))


def test_auto_chooses_by_what_is_there(tmp_path: Path) -> None:
    table = tmp_path / "map.csv"
    table.write_text("rgb,fir\na,x\n")
    assert pair(entries("a"), entries("x")).rule_by == "order"
    assert pair(entries("a", "b"), entries("a", "b")).rule_by == "stem"
    assert pair(clocked([0, 9]), clocked([1, 8])).rule_by == "stamp"
    assert pair(clocked([0, 9]), entries("000000", "000001")).rule_by == "stem"
    assert pair(entries("a"), entries("x"), PairingRule(map_file=str(table))).rule_by == "map"
    assert (
        pair(entries("1600000000"), entries("1600000001"), PairingRule(tolerance_ns=10**9)).rule_by == "stamp"
    )


def test_stems_of_clocked_sources_carry_their_time_difference() -> None:
    assert [p.dt_ns for p in pair(clocked([0, 10]), clocked([3, 11]), PairingRule("stem")).pairs] == [3, 1]


# --- mapping file ---------------------------------------------------------------------------------


def test_csv_map_finds_names_with_and_without_folder_and_suffix(tmp_path: Path) -> None:
    table = tmp_path / "pairs, new.csv"
    table.write_text(
        '\ufeffRGB, note,FIR\nvi/a.png,x,"t,1"\n\nb,y,data/t2.jpg\nvi\\c.d,z,t.3.tiff\n', encoding="utf-8"
    )
    rgb, fir = entries("vi/a", "vi/b", "vi/c.d"), entries("t,1", "t2", "t.3")
    got = pair(rgb, fir, PairingRule("map", map_file=str(table)))
    assert stems(got, rgb, fir) == [("vi/a", "t,1"), ("vi/b", "t2"), ("vi/c.d", "t.3")]
    assert not got.unmatched


def test_json_map_reports_what_is_missing_or_named_twice(tmp_path: Path) -> None:
    table = tmp_path / "rgb_to_thermal_vid_map.json"
    rgb, fir = entries("r1", "r2", "r3", "d1/k", "d2/k", "r9"), entries("t1", "t2", "t3")
    rows = [
        ("r1.jpg", "t1.jpg"),
        ("r2.jpg", "gone.jpg"),
        ("k", "t3.jpg"),
        ("r3", "t2"),
        ("r3", "t3"),
        ("q/r9", "t2"),
    ]
    table.write_text("{" + ",".join(f"{json.dumps(a)}: {json.dumps(b)}" for a, b in rows) + "}")
    got = pair(rgb, fir, PairingRule("map", map_file=str(table)))
    assert stems(got, rgb, fir) == [("r1", "t1")]
    assert_partition(got, rgb, fir)
    said = {u.where.rsplit(" ", 2)[-1]: u.reason for u in got.unmatched if u.role == "map"}
    assert said["2"] == "there is no thermal image 'gone.jpg'"
    assert said["3"] == "more than one RGB image is called 'k'"
    assert set(said) == {"2", "3", "4", "5", "6"}
    assert all("more than once" in said[k] for k in "456")
    assert got.summary().n_unmatched_map == 5


def test_a_longer_path_in_the_map_does_not_match_another_folder(tmp_path: Path) -> None:
    table = tmp_path / "m.csv"
    table.write_text("rgb,fir\nx/a.png,t\nz/b.png,u\n")
    rgb, fir = entries("y/a", "b"), entries("t", "u")
    got = pair(rgb, fir, PairingRule("map", map_file=str(table)))
    assert stems(got, rgb, fir) == [("b", "u")]


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("m.csv", b""),
        ("m.csv", b"left,right\na,b\n"),
        ("m.csv", b"rgb,fir\n"),
        ("m.csv", b"rgb,fir\na\n"),
        ("m.csv", b"rgb,fir\na,b,c\n"),
        ("m.csv", b"rgb,fir\na,\n"),
        ("m.csv", b'rgb,fir\n"a,b\n'),
        ("m.csv", b"rgb,fir\n\xff\xfe,b\n"),
        ("m.csv", b"rgb,rgb,fir\na,b,c\n"),
        ("m.csv", b"rgb,fir\n" + b"a" * 200_000 + b",b\n"),
        ("m.json", b""),
        ("m.json", b"[]"),
        ("m.json", b"{}"),
        ("m.json", b'{"a": 1}'),
        ("m.json", b'{"a": {"b": "c"}}'),
        ("m.json", b'{"a": "b"'),
        ("m.json", b"[" * 100_000),
    ],
)
def test_malformed_maps_are_one_clear_line(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=name) as caught:
        pair(entries("a"), entries("b"), PairingRule("map", map_file=str(tmp_path / name)))
    assert "\n" not in str(caught.value)


def test_absent_folder_and_oversized_maps_are_refused(tmp_path: Path) -> None:
    big = tmp_path / "big.csv"
    with big.open("wb") as file:
        file.truncate(64 * 2**20 + 1)
    for path, said in (
        (big, "over 64 MB"),
        (tmp_path, "no such mapping"),
        (tmp_path / "no.csv", "no such mapping"),
    ):
        with pytest.raises(InputError, match=said):
            pair(entries("a"), entries("b"), PairingRule("map", map_file=str(path)))


# --- rules, refusals, report ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("parts", "said"),
    [
        ({"by": "name"}, "no pairing rule 'name'"),
        ({"by": "stem", "rgb_key": "("}, "no regular expression"),
        ({"by": "stem", "rgb_key": "(a)(b)"}, "2 groups and fir_key 0"),
        ({"by": "order", "rgb_key": "a"}, "no effect"),
        ({"by": "map"}, "needs a mapping file"),
        ({"by": "stem", "map_file": "m.csv"}, "needs rule map"),
        ({"by": "stem", "tolerance_ns": 5}, "stamp only"),
        ({"by": "stamp", "tolerance_ns": -1}, "negative"),
    ],
)
def test_impossible_rules_are_refused_when_made(parts: dict, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        PairingRule(**parts)


def test_empty_sides_are_refused() -> None:
    with pytest.raises(InputError, match="no RGB images"):
        pair([], entries("a"))
    with pytest.raises(InputError, match="no thermal images"):
        pair(entries("a"), [])


def test_no_pair_shows_both_sides_and_the_rules_that_would_match() -> None:
    rgb = entries(*(f"rgb_{k:04d}" for k in range(12)))
    fir = entries(*(f"fir_{k}" for k in range(12)))
    with pytest.raises(InputError) as caught:
        pair(rgb, fir)
    text = str(caught.value)
    assert "'rgb_0000', 'rgb_0001', 'rgb_0002', ..." in text
    assert "'fir_0', 'fir_1', 'fir_2', ..." in text
    assert "--pair index would match 12 of 12" in text
    assert "--pair order would match 12 of 12" in text
    assert "--pair stamp" not in text


def test_no_pair_sees_case_unicode_form_and_folders() -> None:
    with pytest.raises(InputError, match="2 names would match but for upper and lower case or Unicode form"):
        pair(entries("A", "e\u0301", "q"), entries("a", "\u00e9", "z"))
    with pytest.raises(InputError, match=r"--rgb-key .* --fir-key would match 2 of 2"):
        pair(entries("vi/a", "vi/b"), entries("ir/a", "ir/b"))


def test_a_poor_match_names_the_better_rule() -> None:
    rgb = entries("a_1", "b_2", "c_3", "d_4", "e_5")
    fir = entries("a_1", "x_2", "y_3", "z_4", "w_5")
    assert any("--pair index would match 5 of 5" in note for note in pair(rgb, fir).notes)


def test_summary_and_report_count_everything() -> None:
    ms = 10**6
    rgb, fir = (
        clocked([0, 100 * ms, 200 * ms], "rgb"),
        clocked([k * ms for k in (2, 96, 203, *range(900, 960))], "fir"),
    )
    got = pair(rgb, fir, PairingRule("stamp", tolerance_ns=5 * ms))
    s = got.summary()
    assert (s.n_rgb, s.n_fir, s.n_pairs, s.n_unmatched_rgb, s.n_unmatched_fir) == (3, 63, 3, 0, 60)
    assert (s.dt_median_ms, s.dt_max_ms, s.tolerance_ms) == (2.0, 4.0, 5.0)
    lines = report_lines(got, limit=7)
    assert lines[0] == "3 pairs by stamp of 3 RGB and 63 thermal images"
    assert lines[1] == "thermal minus RGB: median +2.0 ms, at most 4.0 ms, tolerance 5.0 ms"
    assert sum(line.startswith("  thermal fir frame") for line in lines) == 7
    assert lines[-1] == "  and 53 more"


def test_report_without_clocks_or_leftovers_is_one_line() -> None:
    assert report_lines(pair(entries("a", "b"), entries("a", "b"))) == [
        "2 pairs by stem of 2 RGB and 2 thermal images"
    ]


def test_channels_of_one_file_are_their_own_pairs() -> None:
    got = Pairing.of_channels(3)
    assert [p[:2] for p in got.pairs] == [(0, 0), (1, 1), (2, 2)]
    assert report_lines(got) == ["3 pairs by channels of 3 RGB and 3 thermal images"]


def test_inputs_are_not_changed() -> None:
    rgb, fir = entries("b", "a"), entries("a", "b")
    before = list(rgb), list(fir)
    pair(rgb, fir)
    assert (rgb, fir) == before


def test_ten_thousand_pairs_by_every_rule_stay_quick() -> None:
    """Quadratic work would be 10^8 steps a rule and miss the suite's patience by far."""
    n = 10_000
    rgb = [Entry(f"{1600000000 + k}", f"r{k}", k * 10**8) for k in range(n)]
    fir = [Entry(f"{1600000000 + k}", f"t{k}", k * 10**8 + 7) for k in range(n)]
    for by in ("stem", "index", "stamp", "order"):
        assert [p[:2] for p in pair(rgb, fir, PairingRule(by)).pairs] == [(k, k) for k in range(n)]
