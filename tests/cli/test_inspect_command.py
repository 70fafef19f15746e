"""`fusion inspect` as a user runs it: text, JSON, page, refusals."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from fusion.cli import main
from fusion.cli.inspect import inspect
from tests.inspect.recorded import FIR, Robot, write_bag

KITTI = (
    "P0: 1 0 0 0 0 1 0 0 0 0 1 0\nP1: 1 0 0 0 0 1 0 0 0 0 1 0\n"
    "P2: 700 0 600 45 0 700 180 0.2 0 0 1 0.003\nP3: 700 0 600 0 0 700 180 0 0 0 1 0\n"
    "R0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: 0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27\n"
)
ROS = """image_width: 640
image_height: 480
camera_name: rgb
camera_matrix: {rows: 3, cols: 3, data: [500, 0, 319.5, 0, 500, 239.5, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
projection_matrix: {rows: 3, cols: 4, data: [500, 0, 319.5, 0, 0, 500, 239.5, 0, 0, 0, 1, 0]}
"""


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    return write_bag(tmp_path_factory.mktemp("bag") / "a flight.bag", Robot())


def test_text_says_roles_and_the_next_command(bag, capsys):
    inspect(str(bag), quiet=True)
    said = capsys.readouterr().out
    assert "/thermal/image_raw" in said
    assert (
        f"fusion preprocess '{bag}' --rgb /camera/image_raw --fir {FIR} --lidar /velodyne_points -o OUT"
        in said
    )
    assert "all 25 messages" in said
    assert "20 of 25 messages" in said


def test_json_for_machines(bag, capsys):
    inspect(str(bag), json=True, full=True, quiet=True)
    record = json.loads(capsys.readouterr().out)
    assert record["format"] == "fusion-inspect/1"
    assert record["facts"]["messages"] == 56
    fir = next(stream for stream in record["streams"] if stream["name"] == FIR)
    assert fir["facts"]["frozen_frames"] == 3
    assert record["next"][0]["words"][:2] == ["fusion", "preprocess"]


def test_a_page_with_pictures_is_not_overwritten_unasked(bag, tmp_path, capsys):
    page = tmp_path / "page.html"
    inspect(str(bag), html=page, quiet=True)
    text = page.read_text()
    assert text.count("<img") >= 4
    with pytest.raises(Exception, match="there already"):
        inspect(str(bag), html=page, quiet=True)
    inspect(str(bag), html=page, overwrite=True, quiet=True)
    assert page.read_text() == text
    capsys.readouterr()


@pytest.mark.parametrize(("name", "text", "camera"), [("000000.txt", KITTI, 700.0), ("rgb.yaml", ROS, 500.0)])
def test_calibrations_of_other_tools(tmp_path, capsys, name, text, camera):
    path = tmp_path / name
    path.write_text(text)
    inspect(str(path), json=True, quiet=True)
    facts = json.loads(capsys.readouterr().out)["facts"]
    assert facts["camera_rgb"]["fx"] == camera
    assert facts["camera_rgb"].get("size") == (None if name.endswith("txt") else "640x480")


def test_a_calibration_that_is_a_folder(tmp_path, capsys):
    projection = "700 0 600 0 0 700 180 0 0 0 1 0"
    (tmp_path / "calib_cam_to_cam.txt").write_text(
        f"S_rect_02: 1242 375\nR_rect_00: 1 0 0 0 1 0 0 0 1\nP_rect_02: {projection}\n"
    )
    (tmp_path / "calib_velo_to_cam.txt").write_text("R: 0 -1 0 0 0 -1 1 0 0\nT: 0 0 0\n")
    inspect(str(tmp_path), json=True, quiet=True)
    record = json.loads(capsys.readouterr().out)
    assert (record["kind"], record["facts"]["camera_rgb"]["size"]) == ("rig", "1242x375")


def test_a_video(tmp_path, capsys):
    pytest.importorskip("av")
    path = tmp_path / "clip.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, (32, 24))
    for k in range(5):
        writer.write(np.full((24, 32, 3), 40 * k, np.uint8))
    writer.release()
    inspect(str(path), json=True, quiet=True)
    record = json.loads(capsys.readouterr().out)
    assert record["facts"]["frames"] == 5
    assert record["streams"][0]["facts"]["size_wh"] == [[32, 24]]
    assert record["streams"][0]["times"]["rate_hz"] == pytest.approx(10)


@pytest.mark.parametrize(
    "name", ["gone", "what.xyz", "bad.txt", "bad.bag", "bad.mcap", "bad.png", "bad.pcd", "bad.toml"]
)
def test_refusals_are_one_line_and_exit_one(tmp_path, capsys, monkeypatch, name):
    path = tmp_path / name
    if name != "gone":
        path.write_bytes(
            b"\x89MCAP0\r\n" if name == "bad.mcap" else b"rubbish, and not even a little of it good"
        )
    if "inspect" not in main.app:
        main.app.command("fusion.cli.inspect:inspect", name="inspect")
    monkeypatch.setattr(sys, "argv", ["fusion", "inspect", str(path)])
    with pytest.raises(SystemExit) as stopped:
        main.main()
    said = capsys.readouterr()
    assert stopped.value.code == 1
    assert said.err.startswith("fusion: ")
    assert said.err.count("\n") == 1
    assert str(path) in said.err
    assert not said.out


def test_help_imports_nothing_heavy():
    import subprocess

    code = "import sys, fusion.cli.inspect; print(sorted({'cv2', 'rosbags', 'numpy'} & set(sys.modules)))"
    root = Path(__file__).parents[2]
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=root)
    assert done.stdout.strip() == "[]"
