"""Pairs of streams whose clocks are not known: only where the board stands still in each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from calib.boards import Board
from calib.moments import Pairing, Shot, check_sizes, pair
from calib.observations import Refusal
from fusion.errors import InputError


def still_shots(
    board: Board, shots: Sequence[Shot], *, still_px: float = 0.5, least: int = 3
) -> list[list[Shot]]:
    """Stretches of at least `least` images, by time, in which the board's points move less than `still_px`.

    The motion is the median of the points' between one image and the next, and since the first of the
    stretch.
    """
    runs: list[list[Shot]] = []
    ordered = sorted(shots, key=lambda s: (s.stamp_ns is not None, s.stamp_ns or 0))
    for shot in ordered:
        run = runs[-1] if runs else []
        if run and max(_motion(board, run[-1], shot), _motion(board, run[0], shot) / 2) < still_px:
            run.append(shot)
        else:
            runs.append([shot])
    return [run for run in runs if len(run) >= least]


def pair_still(
    board: Board,
    streams: Mapping[str, Sequence[Shot]],
    *,
    still_px: float = 0.5,
    least: int = 3,
    margin_s: float = 0.5,
    by: Literal["stamp", "order"] = "stamp",
) -> Pairing:
    """Pairs only where the board stands still in every stream.

    By stamp: stretches pair where they overlap by more than `margin_s` twice, the clocks' error; the images
    nearest to the middle of the overlap count. By order: the first stretch with the first, where there are
    equally many. Raises `InputError` where no stretch is still, or their numbers differ.
    """
    runs = {c: still_shots(board, shots, still_px=still_px, least=least) for c, shots in streams.items()}
    for camera, stretches in runs.items():
        check_sizes(camera, streams[camera])
        if not stretches:
            hint = f"hold it still for {least} images in each pose, or allow more than {still_px:g} px"
            raise InputError("the board never stands still", where=camera, hint=hint)
    if by == "order":
        middle = {c: [run[len(run) // 2] for run in stretches] for c, stretches in runs.items()}
        paired = pair(middle, by="order")
    else:
        paired = pair(_overlaps(runs, margin_s), by="name")
    moved = sum(len(shots) for shots in streams.values()) - sum(len(r) for rs in runs.values() for r in rs)
    kept = ", ".join(f"{len(stretches)} of {camera}" for camera, stretches in runs.items())
    notes = (f"the board stands still in {kept} stretches; {moved} images show it moving or not at all",)
    # what stood still has no motion that a lag could matter for
    still = tuple(replace(view, lag_s=0.0) for view in paired.views)
    return Pairing(still, paired.pairs, f"still {by}", paired.moment_ns, paired.without_board, notes)


def _overlaps(runs: Mapping[str, list[list[Shot]]], margin_s: float) -> dict[str, list[Shot]]:
    """One image of each stretch of each camera, named after the first camera's stretch that it overlaps."""
    first, *others = runs
    named: dict[str, list[Shot]] = {c: [] for c in runs}
    for number, anchor in enumerate(runs[first]):
        low, high = _span(anchor)
        partners = {}
        for camera in others:
            for run in runs[camera]:
                begin, end = max(low, _span(run)[0]), min(high, _span(run)[1])
                if end - begin > 2e9 * margin_s:
                    partners[camera] = (run, (begin + end) // 2)
        middle = next(iter(partners.values()))[1] if partners else (low + high) // 2
        for camera, (run, at) in {first: (anchor, middle), **partners}.items():
            named[camera].append(
                replace(min(run, key=lambda s: abs((s.stamp_ns or 0) - at)), name=f"{number:05d}")
            )
    return named


def _span(run: Sequence[Shot]) -> tuple[int, int]:
    if run[0].stamp_ns is None or run[-1].stamp_ns is None:
        raise InputError(
            "images without a time stamp", where=run[0].file, hint="match still stretches by order"
        )
    return run[0].stamp_ns, run[-1].stamp_ns


def _motion(board: Board, one: Shot, two: Shot) -> float:
    """Median motion in px of the points that both have, under the labelling that moves them least."""
    if isinstance(one.found, Refusal) or isinstance(two.found, Refusal):
        return np.inf
    best = np.inf
    for relabel in board.symmetries():
        _, i, j = np.intersect1d(one.found.ids, relabel[two.found.ids], return_indices=True)
        if len(i) >= 4:
            best = min(best, float(np.median(np.linalg.norm(one.found.uv[i] - two.found.uv[j], axis=1))))
    return best
