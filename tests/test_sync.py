from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fusion import InputError, PairingRule, open_pairs
from tests.worlds import write


def stamped(folder: Path, stamps: list[int]) -> Path:
    folder.mkdir()
    for stamp in stamps:
        write(folder / f"{stamp}.png", np.full((4, 6), stamp % 251, np.uint8))
    return folder


def test_stamps_in_names_reach_the_frames(tmp_path: Path) -> None:
    start = 1_600_000_000_000_000_000
    rgb = stamped(tmp_path / "rgb", [start, start + 33_000_000, start + 66_000_000])
    fir = stamped(tmp_path / "fir", [start + 2_000_001, start + 67_000_000])
    pairs = open_pairs(rgb, fir, PairingRule("stamp"))
    assert [pairs.read(index).dt_ns for index in range(len(pairs))] == [2_000_001, 1_000_000]
    assert [u.where for u in pairs.pairing.unmatched] == [str(rgb / f"{start + 33_000_000}.png")]


def test_changed_is_the_newest_of_both_files(tmp_path: Path) -> None:
    import os

    rgb, fir = stamped(tmp_path / "rgb", [1]), stamped(tmp_path / "fir", [1])
    os.utime(fir / "1.png", ns=(5, 2**62))
    pairs = open_pairs(rgb, fir)
    assert pairs.changed_ns(0) == 2**62


def test_a_missing_side_is_an_input_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nowhere"):
        open_pairs(stamped(tmp_path / "rgb", [1]), tmp_path / "nowhere")
