"""Detections kept between runs: one line of JSON an image, appended as soon as it is there.

A line is known by the SHA-256 of the image's file, the board and the detectors' version, and holds a check
sum. Lines that are cut or damaged are left out and counted: their images are searched again.
"""

from __future__ import annotations

import hashlib
import json
import threading
import zlib
from pathlib import Path
from typing import IO, Any

import numpy as np

from calib.boards import Board, board_toml
from calib.detect.find import VERSION
from calib.observations import Detection, Refusal
from fusion.files import output_error

Result = Detection | Refusal
Kept = tuple[tuple[int, int], Result]
_LARGEST_BYTES = 1 << 28


class DetectionCache:
    """What was found before, by key: read when made, appended to by `put`; threads may share it.

    `hits` counts what was taken from it, `damaged` the lines that could not be used. A context manager. A
    journal that cannot be read is begun anew; one that cannot be written raises `OutputError`.
    """

    def __init__(self, path: Path, board: Board) -> None:
        self.path, self.hits, self.damaged = path, 0, 0
        self._board, self._lock = board, threading.Lock()
        self._board_key = hashlib.sha256(f"{VERSION}\n{board_toml(board)}".encode()).hexdigest()[:16]
        self._files: dict[str, str] = {}
        self._kept: dict[str, Kept] = {}
        self._journal: IO[bytes] | None = None
        self._whole = self._load()

    def key(self, file: str, part: str = "") -> str | None:
        """The key of an image: its file's bytes, and which `part` of it; None where no file can be read."""
        with self._lock:
            digest = self._files.get(file)
        if digest is None:
            try:
                digest = _digest(Path(file))
            except OSError:
                return None
            with self._lock:
                self._files[file] = digest
        return hashlib.sha256(f"{digest}\n{part}\n{self._board_key}".encode()).hexdigest()

    def get(self, key: str | None) -> Kept | None:
        """The image's size and what was found in it, or None."""
        with self._lock:
            kept = self._kept.get(key or "")
            self.hits += kept is not None
        return kept

    def put(self, key: str | None, size_wh: tuple[int, int], result: Result) -> None:
        """Keep a result. Raises `OutputError`."""
        if key is None:
            return
        body: dict[str, Any] = {"key": key, "board": self._board_key, "size_wh": list(size_wh)}
        if isinstance(result, Refusal):
            body["reason"] = result.reason
        else:
            body |= {"method": result.method, "notes": list(result.notes)}
            body |= {"ids": result.ids.tolist(), "uv": result.uv.tolist()}
        text = json.dumps(body, separators=(",", ":"))
        line = json.dumps({"sum": zlib.crc32(text.encode()), "line": text}) + "\n"
        with self._lock:
            self._kept[key] = size_wh, result
            try:
                self._open().write(line.encode())
            except OSError as error:
                raise output_error(error, self.path) from None

    def close(self) -> None:
        if self._journal is not None:
            self._journal.close()
            self._journal = None

    def __enter__(self) -> DetectionCache:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _open(self) -> IO[bytes]:
        if self._journal is None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._journal = self.path.open("ab", buffering=0)
            if not self._whole:  # a run that was killed left half a line
                self._journal.write(b"\n")
        return self._journal

    def _load(self) -> bool:
        """Read the journal; whether it ends with a whole line."""
        try:
            if self.path.stat().st_size > _LARGEST_BYTES:
                self.damaged += 1
                return True
            data = self.path.read_bytes()
        except OSError:
            return True
        for line in data.splitlines():
            self._take(line)
        return not data or data.endswith(b"\n")

    def _take(self, line: bytes) -> None:
        if not line.strip():
            return
        try:
            outer = json.loads(line)
            text = outer["line"]
            if zlib.crc32(text.encode()) != outer["sum"]:
                raise ValueError("check sum")
            body = json.loads(text)
            if body["board"] != self._board_key:  # another board's, or an older detector's
                return
            self._kept[str(body["key"])] = _kept(body, self._board)
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError, OverflowError):
            self.damaged += 1


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _kept(body: dict[str, Any], board: Board) -> Kept:
    """A line's content, checked as if a stranger had written it. Raises `ValueError` and its like."""
    width, height = (int(n) for n in body["size_wh"])
    if not (0 < width < 1 << 16 and 0 < height < 1 << 16):
        raise ValueError("size")
    if "reason" in body:
        return (width, height), Refusal(str(body["reason"]))
    ids, uv = np.array(body["ids"], np.intp), np.array(body["uv"], np.float64).reshape(-1, 2)
    if ids.ndim != 1 or len(ids) < 4 or ids.min() < 0 or ids.max() >= len(board.points_m):
        raise ValueError("ids")
    inside = (uv >= -0.5).all(1) & (uv <= (width - 0.5, height - 0.5)).all(1)
    if not (board.visible[ids].all() and inside.all()):
        raise ValueError("points")
    notes = tuple(str(note) for note in body["notes"])
    return (width, height), Detection(ids, uv, str(body["method"]), notes)
