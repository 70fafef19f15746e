"""Radiometric JPEGs as inputs: one folder that is a whole data set, or the thermal side of two."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fusion.errors import FrameError, InputError
from fusion.radiometric import read_flir
from fusion.sources import open_source
from fusion.sources.radiometric import common_planck, is_radiometric, open_radiometric_files
from fusion.sync import PairedChannels, PairedRadiometric, PairedSources, open_pairs, open_radiometric
from tests.radiometric import flirfile as made

SCENE, STAMP = made.scene(), 1_500_000_000_123_000_000


def visible_only() -> bytes:
    record = (made.EMBEDDED, made.image_record(made.jpg(SCENE), (48, 36)))
    return made.jpeg(made.parts(made.block([(made.CAMERA, made.camera_record()), record])))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two pairs, and one file of every kind that is none."""
    files = {
        "IR_10.jpg": made.flir_jpeg(made.ramp(start=9000), SCENE, stamp_ns=STAMP),
        "IR_2.JPG": made.flir_jpeg(made.ramp(start=15000), SCENE),
        "blind.jpg": made.flir_jpeg(),
        "DC_1.jpg": visible_only(),
        "plain.jpg": made.jpg(SCENE),
        "dji.jpg": made.dji_jpeg(),
        "mask.png": made.png(SCENE),
        "notes.txt": b"x",
    }
    place = tmp_path / "flir"
    place.mkdir()
    for name, data in files.items():
        (place / name).write_bytes(data)
    return place


@pytest.mark.parametrize("form", ["folder", "glob", "file"])
def test_one_folder_is_a_set_of_pairs(folder: Path, form: str) -> None:
    spec = {"folder": folder, "glob": f"{folder}/*", "file": folder / "IR_10.jpg"}[form]
    pairs = open_pairs(spec)
    assert isinstance(pairs, PairedRadiometric)
    stems = ["IR_10"] if form == "file" else ["IR_2", "IR_10"]
    assert [pairs.stems(index) for index in range(len(pairs))] == [(stem, stem) for stem in stems]
    frames = pairs.read(len(pairs) - 1)
    assert np.array_equal(frames.counts, made.ramp(start=9000))
    assert np.array_equal(pairs.read_fir(len(pairs) - 1).pixels, frames.counts)
    assert np.abs(frames.bgr.astype(int) - SCENE).mean() < 2
    assert frames.rgb.stamp_ns == frames.fir.stamp_ns == STAMP
    assert frames.dt_ns == 0
    assert frames.fir.flags == ("fir-radiometric",)
    assert pairs.fir_files[-1] == str(folder / "IR_10.jpg")
    assert pairs.changed_ns(len(pairs) - 1) == (folder / "IR_10.jpg").stat().st_mtime_ns


def test_files_that_are_no_pair_are_named_with_their_reason(folder: Path) -> None:
    pairing = open_radiometric(folder).pairing
    left = {Path(lost.where).name: (lost.role, lost.reason) for lost in pairing.unmatched}
    assert left.keys() == {"blind.jpg", "DC_1.jpg", "plain.jpg", "dji.jpg", "mask.png"}
    assert left["blind.jpg"] == ("fir", "no visible image in it")
    assert left["DC_1.jpg"][0] == left["plain.jpg"][0] == left["mask.png"][0] == "rgb"
    assert "no thermal counts" in left["DC_1.jpg"][1]
    assert left["dji.jpg"][0] == "fir"
    assert "DJI's own" in left["dji.jpg"][1]
    assert open_radiometric(folder).ignored == 1
    summary = pairing.summary()
    assert (summary.n_pairs, summary.n_rgb, summary.n_fir) == (2, 5, 4)
    assert summary.dt_max_ms == 0  # of one file, whatever its clock says
    assert any("not registered" in note for note in pairing.notes)


def test_a_folder_without_a_single_pair_says_what_to_do(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(made.flir_jpeg())
    (tmp_path / "b.jpg").write_bytes(made.dji_jpeg())
    with pytest.raises(InputError, match=r"none of 2 .*a.jpg: no visible image.*two sources"):
        open_pairs(tmp_path)


def test_a_damaged_file_stays_in_and_fails_when_read(folder: Path) -> None:
    data = (folder / "IR_2.JPG").read_bytes()
    (folder / "IR_2.JPG").write_bytes(data[:1500])
    (folder / "IR_3.jpg").symlink_to(folder / "nowhere.jpg")
    pairs = open_radiometric(folder)
    assert [pairs.stems(index)[0] for index in range(len(pairs))] == ["IR_2", "IR_3", "IR_10"]
    with pytest.raises(FrameError, match=r"IR_2.JPG: .*parts of its FLIR data are missing"):
        pairs.read(0)
    with pytest.raises(FrameError, match="cannot be read"):
        pairs.read_fir(1)
    assert pairs.read(2).stem == "IR_10"


def test_what_is_no_radiometric_folder_stays_what_it_was(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(made.png(np.zeros((4, 5, 4), np.uint8)))
    assert not is_radiometric(tmp_path)
    assert isinstance(open_pairs(tmp_path), PairedChannels)
    with pytest.raises(InputError, match="no images found"):
        open_radiometric_files(tmp_path / "nowhere")
    (tmp_path / "a.png").rename(tmp_path / "a.txt")
    (tmp_path / "b.jpg").write_bytes(made.jpg(SCENE))
    with pytest.raises(FrameError, match=r"found 3 .*radiometric JPEGs"):
        open_pairs(tmp_path).read(0)


def test_the_thermal_side_of_two_folders_reads_counts(folder: Path, tmp_path: Path) -> None:
    rgb = tmp_path / "rgb"
    rgb.mkdir()
    for stem in ("IR_10", "IR_2", "blind", "DC_1", "dji", "plain"):
        (rgb / f"{stem}.png").write_bytes(made.png(SCENE))
    pairs = open_pairs(rgb, folder)
    assert isinstance(pairs, PairedSources)
    read = {pairs.stems(index)[1]: index for index in range(len(pairs))}
    for stem, start in (("IR_10", 9000), ("IR_2", 15000), ("blind", 12000)):
        image = pairs.read(read[stem]).fir
        assert np.array_equal(image.pixels, made.ramp(start=start))
        assert image.flags == ("fir-radiometric",)
    for stem, words in (("DC_1", "no thermal counts"), ("dji", "DJI's own"), ("plain", "coloured")):
        with pytest.raises(FrameError, match=words):
            pairs.read_fir(read[stem])
    assert str(folder / "blind.jpg") in pairs.fir_files


def test_the_limit_of_pixels_holds_for_counts(folder: Path) -> None:
    for source in (
        open_source(folder / "blind.jpg", "fir", max_pixels=100),
        open_radiometric_files(folder, max_pixels=100),
    ):
        with pytest.raises(FrameError, match="claim 32 x 24 pixels"):
            source.read(0)


def test_luma_asks_for_pictures_but_counts_stay_counts(folder: Path) -> None:
    source = open_source(folder, "fir", fir_colour="luma")
    by_stem = {entry.stem: source.read(k) for k, entry in enumerate(source.entries) if entry.stem != "DC_1"}
    assert by_stem["blind"].pixels.dtype == np.uint16
    assert by_stem["dji"].flags == by_stem["plain"].flags == ("fir-colour-to-luma",)


def test_the_rgb_side_gets_the_picture_and_says_what_it_is(folder: Path) -> None:
    source = open_source(folder, "rgb")
    flags = {entry.stem: source.read(k).flags for k, entry in enumerate(source.entries)}
    assert flags["IR_10"] == flags["blind"] == ("rgb-thermal-preview",)
    assert flags["plain"] == flags["DC_1"] == ()


def test_one_scale_of_degrees_for_all_files(folder: Path) -> None:
    pairs = open_radiometric(folder)
    planck = common_planck(pairs.fir_files)
    assert planck == read_flir(made.flir_jpeg(), "").planck
    (folder / "IR_3.jpg").write_bytes(b"\xff\xd8 damaged")  # passed over: its frame says why
    assert common_planck([*pairs.fir_files, str(folder / "IR_3.jpg")]) == planck
    (folder / "IR_3.jpg").write_bytes(made.flir_jpeg(emissivity=0.8))
    with pytest.raises(InputError, match=r"emissivity is 0.95 in .*IR_2.JPG, 0.8 in .*IR_3.jpg"):
        common_planck([*pairs.fir_files, str(folder / "IR_3.jpg")])
    with pytest.raises(InputError, match=r"no thermal file tells degrees .*a plain JPEG"):
        common_planck([str(folder / "plain.jpg")])
    assert replace(planck, emissivity=0.8).counts_at(30) != planck.counts_at(30)
