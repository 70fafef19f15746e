"""What lies below a root: sequences, calibrations, stamps, partners, each told apart from its neighbours."""

from __future__ import annotations

from pathlib import Path

import pytest

from fusion.errors import InputError, UsageError
from fusion.manifest import Layout, Manifest, load_manifest
from fusion.sync import PairedSources
from tests.dataset_trees import build, from_pattern, write_role

HEAD = """
format = "fusion-dataset/1"
name = "good"
title = "A set"
licence = "CC0"
citation = "Nobody, 2020"
registered = false
registration_note = "two lenses"
"""
IMAGES = '[rgb]\nfiles = "*/rgb/*.png"\n[fir]\nfiles = "*/fir/*.png"\n'
PAIRED = '[pairing]\nby = "stem"\nrgb_key = "(.*)/rgb/(.*)"\nfir_key = "(.*)/fir/(.*)"\n'


def manifest(folder: Path, *tables: str) -> Manifest:
    path = folder / "good.toml"
    path.write_text("\n".join([HEAD, *tables]), encoding="utf-8")
    return load_manifest(path)


def touch(root: Path, *names: str) -> None:
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(b"x")


def files_of(layout: Layout, role: str) -> list[str]:
    return [path.relative_to(layout.root).as_posix() for path in layout[role].files]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    (tmp_path / "root").mkdir()
    return tmp_path / "root"


# --- roles


def test_files_are_of_their_kind_in_natural_order(tmp_path: Path, root: Path) -> None:
    made = manifest(tmp_path, '[rgb]\nfiles = "rgb/*"\n[lidar]\nfiles = "scan/*"\n')
    touch(root, "rgb/f10.png", "rgb/f2.png", "rgb/.f3.png", "rgb/Thumbs.db", "scan/f2.bin", "scan/notes.txt")
    layout = made.plan(root)
    assert files_of(layout, "rgb") == ["rgb/f2.png", "rgb/f10.png"]
    assert files_of(layout, "lidar") == ["scan/f2.bin"]
    assert layout.lead == "rgb"
    assert layout.missing == ()


def test_a_folder_with_files_of_another_kind_only_lacks_the_role(tmp_path: Path, root: Path) -> None:
    made = manifest(tmp_path, '[rgb]\nfiles = "rgb/*"\n[fir]\nfiles = "fir/*"\n')
    touch(root, "rgb/1.png", "fir/1.txt")
    with pytest.raises(InputError, match="no fir image matches 'fir/\\*'"):
        made.plan(root)


def test_clouds_and_depth_may_be_missing_and_thermal_may_not(tmp_path: Path, root: Path) -> None:
    more = '[lidar]\nfiles = "*/scan/*.bin"\n[depth]\nfiles = "*/depth/*.png"\nper_metre = 256.0\n'
    made = manifest(tmp_path, IMAGES, more, PAIRED)
    touch(root, "a/rgb/1.png", "a/fir/1.png", "a/depth/1.png")
    layout = made.plan(root)
    assert layout.missing == ("lidar",)
    assert set(layout.roles) == {"rgb", "fir", "depth"}
    assert (layout["depth"].per_metre, layout["depth"].value) == (256.0, "depth")
    (root / "a" / "fir" / "1.png").unlink()
    with pytest.raises(InputError, match="no fir image matches"):
        made.plan(root)


def test_stems_count_from_the_fixed_part_whatever_the_root_is_called(tmp_path: Path) -> None:
    """Without keys, names pair by stems below the pattern's fixed part: `vi` and `ir` are not in them."""
    made = manifest(tmp_path, '[rgb]\nfiles = "vi/*.png"\n[fir]\nfiles = "ir/*.png"\n')
    for name in ("root", "my [set] *"):
        touch(tmp_path / name, "vi/1.png", "ir/1.png", "vi/2.png")
        partners = made.plan(tmp_path / name).partners("fir")
        assert partners.by_lead() == {tmp_path / name / "vi" / "1.png": tmp_path / name / "ir" / "1.png"}
        assert [u.reason for u in partners.pairing.unmatched] == ["no thermal image with key '2'"]


@pytest.mark.parametrize(
    ("tables", "said"),
    [
        ("", "expected files"),
        ('[rgb]\nfiles = "a/*.png"\n', "RGB alone fuses nothing"),
        ('[fir]\nfiles = "a/*.png"\n', "or .rgbt. alone"),
        ('[fir]\nfiles = "a/*.png"\n[lidar]\nfiles = "b/*.bin"\n', "or .rgbt. alone"),
        ('[lidar]\nfiles = "b/*.bin"\n[pairing]\nby = "stem"\n', "nothing to pair"),
        ('[lidar]\nfiles = "b/*.bin"\nform = "x y"\n', "lidar.form"),
        ('[lidar]\nfiles = "b/*.bin"\n[lidar.pairing]\nby = "map"\n', "lidar.pairing.by"),
        ('[lidar]\nfiles = "b/*.bin"\n[lidar.pairing]\nlead_key = "("\n', "no regular expression"),
        ('[lidar]\nfiles = "b/*.bin"\n[lidar.pairing]\ntolerance_ms = 3.0\n', "by stamp only"),
        ('[depth]\nfiles = "b/*.png"\n', "depth.per_metre"),
        ('[depth]\nfiles = "b/*.png"\nper_metre = 0.0\n', "depth.per_metre"),
        ('[depth]\nfiles = "b/*.png"\nper_metre = 1.0\nvalue = "height"\n', "depth.value"),
        (IMAGES + '[recording]\nfiles = "*.bag"\n[recording.topics]\nrgb = "/a"\n', "no files by role"),
        ('[recording]\nfiles = "*.bag"\n[recording.topics]\n', "name one at least"),
        ('[recording]\nfiles = "*.bag"\n[recording.topics]\nrgb_info = "/a"\n', "name one at least"),
        ('[recording]\nfiles = "*.bag"\n[recording.topics]\nrgb = "/a b"\n', "recording.topics.rgb"),
        (
            '[recording]\nfiles = "*.bag"\ntolerance_ms = {fir = 1.0}\n[recording.topics]\nrgb = "/a"\n',
            "a role that has no topic",
        ),
        (IMAGES + '[calibration]\nfiles = "a.npy"\n', "note must say why"),
        (IMAGES + '[calibration]\nfiles = "a.npy"\nform = "pickle"\n', "calibration.form"),
        (IMAGES + "[thermal]\ncelsius_per_count = 0.1\n", "go together"),
        (IMAGES.replace(".png", '.png"\nstamps = "name"\nstamp_files = "a.txt', 1), "give one"),
        (IMAGES.replace(".png", '.png"\nbayer = "rgbw', 1), "rgb.bayer"),
        (IMAGES + "[checks.counts]\nfrogs = 3\n", "frogs"),
    ],
)
def test_what_cannot_be_is_refused(tmp_path: Path, tables: str, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        manifest(tmp_path, tables)


@pytest.mark.parametrize(
    ("top", "said"),
    [
        ("paired = false\n", "go together"),
        ('unpaired_note = "x"\n', "go together"),
        ('paired = false\nunpaired_note = "x"\nregistered = true\n', "is not registered"),
    ],
)
def test_a_set_that_is_not_paired_must_say_why(tmp_path: Path, top: str, said: str) -> None:
    head = HEAD.replace("registered = false\n", "") if "registered" in top.split("note")[-1] else HEAD
    path = tmp_path / "good.toml"
    path.write_text(head + top + IMAGES, encoding="utf-8")
    with pytest.raises(UsageError, match=said):
        load_manifest(path)


BAD_PATHS = [
    "/etc/x",
    "../x",
    "a/../b",
    "C:/x",
    "a\\\\b",
    "~/x",
    "./a",
    "a//b",
    "**/a",
    "{a,b}/c",
    "a\\u0000b",
]
PLACES = {
    "rgb.files": '[rgb]\nfiles = "{}"\n[lidar]\nfiles = "b/*.bin"\n',
    "rgb.stamp_files": '[rgb]\nfiles = "a/*.png"\nstamp_files = "{}"\n[lidar]\nfiles = "b/*.bin"\n',
    "lidar.files": '[lidar]\nfiles = "{}"\n',
    "depth.files": '[depth]\nfiles = "{}"\nper_metre = 256.0\n',
    "sparse.files": '[sparse]\nfiles = "{}"\nper_metre = 256.0\n',
    "rgbt.files": '[rgbt]\nfiles = "{}"\n',
    "recording.files": '[recording]\nfiles = "{}"\n[recording.topics]\nrgb = "/a"\n',
    "calibration.files": IMAGES + '[calibration]\nfiles = "{}"\nform = "rig"\n',
    "pairing.map_file": IMAGES + '[pairing]\nby = "map"\nmap_file = "{}"\n',
}


@pytest.mark.parametrize("place", PLACES)
def test_no_path_of_a_manifest_leads_out_of_the_root(tmp_path: Path, place: str) -> None:
    for bad in BAD_PATHS:
        with pytest.raises(UsageError, match=place.replace(".", r"\.")):
            manifest(tmp_path, PLACES[place].replace("{}", bad))


@pytest.mark.parametrize(
    "linked", ["a/rgb/2.png", "a/scan/1.bin", "a/calib.yaml", "a/rgb/times.txt", "a/b.bag"]
)
def test_no_link_of_any_role_leads_out_of_the_root(tmp_path: Path, root: Path, linked: str) -> None:
    tables = [
        '[rgb]\nfiles = "*/rgb/*.png"\nstamp_files = "*/rgb/times.txt"\n[lidar]\nfiles = "*/scan/*.bin"\n',
        '[calibration]\nfiles = "*/calib.yaml"\nform = "ros"\nper = "sequence"\n',
    ]
    if linked.endswith(".bag"):
        tables = ['[recording]\nfiles = "*/*.bag"\n[recording.topics]\nrgb = "/a"\n']
    touch(root, "a/rgb/1.png", "a/rgb/times.txt", "a/other.bag", "a/scan/0.bin")
    (root / linked).unlink(missing_ok=True)
    touch(tmp_path, "outside")
    (root / linked).symlink_to(tmp_path / "outside")
    with pytest.raises(InputError, match="leads out of the data set's root"):
        manifest(tmp_path, *tables).plan(root)


# --- sequences and calibrations


def test_sequences_are_the_folders_that_the_pattern_leaves_open(tmp_path: Path, root: Path) -> None:
    made = manifest(tmp_path, '[rgb]\nfiles = "x/set*/V?/rgb/*.png"\n[lidar]\nfiles = "s/*.bin"\n')
    touch(root, "x/set00/V0/rgb/1.png", "x/set00/V1/rgb/1.png", "s/1.bin")
    layout = made.plan(root)
    assert [layout.sequence_of(path) for path in layout["rgb"].files] == ["set00/V0", "set00/V1"]


def test_one_calibration_covers_everything(tmp_path: Path, root: Path) -> None:
    made = manifest(tmp_path, IMAGES, PAIRED, '[calibration]\nfiles = "calib/rig.toml"\nform = "rig"\n')
    touch(root, "a/rgb/1.png", "a/fir/1.png", "calib/rig.toml")
    layout = made.plan(root)
    assert layout.calibration_of(layout["rgb"].files[0]) == root / "calib" / "rig.toml"


def test_a_calibration_a_sequence_covers_the_folders_of_its_wildcards(tmp_path: Path, root: Path) -> None:
    """`a` has its own; `ab`, which begins with the same letter, has another; `c` has none."""
    part = '[calibration]\nfiles = "*/calib/cams.yaml"\nform = "kalibr"\nper = "sequence"\n'
    made = manifest(tmp_path, IMAGES, PAIRED, part)
    for name in ("a", "ab", "c"):
        touch(root, f"{name}/rgb/1.png", f"{name}/fir/1.png")
    touch(root, "a/calib/cams.yaml", "ab/calib/cams.yaml")
    layout = made.plan(root)
    found = [layout.calibration_of(path) for path in layout["rgb"].files]
    assert found == [root / "a" / "calib" / "cams.yaml", root / "ab" / "calib" / "cams.yaml", None]
    assert layout.calibration is not None
    assert layout.calibration.readable() == layout.calibration.files


def test_kitti_raw_hands_over_the_dates_folder(tmp_path: Path) -> None:
    layout = load_manifest("kitti_raw")
    build(layout, tmp_path)
    plan = layout.plan(tmp_path)
    assert [plan.calibration_of(path) for path in plan["rgb"].files] == [
        tmp_path / "0", tmp_path / "0", tmp_path / "1", tmp_path / "1"
    ]  # fmt: skip
    assert plan.calibration is not None
    assert plan.calibration.readable() == (tmp_path / "0", tmp_path / "1")


def test_kitti_object_has_one_calibration_a_frame(tmp_path: Path) -> None:
    made = load_manifest("kitti_object")
    build(made, tmp_path)
    plan = made.plan(tmp_path)
    for path in plan["rgb"].files:
        assert plan.calibration_of(path) == tmp_path / "training" / "calib" / f"{path.stem}.txt"
    plan["rgb"].files[1].rename(plan["rgb"].files[1].with_stem("another"))
    assert made.plan(tmp_path).calibration_of(plan["rgb"].files[1].with_stem("another")) is None


def test_several_ros_files_of_one_folder_are_handed_over_as_the_folder(tmp_path: Path, root: Path) -> None:
    made = manifest(tmp_path, IMAGES, PAIRED, '[calibration]\nfiles = "c/*.yaml"\nform = "ros"\n')
    touch(root, "a/rgb/1.png", "a/fir/1.png", "c/rgb.yaml", "c/fir.yaml")
    layout = made.plan(root)
    assert layout.calibration_of(layout["rgb"].files[0]) == root / "c"
    (root / "c" / "fir.yaml").unlink()
    assert made.plan(root).calibration_of(layout["rgb"].files[0]) == root / "c" / "rgb.yaml"


def test_a_calibration_in_an_unread_form_is_never_handed_over(tmp_path: Path) -> None:
    made = load_manifest("ms2")
    build(made, tmp_path)
    plan = made.plan(tmp_path)
    assert plan.calibration is not None
    assert len(plan.calibration.files) == 2
    assert plan.calibration.readable() == ()
    assert plan.calibration_of(plan["rgb"].files[0]) is None
    assert "never read" in (plan.calibration.note or "")


# --- stamps and partners


def test_stamp_files_reach_images_pairs_and_clouds(tmp_path: Path, root: Path) -> None:
    """Thermal comes 10 ms after RGB and lacks frame 1: paired in time, with the lines' own stamps."""
    tables = """
[rgb]
files = "*/rgb/data/*.png"
stamp_files = "*/rgb/timestamps.txt"
[fir]
files = "*/fir/data/*.png"
stamp_files = "*/fir/timestamps.txt"
[pairing]
by = "stamp"
tolerance_ms = 15.0
"""
    made = manifest(tmp_path, tables)
    for k in (0, 1, 2):
        write_role(root / "s" / "rgb" / "data" / f"{k:06d}.png", made, "rgb", k)
    for k in (0, 2):
        write_role(root / "s" / "fir" / "data" / f"{k:06d}.png", made, "fir", k)
    (root / "s" / "rgb" / "timestamps.txt").write_text("100.0\n100.1\n100.2\n")
    (root / "s" / "fir" / "timestamps.txt").write_text("100.01\n100.11\n100.21\n")
    layout = made.plan(root)
    partners = layout.partners("fir")
    assert [(i, j, dt) for i, j, dt in partners.pairing.pairs] == [(0, 0, 10_000_000), (2, 1, 10_000_000)]
    rule = layout["fir"].rule
    assert rule is not None
    pairs = PairedSources(layout.open("rgb"), layout.open("fir"), rule)
    frames = pairs.read(1)
    assert (frames.rgb.stamp_ns, frames.fir.stamp_ns) == (100_200_000_000, 100_210_000_000)


def test_stamp_files_that_are_not_there_or_not_readable_are_told(tmp_path: Path, root: Path) -> None:
    made = manifest(tmp_path, IMAGES.replace(".png", '.png"\nstamp_files = "*/rgb/times.txt', 1), PAIRED)
    touch(root, "a/rgb/1.png", "a/fir/1.png")
    with pytest.raises(InputError, match=r"no file of time stamps matches '\*/rgb/times\.txt'"):
        made.plan(root)
    touch(root, "a/rgb/times.txt")
    with pytest.raises(InputError, match=r"times\.txt line 1: 'x' is no time"):
        made.plan(root).partners("fir")


def test_reasons_speak_of_clouds_and_depth_not_of_thermal(tmp_path: Path, root: Path) -> None:
    tables = '[rgb]\nfiles = "rgb/*.png"\n[lidar]\nfiles = "s/*.bin"\n'
    made = manifest(tmp_path, tables, '[sparse]\nfiles = "p/*.png"\nper_metre = 1.0\n')
    touch(root, "rgb/1.png", "rgb/2.png", "s/1.bin", "s/3.bin", "p/2.png")
    layout = made.plan(root)
    lidar = layout.partners("lidar").pairing.unmatched
    assert [u.reason for u in lidar] == ["no cloud with key '2'", "no RGB image with key '3'"]
    (sparse,) = layout.partners("sparse").pairing.unmatched
    assert sparse.reason == "no sparse depth map with key '1'"
    (root / "p" / "2.png").rename(root / "p" / "x.png")
    with pytest.raises(InputError, match=r"no pair by stem among 2 RGB .* and 1 sparse depth maps"):
        made.plan(root).partners("sparse")


def test_images_that_do_not_pair_have_no_rule(tmp_path: Path) -> None:
    made = load_manifest("flir_adas_v2_images")
    build(made, tmp_path)
    layout = made.plan(tmp_path)
    assert layout["fir"].rule is None
    assert load_manifest("msrs").pairing_rule(tmp_path).by == "stem"


def test_mosaics_are_opened_in_colour(tmp_path: Path) -> None:
    made = load_manifest("sthereo")
    build(made, tmp_path)
    layout = made.plan(tmp_path)
    assert layout["rgb"].bayer == "bggr"
    assert layout.open("rgb").read(0).flags == ("rgb-demosaiced",)


# --- recordings


def test_recordings_are_files_or_folders_with_topics_clock_and_tolerances(tmp_path: Path, root: Path) -> None:
    tables = """
[recording]
files = "*/rec*"
stamp = "log"
[recording.topics]
rgb = "/cam"
fir = "/thermal"
fir_info = "/thermal/info"
[recording.tolerance_ms]
fir = 12.5
"""
    made = manifest(tmp_path, tables)
    touch(root, "a/rec_10.mcap", "a/rec_2.mcap", "b/rec_1/metadata.yaml", "b/.rec.mcap")
    recording = made.plan(root).recording
    assert recording is not None
    assert [path.relative_to(root).as_posix() for path in recording.files] == [
        "a/rec_2.mcap", "a/rec_10.mcap", "b/rec_1"
    ]  # fmt: skip
    assert recording.topics == {"rgb": "/cam", "fir": "/thermal", "fir_info": "/thermal/info"}
    assert recording.stamp == "log"
    assert recording.tolerance_ns == {"fir": 12_500_000}
    assert made.state == "unregistered"
    assert made.lead() == "rgb"
    with pytest.raises(InputError, match="fusion preprocess good ROOT"):
        made.globs(root)


def test_a_recordings_calibration_is_found_by_its_folder(tmp_path: Path, root: Path) -> None:
    tables = '[recording]\nfiles = "*/a.bag"\n[recording.topics]\nlidar = "/s"\n'
    part = '[calibration]\nfiles = "*/rig.toml"\nform = "rig"\nper = "sequence"\n'
    made = manifest(tmp_path, tables, part)
    touch(root, "x/a.bag", "x/rig.toml", "y/a.bag")
    layout = made.plan(root)
    assert layout.recording is not None
    assert [layout.calibration_of(path) for path in layout.recording.files] == [root / "x" / "rig.toml", None]
    assert made.state == "lidar only"


def test_the_template_of_recordings_finds_its_bags(root: Path) -> None:
    made = load_manifest("template_recording")
    touch(root, from_pattern("flight_*/*.bag", 0), "rig.toml", "notes.bag")
    layout = made.plan(root)
    assert layout.recording is not None
    assert len(layout.recording.files) == 1
    assert layout.calibration_of(layout.recording.files[0]) == root / "rig.toml"
