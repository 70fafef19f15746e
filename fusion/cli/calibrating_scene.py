"""`fusion calibrate lidar` without a board: from given points, or refined on what both sensors see."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.formats import read_rig
from calib.lidar.points import PointsPose, from_points, read_pairs
from calib.lidar.refine import Refinement, SceneFrame, refine_on_scene
from calib.report.pictures import to_bgr
from fusion.cli.calibrating import Asked, Together
from fusion.cli.running import progress_bar, quiet_libraries, refuse_existing, warn
from fusion.clouds import clouds_in, read_cloud
from fusion.codecs import encode_jpeg
from fusion.errors import FrameError, InputError, UsageError
from fusion.files import replace_file
from fusion.frames import PointCloud
from fusion.geometry import Floats
from fusion.lidar.project import project
from fusion.pairing import stamp_in_name
from fusion.report.depth_picture import overlay
from fusion.rig import Rig, save_rig
from fusion.sources import Source, open_source

FRAMES = 8  # that the scene's refinement looks at
_SLACK_NS = 50_000_000


def run_points(asked: Asked, camera: str, points: Path) -> None:
    """The LiDAR's place from a CSV of matching points."""
    refuse_existing(asked.out, asked.overwrite)
    rig = asked.known()
    found = from_points(rig.camera(camera), *read_pairs(points))
    warn(found.notes)
    left_out = [str(row + 2) for row in np.flatnonzero(~found.inliers)]
    if not asked.quiet:
        print(f"{found.inliers.sum()} of {len(found.inliers)} pairs, rms {found.rms_px:.2f} px")
        if left_out:
            print(f"left out: lines {', '.join(left_out)} of {points}")
        turn, shift = (1000 * np.sqrt(np.linalg.eigvalsh(found.covariance[k])[-1]) for k in (_TURN, _SHIFT))
        print(f"uncertain by {turn:.2f} mrad and {shift:.1f} mm (worst axes)")
    save_rig(asked.out, _with_lidar(rig, camera, found.T_cam_lidar, _points_record(found)))
    if not asked.quiet:
        print(f"{asked.out} written")


_TURN, _SHIFT = np.ix_(range(3), range(3)), np.ix_(range(3, 6), range(3, 6))


def _points_record(found: PointsPose) -> dict[str, Any]:
    return {
        "from": "given points",
        "pairs": len(found.inliers),
        "pairs_used": int(found.inliers.sum()),
        "rms_px": float(found.rms_px),
        "covariance": found.covariance.tolist() if np.isfinite(found.covariance).all() else [],
    }


def run_scene(asked: Asked, camera: str, images: str, clouds: str, together: Together) -> None:
    """The LiDAR's place refined on the scene: the rig must say where it roughly is."""
    refuse_existing(asked.out, asked.overwrite)
    rig = read_rig(asked.rig) if asked.rig is not None else Rig()
    lens = rig.camera(camera)
    try:
        start = rig.pose(camera, "lidar")
    except UsageError as error:
        hint = f"add T_{camera}_lidar, nearly right, for the scene to refine; or give --board, or --points"
        raise UsageError(error.what, where=asked.rig or "", hint=hint) from None
    with (
        quiet_libraries(),
        closing(open_source(images, "fir" if camera == "fir" else "rgb", fir_colour="luma")) as source,
    ):
        pairs = _pairs(source, clouds, together)
        frames = [(source.read(index).pixels, read_cloud(path)) for index, path in pairs]
    scenes = [
        SceneFrame(pixels, cloud.xyz_m, cloud.fields.get("intensity"), cloud.stem) for pixels, cloud in frames
    ]
    with progress_bar("refining", asked.quiet):
        found = refine_on_scene(lens, scenes, start)
    if not asked.quiet:
        print("\n".join(_lines(found, len(frames))))
    if asked.report:
        for name, T in (("before", start), ("after", found.candidate)):
            for pixels, cloud in frames[:3]:
                path = asked.folder / f"{name}_{cloud.stem.replace('/', '_')}.jpg"
                replace_file(path, encode_jpeg(_drawn(pixels, cloud, lens, T), 88))
    save_rig(asked.out, _with_lidar(rig, camera, found.T_cam_lidar, _scene_record(found, len(frames))))
    if not asked.quiet:
        pictures = f"; look at {asked.folder} before you trust it" if asked.report else ""
        print(f"{asked.out} written{pictures}")


def _lines(found: Refinement, frames: int) -> list[str]:
    kept = "refined" if found.kept == "refined" else "the start is kept"
    moved = f"{np.degrees(found.moved_rad):.2f} degrees and {1000 * found.moved_m:.0f} mm"
    return [
        f"{frames} frames: {kept}: {found.note}",
        f"score of held-out edges {found.score_before:.2f} before, {found.score_after:.2f} after"
        f" ({found.gain_sigma:.1f} sigma); moved by {moved}; parts of the data agree within"
        f" {np.degrees(found.agreement_rad):.2f} degrees and {1000 * found.agreement_m:.0f} mm",
    ]


def _scene_record(found: Refinement, frames: int) -> dict[str, Any]:
    return {
        "from": "the scene",
        "frames": frames,
        "kept": found.kept,
        "score_before": float(found.score_before),
        "score_after": float(found.score_after),
        "agreement_rad": float(found.agreement_rad),
        "agreement_m": float(found.agreement_m),
        "note": found.note,
    }


def _with_lidar(rig: Rig, camera: str, T_cam_lidar: Floats, record: dict[str, Any]) -> Rig:
    """The rig with the LiDAR where it was found; other statements about the LiDAR go."""
    kept = {name: T for name, T in rig.transforms.items() if "lidar" not in name.split("_")}
    return replace(
        rig,
        transforms={**kept, f"T_{camera}_lidar": T_cam_lidar},
        evidence={**rig.evidence, "lidar": record},
    )


def _pairs(source: Source, clouds: str, together: Together) -> list[tuple[int, Path]]:
    """Which image goes with which cloud, evenly spread over the recording. Raises `InputError` for none."""
    files = clouds_in(clouds)
    slack = _SLACK_NS if together.tolerance_ms is None else round(together.tolerance_ms * 1e6)
    stems = {entry.stem: index for index, entry in enumerate(source.entries)}
    stamps = {
        index: stamp
        for index, entry in enumerate(source.entries)
        if (stamp := entry.stamp_ns or stamp_in_name(entry.stem)) is not None
    }
    matched = []
    for number, (stem, path) in enumerate(zip(files.stems, files, strict=True)):
        index = _partner(together.by, number, stem, stems, stamps, slack, len(source.entries))
        if index is not None:
            matched.append((index, path))
    if not matched:
        hint = "names must agree, or carry time stamps (--tolerance-ms); or --pair order"
        raise InputError("no image belongs to any of the clouds", where=clouds, hint=hint)
    chosen = np.unique(np.linspace(0, len(matched) - 1, min(FRAMES, len(matched))).astype(int))
    return [matched[k] for k in chosen]


def _partner(
    by: str, number: int, stem: str, stems: dict[str, int], stamps: dict[int, int], slack: int, count: int
) -> int | None:
    if by == "order" or (by == "auto" and count == 1):
        return number if number < count else None
    if by in ("auto", "stem") and stem in stems:
        return stems[stem]
    stamp = stamp_in_name(stem)
    if by == "stem" or stamp is None or not stamps:
        return None
    index = min(stamps, key=lambda k: abs(stamps[k] - stamp))
    return index if abs(stamps[index] - stamp) <= slack else None


def _drawn(pixels: NDArray[Any], cloud: PointCloud, lens: Any, T: Floats) -> NDArray[np.uint8]:
    sparse = project(cloud, lens, T)
    if not len(sparse.value_m):
        raise FrameError("no point of the cloud falls into the image", where=cloud.stem)
    far = float(np.percentile(sparse.value_m, 95))
    return overlay(to_bgr(pixels), sparse, "jet", (min(1.0, far / 2), far))
