"""What a campaign says: its plan before, a table and its warnings after. Plain text, for logs too."""

from __future__ import annotations

from collections.abc import Sequence

from fusion.preprocess.recorded import RecordedFootage
from fusion.preprocess.run import Result
from fusion.preprocess.work import FAULT, PreprocessWork
from fusion.report.table import LOUD_SKIPS, table
from fusion.report.text import registration_text, rig_rows


def campaign_plan(work: PreprocessWork, guessed: Sequence[str]) -> list[str]:
    """What will be done, before the first frame: streams and their clocks, registration, window, outputs."""
    footage, fuser = work.footage, work.fuser()
    fir, rgb = (f"{w}x{h}" for w, h in work.plan.sizes)
    rows = [("input", footage.name)]
    if isinstance(footage, RecordedFootage):
        rows += _stream_rows(footage)
    rows += [
        ("chunks", f"{len(work.chunks)}, about {work.frames} frames, {footage.rate_hz:.3g} a second"),
        ("sizes", f"thermal {fir}, RGB {rgb}"),
        ("registration", registration_text(fuser)),
        *rig_rows(fuser),
        ("coverage", f"{fuser.warp.coverage:.1%} of RGB"),
    ]
    if footage.has_lidar:
        camera = "the rig's RGB camera" if work.onto_rgb else "a virtual camera: no rig says where RGB is"
        rows.append(("depth", f"{work.config.depth.dense.method}, for {camera}"))
    rows.append(("outputs", ", ".join(work.config.outputs.kinds)))
    return [*table(rows), *(f"note: {note}" for note in (*guessed, *fuser.notes))]


def _stream_rows(footage: RecordedFootage) -> list[tuple[str, str]]:
    streams = footage.streams
    rows = [("form", footage.recording.form)]
    for role, topic in streams.topics.items():
        pace = footage.paces[role]
        words = [topic.name, f"{1e9 / pace.interval_ns:.3g} Hz"]
        if streams.stamp == "header" and pace.delay_ns is not None:
            least, most = (ns / 1e6 for ns in pace.delay_ns)
            words.append(f"recorded {least:.1f} to {most:.1f} ms after its stamp")
        if role in footage.tolerance_ns:
            words.append(f"within {footage.tolerance_ns[role] / 1e6:.1f} ms of {streams.lead}")
        if streams.offset_ns.get(role):
            words.append(f"clock shifted by {streams.offset_ns[role] / 1e6:+.3f} ms")
        if streams.drift.get(role):
            words.append(f"and {streams.drift[role] * 1e6:+.1f} ppm")
        rows.append((role, ", ".join(words)))
    stamps = "of the messages' headers" if streams.stamp == "header" else "of the log"
    return [*rows, ("stamps", stamps)]


def campaign_end(result: Result) -> list[str]:
    """The table at the end, everything dropped counted with its reason."""
    report = result.report
    chunks = f"{report.done} done" + (f", {report.kept} kept from before" if report.kept else "")
    rows = [
        ("chunks", chunks + (f", {len(report.failed)} FAILED" if report.failed else "")),
        ("frames", f"{result.made}, {len(result.skipped)} skipped"),
    ]
    if report.frames_made:
        rows.append(("rate", f"{report.frames_per_s:.1f} frames a second, {report.seconds:.1f} s"))
    rows += [
        ("dropped" if k == 0 else "", f"{count} x {reason}")
        for k, (reason, count) in enumerate(
            sorted(item for item in report.lost.items() if not item[0].startswith(FAULT))
        )
    ]
    rows += [("written to", result.url), *(("", product) for product in result.products)]
    return table(rows)


def campaign_warnings(result: Result) -> list[str]:
    """What the user should act on, a line each."""
    report = result.report
    warnings = [key for key in sorted(report.lost) if key.startswith(FAULT)]
    warnings += [f"skipped {stem}: {reason}" for stem, reason in result.skipped[:LOUD_SKIPS]]
    if len(result.skipped) > LOUD_SKIPS:
        warnings.append(f"… and {len(result.skipped) - LOUD_SKIPS} more, all named in frames.csv")
    if result.troubled:
        warnings.append(f"{result.troubled} frames have no depth of their own: frames.csv says why")
    warnings += [f"chunk {one.chunk.name} failed: {one.reason}" for one in report.failed[:LOUD_SKIPS]]
    if len(report.failed) > LOUD_SKIPS:
        warnings.append(f"… and {len(report.failed) - LOUD_SKIPS} more chunks failed")
    return warnings
