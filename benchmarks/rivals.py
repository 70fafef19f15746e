"""The same job by ffmpeg and ImageMagick: commands, their tuning, and a check that they do the same job.

Both get what suits them best: registered pairs of equal size, a fixed window, files numbered from 0.
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from content import Case
from timing import clocked

from fusion.colormaps import colormap_bgr

FFMPEG = shutil.which("ffmpeg")
# Debian's name first: "convert" may be anything
MAGICK = shutil.which("convert-im6.q16") or shutil.which("convert")
ALPHA = 0.85


@dataclass(frozen=True, slots=True)
class Ffmpeg:
    """One way of telling ffmpeg what to do; `output` are the encoder's options."""

    graph: str
    output: tuple[str, ...]
    decode_threads: int = 2
    encode_threads: int = 2
    filter_threads: int = 2

    def command(self, pairs: Path, out: Path, case: Case, count: int, suffix: str) -> list[str]:
        source = ["-threads", str(self.decode_threads), "-framerate", "25", "-start_number", "0"]
        return [
            *(FFMPEG or "ffmpeg", "-nostdin", "-v", "error", "-y"),
            *("-filter_complex_threads", str(self.filter_threads)),
            *(
                *source,
                "-i",
                str(pairs / f"rgb/%06d{suffix}"),
                *source,
                "-i",
                str(pairs / f"fir/%06d{suffix}"),
            ),
            *("-filter_complex", {**GRAPHS, **JPEG_GRAPHS}[self.graph].format(**expressions(case))),
            *("-frames:v", str(count), "-fps_mode", "passthrough", "-start_number", "0"),
            *(*self.output, "-threads", str(self.encode_threads), str(out / f"%06d{suffix}")),
        ]

    @property
    def words(self) -> str:
        threads = f"threads {self.decode_threads}/{self.filter_threads}/{self.encode_threads}"
        return f"{self.graph}; {' '.join(self.output)}; {threads} (decode/filter/encode)"


# Window and colour map are one table each for red, green and blue (or Y, U, V). {counts} gives 8-bit counts,
# mergeplanes lays them into all three planes. The first graphs blend by alpha, those of the second group
# have the weights in the tables and add in SIMD, lut2 does all of it in one table of 256 x 256 a channel.
_RGB, _FIR = "[0:v]format=gbrp[r];", "[1:v]{counts},mergeplanes=0x000000:gbrp"
GRAPHS = {
    "lutrgb, blend=normal": _RGB + _FIR + ",lutrgb={colour}[t];[r][t]blend=all_mode=normal:all_opacity=0.85",
    "lutrgb, mix": _RGB + _FIR + ",lutrgb={colour}[t];[r][t]mix=weights='0.85 0.15'",
    "lutrgb with alpha, overlay": _RGB
    + "[1:v]{counts},format=gbrap,lutrgb={colour}:a=38[t];[r][t]overlay=format=gbrp",
    "lutrgb twice, blend=addition, planar": "[0:v]format=gbrp,lutrgb={weighted}[r];"
    + _FIR
    + ",lutrgb={share}[t];[r][t]blend=all_mode=addition",
    "lutrgb twice, blend=addition, packed": "[0:v]format=rgb24,lutrgb={weighted}[r];"
    "[1:v]{counts},format=rgb24,lutrgb={share}[t];[r][t]blend=all_mode=addition",
    "lut2": _RGB + _FIR + "[t];[r][t]lut2={table}",
}
# JPEG need not leave YUV
_FIR_YUV = "[1:v]{counts},mergeplanes=0x000000:yuvj444p"
JPEG_GRAPHS = {
    "lut2": GRAPHS["lut2"],
    "YUV: lut2": "[0:v]format=yuvj420p[r];" + _FIR_YUV + ",format=yuvj420p[t];[r][t]lut2={table_yuv}",
    "YUV: lutyuv twice, blend=addition": "[0:v]format=yuvj420p,lutyuv={weighted_yuv}[r];"
    + _FIR_YUV
    + ",lutyuv={share_yuv},format=yuvj420p[t];[r][t]blend=all_mode=addition",
    "YUV: lutyuv, blend=normal": "[0:v]format=yuvj420p[r];"
    + _FIR_YUV
    + ",lutyuv={colour_yuv},format=yuvj420p[t];[r][t]blend=all_mode=normal:all_opacity=0.85",
}
PNG_OUTPUTS = tuple(
    ("-c:v", "png", "-compression_level", level, "-pred", pred)
    for level, pred in (("1", "sub"), ("1", "up"), ("1", "avg"), ("1", "paeth"), ("1", "none"))
)
PNG_STORED = ("-c:v", "png", "-compression_level", "0", "-pred", "none")


def expressions(case: Case) -> dict[str, str]:
    """The window and the map `hsv-cold-hot` as ffmpeg expressions in every form that the graphs need."""
    lo, hi = case.window if case.bits == 8 else (0, 255)
    of_val, of_y = _channels("val", lo, hi), _channels("y", lo, hi)

    def scaled(channels: str, weight: float) -> str:
        return ":".join(f"{c}='round({weight}*{of_val[c]})'" for c in channels)

    def table(channels: str) -> str:
        terms = enumerate(channels)
        return ":".join(f"c{i}='floor({ALPHA}*x+{1 - ALPHA:.2f}*{of_y[c]}+0.5)'" for i, c in terms)

    return {
        "counts": _index_16(case) if case.bits == 16 else "format=gray",
        "colour": scaled("rgb", 1),
        "share": scaled("rgb", round(1 - ALPHA, 2)),
        "weighted": ":".join(f"{c}='round({ALPHA}*val)'" for c in "rgb"),
        "table": table("gbr"),
        "colour_yuv": scaled("yuv", 1),
        "share_yuv": scaled("yuv", round(1 - ALPHA, 2)),
        "weighted_yuv": ":".join(f"{c}='round({ALPHA}*val)'" for c in "yuv"),
        "table_yuv": table("yuv"),
    }


def _channels(value: str, lo: int, hi: int) -> dict[str, str]:
    """Each channel, 0 to 255: hue from 4/6 (blue) down to 0 (red), and the same in JPEG's YUV."""
    sixths = f"4*(1-clip(({value}-{lo})/{hi - lo},0,1))"
    r, b = f"255*clip(2-{sixths},0,1)", f"255*clip({sixths}-2,0,1)"
    g = f"255*clip(min({sixths},4-{sixths}),0,1)"
    return {
        "r": r,
        "g": g,
        "b": b,
        "y": f"(0.299*{r}+0.587*{g}+0.114*{b})",
        "u": f"(128-0.168736*{r}-0.331264*{g}+0.5*{b})",
        "v": f"(128+0.5*{r}-0.418688*{g}-0.081312*{b})",
    }


def _index_16(case: Case) -> str:
    lo, hi = case.window
    return f"format=gray16,lut=y='256*round(255*clip((val-{lo})/{hi - lo},0,1))',format=gray"


def jpeg_outputs(quality: int) -> list[tuple[str, ...]]:
    written = ("-c:v", "mjpeg", "-pix_fmt", "yuvj420p", "-qmin", "1", "-q:v", str(quality))
    return [(*written, "-huffman", tables) for tables in ("default", "optimal")]


def tune(
    pairs: Path, out: Path, case: Case, count: int, suffix: str, outputs: Sequence[tuple[str, ...]]
) -> list[tuple[Ffmpeg, float]]:
    """Try graphs, then encoder options, then threads, each with the best so far; the fastest first."""
    tried: dict[Ffmpeg, float] = {}

    def fastest(candidates: Sequence[Ffmpeg]) -> Ffmpeg:
        for candidate in candidates:
            if candidate not in tried:
                tried[candidate] = min(
                    run_ffmpeg(candidate, pairs, out, case, count, suffix) for _ in range(2)
                )
        return min(candidates, key=lambda candidate: tried[candidate])

    graphs = GRAPHS if suffix == ".png" else JPEG_GRAPHS
    best = fastest([Ffmpeg(graph, outputs[0]) for graph in graphs])
    best = fastest([best, *(replace(best, output=output) for output in outputs[1:])])
    best = fastest(
        [
            best,
            replace(best, decode_threads=1),
            replace(best, encode_threads=3),
            replace(best, filter_threads=1),
        ]
    )
    return sorted(tried.items(), key=lambda item: item[1])


def run_ffmpeg(how: Ffmpeg, pairs: Path, out: Path, case: Case, count: int, suffix: str) -> float:
    """Seconds of one run into the emptied folder `out`."""
    return _into(out, count, suffix, [how.command(pairs, out, case, count, suffix)])


# --- ImageMagick

PNG_WRITES = (
    "-define png:compression-level=1 -define png:compression-strategy=2 -define png:compression-filter=2",
    "-quality 12",  # level 1, filter 2 (up)
    "",  # as it comes
)
BLENDS = {
    "blend": "-compose blend -define compose:args=15 -composite",
    "plus": "-compose plus -composite",
}


@dataclass(frozen=True, slots=True)
class Magick:
    """ImageMagick: a process for each frame, or two processes with half of the frames each."""

    process_per_frame: bool
    blend: str
    write: str = PNG_WRITES[0]

    @property
    def words(self) -> str:
        processes = (
            "a process a frame, two at a time"
            if self.process_per_frame
            else "two processes, half of the frames each"
        )
        return f"{processes}; -clut; {BLENDS[self.blend]}; {self.write or 'default PNG settings'}"

    def commands(self, pairs: Path, out: Path, case: Case, count: int) -> list[list[str]]:
        step = 1 if self.process_per_frame else (count + 1) // 2
        return [
            self._command(pairs, out, case, range(at, min(at + step, count))) for at in range(0, count, step)
        ]

    def _command(self, pairs: Path, out: Path, case: Case, frames: range) -> list[str]:
        lo, hi = (limit * (257 if case.bits == 8 else 1) for limit in case.window)
        clut = ["-level", f"{lo},{hi}", str(pairs / "palette.png"), "-clut"]
        dim = ["-evaluate", "multiply", "0.85"], ["-evaluate", "multiply", "0.15"]
        rgb_dim, fir_dim = dim if self.blend == "plus" else ([], [])
        command = [MAGICK or "convert", "-limit", "thread", "1"]
        for frame in frames:
            rgb, fir = (str(pairs / f"{name}/{frame:06d}.png") for name in ("rgb", "fir"))
            command += [rgb, *rgb_dim, "(", fir, *clut, *fir_dim, ")", *BLENDS[self.blend].split()]
            command += [
                "-depth",
                "8",
                *self.write.split(),
                "-write",
                str(out / f"{frame:06d}.png"),
                "+delete",
            ]
        return [*command[:-1], "null:"]  # the last image stays: an empty list at the end is an error


MAGICKS = (
    *(Magick(single, blend) for single in (True, False) for blend in BLENDS),
    *(Magick(False, "blend", write) for write in PNG_WRITES[1:]),
)


def run_magick(how: Magick, pairs: Path, out: Path, case: Case, count: int) -> float:
    palette = pairs / "palette.png"
    if not palette.exists():
        cv2.imwrite(str(palette), colormap_bgr("hsv-cold-hot")[None])
    return _into(out, count, ".png", how.commands(pairs, out, case, count))


def tune_magick(pairs: Path, out: Path, case: Case, count: int) -> list[tuple[Magick, float]]:
    tried = [(how, run_magick(how, pairs, out, case, count)) for how in MAGICKS]
    return sorted(tried, key=lambda item: item[1])


# --- both


def _into(out: Path, count: int, suffix: str, commands: list[list[str]]) -> float:
    """Run the commands, two at a time, and see that `count` files came out; seconds."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    with ThreadPoolExecutor(2) as pool:
        seconds = clocked(lambda: list(pool.map(_run, commands)))
    made = len(list(out.glob(f"*{suffix}")))
    if made != count:
        raise RuntimeError(f"{commands[0][0]} made {made} of {count} files")
    return seconds


def _run(command: list[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{command[0]} failed: {done.stderr.strip()[-500:]}")


def mean_difference(ours: Path, theirs: Path, frames: int = 5) -> float:
    """Mean absolute difference, in grey levels, of the first frames of two folders."""
    suffix = next(ours.iterdir()).suffix
    names = [f"{index:06d}{suffix}" for index in range(frames)]
    pairs = [(cv2.imread(str(ours / name)), cv2.imread(str(theirs / name))) for name in names]
    apart = [np.abs(a.astype(np.int16) - b) for a, b in pairs if a is not None and b is not None]
    if len(apart) != len(names):
        raise RuntimeError(f"{ours} and {theirs} lack some of {names}")
    return float(np.mean(apart))
