"""Streams without a common clock: only where the board stands still in both."""

from __future__ import annotations

import numpy as np
import pytest

from calib.boards import Board
from calib.moments import Shot
from calib.observations import Detection, Refusal
from calib.still import pair_still, still_shots
from fusion.errors import InputError

BOARD = Board.of("chessboard", 5, 4, 0.05)
Plan = list[tuple[float, bool]]
GRID = BOARD.points_m[:, :2] * 1000


def stream(camera: str, rate: float, plan: Plan, delay_s: float, seed: int) -> list[Shot]:
    """A board that, by `plan` of (seconds, still), rests or moves at 60 px/s; at times labelled turned."""
    rng, half = np.random.default_rng(seed), BOARD.symmetries()[1]
    shots, at, x = [], 0.0, 0.0
    for seconds, still in plan:
        for _ in range(int(seconds * rate)):
            at += 1 / rate
            x += 0.0 if still else 60 / rate
            ids = np.arange(20)[:: rng.choice([1, -1])]
            uv = GRID[ids] + (x, 0) + rng.normal(0, 0.05, (20, 2))
            labels = half[ids] if rng.random() < 0.3 else ids
            stamp = round((at + delay_s) * 1e9)
            shots.append(
                Shot(f"{camera}{len(shots)}", f"{x:.3f}", stamp, (640, 480), Detection(labels, uv, "t"))
            )
    return shots


PLAN = [(2.0, True), (1.0, False), (2.0, True), (1.0, False), (2.0, True), (0.5, False)]


def test_stretches_are_found_in_whatever_order_the_images_come():
    shots = stream("rgb", 10, PLAN, 0.0, 0)
    runs = still_shots(BOARD, shots[::-1])
    assert [len({shot.file for shot in run}) for run in runs] == [1, 1, 1]  # x never changes within one
    assert all(19 <= len(run) <= 21 for run in runs)


def test_a_slow_drift_is_no_rest():
    shots = [
        Shot(f"{k}", "", k, (640, 480), Detection(np.arange(20), GRID + np.array([0.4 * k, 0]), "test"))
        for k in range(20)
    ]
    assert all(len(run) <= 4 for run in still_shots(BOARD, shots, still_px=0.5, least=2))


@pytest.mark.parametrize("by", ["stamp", "order"])
def test_pairs_show_the_board_at_the_same_place(by):
    streams = {"rgb": stream("rgb", 10, PLAN, 0.0, 1), "fir": stream("fir", 8, PLAN, 0.3, 2)}
    found = pair_still(BOARD, streams, by=by)
    assert found.pairs[0].shared == 3
    places: dict[str, list[float]] = {}
    for view in found.views:
        places.setdefault(view.moment, []).append(float(view.file))
        assert view.lag_s == 0.0
    assert len({p[0] for p in places.values()}) == 3
    assert all(a == pytest.approx(b, abs=1e-9) for a, b in places.values())
    assert "3 of rgb, 3 of fir" in found.notes[0]


def test_clocks_that_differ_by_more_than_the_margin_leave_no_overlap_to_trust():
    streams = {"rgb": stream("rgb", 10, PLAN, 0.0, 1), "fir": stream("fir", 8, PLAN, 1.5, 2)}
    assert pair_still(BOARD, streams, margin_s=0.5).pairs[0].shared == 0


def test_order_refuses_different_numbers_of_stretches():
    streams = {"rgb": stream("rgb", 10, PLAN, 0.0, 1), "fir": stream("fir", 8, PLAN[:2], 0.0, 2)}
    with pytest.raises(InputError, match="by order: 3 of rgb, 1 of fir"):
        pair_still(BOARD, streams, by="order")


def test_a_board_that_never_rests_or_is_never_seen():
    moving = stream("rgb", 10, [(3.0, False)], 0.0, 0)
    with pytest.raises(InputError, match="rgb: the board never stands still"):
        pair_still(BOARD, {"rgb": moving})
    nothing = [Shot(f"{k}", "", k, (640, 480), Refusal("no")) for k in range(9)]
    with pytest.raises(InputError, match="fir: the board never stands still"):
        pair_still(BOARD, {"fir": nothing})
