"""`fusion datasets check` of recordings: topics, their types, and what their first messages hold."""

from __future__ import annotations

from pathlib import Path

from rosbags.rosbag1 import Writer

from fusion.cli.dataset_checks import Report, check
from fusion.manifest import Manifest, load_manifest
from fusion.rig import save_rig
from tests.bags import ROS1, bag, image
from tests.dataset_trees import rig_for


def wrong(report: Report) -> list[tuple[str, str]]:
    return [(finding.kind, finding.text) for finding in report.findings if finding.wrong]


def altered(manifest: Manifest, **changes: object) -> Manifest:
    return Manifest.model_validate({**manifest.model_dump(exclude_none=True), **changes})


def recording(folder: Path, **checks: object) -> Manifest:
    made = load_manifest("template_recording").model_dump(exclude_none=True)
    made["recording"] = {"files": "flight_*/*.bag", "topics": {"rgb": "/cam", "fir": "/thermal"}}
    made["checks"] = checks
    del made["calibration"]
    folder.mkdir(exist_ok=True)
    return Manifest.model_validate(made)


GOOD = {"/cam": ("bgr8", 64, 48, 3), "/thermal": ("mono16", 32, 24, 2)}


def test_recordings_are_opened_and_their_first_messages_read(tmp_path: Path) -> None:
    made = recording(tmp_path, rgb_size_wh=[64, 48], fir_size_wh=[32, 24], fir_bits=16)
    for k in (1, 2):
        bag(tmp_path / f"flight_{k}" / "a.bag", GOOD)
    report = check(made, tmp_path)
    assert wrong(report) == []
    seen = {one.role: (one.where, one.files, one.sizes_wh, one.pixels) for one in report.roles}
    assert seen == {
        "rgb": ("/cam", 6, {"64x48": 1}, {"bgr8": 1}),
        "fir": ("/thermal", 6, {"32x24": 1}, {"mono16": 1}),
    }


def test_a_topic_that_is_not_there_lists_those_that_are(tmp_path: Path) -> None:
    made = recording(tmp_path)
    path = bag(tmp_path / "flight_1" / "a.bag", {"/cam": GOOD["/cam"], "/ir": GOOD["/thermal"]})
    ((kind, text),) = wrong(check(made, tmp_path))
    assert kind == "topic"
    assert text.startswith(f"{path}: no topic /thermal for fir; it has ")
    assert "/cam (sensor_msgs/msg/Image)" in text
    assert "/ir (sensor_msgs/msg/Image)" in text


def test_a_topic_of_the_wrong_type_and_images_of_another_kind(tmp_path: Path) -> None:
    made = recording(tmp_path, fir_size_wh=[640, 512], fir_bits=16)
    bag(tmp_path / "flight_1" / "a.bag", {"/cam": GOOD["/cam"], "/thermal": ("mono8", 32, 24, 1)})
    kinds = dict(wrong(check(made, tmp_path)))
    assert "fir images of template_recording are 640x512, those recorded are 32x24" in kinds["size"]
    assert "have 16 bits, those recorded 8" in kinds["bits"]
    path = tmp_path / "flight_1" / "a.bag"
    path.unlink()
    with Writer(path) as writer:
        text = writer.add_connection("/thermal", "std_msgs/msg/String", typestore=ROS1)
        word = ROS1.serialize_ros1(ROS1.types["std_msgs/msg/String"]("warm"), "std_msgs/msg/String")
        writer.write(text, 10**18, bytes(word))
        camera = writer.add_connection("/cam", "sensor_msgs/msg/Image", typestore=ROS1)
        writer.write(camera, 10**18, image(10**18, "bgr8", 64, 48, 3))
    assert (
        "/thermal is std_msgs/msg/String, which cannot be fir" in dict(wrong(check(made, tmp_path)))["topic"]
    )


def test_a_file_that_is_no_recording_is_named(tmp_path: Path) -> None:
    made = recording(tmp_path)
    bag(tmp_path / "flight_1" / "a.bag", GOOD)
    (tmp_path / "flight_2").mkdir()
    (tmp_path / "flight_2" / "b.bag").write_bytes(b"nothing")
    report = check(made, tmp_path)
    assert [kind for kind, _ in wrong(report)] == ["unreadable"]
    assert "flight_2/b.bag" in wrong(report)[0][1]
    assert next(one.files for one in report.roles if one.role == "rgb") == 3


def test_a_recordings_calibration_is_held_against_its_images(tmp_path: Path) -> None:
    made = altered(recording(tmp_path), calibration={"files": "rig.toml", "form": "rig"})
    bag(tmp_path / "flight_1" / "a.bag", GOOD)
    save_rig(tmp_path / "rig.toml", rig_for(altered(made, checks={"fir_size_wh": [320, 256]})))
    ((kind, text),) = wrong(check(made, tmp_path))
    assert kind == "calibration"
    assert "it is for fir images of 320x256, these are 32x24" in text


def test_a_recording_that_is_cut_off_is_damaged(tmp_path: Path) -> None:
    made = recording(tmp_path)
    path = bag(tmp_path / "flight_1" / "a.bag", GOOD)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) - 200])  # its index is gone
    report = check(made, tmp_path)
    assert not report.ok
    assert "damage" in [kind for kind, _ in wrong(report)]
    assert all(str(path) in text for _, text in wrong(report))


def test_a_topic_without_messages_is_wrong(tmp_path: Path) -> None:
    made = recording(tmp_path)
    path = tmp_path / "flight_1" / "a.bag"
    path.parent.mkdir()
    with Writer(path) as writer:
        camera = writer.add_connection("/cam", "sensor_msgs/msg/Image", typestore=ROS1)
        writer.add_connection("/thermal", "sensor_msgs/msg/Image", typestore=ROS1)
        writer.write(camera, 10**18, image(10**18, "bgr8", 64, 48, 3))
    ((kind, text),) = wrong(check(made, tmp_path))
    assert kind == "topic"
    assert "/thermal" in text
