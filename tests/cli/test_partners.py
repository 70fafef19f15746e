"""Which image goes with which cloud."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fusion.cli.partners import SLACK_NS, Partners
from fusion.errors import FrameError, InputError
from fusion.sources import Source, open_source
from tests.worlds import write


def images(folder: Path, *stems: str) -> Source:
    """Grey images; each one's level is its place in `stems`."""
    for level, stem in enumerate(stems):
        (folder / stem).parent.mkdir(parents=True, exist_ok=True)
        write(folder / f"{stem}.png", np.full((4, 5), level, np.uint8))
    return open_source(folder, "fir")


def levels(partners: Partners, count: int) -> list[int | None]:
    return [int(partners.read(k).pixels[0, 0]) if partners.has(k) else None for k in range(count)]


def test_by_name_where_any_agrees(tmp_path: Path) -> None:
    partners = Partners("--guide", images(tmp_path, "c", "a", "x", "d"), ["a", "b", "c"])
    assert levels(partners, 3) == [1, None, 0]
    assert partners.notes == ["--guide: 1 of 3 inputs have no image there"]
    assert partners.file(0) == str(tmp_path / "a.png")
    assert partners.file(1) == ""
    with pytest.raises(FrameError, match="no image in --guide"):
        partners.read(1)


def test_names_that_agree_are_believed_before_times(tmp_path: Path) -> None:
    stems = ["1700000000.000000000", "1700000001.000000000"]
    partners = Partners("--score", images(tmp_path, "1700000000.010000000", stems[1]), stems)
    assert levels(partners, 2) == [None, 1]


def test_by_the_nearest_time_within_half_a_turn(tmp_path: Path) -> None:
    clouds = [1_700_000_000_000_000_000 + k * 100_000_000 for k in range(4)]
    shifts = [SLACK_NS, -SLACK_NS, SLACK_NS + 1, 10_000_000]
    source = images(tmp_path, *(str(t + s) for t, s in zip(clouds, shifts, strict=True)))
    partners = Partners("--overlay", source, [str(t) for t in clouds])
    at = [int(entry.stem) for entry in source.entries]
    found = [partners.file(k) for k in range(4)]
    for k, file in enumerate(found):
        nearest = min(at, key=lambda stamp: abs(stamp - clouds[k]))
        assert (file == str(tmp_path / f"{nearest}.png")) == (abs(nearest - clouds[k]) <= SLACK_NS), k
    assert found[3]
    assert partners.notes == [f"--overlay: {found.count('')} of 4 inputs have no image there"] * ("" in found)


def test_the_only_one_goes_with_the_only_one(tmp_path: Path) -> None:
    partners = Partners("--overlay", images(tmp_path, "anything"), ["000000"])
    assert levels(partners, 1) == [0]
    assert partners.notes == []


def test_one_image_does_not_go_with_two_clouds(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"--guide.*'a' and 'anything' do not"):
        Partners("--guide", images(tmp_path, "anything"), ["a", "b"])


def test_times_too_far_apart_belong_to_nothing(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no image belongs"):
        Partners("--guide", images(tmp_path, "1700000009000000000", "x"), ["1700000000000000000", "b"])


def test_a_damaged_partner_is_a_frames_error(tmp_path: Path) -> None:
    source = images(tmp_path, "a", "b")
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    partners = Partners("--score", source, ["a", "b"])
    with pytest.raises(FrameError):
        partners.read(0)
    assert partners.read(1).pixels.shape == (4, 5)
