"""What is damaged: recordings of a tiny mine in every container, drawn pictures and clouds, real files."""

from __future__ import annotations

import json
import runpy
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from fuzz_mutate import mcap_without_crcs

ROOT = Path(__file__).parents[1]
MOST_BYTES = 3 << 20  # of a real file
TEXTS = (".toml", ".yaml", ".yml", ".json", ".txt", ".msg", ".csv")


@dataclass(frozen=True, slots=True)
class Seed:
    """Files by name below the folder of a case; `main` is what the reader is given ("" the folder).

    Of `damaged` one is mutated (none named: of all). `about` is what else a reader must know.
    """

    name: str
    files: dict[str, bytes]
    main: str = ""
    damaged: tuple[str, ...] = ()
    about: Any = field(default=None, compare=False)


Seeds = dict[str, list[Seed]]

_SETTINGS = """format = "fusion-preprocess/1"
chunk_s = 10.0

[streams]
fir = "/thermal/image"
tolerance_ms = 20.0

[outputs]
kinds = ["folder", "mcap"]

[fuse.thermal]
window_over = "running"

[fuse.warp]
rig = "rig.toml"
"""


def all_seeds(scratch: Path, shared: Path | None) -> Seeds:
    """By group, drawn anew in `scratch`; `shared` adds the real files that are there."""
    seeds = _recordings(scratch)
    seeds["images"] = _images()
    seeds["clouds"] = _clouds(scratch)
    seeds["flir"] = _flir()
    seeds["rigs"] = _rigs(scratch)
    seeds["toml"] = [_one(p.name, p.read_bytes()) for p in sorted((ROOT / "datasets").glob("*.toml"))]
    if shared is not None:
        for group, seed in _real(shared):
            seeds[group].append(seed)
    return seeds | _ours(seeds)


def _ours(seeds: Seeds) -> Seeds:
    """Our own files, and all files together."""
    from fusion.preprocess.rows import FrameRow
    from fusion.sinks.index import Row, to_csv

    index = to_csv([FrameRow(f"{k:06d}", "made", "1", "2") for k in range(4)], FrameRow)
    other = to_csv([Row(f"{k:06d}", "a", "fused", "1", "2") for k in range(4)], Row)
    ours = {
        "rig": [seed for seed in seeds["rigs"] if seed.main.endswith(".toml")],
        "records": [_record()],
        "rows": [_one("frames.csv", text.encode()) for text in (index, other)],
        "settings": [_one("settings.toml", _SETTINGS.encode())],
    }
    groups = ("rosbag1", "sqlite", "rosbag2-mcap", "mcap", "images", "flir", "clouds", "rigs")
    small = [
        seed for group in groups for seed in seeds[group] if sum(map(len, seed.files.values())) < 400_000
    ]
    return ours | {"any": small}


def _one(name: str, data: bytes, about: Any = None) -> Seed:
    return Seed(name, {Path(name).name: data}, Path(name).name, about=about)


def _recordings(scratch: Path) -> Seeds:
    from fusion.simulate.container_writers import COMPRESSIONS
    from fusion.simulate.containers import write_recording
    from fusion.simulate.mine.config import MineConfig
    from fusion.simulate.mine.recording import make_mine

    rgb, fir = ({"camera": {"size_wh": size}, "rate_hz": 10} for size in ((48, 36), (32, 24)))
    lidar = {"rings": 16, "columns": 64}
    config = MineConfig.of(duration_s=0.35, truth=False, rgb=rgb, thermal=fir, lidar=lidar)
    make_mine(scratch / "mine", config, threads=1)
    seeds: Seeds = {name: [] for name in ("rosbag1", "sqlite", "rosbag2-mcap", "mcap")}
    for form, compressions in COMPRESSIONS.items():
        group = {"rosbag1": "rosbag1", "rosbag2": "sqlite", "rosbag2-mcap": "rosbag2-mcap"}.get(form, "mcap")
        for compression in compressions:
            out = scratch / f"{form}-{compression}"
            seeds[group].append(
                _recording(write_recording(scratch / "mine", out, form, compression=compression).path)
            )
    for seed in seeds["mcap"][::2]:
        open_to_all = mcap_without_crcs(next(iter(seed.files.values())))
        seeds["mcap"].append(Seed(f"no-crc-{seed.name}", {seed.main: open_to_all}, seed.main))
    split = scratch / "split"
    seeds["sqlite"].append(
        _recording(write_recording(scratch / "mine", split, "rosbag2", split_bytes=20_000).path)
    )
    return seeds | {"messages": list(_messages(seeds))}


def _recording(path: Path, name: str = "") -> Seed:
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    base = path if path.is_dir() else path.parent
    data = {file.relative_to(base).as_posix(): file.read_bytes() for file in files}
    return Seed(name or path.name, data, "" if path.is_dir() else path.name)


def _messages(recordings: Seeds) -> Iterator[Seed]:
    """The first message of every topic over every wire, with the definition that came with it."""
    from tempfile import TemporaryDirectory

    from fusion.recordings import open_recording

    seen = set()
    for seed in (seed for group in ("rosbag1", "sqlite", "mcap") for seed in recordings[group]):
        with TemporaryDirectory() as folder:
            recording = open_recording(_laid_out(seed, Path(folder)))
            for topic, _, data in recording.packets():
                key = (topic.name, topic.encoding, topic.schema.form)
                if key not in seen:
                    seen.add(key)
                    files = {"message": bytes(data), "definition.msg": topic.schema.data}
                    yield Seed(f"{topic.encoding} {topic.schema.name}", files, about=topic)
            recording.close()


def _laid_out(seed: Seed, folder: Path) -> Path:
    for name, data in seed.files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    return folder / seed.main


def _images() -> list[Seed]:
    y, x = np.mgrid[:24, :32]
    grey = (3 * x + 5 * y).astype(np.uint8)
    bgr = np.stack([grey, grey[::-1], 255 - grey], -1)
    pictures = {"8": grey, "16": (grey.astype(np.uint16) * 250), "bgr": bgr, "bgra": np.dstack([bgr, grey])}
    seeds = []
    for suffix, kinds in {
        ".png": ("8", "16", "bgr", "bgra"),
        ".jpg": ("8", "bgr"),
        ".tiff": ("8", "16", "bgr", "bgra"),
        ".bmp": ("8", "bgr"),
        ".webp": ("bgr",),
        ".pgm": ("8", "16"),
        ".ppm": ("bgr",),
    }.items():
        for kind in kinds:
            data = cv2.imencode(suffix, pictures[kind])[1].tobytes()
            seeds.append(_one(f"{kind}{suffix}", data))
    ascii_ppm = b"P3 2 2 255\n" + b"1 2 3 4 5 6 7 8 9 10 11 12\n"
    return [*seeds, _one("ascii.ppm", ascii_ppm), *_pillow_images(bgr)]


def _pillow_images(bgr: Any) -> list[Seed]:
    """What OpenCV does not write: palettes, interlaced and packed TIFFs, progressive JPEG."""
    import io

    from PIL import Image

    seeds = []
    for name, kind, options in (
        *(("palette.png", "P", {}), ("bits.png", "1", {}), ("grey-alpha.png", "LA", {})),
        *(
            ("lzw.tiff", "RGB", {"compression": "tiff_lzw"}),
            ("deflate.tiff", "L", {"compression": "tiff_deflate"}),
        ),
        *(
            ("packbits.tiff", "L", {"compression": "packbits"}),
            ("progressive.jpg", "RGB", {"progressive": True}),
        ),
    ):
        stream = io.BytesIO()
        Image.fromarray(bgr).convert(kind).save(
            stream, {"jpg": "jpeg"}.get(name[-3:], name.split(".")[-1]), **options
        )
        seeds.append(_one(name, stream.getvalue()))
    return seeds


def _clouds(scratch: Path) -> list[Seed]:
    make = runpy.run_path(str(ROOT / "tests/clouds/cloud_files.py"))
    rows = make["records"](60)
    xyz = np.stack([rows[axis] for axis in "xyz"], -1)
    made = {f"{kind}.pcd": make["pcd"](rows, kind) for kind in ("ascii", "binary", "binary_compressed")}
    orders = ("ascii", "binary_little_endian", "binary_big_endian")
    made |= {f"{order}.ply": make["ply"](rows, order) for order in orders}
    made |= {"points.npy": make["npy"](xyz), "rows.npy": make["npy"](rows)}
    made |= {"two.npz": make["npz"](xyz=xyz, ring=rows["ring"])}
    made |= {"packed.npz": make["npz"](True, xyz=xyz, ring=rows["ring"])}
    made |= {"kitti.bin": np.column_stack([xyz, rows["ring"]]).astype("<f4").tobytes()}
    made |= {"nuscenes.pcd.bin": np.column_stack([xyz, rows["t"], rows["ring"]]).astype("<f4").tobytes()}
    scan = next((scratch / "mine" / "lidar").iterdir())
    made |= {"mine.pcd": scan.read_bytes()}
    try:
        made |= {
            f"a.{'laz' if packed else 'las'}": make["las"](xyz.astype(float), packed)
            for packed in (False, True)
        }
    except ImportError:
        print("laspy is not installed: LAS and LAZ are not fuzzed")
    return [_one(name, data) for name, data in made.items()]


def _flir() -> list[Seed]:
    made = runpy.run_path(str(ROOT / "tests/radiometric/flirfile.py"))
    scene = made["scene"]()
    seeds = [
        _one(f"{c}.jpg", made["flir_jpeg"](coding=c, visible=scene)) for c in ("raw", "png", "swapped-png")
    ]
    return [*seeds, _one("dji.jpg", made["dji_jpeg"]())]


def _rigs(scratch: Path) -> list[Seed]:
    from calib.formats import FORMATS, write_rig
    from fusion.errors import FusionError
    from fusion.rig import Rig
    from fusion.simulate.mine.truth import Truth

    truth = Truth(scratch / "mine").rig
    lenses = {"rgb": truth.cameras["rgb"]}
    seeds = []
    for form in FORMATS:
        for k, rig in enumerate((truth, Rig(lenses, truth.transforms), Rig(lenses))):
            suffix = {
                "rig": ".toml",
                "koide": ".json",
                "kitti": ".txt",
                "plain": ".txt",
                "kitti-raw": "",
            }.get(form, ".yaml")
            out = scratch / f"rig-{form}-{k}{suffix}"
            try:
                write_rig(out, rig, form)
            except FusionError:
                continue
            seeds.append(_recording(out, f"{form} {k}"))
    assert len(seeds) >= len(FORMATS), [seed.name for seed in seeds]
    return seeds


def _record() -> Seed:
    """A chunk's record as it is committed."""
    from fusion.preprocess.records import RECORD_FORMAT

    rows = [[f"{k:06d}", "made", *(["1"] * 17)] for k in range(4)]
    files = {f"fused/{k:06d}.png": 1000 + k for k in range(4)}
    record = {"format": RECORD_FORMAT, "run_id": "ab12", "chunk": [3, 10, 20, 4], "seconds": 1.5}
    record |= {"lost": {"fir: no partner": 2}, "files": files, "rows": rows}
    return _one("000003.json", json.dumps(record).encode())


def _real(shared: Path) -> Iterator[tuple[str, Seed]]:
    """The real files that are not too large to be written thousands of times."""
    for group, pattern in (
        *(
            ("rosbag1", "recordings/*.bag"),
            ("mcap", "recordings/*/*/*.mcap"),
            ("mcap", "recordings/*/*/*/*.mcap"),
        ),
        *(("sqlite", "recordings/*/test*sqlite3"), ("sqlite", "recordings/*/sqlite3/*")),
        *(("rosbag2-mcap", "recordings/*/test*mcap"), ("rosbag2-mcap", "recordings/*/mcap/*")),
        *(("flir", "radiometric/*.jpg"), ("flir", "radiometric/*/*.JPG"), ("images", "radiometric/*.tiff")),
        *(("clouds", "mine_lidar/*.pcd"), ("clouds", "kitti_object/velodyne/*.bin")),
        *(("images", "rgbt_pairs/*/*/*.jpg"), ("images", "kitti_depth/groundtruth/*05.png")),
        *(("rigs", "kitti_object/calib/*.txt"), ("rigs", "lidar_camera/*/calib.txt")),
    ):
        for path in sorted(shared.glob(pattern))[:8]:
            seed = _recording(path, f"real {path.name}")
            if seed.files and sum(map(len, seed.files.values())) <= MOST_BYTES:
                yield group, seed
