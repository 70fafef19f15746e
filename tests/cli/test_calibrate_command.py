"""`fusion calibrate` as a user meets it: a small simulated session, its truth, and bad input in one line."""

from __future__ import annotations

import hashlib
import math
import re
import shutil
import tomllib
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from io import StringIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.boards import load_board
from fusion.cli.main import main
from fusion.clouds import read_cloud
from fusion.geometry import invert
from fusion.rig import Rig, load_rig, save_rig
from tests.cli.conftest import Answer
from tests.cli.test_blend_command import one_line
from tests.worlds import read, tree, write

Fusion = Callable[..., Answer]
POSES = 9
SMALL = """\
format = "fusion-mine/1"
truth = false
[board]
cols = 7
rows = 5
square_m = 0.1
distance_m = [0.9, 2.2]
[rgb.camera]
size_wh = [320, 240]
fov_deg = 84
distortion = [-0.19, 0.035, 0.0004, -0.0003, 0.0]
[thermal.camera]
size_wh = [320, 256]
fov_deg = 68
distortion = [-0.24, 0.07, -0.0005, 0.0006, 0.0]
[lidar]
columns = 512
"""
BOARD = """\
format = "fusion-board/1"
kind = "chessboard"
cols = 7
rows = 5
spacing_m = 0.1
plate_m = [-0.15, -0.15, 0.75, 0.55]
"""


def run(*words: object) -> Answer:
    """As the fixture `fusion`, for fixtures that serve a whole module."""
    out, err = StringIO(), StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err):
        patch.setattr("sys.argv", ["fusion", *map(str, words)])
        with pytest.raises(SystemExit) as ended:
            main()
    assert isinstance(ended.value.code, int)
    return Answer(ended.value.code, out.getvalue(), err.getvalue())


@dataclass(frozen=True)
class World:
    """A session, and what the three commands made of it."""

    folder: Path
    stereo: Answer
    lidar: Answer

    @property
    def board(self) -> Path:
        return self.folder / "board.toml"

    @property
    def cameras(self) -> Path:
        return self.folder / "cameras.toml"

    @property
    def rig(self) -> Path:
        return self.folder / "rig.toml"

    def files(self, kind: str) -> list[Path]:
        return sorted((self.folder / kind).iterdir())

    def truth(self) -> Rig:
        return load_rig(self.folder / "truth/rig.toml")


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> World:
    folder = tmp_path_factory.mktemp("session") / "s"
    config = folder.with_name("small.toml")
    config.write_text(SMALL)
    made = run("simulate", "session", folder, "--poses", POSES, "--config", config)
    assert made.code == 0, made.err
    (folder / "board.toml").write_text(BOARD)
    rgb, fir, lidar, board = (folder / name for name in ("rgb", "fir", "lidar", "board.toml"))
    cameras, out = folder / "cameras.toml", folder / "rig.toml"
    stereo = run("calibrate", "stereo", rgb, fir, "--board", board, "-o", cameras, "--no-report")
    joint = ["--fir", fir, "--board", board, "--rig", cameras, "-o", out]
    return World(folder, stereo, run("calibrate", "lidar", rgb, lidar, *joint))


@pytest.fixture
def bench(world: World, tmp_path: Path) -> Bench:
    """A folder to work in, with what was found of the session's images already."""
    shutil.copytree(world.folder / ".detections", tmp_path / ".detections")
    return Bench(world, tmp_path)


@dataclass(frozen=True)
class Bench:
    world: World
    folder: Path

    @property
    def out(self) -> Path:
        return self.folder / "out.toml"

    def copy(self, name: str, files: Sequence[Path], names: Sequence[str] | None = None) -> Path:
        """A folder with copies of files, renamed."""
        (self.folder / name).mkdir()
        for k, file in enumerate(files):
            shutil.copy(file, self.folder / name / (names[k] if names else file.name))
        return self.folder / name

    def drawn(self, name: str, kind: str, change: Callable[[Any], Any], every: int = 1) -> Path:
        """A folder with images of the session, each `every`th changed."""
        made = self.copy(name, self.world.files(kind))
        for path in sorted(made.iterdir())[::every]:
            write(path, change(read(path)))
        return made

    def clouds(self, name: str, change: Callable[[Any], Any]) -> Path:
        (self.folder / name).mkdir()
        for path in self.world.files("lidar"):
            np.save(self.folder / name / f"{path.stem}.npy", change(read_cloud(path).xyz_m.copy()))
        return self.folder / name

    def stereo(self, *options: object, rgb: Path | None = None, fir: Path | None = None) -> list[object]:
        rgb, fir = rgb or self.world.folder / "rgb", fir or self.world.folder / "fir"
        return ["stereo", rgb, fir, "--board", self.world.board, *self.rest(), *options]

    def one(self, images: Path, *options: object) -> list[object]:
        return ["intrinsics", images, "--board", self.world.board, *self.rest(), *options]

    def lidar(self, clouds: Path | None, *options: object) -> list[object]:
        rgb, clouds = self.world.folder / "rgb", clouds or self.world.folder / "lidar"
        board = [] if "--points" in options else ["--board", self.world.board]
        rig = [] if "--rig" in options else ["--rig", self.world.cameras]
        return ["lidar", rgb, clouds, *board, *rig, *self.rest(), *options]

    def rest(self) -> list[object]:
        return ["-o", self.out, "--no-report", "--quiet"]


def turned_rad(A: Any, B: Any) -> float:
    return float(Rotation.from_matrix(np.asarray(A)[:3, :3].T @ np.asarray(B)[:3, :3]).magnitude())


# --- from board images to a rig


def test_three_commands_find_the_truth(world: World) -> None:
    """Three times the figures that are asked of ideal corners, of 9 views instead of 30."""
    assert world.stereo.code == 0, world.stereo.err
    assert world.lidar.code == 0, world.lidar.err
    truth, few = world.truth(), math.sqrt(30 / POSES)
    for path, bounds in ((world.cameras, {"fir": (1.5e-3, 3e-3)}),
                         (world.rig, {"fir": (1.5e-3, 3e-3), "lidar": (3e-3, 15e-3)})):  # fmt: skip
        found = load_rig(path)
        for name, camera in found.cameras.items():
            true = truth.camera(name)
            assert camera.size_wh == true.size_wh
            np.testing.assert_allclose((camera.fx, camera.fy), (true.fx, true.fy), rtol=4.5e-3 * few)
            np.testing.assert_allclose((camera.cx, camera.cy), (true.cx, true.cy), atol=3 * few)
        assert set(found.transforms) == {f"T_rgb_{name}" for name in bounds}
        for name, (turn, shift) in bounds.items():
            T, T_true = found.pose("rgb", name), truth.pose("rgb", name)
            assert turned_rad(T, T_true) < few * turn, name
            assert np.linalg.norm(T[:3, 3] - T_true[:3, 3]) < few * shift, name


def test_what_the_commands_say(world: World) -> None:
    assert f"rgb: the board in {POSES} of {POSES} images\n" in world.stereo.out
    assert f"rgb-fir: {POSES} shared" in world.stereo.out
    assert f"fir: the board in {POSES} of {POSES} images, {POSES} as found before" in world.lidar.out
    assert "refined with the rest" in world.lidar.out
    assert re.search(r"^loop of three +\d+\.\d+ +\d+\.\d", world.lidar.out, re.MULTILINE)
    for answer in (world.stereo, world.lidar):
        assert re.search(r"^verdict: (good|usable)", answer.out, re.MULTILINE)
        assert f"next: rgb: {POSES} views are few" in answer.out
        assert all(line.startswith("fusion: warning: ") for line in answer.err.splitlines())
    assert "lidar to rgb" in world.lidar.out


def test_the_rig_carries_its_evidence(world: World) -> None:
    evidence = tomllib.loads(world.rig.read_text())["evidence"]
    assert evidence["verdict"] in world.lidar.out
    files = [p for kind in ("rgb", "fir", "lidar") for p in world.files(kind)]
    hashes = {entry["file"]: entry["sha256"] for entry in evidence["inputs"]}
    assert hashes == {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in files}
    names, matrix = evidence["covariance"]["names"], np.array(evidence["covariance"]["matrix"])
    assert {"rgb.fx", "fir.cy", "T_rgb_fir.rx", "T_rgb_lidar.tz"} <= set(names)
    assert matrix.shape == (len(names), len(names))
    assert np.linalg.eigvalsh(matrix).min() > 0
    for name in ("rgb", "fir"):
        figures = evidence["cameras"][name]
        assert figures["views"] <= POSES
        assert 0 < figures["rms_px"] < 0.35
        assert 0 < figures["held_out_px"] < 0.5
    assert evidence["board"]["spacing_m"] == 0.1


def test_the_stated_uncertainty_is_of_the_size_of_the_error(world: World) -> None:
    """Not more than five standard deviations off along any axis of the thermal camera's place."""
    evidence = tomllib.loads(world.rig.read_text())["evidence"]["covariance"]
    at = [evidence["names"].index(f"T_rgb_fir.t{axis}") for axis in "xyz"]
    covariance = np.array(evidence["matrix"])[np.ix_(at, at)]
    off = load_rig(world.rig).pose("rgb", "fir")[:3, 3] - world.truth().pose("rgb", "fir")[:3, 3]
    assert off @ np.linalg.solve(covariance, off) < 5**2 * 3


def test_the_report_stands_alone_and_no_report_leaves_none(world: World) -> None:
    page = (world.folder / "rig_evidence/report.html").read_text()
    pictures = re.findall(r'src="data:image/(png|jpeg);base64,', page)
    assert len(pictures) >= 9
    assert "http" not in page
    for words in ("thermal edges on RGB", "T_rgb_lidar.rx", "how far lidar may land off on rgb"):
        assert words in page
    assert not (world.folder / "cameras_evidence").exists()


def test_the_rig_blends_as_the_truth_does(fusion: Fusion, world: World, tmp_path: Path) -> None:
    """At the distance of the boards, beside a rig that is two degrees wrong."""
    wrong = load_rig(world.rig)
    wrong.transforms["T_rgb_fir"][:3, :3] @= Rotation.from_euler("y", 2, degrees=True).as_matrix()
    save_rig(tmp_path / "wrong.toml", wrong)
    fused = {}
    for name, rig in (
        ("truth", world.folder / "truth/rig.toml"),
        ("rig", world.rig),
        ("wrong", tmp_path / "wrong.toml"),
    ):
        words = [world.folder / "rgb", world.folder / "fir", "-o", tmp_path / name, "--quiet", "--rig", rig]
        answer = fusion("blend", *words, "--distance", 2, "--tolerance-ms", 50)
        assert answer.code == 0, answer.err
        fused[name] = np.stack([read(p).astype(float) for p in sorted((tmp_path / name / "fused").iterdir())])
    assert len(fused["rig"]) == POSES
    off, wrongly = (np.abs(fused[name] - fused["truth"]).mean() for name in ("rig", "wrong"))
    assert off < 0.5
    assert wrongly > 5 * off


def test_a_check_finds_nothing_wrong_with_it(fusion: Fusion, world: World) -> None:
    words = ["--rgb", world.folder / "rgb", "--fir", world.folder / "fir"]
    answer = fusion("calibrate", "check", world.rig, *words)
    assert (answer.code, answer.err) == (0, "")
    assert "error" not in answer.out
    assert "rgb and fir are 78" in answer.out


# --- cache, pictures, quiet


def test_a_stopped_search_goes_on_and_ends_the_same(fusion: Fusion, world: World, bench: Bench) -> None:
    """Half a journal, its last line cut: the rest is searched again, and the rig is the same to the byte."""
    images = bench.copy("few", world.files("rgb")[:6])
    words = [w for w in bench.one(images) if w != "--quiet"]
    whole = fusion("calibrate", *words)
    assert (whole.code, "6 of 6 images, 6 as found before" in whole.out) == (0, True), whole.err
    first = bench.out.read_bytes()
    journal = bench.folder / ".detections/rgb.jsonl"
    lines = journal.read_bytes().splitlines(keepends=True)
    journal.write_bytes(b"".join(lines[:3]) + lines[3][:50])
    bench.out.unlink()
    again = fusion("calibrate", *words)
    assert again.code == 0, again.err
    assert "6 of 6 images, 3 as found before" in again.out
    assert bench.out.read_bytes() == first
    assert len(journal.read_bytes().splitlines()) == 4 + 3


def test_ctrl_c_keeps_what_was_found(
    fusion: Fusion, world: World, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    import calib.detect.folder as folder

    shutil.rmtree(bench.folder / ".detections")
    images = bench.copy("few", world.files("rgb")[:4])
    searched, found = [], folder.find_board

    def stopped(*words: Any) -> Any:
        searched.append(words)
        if len(searched) > 2:
            raise KeyboardInterrupt
        return found(*words)

    words = [*bench.one(images), "--workers", 1]
    with monkeypatch.context() as patch:
        patch.setattr(folder, "find_board", stopped)
        one_line(fusion("calibrate", *words), "interrupted", "goes on where this one stopped", code=130)
    assert not bench.out.exists()
    words.remove("--quiet")
    assert "4 of 4 images, 2 as found before" in fusion("calibrate", *words).out


def test_debug_draws_a_picture_an_image(fusion: Fusion, world: World, bench: Bench) -> None:
    images = bench.copy("few", world.files("rgb"))
    write(images / "empty.png", np.zeros((240, 320, 3), np.uint8))
    answer = fusion("calibrate", *bench.one(images), "--debug")
    assert answer.code == 0, answer.err
    pictures = sorted((bench.folder / "out_evidence/debug/rgb").iterdir())
    assert [p.stem for p in pictures] == sorted(p.stem for p in images.iterdir())
    assert all(read(p).shape[0] >= 240 for p in pictures)


def test_quiet_says_nothing_and_a_later_rig_keeps_the_others(
    fusion: Fusion, world: World, bench: Bench
) -> None:
    fir = world.folder / "fir"
    answer = fusion("calibrate", *bench.one(fir), "--camera", "fir", "--rig", world.rig)
    assert (answer.code, answer.out) == (0, ""), answer.err
    new, old = load_rig(bench.out), load_rig(world.rig)
    assert new.camera("rgb") == old.camera("rgb")
    assert new.camera("fir") != old.camera("fir")
    assert set(new.transforms) == set(old.transforms)
    written = [name for name in tree(bench.folder) if not name.startswith(".detections/")]
    assert written == ["out.toml"]


# --- board, check, convert


@pytest.mark.parametrize("suffix", [".pdf", ".svg"])
def test_a_board_is_printed_and_described(fusion: Fusion, tmp_path: Path, suffix: str) -> None:
    out = tmp_path / f"b{suffix}"
    answer = fusion("calibrate", "board", out, "--cols", 7, "--rows", 5, "--spacing-mm", 40)
    assert answer.code == 0, answer.err
    assert out.read_bytes()[:5] == {".pdf": b"%PDF-", ".svg": b"<svg "}.get(suffix, b"")
    board = load_board(tmp_path / "b.toml")
    assert (board.kind, board.cols, board.rows, board.spacing_m) == ("chessboard", 7, 5, 0.04)
    before = tree(tmp_path)
    one_line(fusion("calibrate", "board", out), "is there already", code=1)
    one_line(fusion("calibrate", "board", out.with_suffix(".svg" if suffix == ".pdf" else ".pdf")), "b.toml")
    assert tree(tmp_path) == before
    assert fusion("calibrate", "board", out, "--overwrite").code == 0
    assert load_board(tmp_path / "b.toml").cols == 9


def test_kalibrs_target_is_printed(fusion: Fusion, tmp_path: Path) -> None:
    target = tmp_path / "target.yaml"
    target.write_text("target_type: 'aprilgrid'\ntagCols: 6\ntagRows: 5\ntagSize: 0.03\ntagSpacing: 0.3\n")
    assert fusion("calibrate", "board", tmp_path / "t.svg", "--board", target).code == 0
    board = load_board(tmp_path / "t.toml")
    assert (board.kind, board.cols, board.rows, board.marker_m) == ("aprilgrid", 6, 5, 0.03)
    assert board.spacing_m == pytest.approx(0.039)
    one_line(fusion("calibrate", "board", tmp_path / "u.svg", "--board", target, "--cols", 4), "--cols")


@pytest.mark.parametrize(
    "options",
    [
        ["--cols", 0], ["--cols", 2000], ["--spacing-mm", "nan"], ["--spacing-mm", -3], ["--marker-mm", 5],
        ["--kind", "charuco", "--marker-mm", 50], ["--kind", "charuco", "--dictionary", "none"],
        ["--kind", "spots"], ["--board", "missing.toml"],
    ],
    ids=lambda options: " ".join(map(str, options)),
)  # fmt: skip
def test_boards_that_cannot_be_printed(fusion: Fusion, tmp_path: Path, options: list[object]) -> None:
    one_line(fusion("calibrate", "board", tmp_path / "b.pdf", *options), code=2)
    one_line(fusion("calibrate", "board", tmp_path / "b.png"), "neither .pdf nor .svg", code=2)
    assert not tree(tmp_path)


FORMS: dict[str, tuple[str, list[object], list[object], set[str]]] = {
    "rig": ("c.toml", [], [], {"rgb", "fir", "lidar"}),
    "ros": ("ros", [], [], {"rgb", "fir"}),
    "opencv": ("c.yml", [], [], {"rgb", "fir", "lidar"}),
    "koide": ("c.json", [], ["--size", 320, 240], {"rgb", "lidar"}),
    "plain": ("kdt.txt", [], ["--size", 320, 240], {"rgb", "lidar"}),
    "kitti": ("calib.txt", ["--force"], ["--size", 320, 240], {"rgb", "lidar"}),
    "kitti-raw": ("raw", ["--force"], [], {"rgb", "lidar"}),
}


@pytest.mark.parametrize("form", FORMS)
def test_every_form_there_and_back(fusion: Fusion, world: World, tmp_path: Path, form: str) -> None:
    name, there, back, kept = FORMS[form]
    out = tmp_path / name
    answer = fusion("calibrate", "convert", world.rig, out, "--form", form, *there)
    assert answer.code == 0, answer.err
    assert ("note: " in answer.out) == (form != "rig")
    answer = fusion("calibrate", "convert", out, tmp_path / "back.toml", *back)
    assert answer.code == 0, answer.err
    old, new = load_rig(world.rig), load_rig(tmp_path / "back.toml")
    assert set(new.cameras) == kept - {"lidar"}
    for camera in new.cameras:
        a, b = old.camera(camera), new.camera(camera)
        assert b.size_wh == a.size_wh
        np.testing.assert_allclose((b.fx, b.fy, b.cx, b.cy), (a.fx, a.fy, a.cx, a.cy), rtol=1e-9)
        if not there:
            np.testing.assert_allclose(b.distortion, a.distortion, rtol=1e-9)
    for sensor in (kept - {"rgb"}) if form != "ros" else ():
        np.testing.assert_allclose(new.pose("rgb", sensor), old.pose("rgb", sensor), atol=1e-9)
    before = tree(tmp_path)
    one_line(
        fusion("calibrate", "convert", world.rig, out, "--form", form, *there), "is there already", code=1
    )
    assert tree(tmp_path) == before
    again = fusion("calibrate", "convert", world.rig, out, "--form", form, *there, "--overwrite")
    assert again.code == 0, again.err
    assert tree(tmp_path) == before


def test_what_cannot_be_converted(fusion: Fusion, world: World, tmp_path: Path) -> None:
    rig = world.rig
    one_line(fusion("calibrate", "convert", rig, tmp_path / "a.wurst"), "the name does not tell", "koide")
    one_line(fusion("calibrate", "convert", rig, tmp_path / "a", "--form", "wurst"), "'wurst'", "kitti-raw")
    one_line(fusion("calibrate", "convert", tmp_path / "none", tmp_path / "a.toml"), "none", "cannot be read")
    one_line(fusion("calibrate", "convert", rig, tmp_path / "calib.txt"), "undistort", "force")
    one_line(fusion("calibrate", "convert", world.board, tmp_path / "a.toml"), "board.toml", "fusion-rig/1")
    koide = tmp_path / "k.json"
    assert fusion("calibrate", "convert", rig, koide).code == 0
    one_line(fusion("calibrate", "convert", koide, tmp_path / "a.toml"), "how large", "--size")
    assert list(tree(tmp_path)) == ["k.json"]


def test_kalibr_takes_four_coefficients(fusion: Fusion, world: World, tmp_path: Path) -> None:
    rig = world.truth()
    four = Rig({n: replace_distortion(c, 4) for n, c in rig.cameras.items()}, rig.transforms)
    save_rig(tmp_path / "four.toml", four)
    chain = tmp_path / "camchain.yaml"
    assert fusion("calibrate", "convert", tmp_path / "four.toml", chain).code == 0
    assert fusion("calibrate", "convert", chain, tmp_path / "back.toml").code == 0
    back = load_rig(tmp_path / "back.toml")
    np.testing.assert_allclose(back.pose("rgb", "fir"), rig.pose("rgb", "fir"), atol=1e-12)
    np.testing.assert_allclose(back.camera("fir").distortion[:4], rig.camera("fir").distortion[:4])
    one_line(fusion("calibrate", "convert", world.rig, tmp_path / "no_camchain.yaml"), "4 distortion")
    assert not (tmp_path / "no_camchain.yaml").exists()


def replace_distortion(camera: Any, count: int) -> Any:
    return replace(camera, distortion=camera.distortion[:count])


ROS = """\
image_width: 640
image_height: 480
camera_name: head
camera_matrix: {rows: 3, cols: 3, data: [0,0,0,0,0,0,0,0,0]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0,0,0,0,0]}
rectification_matrix: {rows: 3, cols: 3, data: [0,0,0,0,0,0,0,0,0]}
projection_matrix: {rows: 3, cols: 4, data: [0,0,0,0,0,0,0,0,0,0,0,0]}
"""


def test_a_check_says_what_is_wrong(fusion: Fusion, world: World, tmp_path: Path) -> None:
    (tmp_path / "ros.yaml").write_text(ROS)
    one_line(fusion("calibrate", "check", tmp_path / "ros.yaml"), "uncalibrated", code=1)
    one_line(fusion("calibrate", "check", tmp_path / "none.toml"), "cannot be read", code=1)
    one_line(
        fusion("calibrate", "check", world.rig, "--rgb", world.folder / "fir"), "320x240", "320x256", code=1
    )
    one_line(fusion("calibrate", "check", world.rig, "--rgb", tmp_path / "no"), "no such file", code=1)
    rig = load_rig(world.rig)
    turned = {**rig.transforms, "T_rgb_lidar": invert(rig.transforms["T_rgb_lidar"])}
    save_rig(tmp_path / "inverted.toml", Rig(rig.cameras, turned))
    answer = fusion("calibrate", "check", tmp_path / "inverted.toml")
    assert "inverted" in answer.out + answer.err


# --- bad input: stereo and intrinsics


def fails(fusion: Fusion, bench: Bench, command: Sequence[object], *words: str, code: int = 1) -> None:
    """One clear line, and nothing written; an OUT that is there stays, even if it may be replaced."""
    kept = {k: v for k, v in tree(bench.folder).items() if not k.startswith(".detections")}
    one_line(fusion("calibrate", *command), *words, code=code)
    bench.out.write_text("mine")
    one_line(fusion("calibrate", *command, "--overwrite"), *words, code=code)
    one_line(fusion("calibrate", *command), "is there already", code=1) if code == 1 else None
    assert bench.out.read_text() == "mine"
    bench.out.unlink()
    assert {k: v for k, v in tree(bench.folder).items() if not k.startswith(".detections")} == kept


def test_no_board_in_any_image(fusion: Fusion, bench: Bench) -> None:
    (bench.folder / "grey").mkdir()
    for k in range(2):
        noise = np.random.default_rng(k).integers(0, 255, (120, 160, 3), np.uint8)
        write(bench.folder / f"grey/{k}.png", noise)
    words = ["no board in any of 2 images of rgb", "grey", "chessboard 7x5", "--debug"]
    fails(fusion, bench, bench.one(bench.folder / "grey"), *words)
    fails(fusion, bench, bench.stereo(rgb=bench.folder / "grey"), *words)


def test_too_few_views(fusion: Fusion, bench: Bench) -> None:
    rgb, fir = (bench.copy(f"one_{k}", bench.world.files(k)[:1]) for k in ("rgb", "fir"))
    fails(fusion, bench, bench.one(rgb), "rgb: one view only", "tilted")
    fails(fusion, bench, bench.stereo(rgb=rgb, fir=fir), "one view only")
    two = bench.copy("two", bench.world.files("rgb")[:2])
    fails(fusion, bench, bench.one(two), "2 views only", "at least 3")


def test_all_views_alike(fusion: Fusion, bench: Bench) -> None:
    stamps = [1_700_000_001_000_000_000 + 2_000_000_000 * k for k in range(6)]
    rgb = bench.copy("rgb", bench.world.files("rgb")[3:4] * 6, [f"{s}.jpg" for s in stamps])
    fir = bench.copy("fir", bench.world.files("fir")[3:4] * 6, [f"{s}.png" for s in stamps])
    words = "all 6 views are alike", "tilt", "focal length"
    fails(fusion, bench, bench.one(rgb), *words)
    fails(fusion, bench, bench.stereo(rgb=rgb, fir=fir), *words)


def test_wrong_columns_and_rows(fusion: Fusion, bench: Bench) -> None:
    other = bench.folder / "other.toml"
    other.write_text(BOARD.replace("cols = 7", "cols = 5"))
    few = bench.copy("few", bench.world.files("rgb")[:3])
    command = ["intrinsics", few, "--board", other, *bench.rest()]
    fails(fusion, bench, command, "35 corners (7 x 5) does not fit the board's 5 x 5")


def test_mixed_image_sizes(fusion: Fusion, bench: Bench) -> None:
    rgb = bench.copy("rgb", bench.world.files("rgb"))
    odd = sorted(rgb.iterdir())[2]
    write(odd, cv2.resize(read(odd), (480, 360)))
    words = "8 of 9 are 320x240", odd.name, "480x360"
    fails(fusion, bench, bench.one(rgb), *words)
    fails(fusion, bench, bench.stereo(rgb=rgb), *words)


@pytest.mark.parametrize(("flip", "name"), [(np.s_[:, ::-1], "left-right"), (np.s_[::-1], "top-bottom")])
def test_a_mirrored_thermal_stream(fusion: Fusion, bench: Bench, flip: Any, name: str) -> None:
    fir = bench.drawn("fir", "fir", lambda pixels: pixels[flip].copy())
    fails(fusion, bench, bench.stereo(fir=fir), f"fir are mirrored {name}", "flip fir")


def test_swapped_folders(fusion: Fusion, bench: Bench) -> None:
    rgb, fir = bench.world.folder / "rgb", bench.world.folder / "fir"
    fails(fusion, bench, bench.stereo(rgb=fir, fir=rgb), "swapped", "RGB comes first")
    grey = bench.drawn("grey", "rgb", lambda bgr: np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY)))
    warm = bench.drawn("warm", "fir", lambda k: ((k - k.min()) / np.ptp(k) * 255).astype(np.uint8))
    command = bench.stereo("--rig", bench.world.cameras, rgb=warm, fir=grey)
    fails(fusion, bench, command, "320x256", "look swapped")


def test_clocks_that_are_apart(fusion: Fusion, bench: Bench) -> None:
    """The table of pairs, and a tolerance that works: given, it does."""
    files = bench.world.files("fir")
    late = bench.copy("late", files, [f"{int(f.stem) + 400_000_000}.png" for f in files])
    fails(fusion, bench, bench.stereo(fir=late), "rgb-fir: 0 shared", "437 ms apart", "482 ms would pair")
    answer = fusion(
        "calibrate", *bench.stereo("--tolerance-ms", 482, "--rig", bench.world.cameras, "--hold", fir=late)
    )
    assert answer.code == 0, answer.err
    T, truth = load_rig(bench.out).pose("rgb", "fir"), bench.world.truth().pose("rgb", "fir")
    assert turned_rad(T, truth) < 1.5e-3


def test_names_that_do_not_match(fusion: Fusion, bench: Bench) -> None:
    a = bench.copy("a", bench.world.files("rgb"), [f"a{k:02d}.jpg" for k in range(POSES)])
    b = bench.copy("b", bench.world.files("fir"), [f"b{k:02d}.png" for k in range(POSES)])
    fails(fusion, bench, bench.stereo(rgb=a, fir=b), "rgb-fir: 0 shared", "by name or order")
    fails(fusion, bench, bench.stereo("--pair", "stamp", rgb=a, fir=b), "without a time stamp")
    (sorted(b.iterdir())[0]).unlink()
    fails(fusion, bench, bench.stereo("--pair", "order", rgb=a, fir=b), "9 of rgb, 8 of fir")


def test_images_in_another_order(fusion: Fusion, bench: Bench) -> None:
    a = bench.copy("a", bench.world.files("rgb"), [f"a{k:02d}.jpg" for k in range(POSES)])
    mixed = [f"b{k:02d}.png" for k in (3, 1, 4, 0, 5, 8, 2, 6, 7)]
    b = bench.copy("b", bench.world.files("fir"), mixed)
    fails(fusion, bench, bench.stereo("--pair", "order", rgb=a, fir=b), "1 of 9 moments", "matched rightly")


def test_saturated_thermal_images(fusion: Fusion, bench: Bench) -> None:
    full = bench.drawn("full", "fir", lambda counts: np.full_like(counts, 65535))
    fails(fusion, bench, bench.stereo(fir=full), "no board in any of 9 images of fir", "saturated")


def test_images_that_are_not_there(fusion: Fusion, bench: Bench) -> None:
    (bench.folder / "empty").mkdir()
    fails(fusion, bench, bench.stereo(fir=bench.folder / "empty"), "no images in this folder")
    fails(fusion, bench, bench.stereo(fir=bench.folder / "nowhere"), "no such file or folder")


def test_a_board_that_never_stands_still(fusion: Fusion, bench: Bench) -> None:
    """With unknown clocks single images do not do; three of each pose do, whatever their stamps say."""
    fails(fusion, bench, bench.stereo("--timing", "static"), "never stands still", "3 images in each pose")
    fails(fusion, bench, bench.stereo("--timing", "offset"), "no offset can be estimated")
    folders = {}
    for kind, suffix, shift in (("rgb", "jpg", 0), ("fir", "png", 200)):
        names = [
            f"{(1_700_000_001_000 + shift + 2000 * k + 500 * j) * 1_000_000}.{suffix}"
            for k in range(6)
            for j in range(4)
        ]
        folders[kind] = bench.copy(kind, [f for f in bench.world.files(kind)[:6] for _ in range(4)], names)
    answer = fusion("calibrate", *bench.stereo("--timing", "static", **folders))
    assert answer.code == 0, answer.err
    assert "the board stands still in 6 of rgb, 6 of fir stretches" in answer.err
    assert tomllib.loads(bench.out.read_text())["evidence"]["cameras"]["rgb"]["views"] == 6


BOARDS = {
    "empty": ("", "fusion-board/1"),
    "text": ("nonsense [", "cannot be read as TOML"),
    "kind": (BOARD.replace("chessboard", "chessbord"), "kind", "asymmetric-circles"),
    "spacing": (BOARD.replace("spacing_m = 0.1", "spacing_m = -0.1"), "spacing_m"),
    "missing": (BOARD.replace("spacing_m = 0.1", ""), "spacing_m"),
    "unknown": (BOARD + 'colour = "red"\n', "colour"),
    "small": (BOARD.replace("cols = 7", "cols = 1"), "1x5"),
    "kalibr": ("target_type: 'aprilgrid'\ntagCols: 6\n", "tagRows"),
    "binary": ("\udcff\udcd8\udcff", "not text"),
}


@pytest.mark.parametrize("name", BOARDS)
def test_boards_that_cannot_be_read(fusion: Fusion, bench: Bench, name: str) -> None:
    text, *words = BOARDS[name]
    path = bench.folder / "b.toml"
    path.write_bytes(text.encode(errors="surrogateescape"))
    command = ["intrinsics", bench.world.folder / "rgb", "--board", path, *bench.rest()]
    fails(fusion, bench, command, "b.toml", *words, code=2)


def test_files_that_cannot_be_a_board_or_a_rig(fusion: Fusion, bench: Bench) -> None:
    rgb, missing = bench.world.folder / "rgb", bench.folder / "missing.toml"
    for path, word in ((missing, "No such file"), (bench.folder, "directory")):
        answer = fusion("calibrate", "intrinsics", rgb, "--board", path, *bench.rest())
        one_line(answer, str(path), word, code=2)
        assert "Errno" not in answer.err
    for command in (bench.one(rgb, "--rig", missing), bench.stereo("--rig", missing)):
        one_line(fusion("calibrate", *command), str(missing), "cannot be read", code=2)
    assert not bench.out.exists()


def test_options_that_cannot_be(fusion: Fusion, bench: Bench) -> None:
    for options, word in (
        (["--tolerance-ms", -4], "--tolerance-ms: -4 ms"), (["--tolerance-ms", "nan"], "--tolerance-ms"),
        (["--workers", 0], "--workers"), (["--rgb-model", "wide"], "fisheye"), (["--pair", "luck"], "stem"),
    ):  # fmt: skip
        fails(fusion, bench, bench.stereo(*options), word, code=2)


def test_where_a_rig_cannot_be_written(fusion: Fusion, world: World, bench: Bench) -> None:
    rgb = world.folder / "rgb"
    (bench.folder / "file").write_text("mine")
    base = ["calibrate", "intrinsics", rgb, "--board", world.board, "--no-report", "--quiet", "-o"]
    before = tree(bench.folder)
    one_line(fusion(*base, bench.folder), "is a folder", code=1)
    one_line(fusion(*base, bench.folder / "file/rig.toml"), "cannot be written", code=1)
    one_line(fusion(*base, "/proc/nowhere/rig.toml"), "/proc", code=1)
    assert tree(bench.folder) == before
    assert fusion(*base, bench.folder / "new/folder/rig.toml").code == 0
    assert load_rig(bench.folder / "new/folder/rig.toml").camera("rgb").size_wh == (320, 240)


# --- bad input: LiDAR


def test_clouds_without_a_number(fusion: Fusion, bench: Bench) -> None:
    clouds = bench.clouds("nan", lambda xyz: np.full((50, 3), np.nan))
    fails(fusion, bench, bench.lidar(clouds), "none of 9 clouds", "no point of it is a number")


def test_clouds_with_some_nan_do(fusion: Fusion, bench: Bench) -> None:
    def some(xyz: Any) -> Any:
        xyz[::7] = np.nan
        return xyz

    answer = fusion("calibrate", *bench.lidar(bench.clouds("some", some)))
    assert answer.code == 0, answer.err
    T, truth = load_rig(bench.out).pose("rgb", "lidar"), bench.world.truth().pose("rgb", "lidar")
    assert turned_rad(T, truth) < 3 * math.sqrt(2) * 1e-3  # RGB and LiDAR alone, of fewer points
    assert np.linalg.norm((T - truth)[:3, 3]) < 15e-3


def test_the_board_is_in_no_cloud(fusion: Fusion, bench: Bench) -> None:
    rng = np.random.default_rng(0)
    wall = np.stack([np.full(3000, 8.0), rng.uniform(-5, 5, 3000), rng.uniform(-3, 3, 3000)], 1)
    clouds = bench.clouds("wall", lambda xyz: wall)
    fails(fusion, bench, bench.lidar(clouds), "found in 0 clouds", "no flat patch of the plate's size")
    one = bench.world.files("lidar")[0]
    fails(fusion, bench, bench.lidar(one), "found in 1", "at least 3")


def test_clouds_of_another_time(fusion: Fusion, bench: Bench) -> None:
    files = bench.world.files("lidar")
    late = bench.copy("late", files, [f"{int(f.stem) + 900_000_000}.pcd" for f in files])
    fails(fusion, bench, bench.lidar(late), "no cloud belongs", "904 ms apart", "995 ms would pair")


def test_a_board_without_its_plate(fusion: Fusion, bench: Bench) -> None:
    plain = bench.folder / "plain.toml"
    plain.write_text(BOARD.split("plate_m")[0])
    few = bench.copy("few", bench.world.files("rgb")[:3])
    clouds = bench.world.folder / "lidar"
    command = ["lidar", few, clouds, "--board", plain, "--rig", bench.world.cameras, *bench.rest()]
    fails(fusion, bench, command, "plate_m = [left, top, right, bottom]", code=2)


def test_a_rig_from_another_camera(fusion: Fusion, bench: Bench) -> None:
    text = bench.world.cameras.read_text()
    other = bench.folder / "other.toml"
    other.write_text(text.replace("[320, 240]", "[640, 480]"))
    for command in (bench.lidar(None, "--rig", other), bench.stereo("--rig", other)):
        fails(fusion, bench, command, "images of 320x240", "rig's camera has 640x480")
    other.write_text(text.replace("cameras.rgb", "cameras.left").replace("T_rgb", "T_left"))
    fails(fusion, bench, bench.lidar(None, "--rig", other), "no camera 'rgb'", "left", code=2)


def test_a_rig_that_does_not_say_where_the_lidar_is(fusion: Fusion, bench: Bench) -> None:
    rgb, clouds, rig = (bench.world.folder / name for name in ("rgb", "lidar", "cameras.toml"))
    command = ["lidar", rgb, clouds, "--rig", rig, *bench.rest()]
    fails(fusion, bench, command, "cameras.toml", "T_rgb_lidar", "--board", code=2)
    fails(fusion, bench, [*command, "--fir", bench.world.folder / "fir"], "--fir", code=2)


HEAD = "x_m,y_m,z_m,u_px,v_px\n"
POINTS = {
    "empty": ("", "line 1", 2),
    "other": ("a,b\n1,2\n", "x_m", 2),
    "short": (HEAD + "1,2,3,4\n", "line 2", 2),
    "none": (HEAD, "0 pairs", 1),
    "word": (HEAD + "1,2,3,4,five\n", "'five'", 2),
    "line": (HEAD + "".join(f"{k},0,0,{100 + k},50\n" for k in range(8)), "one line", 1),
    "random": (
        HEAD
        + "".join(f"{','.join(map(str, r))}\n" for r in np.random.default_rng(0).uniform(1, 100, (12, 5))),
        "agree on a pose",
        1,
    ),
}


@pytest.mark.parametrize("name", POINTS)
def test_points_that_give_no_pose(fusion: Fusion, bench: Bench, name: str) -> None:
    text, word, code = POINTS[name]
    path = bench.folder / "points.csv"
    path.write_text(text)
    fails(fusion, bench, bench.lidar(None, "--points", path), word, code=code)


def test_points_give_the_pose_that_made_them(fusion: Fusion, bench: Bench) -> None:
    """With a tenth of the pairs wrong, which are named by their lines."""
    truth, rng = bench.world.truth(), np.random.default_rng(4)
    xyz = rng.uniform((2, -1.2, -0.8), (6, 1.2, 0.8), (30, 3))
    T = truth.pose("rgb", "lidar")
    uv, ahead = load_rig(bench.world.cameras).camera("rgb").project(xyz @ T[:3, :3].T + T[:3, 3])
    assert ahead.all()
    uv += rng.normal(0, 0.3, uv.shape)
    uv[[4, 11, 25]] += 40
    path = bench.folder / "points.csv"
    rows = [",".join(f"{x:.6f}" for x in (*p, *q)) for p, q in zip(xyz, uv, strict=True)]
    path.write_text(HEAD + "\n".join(rows) + "\n")
    words = [w for w in bench.lidar(None, "--points", path) if w != "--quiet"]
    answer = fusion("calibrate", *words)
    assert answer.code == 0, answer.err
    assert "left out: lines 6, 13, 27 of" in answer.out
    found = load_rig(bench.out).pose("rgb", "lidar")
    assert turned_rad(found, T) < 3e-3
    assert np.linalg.norm((found - T)[:3, 3]) < 15e-3


@pytest.mark.parametrize("name", ["board", "intrinsics", "stereo", "lidar", "align", "check", "convert"])
def test_help_shows_worked_examples(fusion: Fusion, name: str) -> None:
    answer = fusion("calibrate", name, "--help")
    assert answer.code == 0
    assert answer.out.count(f"fusion calibrate {name} ") >= 2
