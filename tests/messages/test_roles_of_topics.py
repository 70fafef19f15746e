"""Which topic plays which role: robots as they are wired, and evidence that contradicts a name."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fusion.messages.base import CameraInfo, CompressedImage, Points, RawImage, Transforms
from fusion.messages.roles import Seen, camera_of, guess_roles, roles_of, words_of
from fusion.recordings.base import Schema, Topic


def topic(name, count: int | None = 10):
    return Topic(name, Schema("any/msg/Type"), "cdr", count)


def raw(name, encoding, size=(640, 480), **more):
    return Seen(topic(name), RawImage, encoding, size, **more)


def jpeg(name, encoding="bgr8", size=(640, 480)):
    return Seen(topic(name), CompressedImage, encoding, size)


def cloud(name, *fields):
    return Seen(topic(name), Points, fields=("x", "y", "z", *fields))


def names(roles):
    return {role: chosen.name for role, (chosen, _) in roles.chosen.items()}


ROBOTS = {
    "a drone: camera, Boson, Ouster": (
        [
            jpeg("/camera/image_raw/compressed"),
            raw("/flir_boson/image_raw", "mono16", (640, 512)),
            cloud("/os_cloud_node/points", "intensity", "t", "ring"),
        ],
        {
            "rgb": "/camera/image_raw/compressed",
            "fir": "/flir_boson/image_raw",
            "lidar": "/os_cloud_node/points",
        },
    ),
    "RealSense beside a thermal camera": (
        [
            raw("/camera/color/image_raw", "rgb8"),
            raw("/camera/infra1/image_rect_raw", "mono8"),
            raw("/camera/infra2/image_rect_raw", "mono8"),
            raw("/camera/aligned_depth_to_color/image_raw", "16UC1"),
            raw("/thermal/image_raw", "mono16", (320, 256)),
            cloud("/camera/depth/color/points", "rgb"),
            cloud("/velodyne_points", "intensity", "ring"),
        ],
        {
            "rgb": "/camera/color/image_raw",
            "fir": "/thermal/image_raw",
            "depth": "/camera/aligned_depth_to_color/image_raw",
            "lidar": "/velodyne_points",
        },
    ),
    "names that say nothing, pixels that do": (
        [raw("/cam_a/image", "bayer_rggb8", (1920, 1200)), raw("/cam_b/image", "16UC1", (640, 512))],
        {"rgb": "/cam_a/image", "fir": "/cam_b/image"},
    ),
    "near infrared alone is no thermal": (
        [raw("/camera/color/image_raw", "rgb8"), raw("/camera/infra1/image_rect_raw", "mono8")],
        {"rgb": "/camera/color/image_raw"},
    ),
    "one namespace for both": (
        [raw("/sensors/rgb", "bgr8"), raw("/sensors/lwir", "mono16")],
        {"rgb": "/sensors/rgb", "fir": "/sensors/lwir"},
    ),
    "FLIR also makes visible cameras": (
        [raw("/flir_camera/image_raw", "bayer_rggb8"), raw("/lepton/image", "mono16", (160, 120))],
        {"rgb": "/flir_camera/image_raw", "fir": "/lepton/image"},
    ),
    "thermal in colour is no thermal": ([jpeg("/thermal/image/compressed")], {}),
    "compressed depth": (
        [Seen(topic("/d/image/compressedDepth"), CompressedImage, "16UC1; compressedDepth png")],
        {"depth": "/d/image/compressedDepth"},
    ),
    "16 bits that are mostly empty are depth": (
        [raw("/a/image", "16UC1", zeros=0.8), raw("/b/image", "16UC1", zeros=0.0)],
        {"depth": "/a/image", "fir": "/b/image"},
    ),
    "a mask and an overlay are no cameras": (
        [raw("/rgb/image", "bgr8"), raw("/rgb_overlay/image", "bgr8"), raw("/thermal/mask", "mono8")],
        {"rgb": "/rgb/image"},
    ),
}


@pytest.mark.parametrize("robot", ROBOTS)
def test_robots(robot):
    seen, expected = ROBOTS[robot]
    found = roles_of(seen)
    assert names(found) == expected
    assert not found.ambiguous
    assert all(why for _, why in found.chosen.values())


def test_two_equal_cameras_are_ambiguous_and_both_are_named():
    found = roles_of([raw("/left/image_raw", "rgb8"), raw("/right/image_raw", "rgb8")])
    assert [g.topic.name for g in found.ambiguous["rgb"]] == ["/left/image_raw", "/right/image_raw"]


def test_transports_of_one_camera_are_no_ambiguity():
    found = roles_of([jpeg("/cam/image_raw/compressed"), raw("/cam/image_raw", "bgr8")])
    assert not found.ambiguous
    assert found.chosen["rgb"][0].name == "/cam/image_raw"


def test_a_topic_without_messages_plays_no_role():
    assert guess_roles([Seen(topic("/rgb/image", 0), RawImage, "bgr8")]) == ()
    unknown = Seen(topic("/rgb/image", None), RawImage, "bgr8")
    assert roles_of([unknown]).chosen["rgb"][0].name == "/rgb/image"


def test_unused_types_play_no_role():
    assert guess_roles([Seen(topic("/thermal/odometry"), None)]) == ()


def test_infos_belong_to_their_cameras():
    seen = [
        raw("/camera/image", "bgr8"),
        Seen(topic("/camera/camera_info"), CameraInfo),
        raw("/thermal/image_raw", "mono16"),
        Seen(topic("/thermal/camera_info"), CameraInfo),
        Seen(topic("/tf_static"), Transforms),
    ]
    found = roles_of(seen)
    infos = {role: info.name for role, (info, _) in found.infos.items()}
    assert infos == {"rgb": "/camera/camera_info", "fir": "/thermal/camera_info"}
    assert [t.name for t in found.transforms] == ["/tf_static"]


def test_an_info_beside_two_cameras_is_nobodys():
    seen = [
        raw("/rgb", "bgr8"),
        raw("/lwir", "mono16"),
        Seen(topic("/camera_info"), CameraInfo),
    ]
    found = roles_of(seen)
    assert set(found.chosen) == {"rgb", "fir"}
    assert found.infos == {}
    alone = roles_of([raw("/image_raw", "bgr8"), Seen(topic("/camera_info"), CameraInfo)])
    assert alone.infos["rgb"][0].name == "/camera_info"


def test_devices_and_words():
    assert camera_of("/thermal/image_raw/compressed") == camera_of("/thermal/camera_info") == "/thermal"
    assert camera_of("/sensors/rgb") != camera_of("/sensors/fir")
    assert camera_of("/image_raw") == "/image_raw"
    assert words_of("/flirBoson/image_raw2") >= {"flir", "boson", "image"}


SOME = [seen for robot in ROBOTS.values() for seen in robot[0]]


@given(st.lists(st.sampled_from(SOME), max_size=8, unique_by=lambda seen: seen.topic.name), st.randoms())
def test_order_does_not_matter_and_no_device_plays_two_roles(seen, rng: random.Random):
    found = roles_of(seen)
    shuffled = list(seen)
    rng.shuffle(shuffled)
    assert names(roles_of(shuffled)) == names(found)
    devices = [camera_of(chosen.name) for chosen, _ in found.chosen.values()]
    assert len(set(devices)) == len(devices)
    for role, (chosen, _) in found.chosen.items():
        rivals = [g.points for g in found.guesses if g.role == role and g.topic == chosen]
        assert rivals
        assert rivals[0] > 0


@given(st.text(max_size=40), st.text(max_size=12))
def test_any_name_and_encoding_is_taken(name, encoding):
    roles_of([raw(name, encoding), jpeg(name + "/compressed", encoding), cloud(name)])
