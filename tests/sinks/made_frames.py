"""Frames as `fusion preprocess` hands them to its outputs: small, each different, with everything."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fusion.chunks import Chunk
from fusion.codecs import encode_jpeg, encode_png
from fusion.frames import FrameSet, FusedFrame, Image, PointCloud, Window
from fusion.geometry import FisheyeCamera, PinholeCamera, invert
from fusion.lidar.lane import DepthFrame
from fusion.lidar.sparse import DenseDepth, SparseDepth, Value
from fusion.rig import Rig
from fusion.sinks.base import Made, Output, Setup
from fusion.storage import Storage

SIZE_WH = (48, 32)
RATE_HZ = 20.0
FIRST_NS = 1_700_000_000_123_456_789
CHUNKS = tuple(Chunk(k, 1000 * k, 1000 * (k + 1), 3) for k in range(4))

_c, _s = np.cos(0.3), np.sin(0.3)
T_RGB_LIDAR = np.array([[0, -1, 0, 0.05], [0, 0, -1, 0.1], [1, 0, 0, -0.2], [0, 0, 0, 1]], np.float64)
T_RGB_FIR = np.array([[_c, 0, _s, 0.07], [0, 1, 0, -0.02], [-_s, 0, _c, 0.01], [0, 0, 0, 1]], np.float64)
CAMERA = PinholeCamera(SIZE_WH, 40.0, 41.0, 23.0, 15.5, (-0.1, 0.02, 0.001, -0.002, 0.003))
RIG = Rig({"rgb": CAMERA, "fir": FisheyeCamera((20, 16), 18.0, 18.0, 9.5, 7.5)}, {})
RIG = Rig(RIG.cameras, {"T_rgb_lidar": T_RGB_LIDAR, "T_fir_rgb": invert(T_RGB_FIR)})
SETUP = Setup(RIG, CAMERA, RATE_HZ)


def stamp(k: int) -> int:
    """Of frame k; the intervals differ."""
    return FIRST_NS + k * 50_000_000 + (k * k % 7) * 1_234_567


def picture(k: int, size_wh: tuple[int, int] = SIZE_WH) -> NDArray[np.uint8]:
    """Smooth waves in colour, elsewhere in each frame: what a video can be told apart by."""
    w, h = size_wh
    v, u = np.mgrid[:h, :w]
    waves = [np.sin(u / 9 + k), np.sin(v / 7 + 2 * k), np.cos((u + v) / 11 + k)]
    return np.rint(128 + 90 * np.stack(waves, -1)).astype(np.uint8)


def cloud(k: int, stamp_ns: int | None = None) -> PointCloud:
    rng = np.random.default_rng(k)
    n = 20 + k
    fields = {
        "intensity": rng.uniform(0, 255, n).astype(np.float32),
        "ring": np.arange(n, dtype=np.int32) % 16,
        "time_s": np.linspace(0, 0.1, n),
    }
    return PointCloud(rng.normal(0, 9, (n, 3)).astype(np.float32), fields, f"{k}", stamp_ns)


def depth(k: int, value: Value = "depth") -> DepthFrame:
    w, h = SIZE_WH
    z = np.linspace(0.5, 90, w * h, dtype=np.float32).reshape(h, w) + np.float32(k)
    z[0, :5] = 0
    none = np.empty(0)
    sparse = SparseDepth(SIZE_WH, none, none, none.astype(np.float32), value, np.empty(0, np.int64))
    return DepthFrame(f"{k}", sparse, DenseDepth(z, z > 0, value))


def made(
    k: int,
    size_wh: tuple[int, int] = SIZE_WH,
    stamp_ns: int | None = -1,
    whole: bool = True,
    jpeg: bool = False,
) -> Made:
    """Frame k; every second one has a cloud, measured 30 ms before it. `whole` is all but the picture."""
    bgr, at = picture(k, size_wh), stamp(k) if stamp_ns == -1 else stamp_ns
    counts = (7000 + np.arange(size_wh[0] * size_wh[1]).reshape(size_wh[::-1]) + k).astype(np.uint16)
    mask = np.where(counts > 7010, np.uint8(255), np.uint8(0))
    scan = cloud(k, None if at is None else at - 30_000_000) if whole and k % 2 == 0 else None
    fused = FusedFrame(f"f{k}", bgr, mask if whole else None, Window(0, 1), 0, 0, 1, at, at)
    frames = FrameSet(Image(bgr, f"f{k}", at), Image(counts[:16, :20], f"t{k}", at), scan)
    encoded = {"fused": encode_jpeg(bgr, 90) if jpeg else encode_png(bgr)}
    if not whole:
        return Made(f"f{k}", frames, fused, encoded=encoded)
    encoded |= {"mask": encode_png(mask), "fir": encode_png(counts), "support": encode_png(mask)}
    return Made(f"f{k}", frames, fused, counts, depth(k) if scan else None, encoded)


def frames_of(chunk: Chunk) -> list[int]:
    """The numbers of a chunk's frames: three each, none in the third."""
    return [] if chunk.index == 2 else [3 * chunk.index + k for k in range(3)]


def do(output: Output, chunk: Chunk, out: Storage, whole: bool = True) -> dict[str, int]:
    part = output.open(chunk, out)
    for k in frames_of(chunk):
        part.add(made(k, whole=whole))
    return dict(part.close())


def file_bytes(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
