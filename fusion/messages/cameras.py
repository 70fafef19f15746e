"""From a camera's calibration as it was sent to a camera model."""

from __future__ import annotations

from fusion.errors import FrameError, UsageError
from fusion.geometry import FisheyeCamera, PinholeCamera
from fusion.messages.base import CameraInfo

_PINHOLE = ("plumb_bob", "rational_polynomial")
_FISHEYE = ("equidistant", "fisheye", "kannala_brandt")
_COUNTS = {"plumb_bob": (4, 5), "rational_polynomial": (8,)}


def camera_of(info: CameraInfo, *, where: str = "") -> PinholeCamera | FisheyeCamera:
    """The camera that took the raw images: K and D (R and P belong to rectified ones).

    Trailing zeros of D beyond what the model has are dropped; a model without a name is a pinhole if its D is
    all zero. Raises `FrameError` for one that is uncalibrated (K[0] = 0), of an unknown model, skewed, or
    with numbers that no camera has.
    """
    K = info.K
    if not K.any() or K[0, 0] == 0:
        hint = "calibrate it (fusion calibrate), or give a rig"
        raise FrameError("the camera is uncalibrated: its K begins with 0", where=where, hint=hint)
    if K[0, 1] or K[1, 0] or tuple(K[2]) != (0, 0, 1):
        raise FrameError(f"its K is no camera matrix: {K.ravel().tolist()}", where=where)
    model = info.model.lower()
    plain = not any(info.D)
    if model not in (*_PINHOLE, *_FISHEYE) and not (plain and not model):
        known = ", ".join((*_PINHOLE, *_FISHEYE))
        raise FrameError(
            f"its distortion model {info.model!r} is not known", where=where, hint=f"one of: {known}"
        )
    distortion = () if plain else _distortion(info, model, where)
    lens = FisheyeCamera if model in _FISHEYE else PinholeCamera
    try:
        size_wh = (int(info.width), int(info.height))
        return lens(size_wh, float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), distortion)
    except UsageError as error:
        raise FrameError(error.what, where=where, hint=error.hint) from None


def _distortion(info: CameraInfo, model: str, where: str) -> tuple[float, ...]:
    """D with as many coefficients as the model has: what is missing is 0, zeros too many go."""
    counts = _COUNTS.get(model, (4,))
    used = max((k for k, value in enumerate(info.D, 1) if value), default=0)
    for count in counts:
        if used <= count <= max(len(info.D), counts[0]):
            return (*info.D[:count], *[0.0] * (count - len(info.D)))
    raise FrameError(
        f"{len(info.D)} coefficients of the model {info.model}", where=where, hint=f"one of {counts}"
    )
