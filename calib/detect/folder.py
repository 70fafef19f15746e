"""Finding a board in many images: in threads, in order, taken up again where a run was stopped."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.boards import Board
from calib.detect.cache import DetectionCache, Result
from calib.detect.find import find_board
from calib.detect.picture import debug_picture
from calib.detect.trace import Trace
from calib.observations import Refusal
from fusion.errors import FusionError

Progress = Callable[[int, int], None]
Debug = Callable[["ImageRef", NDArray[np.uint8]], None]


@dataclass(frozen=True, slots=True)
class ImageRef:
    """An image that is not read yet: `name` for messages, `read` gives H x W or H x W x 3 pixels.

    `file` is the file that it lies in, `part` which part of it where that holds several (``frame 12``): they
    and the file's bytes are what a cache knows it by. `read` is called from several threads.
    """

    name: str
    read: Callable[[], NDArray[Any]]
    file: str = ""
    part: str = ""
    stamp_ns: int | None = None


@dataclass(frozen=True, slots=True)
class Found:
    """What was found in an image. `size_wh` is None where the image could not be read."""

    image: ImageRef
    size_wh: tuple[int, int] | None
    result: Result
    cached: bool = False

    @property
    def name(self) -> str:
        return self.image.name

    @property
    def stamp_ns(self) -> int | None:
        return self.image.stamp_ns


def find_in_images(
    images: Sequence[ImageRef],
    board: Board,
    *,
    cache: DetectionCache | None = None,
    workers: int = 1,
    progress: Progress | None = None,
    debug: Debug | None = None,
) -> list[Found]:
    """Search every image; one `Found` each, in the images' order, whatever the number of `workers`.

    An image that cannot be read is a `Refusal` with the reason, and is not cached. `progress(done, total)`
    and `debug(image, picture)` are called in order by the calling thread; with `debug` all images are
    searched, for a cache keeps no pictures. Raises `OutputError` where the cache cannot be written.
    """
    found: list[Found] = []
    search = _Search(board, cache, debug is not None)
    for one, picture in _in_order(search, images, max(1, workers)):
        found.append(one)
        if debug is not None and picture is not None:
            debug(one.image, picture)
        if progress is not None:
            progress(len(found), len(images))
    return found


_Step = tuple[Found, NDArray[np.uint8] | None]


@dataclass(frozen=True, slots=True)
class _Search:
    board: Board
    cache: DetectionCache | None
    pictures: bool

    def __call__(self, image: ImageRef) -> _Step:
        key = self.cache.key(image.file, image.part) if self.cache is not None and image.file else None
        kept = self.cache.get(key) if self.cache is not None and not self.pictures else None
        if kept is not None:
            return Found(image, *kept, cached=True), None
        trace = Trace(wanted=self.pictures)
        try:
            pixels = image.read()
            result = find_board(pixels, self.board, trace)
        except (FusionError, OSError) as error:
            return Found(image, None, Refusal(f"cannot be read: {error}")), None
        size_wh = pixels.shape[1], pixels.shape[0]
        if self.cache is not None:
            self.cache.put(key, size_wh, result)
        picture = debug_picture(pixels, result, trace, image.name, self.board) if self.pictures else None
        return Found(image, size_wh, result), picture


def _in_order(search: _Search, images: Sequence[ImageRef], workers: int) -> Iterator[_Step]:
    """Results in order; never more images under way than keep the workers busy."""
    with ThreadPoolExecutor(workers) as pool:
        waiting: list[Future[_Step]] = []
        try:
            for image in images:
                waiting.append(pool.submit(search, image))
                if len(waiting) > 2 * workers:
                    yield waiting.pop(0).result()
            while waiting:
                yield waiting.pop(0).result()
        finally:
            for future in waiting:
                future.cancel()
