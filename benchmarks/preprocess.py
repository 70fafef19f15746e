"""`fusion preprocess` on a recording: against its parts, its start, its first frame, and on Dask workers."""

from __future__ import annotations

import struct
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import count
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from recordings import flight
from table import Row, Section, at_least, at_most, per_second, spread
from timing import Sample, clocked, interleaved
from workspace import FUSION, Workspace

from fusion.batch import opencv_on_one_thread
from fusion.codecs import encode_png
from fusion.preprocess.campaign import Route
from fusion.preprocess.config import load_preprocess_config
from fusion.preprocess.footage import Moment
from fusion.preprocess.recorded import RecordedFootage
from fusion.preprocess.run import preprocess
from fusion.preprocess.streams import resolve_streams
from fusion.preprocess.work import PreprocessWork, make_plan
from fusion.recordings import open_recording
from fusion.rig import load_rig
from fusion.simulate.containers import write_recording
from fusion.sinks.base import Made
from fusion.sinks.depth import quantised, sparse_npz

LEAST_SHARE, FIRST_FRAME_S, START_S, DASK_GAIN = 0.9, 2.0, 1.0, 1.6
POLL_S, WAIT_S = 0.005, 120.0

TEXT = """\
A simulated flight of {flight:g} s (RGB of 640x480 at 20 Hz as JPEG, thermal of 640x512 at 25 Hz, clouds
at 10 Hz) as MCAP with ROS 2 messages, repeated end to end with stamps that go on; thermal is warped by
each scan's depth, as a rig has it by default, and every output of the folder is written: fused, mask,
thermal counts, depth, support, sparse depth.

*Unavoidable* are these parts alone on the very same frames, in memory, on as many threads, one after the
other: decoding (message and JPEG to RGB, message to thermal counts and to a cloud), densifying
(`DepthLane.of_cloud`) and encoding what is written. Their sum is what no arrangement can avoid with these
codecs and this method; not in it are reading, matching, windows, warping, blending, files and records,
which the campaign does besides. {frames} frames in {chunks} chunks; *planned* adds opening the recording
and the plan.

*Starting* is a whole process, `fusion preprocess` with the rig, from its start until it begins its first
chunk (`run.toml` is there), or until the first file is in `fused/`; files are looked for every {poll:g}
ms. The large recording has {gigabytes:.3g} GB. *Dask* is the same campaign with chunks of {dask_s:g} s on
workers of a cluster that runs already and has done it once: one worker, or two."""


@dataclass(frozen=True, slots=True)
class Amount:
    """How much is measured: seconds of the flight, how often it is repeated, bytes of the large recording."""

    flight_s: float = 3.0
    copies: int = 3
    rounds: int = 3
    starts: int = 5
    large_bytes: float = 10e9
    chunk_s: float = 4.5
    dask_chunk_s: float = 0.9


FULL = Amount()
QUICK = Amount(1.0, 2, 1, 1, 0.5e9, 1.0, 0.5)


def measure(space: Workspace, amount: Amount) -> Section:
    mine = flight(space, amount.flight_s)
    once = write_recording(mine, space.root / "once", "mcap-ros2").path
    rig, path = mine / "truth" / "rig.toml", space.root / "flight.mcap"
    repeat(once, path, amount.flight_s, copies=amount.copies)
    work = planned(path, rig, amount.chunk_s)
    text = TEXT.format(
        flight=amount.flight_s,
        frames=work.frames,
        chunks=len(work.chunks),
        poll=1e3 * POLL_S,
        gigabytes=amount.large_bytes / 1e9,
        dask_s=amount.dask_chunk_s,
    )
    rows = [row for workers in (1, 2) for row in _against_parts(space, work, path, rig, amount, workers)]
    rows += _starting(space, once, rig, amount)
    rows += _dask(space, planned(path, rig, amount.dask_chunk_s), amount.rounds)
    return Section("`fusion preprocess` on a recording", text, ("ours", "other"), rows)


def planned(path: Path, rig: Path, chunk_s: float) -> PreprocessWork:
    """The campaign that `fusion preprocess PATH --rig RIG --chunk-s` does."""
    fuse: dict[str, Any] = {"warp": {"rig": str(rig)}}
    config, loaded = load_preprocess_config(None, {"fuse": fuse, "chunk_s": chunk_s}), load_rig(str(rig))
    recording = open_recording(path)
    streams, _ = resolve_streams(recording, config.streams, loaded)
    footage = RecordedFootage(str(path), streams, recording)
    return PreprocessWork(footage, config, make_plan(footage, config), loaded)


# --- the campaign against its parts


def _against_parts(
    space: Workspace, work: PreprocessWork, path: Path, rig: Path, amount: Amount, workers: int
) -> list[Row]:
    moments = [m for c in work.chunks for m in work.footage.moments(c) if isinstance(m, Moment)]
    maker, _ = work.parts()
    with opencv_on_one_thread(), ThreadPoolExecutor(workers) as pool:
        made = [troubled.made for troubled in pool.map(maker.make, moments)]
        parts = _parts(work, moments, made)
        windows = work.plan.windows

        def fuse(pair: tuple[Moment, Made]) -> None:
            (moment, one), depth = pair, pair[1].depth
            window = windows.window(moment.position, one.frames.counts)
            depth_m = None if depth is None else depth.dense.value_m
            work.fuser().stages(one.frames, window, depth_m, with_counts=True)

        jobs = {name: _on(pool, job, items) for name, (job, items) in parts.items()}
        jobs["fuse"] = _on(pool, fuse, list(zip(moments, made, strict=True)))
        jobs["campaign"] = lambda: clocked(lambda: _campaign(space, work, Route(workers), len(moments)))
        jobs["plan"] = lambda: clocked(lambda: planned(path, rig, amount.chunk_s).footage.close())
        taken = interleaved(jobs, amount.rounds, warm=0)  # making the frames was the warm-up
    frames, shared = len(moments), [taken[name] for name in parts]
    least = _sum(*shared)
    fused = _sum(least, taken["fuse"])
    whole, plan = taken["campaign"], taken["plan"]
    both = _sum(whole, plan)
    each = ", ".join(f"{name} {1e3 * taken[name].median / frames:.3g} ms" for name in parts)
    said = "1 worker" if workers == 1 else f"{workers} workers"
    return [
        Row(
            f"campaign / unavoidable, {said} (a frame: {each})",
            per_second(whole.rate(frames)),
            per_second(least.rate(frames)),
            least.over(whole),
            at_least(LEAST_SHARE),
        ),
        Row(
            f"the same, fusing counted as unavoidable ({1e3 * taken['fuse'].median / frames:.3g} ms)",
            per_second(whole.rate(frames)),
            per_second(fused.rate(frames)),
            fused.over(whole),
        ),
        Row(
            f"campaign planned / unavoidable, {said} (plan {1e3 * plan.median:.0f} ms)",
            per_second(both.rate(frames)),
            per_second(least.rate(frames)),
            least.over(both),
        ),
    ]


def _sum(*samples: Sample) -> Sample:
    return Sample(tuple(sum(values) for values in zip(*(sample.values for sample in samples), strict=True)))


def _parts(
    work: PreprocessWork, moments: Sequence[Moment], made: Sequence[Made]
) -> dict[str, tuple[Callable[[Any], object], Sequence[Any]]]:
    lane = work.lane()
    clouds = [one.frames.cloud for one in made if one.frames.cloud is not None]

    def decode(moment: Moment) -> None:
        moment.images()
        if moment.cloud is not None:
            moment.cloud()

    return {
        "decode": (decode, moments),
        "densify": (lane.of_cloud, clouds) if lane is not None else (len, []),
        "encode": (_encode, made),
    }


def _encode(made: Made) -> None:
    """All files of a frame."""
    encode_png(made.fused.bgr)
    if made.fused.mask is not None:
        encode_png(made.fused.mask)
    if made.fir_counts is not None:
        encode_png(made.fir_counts)
    if made.depth is not None:
        encode_png(quantised(made.depth.dense.value_m))
        encode_png(made.depth.dense.support * np.uint8(255))
        sparse_npz(made.depth.sparse)


def _on(pool: ThreadPoolExecutor, job: Callable[[Any], object], items: Sequence[Any]) -> Callable[[], float]:
    return lambda: clocked(lambda: [None for _ in pool.map(job, items)])


def _campaign(space: Workspace, work: PreprocessWork, route: Route, frames: int) -> None:
    result = preprocess(work, str(space.fresh_out()), route=route)
    if result.made != frames or result.report.failed:
        raise RuntimeError(f"{result.made} of {frames} frames were made: {result.report.failed[:1]}")


# --- whole processes


def _starting(space: Workspace, once: Path, rig: Path, amount: Amount) -> list[Row]:
    small = [_until(space, once, rig) for _ in range(amount.starts + 1)][1:]
    start, first = (Sample(tuple(values)) for values in zip(*small, strict=True))
    large = space.root / "large.mcap"
    try:
        repeat(once, large, amount.flight_s, size_bytes=amount.large_bytes)
        begun, shown = (
            Sample(tuple(v)) for v in zip(*[_until(space, large, rig) for _ in range(3)], strict=True)
        )
    finally:
        large.unlink(missing_ok=True)
    size = f"{amount.large_bytes / 1e9:.3g} GB"
    return [
        Row(
            f"start to first chunk, {once.stat().st_size / 1e6:.0f} MB", "", "", start, at_most(START_S, " s")
        ),
        Row("start to first frame, the same", "", "", first, at_most(FIRST_FRAME_S, " s")),
        Row(f"start to first chunk, {size}", spread(begun, " s"), note="for information"),
        Row(f"start to first frame, {size}", "", "", shown, at_most(FIRST_FRAME_S, " s")),
    ]


def _until(space: Workspace, path: Path, rig: Path) -> tuple[float, float]:
    """Seconds of a process until its first chunk begins, and until its first frame is there."""
    out = space.fresh_out()
    command = [str(FUSION), "preprocess", str(path), "-o", str(out), "--rig", str(rig), "--quiet"]
    began = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    try:
        seen = [_seen(process, out, pattern, began) for pattern in ("run.toml", "fused/[0-9]*")]
    finally:
        process.kill()
        process.communicate()
    return seen[0], seen[1]


def _seen(process: subprocess.Popen[bytes], out: Path, pattern: str, began: float) -> float:
    while not any(out.glob(pattern)):
        if process.poll() is not None and process.returncode:
            raise RuntimeError(f"fusion preprocess failed: {process.communicate()[1].decode()[-500:]}")
        if time.perf_counter() - began > WAIT_S:
            raise RuntimeError(f"no {pattern} in {WAIT_S:g} s")
        time.sleep(POLL_S)
    return time.perf_counter() - began


# --- Dask


def _dask(space: Workspace, work: PreprocessWork, rounds: int) -> list[Row]:
    frames = sum(isinstance(m, Moment) for chunk in work.chunks for m in work.footage.moments(chunk))
    with ExitStack() as clusters:
        routes, begun = {}, []
        for workers in (1, 2):
            began = time.perf_counter()
            route = clusters.enter_context(_cluster(workers))
            _campaign(space, work, route, frames)
            begun.append(time.perf_counter() - began)
            routes[workers] = route
        jobs = {
            str(workers): lambda route=route: clocked(lambda: _campaign(space, work, route, frames))
            for workers, route in routes.items()
        }
        taken = interleaved(jobs, rounds, warm=0)
    one, two = taken["1"], taken["2"]
    cold = begun[1] - two.median
    return [
        Row(
            f"Dask, 2 workers / 1 worker ({len(work.chunks)} chunks)",
            per_second(two.rate(frames)),
            per_second(one.rate(frames)),
            one.over(two),
            at_least(DASK_GAIN),
        ),
        Row(
            "Dask, start of 2 workers and their first chunks, beyond that",
            f"{cold:.3g} s",
            note="for information",
        ),
    ]


@contextmanager
def _cluster(workers: int) -> Iterator[Route]:
    from distributed import LocalCluster

    with LocalCluster(
        n_workers=workers, threads_per_worker=1, host="127.0.0.1", dashboard_address=":0"
    ) as cluster:
        yield Route(scheduler=str(cluster.scheduler_address))  # type: ignore[union-attr]


# --- recordings of any length


def repeat(
    source: Path, target: Path, seconds: float, *, copies: int | None = None, size_bytes: float = 0
) -> None:
    """The MCAP of ROS 2 messages `source`, of `seconds`, end to end: so often, or up to a size.

    Log times and the stamps in the messages' headers go on from one copy to the next.
    """
    with source.open("rb") as file, target.open("wb") as out:
        messages = list(make_reader(file).iter_messages())
        writer = Writer(out, compression=CompressionType.NONE)
        writer.start()
        channels: dict[int, int] = {}
        for schema, channel, _ in messages:
            if schema is not None and channel.id not in channels:
                own = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, own)
        for copy in count():
            if copy == copies or (size_bytes and out.tell() >= size_bytes):
                break
            shift_s = copy * ceil(seconds)
            for _, channel, message in messages:
                if copy and channel.topic == "/tf_static":
                    continue
                log_ns = message.log_time + shift_s * 10**9
                writer.add_message(channels[channel.id], log_ns, _later(message.data, shift_s), log_ns)
        writer.finish()


def _later(data: bytes, seconds: int) -> bytes:
    """A ROS 2 message with a header, as CDR (4 bytes, then the stamp's seconds), moved in time."""
    (own,) = struct.unpack_from("<i", data, 4)
    return b"".join((data[:4], struct.pack("<i", own + seconds), data[8:]))
