"""Files of real cameras: their constants as ExifTool reads them, and the degrees that the cameras show.

What a camera writes into its picture, or beside it, is the independent truth: it comes from its own software.
"""

from __future__ import annotations

from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from fusion.errors import FrameError
from fusion.radiometric import FlirImage, read_flir
from fusion.sources import open_source

NAMES = ("r1", "r2", "b", "o", "emissivity", "distance_m", "humidity", "window_transmission")
# by `exiftool -n -FLIR:all`, 12.57
CONSTANTS = {
    "DJI_XT2": (17096.453125, 0.046582058, 1428, -267, 1, 20, 0.5, 1),
    "DJI_XTR": (17096.453125, 0.048084795, 1428, -370, 0.7, 20, 0.5, 1),
    "FLIR": (17837.53125, 0.012332781, 1450.4, -1143, 0.95, 1, 0.5, 1),
    "FLIR_AX8": (16951.796875, 0.014294867, 1435.1, -7142, 0.95, 1, 0.5, 1),
    "FLIR_B60": (13559.122, 0.010364772, 1368.1, -5202, 1, 1, 0.5, 1),
    "FLIR_E40": (14866.514, 0.011086479, 1395.7, -5859, 0.95, 2, 0.49, 0.98),
    "FLIR_T640": (15848.854, 0.014533112, 1414.9, -4405, 0.95, 1, 0.5, 1),
}
DEGC = {  # reflected, atmosphere, window
    "DJI_XT2": (22, 40, 22),
    "DJI_XTR": (22, 32, 22),
    "FLIR_E40": (21, 14, 19),
}
TAKEN = {  # UTC
    "DJI_XT2": "2018-07-27T14:51:54.480",
    "FLIR": "2017-09-08T14:04:36.266",
    "FLIR_AX8": "2000-01-01T05:54:26.054",
    "FLIR_E40": "2013-04-12T10:24:01.131",
    "FLIR_T640": "2020-11-10T10:39:48.232",
}
SIZES = {  # thermal, visible
    "DJI_XT2": ((640, 512), None),
    "DJI_XTR": ((640, 512), None),
    "FLIR": ((240, 320), (480, 640)),
    "FLIR_AX8": ((80, 60), (640, 480)),
    "FLIR_B60": ((180, 180), (480, 480)),
    "FLIR_E40": ((160, 120), None),
    "FLIR_T640": ((640, 480), (2592, 1944)),
}


def image_of(shared_data: Path, name: str) -> FlirImage:
    path = shared_data / "radiometric" / f"{name}.jpg"
    return read_flir(path.read_bytes(), str(path))


@pytest.mark.parametrize("name", CONSTANTS)
def test_constants_times_and_sizes(shared_data: Path, name: str) -> None:
    image = image_of(shared_data, name)
    found = [getattr(image.planck, key) for key in NAMES]
    assert found == pytest.approx(CONSTANTS[name], rel=1e-7)
    air = (image.planck.alpha1, image.planck.alpha2, image.planck.beta1, image.planck.beta2, image.planck.x)
    assert air == pytest.approx((0.006569, 0.01262, -0.002276, -0.00667, 1.9), rel=1e-6)
    degc = (image.planck.reflected_k, image.planck.atmosphere_k, image.planck.window_k)
    assert degc == pytest.approx([t + 273.15 for t in DEGC.get(name, (20, 20, 20))], abs=0.02)
    if name in TAKEN:
        assert image.stamp_ns is not None
        at = datetime.fromtimestamp(image.stamp_ns / 1e9, UTC)
        assert at.isoformat(timespec="milliseconds").startswith(TAKEN[name])
    thermal, visible = SIZES[name]
    assert image.counts.shape[::-1] == thermal
    assert (None if image.visible_bgr is None else image.visible_bgr.shape[1::-1]) == visible


def middle(celsius: np.ndarray) -> float:
    h, w = celsius.shape
    return float(celsius[h // 2 - 1 : h // 2 + 1, w // 2 - 1 : w // 2 + 1].mean())


def test_degrees_are_those_in_the_cameras_own_picture(shared_data: Path) -> None:
    """E40: spot 20.9 at the centre. AX8: max 25.5, min 24.3, average 25.1."""
    assert round(middle(image_of(shared_data, "FLIR_E40").celsius()), 1) == 20.9
    ax8 = image_of(shared_data, "FLIR_AX8").celsius()
    assert (round(float(ax8.max()), 1), round(float(ax8.min()), 1)) == (25.5, 24.3)
    assert ax8.mean() == pytest.approx(25.1, abs=0.1)


def test_degrees_are_those_beside_the_picture(shared_data: Path) -> None:
    """DJI's XMP gives the centre's temperature in whole degrees: 34 and 26; the B60's picture says 19.0 F."""
    assert int(middle(image_of(shared_data, "DJI_XT2").celsius())) == 34
    assert int(middle(image_of(shared_data, "DJI_XTR").celsius())) == 26
    assert middle(image_of(shared_data, "FLIR_B60").celsius()) * 1.8 + 32 == pytest.approx(19.0, abs=0.2)


def test_the_hottest_spot_of_the_t640(shared_data: Path) -> None:
    """The picture says 199 F for the area that its measurement record gives, x 64, y 98, 313 x 279 pixels."""
    celsius = image_of(shared_data, "FLIR_T640").celsius()
    assert round(float(celsius[98 : 98 + 279, 64 : 64 + 313].max()) * 1.8 + 32) == 199


@pytest.mark.parametrize("name", CONSTANTS)
def test_every_count_of_a_real_image_comes_back_from_its_degrees(shared_data: Path, name: str) -> None:
    image = image_of(shared_data, name)
    counts, degrees = (array.ravel()[::313] for array in (image.counts, image.celsius()))
    assert [round(image.counts_at(float(degc))) for degc in degrees] == counts.tolist()


def test_visible_images_show_the_scene(shared_data: Path) -> None:
    """Not turned, not in wrong colours: sky above is blue, the mug is white, the railing is yellow."""
    means = {}
    for name, box in {
        "FLIR_B60": np.s_[100:200, 10:60],
        "FLIR": np.s_[225:250, 180:250],
        "FLIR_T640": np.s_[1577:1597, 1650:1670],
    }.items():
        visible = image_of(shared_data, name).visible_bgr
        assert visible is not None
        means[name] = visible[box].reshape(-1, 3).mean(0)
    blue, green, red = means["FLIR_B60"]
    assert blue > green > red > 120
    assert means["FLIR"].min() > 120
    assert means["FLIR_T640"][0] < 0.7 * means["FLIR_T640"][1:].min()


@pytest.mark.parametrize(
    "name", ["DJI_H20T.jpg", *(f"{kind}/DJI_0001_R.JPG" for kind in ("H20T", "M2EA", "M30T"))]
)
def test_djis_own_files_are_refused_by_name(shared_data: Path, name: str) -> None:
    path = shared_data / "radiometric" / name
    with pytest.raises(FrameError, match=r"DJI's own .*R-JPEG.* APP3 and APP4 .*Thermal SDK.*16-bit TIFF"):
        read_flir(path.read_bytes(), str(path))
    with pytest.raises(FrameError, match="DJI's own"):
        open_source(path, "fir").read(0)
    assert open_source(path, "fir", fir_colour="luma").read(0).pixels.dtype == np.uint8


def test_a_16_bit_tiff_keeps_its_counts(shared_data: Path) -> None:
    image = open_source(shared_data / "radiometric" / "example_radiometric.tiff", "fir").read(0)
    assert (image.pixels.dtype, image.size_wh) == (np.uint16, (640, 512))
    assert (image.pixels.min(), image.pixels.max()) == (6743, 7077)


@pytest.mark.parametrize("name", CONSTANTS)
def test_damage_in_real_files_is_an_error_of_the_frame(shared_data: Path, name: str) -> None:
    data = (shared_data / "radiometric" / f"{name}.jpg").read_bytes()
    rng = np.random.default_rng(len(data))
    for attempt in range(6):
        broken = bytearray(data[: len(data) - attempt * len(data) // 7])
        for place in rng.integers(0, min(len(broken), 8000 if attempt % 2 else len(broken)), 40):
            broken[place] = rng.integers(0, 256)
        with suppress(FrameError):
            assert read_flir(bytes(broken), name, visible=name != "FLIR_T640").counts.dtype == np.uint16
