"""Folders, images, clouds, rigs, outputs: what is said of them, and what is refused."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from fusion.clouds import write_pcd
from fusion.errors import InputError
from fusion.frames import PointCloud
from fusion.geometry import PinholeCamera
from fusion.inspect import inspect
from fusion.messages.roles import camera_of
from fusion.rig import Rig, save_rig
from tests.inspect.recorded import chosen, streams

START_NS = 1_700_000_000 * 10**9
MS = 1_000_000


def write_images(
    folder: Path, count: int, make, step_ms=50, gap_after=None, suffix=".png"
) -> list[np.ndarray]:
    folder.mkdir(parents=True)
    made, ns = [], START_NS
    for k in range(count):
        made.append(make(k))
        assert cv2.imwrite(str(folder / f"{ns}{suffix}"), made[-1])
        ns += step_ms * MS * (5 if k == gap_after else 1)
    return made


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """RGB, thermal (frames 4 and 5 repeat the 3rd) and clouds in folders, with a rig."""
    root = tmp_path_factory.mktemp("flight") / "day one"
    rng = np.random.default_rng(0)
    colours = rng.integers(0, 256, (30, 24, 32, 3)).astype(np.uint8)
    counts = rng.integers(7000, 7500, (30, 40, 48)).astype(np.uint16)
    counts[4] = counts[5] = counts[3]
    write_images(root / "rgb", 30, lambda k: colours[k], gap_after=9)
    write_images(root / "lwir", 30, lambda k: counts[k])
    (root / "lidar").mkdir()
    for k in range(3):
        xyz = rng.uniform(1, 5, (50 + k, 3)).astype(np.float32)
        cloud = PointCloud(xyz, {"ring": np.zeros(50 + k, np.int32)})
        write_pcd(root / "lidar" / f"{START_NS + k * 100 * MS}.pcd", cloud)
    save_rig(root / "rig.toml", Rig({"rgb": PinholeCamera((32, 24), 30, 30, 15.5, 11.5)}))
    (root / "notes.txt").write_text("nothing")
    return root, counts


def test_a_flight_in_folders(flight):
    root, counts = flight
    found = inspect(root, full=True, pictures=True)
    by_name = streams(found)
    assert {name: s.count for name, s in by_name.items()} == {"rgb": 30, "lwir": 30, "lidar": 3}
    assert chosen(found) == {
        "rgb": "rgb",
        "fir": "lwir",
        "lidar": "lidar",
    }
    fir, rgb = by_name["lwir"], by_name["rgb"]
    assert fir.facts["values"] == {
        "least": int(counts.min()),
        "p1": int(np.quantile(counts, 0.01, method="inverted_cdf")),
        "median": int(np.quantile(counts, 0.5, method="inverted_cdf")),
        "p99": int(np.quantile(counts, 0.99, method="inverted_cdf")),
        "most": int(counts.max()),
    }
    assert (fir.facts["frozen_frames"], fir.facts["frozen_from_to"]) == (2, [[3, 5]])
    assert (rgb.times.gap_count, rgb.times.clock) == (1, "name")
    assert rgb.times.gaps_ns == ((START_NS + 9 * 50 * MS, START_NS + 14 * 50 * MS),)
    assert by_name["lidar"].facts["points"] == [50, 52]
    assert "frozen_frames" not in rgb.facts
    blend = found.steps[0].words
    assert blend == (
        *("fusion", "blend", str(root / "rgb"), str(root / "lwir")),
        *("--rig", str(root / "rig.toml"), "-o", "OUT", "--preview"),
    )
    assert len(found.pictures) == 4  # two thumbnails, one histogram, one cloud


def test_a_sample_says_that_it_is_one(flight):
    found = inspect(flight[0] / "lwir")
    (stream,) = streams(found).values()
    assert (stream.looked.seen, stream.looked.of) == (20, 30)
    assert "frozen_frames" not in stream.facts
    assert stream.times.looked.seen == 30  # names cost nothing
    assert found.steps[-1].words == ("fusion", "inspect", str(flight[0] / "lwir"), "--full")
    assert found.title == "a folder of images"


def test_damaged_images_are_counted_and_named(tmp_path):
    write_images(tmp_path / "a", 4, lambda k: np.full((8, 9), k, np.uint8))
    broken = tmp_path / "a" / f"{START_NS}.png"
    broken.write_bytes(broken.read_bytes()[:40])
    found = inspect(tmp_path / "a", full=True)
    assert len(found.faults) == 1
    assert broken.name in found.faults[0]
    assert found.streams[0].facts["values"]["least"] == 1
    assert "frozen_frames" not in found.streams[0].facts


def test_sets_side_by_side_are_paired_within(tmp_path):
    for place in ("north", "south"):
        write_images(
            tmp_path / place / "vi", 2, lambda k: np.eye(8, dtype=np.uint8)[..., None] * [9, 99, 200]
        )
        write_images(tmp_path / place / "ir", 2, lambda k: np.full((8, 8), 7, np.uint8))
    found = inspect(tmp_path)
    pairs = [(step.words[2], step.words[3]) for step in found.steps]
    assert pairs == [(str(tmp_path / p / "vi"), str(tmp_path / p / "ir")) for p in ("north", "south")]
    assert found.roles is None


def test_numbers_are_no_times(tmp_path):
    folder = tmp_path / "image"
    folder.mkdir()
    for k in range(3):
        cv2.imwrite(str(folder / f"{k:010d}.png"), np.zeros((4, 4), np.uint8))
    assert inspect(folder).streams[0].times is None


def test_one_of_each(flight, tmp_path):
    root, _ = flight
    image = inspect(next((root / "lwir").iterdir()), pictures=True)
    assert (image.kind, image.facts["size_wh"], image.facts["bits"]) == ("image", [48, 40], 16)
    assert image.facts["content"] == "counts"
    cloud = inspect(root / "lidar" / f"{START_NS}.pcd", pictures=True)
    assert (cloud.kind, cloud.facts["points"]) == ("cloud", 50)
    assert cloud.steps[0].words[:2] == ("fusion", "depth")
    rig = inspect(root / "rig.toml")
    assert rig.facts["camera_rgb"]["view_deg"] == pytest.approx(2 * np.degrees(np.arctan(16 / 30)), abs=0.01)


def test_a_simulated_mine(tmp_path):
    write_images(tmp_path / "rgb", 2, lambda k: np.full((8, 8, 3), (1, 50, 99), np.uint8))
    write_images(tmp_path / "fir", 2, lambda k: np.full((8, 8), 7000, np.uint16))
    (tmp_path / "truth").mkdir()
    (tmp_path / "truth" / "mine.toml").write_text('format = "fusion-mine/1"\n')
    found = inspect(tmp_path)
    assert found.kind == "mine"
    assert found.faults  # clocks and freezes are not there, and it says so
    assert found.steps[0].words[:2] == ("fusion", "blend")


def test_a_known_data_set(tmp_path):
    colour, grey = np.full((8, 8, 3), (1, 50, 99), np.uint8), np.full((8, 8), 7, np.uint8)
    write_images(tmp_path / "visible" / "train", 1, lambda k: colour, suffix=".jpg")
    write_images(tmp_path / "infrared" / "train", 1, lambda k: grey, suffix=".jpg")
    found = inspect(tmp_path)
    assert found.kind == "dataset"
    assert "llvip" in found.title
    assert found.facts["layout_of_llvip"] == {"rgb": 1, "fir": 1}
    assert ("fusion", "preprocess", "llvip", str(tmp_path), "-o", "OUT") in [
        step.words for step in found.steps
    ]


def test_folders_like_those_of_the_mine_are_not_taken_for_it(tmp_path):
    write_images(tmp_path / "rgb", 1, lambda k: np.full((8, 8, 3), (1, 50, 99), np.uint8))
    write_images(tmp_path / "fir", 1, lambda k: np.full((8, 8), 7, np.uint16))
    found = inspect(tmp_path)
    assert found.kind == "folder"
    assert found.steps[0].words[:2] == ("fusion", "blend")


def test_a_manifest():
    found = inspect(Path(__file__).parents[2] / "datasets" / "llvip.toml")
    assert (found.kind, found.facts["name"]) == ("manifest", "llvip")


def test_an_output(tmp_path):
    from fusion.cli.main import app

    write_images(tmp_path / "rgb", 3, lambda k: np.full((32, 40, 3), (1, 50, 99), np.uint8))
    rng = np.random.default_rng(0)
    write_images(tmp_path / "fir", 3, lambda k: rng.integers(7000, 7400, (32, 40)).astype(np.uint16))
    broken = tmp_path / "fir" / f"{START_NS}.png"
    broken.write_bytes(broken.read_bytes()[:60])
    out = tmp_path / "out"
    app(
        ["blend", *(str(tmp_path / s) for s in ("rgb", "fir")), "-o", str(out), "--quiet", "--workers", "1"],
        exit_on_error=False,
        result_action="return_value",
    )
    found = inspect(out, pictures=True)
    assert (found.kind, found.facts["frames"], found.facts["skipped"]) == ("run", 2, 1)
    assert found.facts["files"]["fused"] == 2
    assert found.notes
    assert not found.faults
    assert found.pictures
    next((out / "fused").iterdir()).unlink()
    assert inspect(out).faults == ("1 of 2 frames have no file",)


def test_an_output_of_preprocess_is_no_rosbag2_though_it_holds_an_mcap(tmp_path):
    (tmp_path / "run.toml").write_text('format = "fusion-run/1"\n')
    (tmp_path / "fused.mcap").write_bytes(b"\x89MCAP0\r\n")
    (tmp_path / "lost.csv").write_text("role,reason,count\nfir,no rgb near,2\n")
    stopped = inspect(tmp_path)
    assert stopped.kind == "run"
    assert "same command again" in stopped.faults[0]
    assert stopped.facts["lost"] == ["2 fir: no rgb near"]
    (tmp_path / "frames.csv").write_text(
        "stem,status,rgb_stamp_ns,reason\na,made,5000000000,\nb,failed,,broken\n"
    )
    done = inspect(tmp_path)
    assert not done.faults
    assert (done.facts["frames"], done.facts["skipped"]) == (1, 1)
    assert done.notes == ("skipped 1: broken",)


def test_refused_in_one_line(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "nothing.pcd").write_bytes(b"")
    (tmp_path / "zero.xyz").write_bytes(b"")
    (tmp_path / "what.xyz").write_bytes(b"abc")
    (tmp_path / "deep" / "er").mkdir(parents=True)
    for name, words in {
        "gone.bag": "no such file",
        "empty": "an empty folder",
        "zero.xyz": "an empty file",
        "what.xyz": "a recording",
        "nothing.pcd": "nothing.pcd",
        "deep": "nothing here",
        "a\0b": "",
    }.items():
        with pytest.raises(InputError) as refused:
            inspect(tmp_path / name)
        assert words in str(refused.value), name
        assert "\n" not in str(refused.value)


def test_what_is_refused_says_what_would_not_be(tmp_path):
    with pytest.raises(InputError) as refused:
        inspect(tmp_path)
    for kind in ("rosbag", "radiometric JPEG", "point cloud", "rig.toml", "manifest", "video"):
        assert kind in refused.value.hint


def test_a_url_is_a_recording_or_nothing():
    with pytest.raises(InputError, match="memory://nowhere"):
        inspect("memory://nowhere/flight.mcap")


def test_a_folder_that_leads_to_itself_ends(tmp_path):
    write_images(tmp_path / "a", 1, lambda k: np.zeros((4, 4), np.uint8))
    (tmp_path / "a" / "loop").symlink_to(tmp_path)
    assert [stream.name for stream in inspect(tmp_path).streams] == ["a"]


def test_folders_are_devices_of_their_own():
    assert camera_of("Images/rgb") != camera_of("Images/fir")


# --- real files


def test_real_radiometric_files(shared_data):
    folder = shared_data / "radiometric"
    truth = {"FLIR_AX8": (80, 60), "FLIR_E40": (160, 120), "FLIR_T640": (640, 480)}
    for name, size in truth.items():
        found = inspect(folder / f"{name}.jpg", pictures=True)
        assert found.kind == "radiometric"
        assert tuple(found.facts["thermal_size_wh"]) == size
        low, high = (found.facts["temperature_celsius"][key] for key in ("least", "most"))
        assert -70 < low < high < 200
        assert found.facts["counts"]["most"] > 255
    assert "visible_size_wh" in inspect(folder / "FLIR_AX8.jpg").facts
    assert inspect(folder / "FLIR_E40.jpg").facts["visible_image"] == "none"
    for name in ("H20T", "M2EA", "M30T"):
        found = inspect(folder / name / "DJI_0001_R.JPG")
        assert found.kind == "image"
        assert "DJI" in found.notes[0]
        assert not found.steps
    tiff = inspect(folder / "example_radiometric.tiff")
    assert (tiff.facts["size_wh"], tiff.facts["bits"]) == ([640, 512], 16)
    assert (tiff.facts["values"]["least"], tiff.facts["values"]["most"]) == (6743, 7077)


def test_a_real_folder_of_radiometric_files(shared_data):
    found = inspect(shared_data / "radiometric")
    here = next(stream for stream in found.streams if stream.name == ".")
    assert here.count == 9
    assert here.facts["radiometric"] == 7  # all but DJI_H20T and the TIFF
    assert here.facts["files"] == {"jpg": 8, "tiff": 1}
