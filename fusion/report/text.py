"""What a blend run says: its plan before, a table and its warnings after. Plain text, for logs too."""

from __future__ import annotations

import math
from pathlib import Path

from fusion.batch import RunReport
from fusion.fusing import FrameFuser
from fusion.pipeline import Fuser
from fusion.report.table import LOUD_SKIPS, table
from fusion.rig_warp import PARALLAX_M, DepthWarp, parallax_px
from fusion.thermal import clip_advice
from fusion.warp import Warp


def plan_lines(fuser: Fuser) -> list[str]:
    """What will be done, before the first frame: pairs, registration, window, colours."""
    config, warp, pairing = fuser.config, fuser.warp, fuser.pairs.pairing
    fir, rgb = (f"{w}x{h}" for w, h in fuser.sizes)
    left, top, right, bottom = warp.border_ltrb
    x, y, width, height = warp.crop_xywh
    rows = [
        ("pairs", f"{len(fuser)} by {pairing.rule_by}, {len(pairing.unmatched)} unmatched"),
        ("sizes", f"thermal {fir}, RGB {rgb}"),
        ("registration", registration_text(fuser)),
        *rig_rows(fuser),
        ("coverage", f"{warp.coverage:.1%} of RGB"),
    ]
    if fuser.pairs.ignored:
        rows.insert(1, ("ignored", f"{fuser.pairs.ignored} other files in the inputs"))
    if not warp.full:
        crop = f"crop to {width}x{height} at ({x}, {y})"
        rows.append(("border", f"left {left}, top {top}, right {right}, bottom {bottom} px"))
        rows.append(("outside", crop if config.warp.outside == "crop" else config.warp.outside))
    colours = f"colour map {config.thermal.colormap}, {config.blend.method}, alpha {config.blend.alpha:g}"
    rows.append(("preset", f"{config.preset}: {colours}"))
    return [*table(rows), *(f"note: {note}" for note in pairing.notes)]


def closing_lines(fuser: Fuser, report: RunReport, out: Path) -> list[str]:
    """The table at the end of a run, every dropped frame counted."""
    done = report.fused + report.kept
    rows = [
        ("fused", f"{report.fused}" + (f", and {report.kept} kept from before" if report.kept else "")),
        ("skipped", f"{len(report.skipped)}"),
        ("unmatched", f"{len(fuser.pairs.pairing.unmatched)}"),
        ("window", f"{_span(report.window_lo)} to {_span(report.window_hi)} counts"),
        ("clipped", f"{report.clipped_below:.1%} below, {report.clipped_above:.1%} above"),
    ]
    rows += _depth_rows(fuser)
    dt = fuser.pairs.pairing.summary()
    if dt.dt_median_ms is not None:
        rows.append(("time apart", f"median {dt.dt_median_ms:.3f} ms, largest {dt.dt_max_ms:.3f} ms"))
    rows += [(flag, f"{count} of {done} frames") for flag, count in sorted(report.flags.items())]
    rows.append(("written to", str(out)))
    return table(rows)


def warnings_of(fuser: Fuser, report: RunReport) -> list[str]:
    """What the user should act on, a line each."""
    warnings = [f"skipped {stem}: {reason}" for stem, reason in report.skipped[:LOUD_SKIPS]]
    if len(report.skipped) > LOUD_SKIPS:
        warnings.append(f"… and {len(report.skipped) - LOUD_SKIPS} more, all named in frames.csv")
    if fuser.pairs.pairing.unmatched:
        warnings.append(
            f"{len(fuser.pairs.pairing.unmatched)} images without a partner are named in unmatched.csv"
        )
    if fuser.size_groups > 1:
        warnings.append(
            f"the images come in {fuser.size_groups} different sizes; frames differ in size accordingly"
        )
    warnings += [f"window sample passed over: {reason}" for reason in fuser.windows.skipped]
    advice = clip_advice(report.clipped_below, report.clipped_above, fuser.config.thermal.rule())
    return [*warnings, *([advice] if advice else [])]


def registration_text(fuser: Fuser | FrameFuser) -> str:
    """How thermal comes onto RGB, in a few words."""
    registration = fuser.registration
    if registration is None:
        return _rig(fuser)
    fit = registration.fit
    if fit is None:
        return "none: scaled to fit" if registration.kind == "scale" else registration.kind
    text = f"{fit.inliers} of {fit.count} points, rms {fit.rms_px:.2f} px, largest {fit.max_px:.2f} px"
    return text + (
        f", left out median {fit.leave_one_out_px:.2f} px" if fit.leave_one_out_px is not None else ""
    )


def _rig(fuser: Fuser | FrameFuser) -> str:
    warp, given = fuser.warp, fuser.config.warp
    undistorted = ", RGB undistorted" if given.undistort else ""
    if not isinstance(warp, DepthWarp):
        return f"rig, {_metres(given.distance_m)}{undistorted}"
    otherwise = (
        f"{_metres(warp.distance_m)} where there is none"
        if warp.distance_m
        else "nothing where there is none"
    )
    return f"rig, by {warp.value}, {otherwise}{undistorted}"


def rig_rows(fuser: Fuser | FrameFuser) -> list[tuple[str, str]]:
    """What a wrong distance would cost: how far off thermal is drawn for things nearer and farther."""
    warp = fuser.warp
    if isinstance(warp, Warp) or fuser.rig is None or (isinstance(warp, DepthWarp) and not warp.distance_m):
        return []
    at_m = fuser.config.warp.distance_m or math.inf
    undistort = fuser.config.warp.undistort
    off = parallax_px(fuser.rig, at_m, PARALLAX_M, undistort)
    cells = [
        f"{'not seen' if math.isnan(px) else f'{px:.1f} px'} for things at {_metres(metres)}"
        for metres, px in zip(PARALLAX_M, off, strict=True)
    ]
    return [("parallax" if row == 0 else "", cell) for row, cell in enumerate(cells)]


def _depth_rows(fuser: Fuser) -> list[tuple[str, str]]:
    tally = fuser.depth_tally
    if not tally.frames:
        return []
    words = f"{tally.seen / tally.pixels:.1%} seen, {tally.hidden / tally.pixels:.1%} hidden from thermal"
    words += f", {tally.unknown / tally.pixels:.1%} without depth"
    if isinstance(fuser.warp, DepthWarp) and fuser.warp.distance_m:
        words += f", {tally.assumed / tally.pixels:.1%} taken to be at {_metres(fuser.warp.distance_m)}"
    return [("by depth", f"{words} (of the pixels of {tally.frames} frames made now)")]


def _metres(distance_m: float | None) -> str:
    return "infinity" if distance_m is None or math.isinf(distance_m) else f"{distance_m:g} m"


def _span(span: tuple[float, float] | None) -> str:
    if span is None:
        return "-"
    return f"{span[0]:.6g}" if span[0] == span[1] else f"{span[0]:.6g}…{span[1]:.6g}"
