"""What is known of the real sets: the state of each, and file names as they stand in its own listing."""

from __future__ import annotations

STATES = {
    "caltech_aerial": "unregistered",
    "cvc14": "unregistered",
    "flir_adas_v2": "unregistered",
    "flir_adas_v2_images": "unpaired",
    "kaist": "registered",
    "kitti_depth": "lidar only",
    "kitti_object": "lidar only",
    "kitti_raw": "lidar only",
    "llvip": "registered",
    "m3fd": "registered",
    "mfnet": "registered",
    "mil_multispectral": "unregistered",
    "mine": "unregistered",
    "ms2": "unregistered",
    "msrs": "registered",
    "pst900": "registered",
    "pst900_raw": "registered",
    "roadscene": "registered",
    "sthereo": "unregistered",
    "vivid": "unregistered",
}


def of_pst900(kind: str) -> tuple[list[tuple[str, str]], list[str]]:
    names = [f"31_bag1a_rect_rgb_frame00000000{k}" for k in ("07", "12")]
    parts = ("test", "train")
    others = {"thermal", "thermal_raw", "depth", "labels"} - {kind}
    return (
        [(f"{part}/rgb/{name}.png", f"{part}/{kind}/{name}.png") for part in parts for name in names],
        [f"test/{other}/{names[0]}.png" for other in sorted(others)],
    )


# What lies in the real sets, by their own listings and by those who read them: pairs, and files that must not
# be taken for images of the set.
RECIPES: dict[str, tuple[list[tuple[str, str]], list[str]]] = {
    "mil_multispectral": (
        [("Images/rgb/04005.png", "Images/fir/04005.png"), ("Images/rgb/04006.png", "Images/fir/04006.png")],
        ["Images/nir/04005.png", "Images/mir/04005.png", "labels/rgb/04005.txt"],
    ),
    "msrs": (
        [
            ("test/vi/00537D.png", "test/ir/00537D.png"),
            ("train/vi/00537D.png", "train/ir/00537D.png"),  # one name in both parts is two pairs
            ("train/vi/00881N.png", "train/ir/00881N.png"),
        ],
        [
            "detection/vi/1042.png",
            "detection/ir/1042.png",
            "test/Segmentation_labels/00537D.png",
            "README.md",
        ],
    ),
    "pst900": of_pst900("thermal"),
    "pst900_raw": of_pst900("thermal_raw"),
    "roadscene": (
        [(f"crop_LR_visible/FLIR_{k}.jpg", f"cropinfrared/FLIR_{k}.jpg") for k in ("00006", "05164")],
        ["crop_HR_visible/FLIR_05164.jpg"],
    ),
    "kaist": (
        [
            (f"images/{place}/visible/I00000.jpg", f"images/{place}/lwir/I00000.jpg")
            for place in ("set00/V000", "set00/V001", "set11/V000")
        ],
        ["annotations/set00/V000/I00000.txt"],
    ),
    "llvip": (
        [
            (f"visible/{name}.jpg", f"infrared/{name}.jpg")
            for name in ("train/010001", "train/010002", "test/190001")
        ],
        ["Annotations/010001.xml"],
    ),
    "m3fd": ([("vi/00000.png", "ir/00000.png"), ("vi/00001.png", "ir/00001.png")], ["vi/Thumbs.db"]),
    "cvc14": (
        [
            (f"{time}/Visible/{part}/FramesPos/2014_1.tif", f"{time}/FIR/{part}/FramesPos/2014_1.tif")
            for time, part in (("Day", "Train"), ("Day", "NewTest"), ("Night", "Train"))
        ],
        ["Day/Visible/Train/FramesNeg/2014_1.tif", "Day/FIR/Train/Annotations/2014_1.txt"],
    ),
    "ms2": (
        [
            (f"sync_data/_2021-08-06-10-59-33/rgb/img_left/00000{k}.png",
             f"sync_data/_2021-08-06-10-59-33/thr/img_left/00000{k}.png")
            for k in (0, 1)
        ],
        [f"sync_data/_2021-08-06-10-59-33/{kind}/img_left/000000.png" for kind in ("nir",)]
        + ["sync_data/_2021-08-06-10-59-33/rgb/img_right/000000.png"],
    ),
    "vivid": (
        [
            (f"{place}/RGB/data/000001.png", f"{place}/Thermal/data/000001.png")
            for place in ("indoor_robust_dark", "outdoor_robust_day1")
        ],
        ["indoor_robust_dark/Warped_Depth/data_RGB/000001.npy"],
    ),
    "caltech_aerial": (
        [(f"color/a_{k}_eo-{k}.jpg", f"thermal16/b_{k + 7}_thermal-{k}.tiff") for k in (15716, 9)],
        ["thermal8/b_thermal-9.png"],
    ),
    "sthereo": (
        [
            (f"image/stereo_left/{1630107000000000000 + 100_000_000 * k}.png",
             f"image/stereo_thermal_14_left/{1630107000010000000 + 100_000_000 * k}.png")
            for k in range(3)
        ],
        ["image/stereo_right/1630107000000000000.png", "sensor_data/data_stamp.csv"],
    ),
}  # fmt: skip
