"""Times from text files: exact to the nanosecond, each line to its image, and nothing guessed."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fusion.errors import InputError
from fusion.manifest.stamps import MAX_BYTES, StampFiles, read_stamps


def write(folder: Path, *lines: str, name: str = "timestamps.txt") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder / name


@pytest.mark.parametrize(
    ("line", "want"),
    [
        ("2011-09-26 13:02:25.964389445", 1317042145_964389445),
        ("2011-09-26T13:02:25Z", 1317042145_000000000),
        ("2011-09-26 13:02:25.5", 1317042145_500000000),
        ("1700000000150702778", 1700000000150702778),
        ("1700000000150", 1700000000150_000000),
        ("1700000000.150702778", 1700000000150702778),
        ("0.000000e+00", 0),
        ("1.036224e-01", 103622400),
        ("12", 12_000000000),
    ],
)
def test_every_form_is_exact(tmp_path: Path, line: str, want: int) -> None:
    assert read_stamps(write(tmp_path, line)) == [want]


@given(st.datetimes(datetime(1980, 1, 1), datetime(2100, 1, 1)), st.integers(0, 999_999_999))
def test_dates_agree_with_the_calendar(moment: datetime, fraction: int) -> None:
    from fusion.manifest.stamps import _stamp

    whole = moment.replace(microsecond=0, tzinfo=UTC)
    text = f"{whole:%Y-%m-%d %H:%M:%S}.{fraction:09d}"
    days = (whole - datetime(1970, 1, 1, tzinfo=UTC)).days
    seconds = days * 86400 + whole.hour * 3600 + whole.minute * 60 + whole.second
    assert _stamp(text) == seconds * 10**9 + fraction


@pytest.mark.parametrize(
    "line",
    ["", "now", "2011-02-31 00:00:00", "2011-09-26 25:00:00", "-1.5", "nan", "1e99", "12345678901234", "1,5"],
)
def test_what_is_no_time_is_named_with_its_line(tmp_path: Path, line: str) -> None:
    path = write(tmp_path, "1.0", line, "2.0")
    with pytest.raises(InputError, match=r"timestamps\.txt line 2: '.*' is no time"):
        read_stamps(path)


def test_files_that_hold_no_times(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="empty"):
        read_stamps(write(tmp_path, ""))
    with pytest.raises(InputError, match="cannot be read"):
        read_stamps(tmp_path / "gone.txt")
    (tmp_path / "latin.txt").write_bytes(b"\xff\xfe\xfd")
    with pytest.raises(InputError, match="cannot be read"):
        read_stamps(tmp_path / "latin.txt")
    with (tmp_path / "big.txt").open("wb") as file:
        file.truncate(MAX_BYTES + 1)
    with pytest.raises(InputError, match="over 64 MB"):
        read_stamps(tmp_path / "big.txt")


def test_a_line_belongs_to_the_image_of_its_number(tmp_path: Path) -> None:
    """Frames that a set leaves out shift nothing; each sequence has its own file."""
    write(tmp_path / "a", "10.0", "11.0", "12.0", "13.0")
    write(tmp_path / "b", "20.0", "21.0")
    files = [tmp_path / "a" / "data" / f"{k:010d}.png" for k in (0, 1, 3)]
    files += [tmp_path / "b" / "data" / f"{k:010d}.png" for k in (0, 1)]
    files.append(tmp_path / "c" / "0.png")
    stamps = StampFiles([tmp_path / "a" / "timestamps.txt", tmp_path / "b" / "timestamps.txt"]).of(files)
    assert stamps == [10 * 10**9, 11 * 10**9, 13 * 10**9, 20 * 10**9, 21 * 10**9, None]


def test_images_that_are_not_numbered_take_the_lines_in_order_only_where_counts_agree(tmp_path: Path) -> None:
    path = write(tmp_path, "1.0", "2.0")
    named = StampFiles([path])
    assert named.of([tmp_path / "left.png", tmp_path / "right.png"]) == [10**9, 2 * 10**9]
    assert named.of([tmp_path / "left.png"]) == [None]
    assert named.of([tmp_path / "x7.png", tmp_path / "x8.png"]) == [10**9, 2 * 10**9]  # numbered from 7
    assert named.of([tmp_path / "x1.png", tmp_path / "x8.png", tmp_path / "x9.png"]) == [
        2 * 10**9,
        None,
        None,
    ]
    assert named.of([tmp_path / "a1.png", tmp_path / "b1.png", tmp_path / "c0.png"]) == [None, None, 10**9]


def test_a_number_of_any_length_is_no_crash(tmp_path: Path) -> None:
    named = StampFiles([write(tmp_path, "1.0", "2.0")])
    assert named.of([tmp_path / f"{'9' * 200}.png"]) == [None]
