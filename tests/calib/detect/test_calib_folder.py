"""Many images: in order, in threads; taken up again after a kill; caches that cannot be trusted."""

from __future__ import annotations

import json
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from board_pictures import shoot, without_board

from calib.boards import Board
from calib.detect.cache import DetectionCache
from calib.detect.folder import Found, ImageRef, find_in_images
from calib.observations import Detection, Refusal
from fusion.errors import FrameError

BOARD = Board.of("circles", 6, 4, 0.03)
SMALL = (200, 150)


class Folder:
    """Images on disk: two with the board, one without, one damaged; counts what is read."""

    def __init__(self, path: Path) -> None:
        self.path, self.read, self.lock = path, list[str](), threading.Lock()
        for k, image in enumerate((self.board(0.1), without_board(1, SMALL), self.board(0.3))):
            cv2.imwrite(str(path / f"{k}.png"), image)
        (path / "3.png").write_bytes(b"\x89PNG no image")

    @staticmethod
    def board(turn: float) -> Any:
        return shoot(BOARD, turn=turn, size_wh=SMALL).counts(60, 120, noise=1)

    def refs(self) -> list[ImageRef]:
        def reader(file: Path) -> Any:
            def read() -> Any:
                with self.lock:
                    self.read.append(file.name)
                image = cv2.imdecode(np.frombuffer(file.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
                if image is None:
                    raise FrameError("cannot be decoded", where=file)
                return image

            return read

        files = sorted(self.path.glob("*.png"))
        return [ImageRef(f.stem, reader(f), str(f), stamp_ns=k) for k, f in enumerate(files)]


@pytest.fixture
def folder(tmp_path: Path) -> Folder:
    return Folder(tmp_path)


def kinds(found: Sequence[Found]) -> list[str]:
    return [type(one.result).__name__ for one in found]


def same(one: Found, two: Found) -> bool:
    a, b = one.result, two.result
    if isinstance(a, Refusal) or isinstance(b, Refusal):
        return a == b and one.size_wh == two.size_wh
    equal = np.array_equal(a.ids, b.ids) and np.array_equal(a.uv, b.uv)
    return equal and (a.method, a.notes, one.size_wh) == (b.method, b.notes, two.size_wh)


def test_one_result_an_image_in_order_whatever_the_workers(folder: Folder) -> None:
    seen: list[tuple[int, int]] = []
    one = find_in_images(folder.refs(), BOARD, progress=lambda *done: seen.append(done))
    assert kinds(one) == ["Detection", "Refusal", "Detection", "Refusal"]
    assert seen == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert [found.name for found in one] == ["0", "1", "2", "3"]
    assert [found.stamp_ns for found in one] == [0, 1, 2, 3]
    assert one[0].size_wh == SMALL
    assert one[3].size_wh is None
    assert isinstance(one[3].result, Refusal)
    assert "cannot be decoded" in one[3].result.reason
    many = find_in_images(folder.refs(), BOARD, workers=3)
    assert all(same(a, b) for a, b in zip(one, many, strict=True))


def test_second_run_reads_only_what_was_not_done(folder: Folder, tmp_path: Path) -> None:
    """The first run is stopped after two images; what it found is not searched again."""
    path = tmp_path / "cache" / "rgb.jsonl"

    class Killed(BaseException):
        pass

    def stop(done: int, _: int) -> None:
        if done == 2:
            raise Killed

    with DetectionCache(path, BOARD) as cache, pytest.raises(Killed):
        find_in_images(folder.refs()[:2] + folder.refs()[2:], BOARD, cache=cache, progress=stop)
    lines = path.read_text().splitlines()
    assert len(lines) >= 2
    path.write_text(lines[0] + "\n" + lines[1] + "\n" + lines[0][:50])  # killed while it wrote
    done = 2
    folder.read.clear()
    with DetectionCache(path, BOARD) as cache:
        found = find_in_images(folder.refs(), BOARD, cache=cache)
        assert (cache.hits, cache.damaged) == (done, 1)
    assert len(folder.read) == 4 - done
    folder.read.clear()
    with DetectionCache(path, BOARD) as cache:
        again = find_in_images(folder.refs(), BOARD, cache=cache)
        assert (cache.hits, cache.damaged) == (3, 1)
    assert folder.read == ["3.png"]  # an image that cannot be read is tried again
    assert all(same(a, b) for a, b in zip(found, again, strict=True))
    assert [one.cached for one in again] == [True, True, True, False]


def test_key_is_the_content_the_part_and_the_board(folder: Folder, tmp_path: Path) -> None:
    file = str(folder.path / "0.png")
    cache = DetectionCache(tmp_path / "c", BOARD)
    other = DetectionCache(tmp_path / "c", Board.of("circles", 6, 4, 0.031))
    assert cache.key(file) == cache.key(file)
    assert cache.key(file) != cache.key(file, "frame 1")
    assert cache.key(file) != other.key(file)
    assert cache.key(str(tmp_path / "none")) is None
    moved = folder.path / "moved.png"
    moved.write_bytes((folder.path / "0.png").read_bytes())
    assert cache.key(str(moved)) == cache.key(file)
    moved.write_bytes(moved.read_bytes() + b"x")
    assert DetectionCache(tmp_path / "c", BOARD).key(str(moved)) != cache.key(file)


def test_lines_that_lie_are_counted_and_left_out(folder: Folder, tmp_path: Path) -> None:
    path = tmp_path / "cache.jsonl"
    with DetectionCache(path, BOARD) as cache:
        find_in_images(folder.refs()[:1], BOARD, cache=cache)
    good = path.read_text()
    line = json.loads(good)["line"]

    def forged(**change: Any) -> str:
        import zlib

        text = json.dumps(json.loads(line) | change)
        return json.dumps({"sum": zlib.crc32(text.encode()), "line": text})

    uv = json.loads(line)["uv"]
    bad = [
        good.replace(f"{uv[0][0]}", f"{uv[0][0] + 1}", 1),  # the check sum alone tells
        forged(ids=[0, 0, 1, 2], uv=uv[:4]),
        forged(ids=[0, 1, 2, 99], uv=uv[:4]),
        forged(ids=[0, 1, 2, -1], uv=uv[:4]),
        forged(ids=[0, 1, 2, 3], uv=uv[:3]),
        forged(ids=[0, 1, 2, 3], uv=[[1e9, 0]] * 4),
        forged(ids=[0, 1, 2, 3], uv=[[float("nan"), 0]] * 4),
        forged(size_wh=[0, 10]),
        forged(size_wh=None),
        "[]",
        "\x00\xff",
        "[" * 100000,
    ]
    path.write_text("\n".join(bad) + "\n")
    cache = DetectionCache(path, BOARD)
    assert cache.damaged == len(bad)
    folder.read.clear()
    with cache:
        assert kinds(find_in_images(folder.refs()[:1], BOARD, cache=cache)) == ["Detection"]
    assert folder.read == ["0.png"]


def test_another_boards_lines_are_no_damage(folder: Folder, tmp_path: Path) -> None:
    path = tmp_path / "cache.jsonl"
    with DetectionCache(path, BOARD) as cache:
        find_in_images(folder.refs()[:1], BOARD, cache=cache)
    other = DetectionCache(path, Board.of("circles", 3, 3, 0.03))
    assert (other.damaged, other.get(other.key(str(folder.path / "0.png")))) == (0, None)


def test_debug_gives_a_picture_an_image_even_where_cached(folder: Folder, tmp_path: Path) -> None:
    with DetectionCache(tmp_path / "c", BOARD) as cache:
        find_in_images(folder.refs(), BOARD, cache=cache)
        pictures: dict[str, Any] = {}
        find_in_images(
            folder.refs(), BOARD, cache=cache, debug=lambda ref, picture: pictures.update({ref.name: picture})
        )
    assert sorted(pictures) == ["0", "1", "2"]
    assert all(picture.ndim == 3 for picture in pictures.values())


def test_detections_are_checked_when_made() -> None:
    with pytest.raises(ValueError, match="different ids"):
        Detection(np.array([1, 1]), np.zeros((2, 2)), "x")
