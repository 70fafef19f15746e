"""`fusion simulate record`: a simulated mine as a bag or an MCAP."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

Form = Literal["rosbag1", "rosbag2", "rosbag2-mcap", "mcap-ros1", "mcap-ros2", "mcap-protobuf", "mcap-json"]


def simulate_record(
    mine: Annotated[Path, Parameter(help="Folder that fusion simulate mine wrote.")],
    out: Annotated[Path, Parameter(help="File to write, for rosbag2 a folder; it must not exist.")],
    /,
    *,
    form: Annotated[Form, Parameter(help="Container, and for MCAP what messages are written in.")],
    compression: Annotated[
        Literal["none", "lz4", "bz2", "zstd", "zstd-message", "zstd-file"],
        Parameter(help="Of chunks; rosbag2 can have each message or each file compressed."),
    ] = "none",
    raw: Annotated[bool, Parameter(help="RGB as bgr8 instead of the files' JPEG or PNG.")] = False,
    split_mb: Annotated[float | None, Parameter(help="Another file of a rosbag2 after this many MB.")] = None,
    quiet: Annotated[bool, Parameter(help="No progress, no closing line.")] = False,
) -> None:
    """Write a simulated mine as a robot's recorder would have written it."""
    from fusion.cli.running import progress_bar
    from fusion.simulate.containers import write_recording

    split_bytes = None if split_mb is None else round(split_mb * 1e6)
    with progress_bar("recording", quiet) as progress:
        written = write_recording(
            mine,
            out,
            form,
            compression=compression,
            raw=raw,
            split_bytes=split_bytes,
            progress=progress,
        )
    if not quiet:
        print(f"{written.messages} messages, {written.size_bytes / 1e6:.1f} MB, in {written.path}")
