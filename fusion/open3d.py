"""Open3D, imported when it is needed and not before: it takes about a second, and system libraries."""

from __future__ import annotations

import ctypes
from contextlib import suppress
from functools import lru_cache
from typing import Any

from fusion.errors import FusionError


@lru_cache(maxsize=1)
def load() -> Any:
    """The module `open3d`. Where it cannot load, raises `FusionError` that names the system packages."""
    _preload_libusb()
    try:
        import open3d
    except (ImportError, OSError) as error:
        packages = "libegl1 libgl1 libx11-6 libudev1 libusb-1.0-0 libidn2-0"
        hint = f"pip install open3d-cpu; on Debian: apt-get install {packages}"
        raise FusionError(f"Open3D cannot be loaded: {error}", hint=hint) from None
    return open3d


def _preload_libusb() -> None:
    """Open3D links libusb, which slim systems lack, and a wheel carries."""
    with suppress(ImportError, OSError):
        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
