"""Outputs that are one file in the end: a part for each chunk, joined when all are done."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from fusion.chunks import Chunk, record_name
from fusion.errors import OutputError
from fusion.files import output_error
from fusion.sinks.base import Made
from fusion.storage import Storage

NO_RATE_HZ = 10.0  # of frames without clock, where nobody knows their rate


@dataclass(frozen=True, slots=True)
class JoinedParts:
    """The parts below `folder`, called by their chunk and `suffix`; `joined` tells what the joined file
    holds.

    In a local folder parts come and go: no record of a chunk names them, for they are gone after a run that
    finished. So `finish` itself makes sure that none is missing. It may be killed and repeated at any
    moment: parts are removed after the joined file has its name, a part wins over what was joined before,
    and what is in neither loses its chunk's record, so that the same command makes it again. Elsewhere parts
    stay and are named.
    """

    folder: str
    suffix: str
    joined: Callable[[Path], tuple[Sequence[str], set[str]]]  # of the output's folder: names, keys of chunks

    def name(self, chunk: Chunk) -> str:
        return f"{self.folder}/{chunk.name}{self.suffix}"

    def store(self, chunk: Chunk, data: bytes, out: Storage) -> Mapping[str, int]:
        """Store a part; what the chunk's record shall say of it."""
        out.write(self.name(chunk), data)
        return {} if local_folder(out) else {self.name(chunk): len(data)}

    def finish(
        self,
        chunks: Sequence[Chunk],
        out: Storage,
        join: Callable[[Path, Mapping[str, Path | None]], Sequence[str]],
    ) -> Sequence[str]:
        """Let `join` put the parts together, in the order of the chunks; the names of what is there then.

        `join` gets the output's folder and, by the chunk's key, the part, or None where the joined file
        holds it. Raises `OutputError` where a part is missing, and what `join` raises.
        """
        folder = local_folder(out)
        if folder is None:
            return (f"{self.folder}/",)
        parts = {*out.names(self.folder)}
        names, joined = self.joined(folder)
        chunks = sorted(chunks, key=lambda chunk: chunk.index)
        self._check([c for c in chunks if self.name(c) not in parts and key_of(c) not in joined], out)
        keys = {key_of(c): folder / self.name(c) if self.name(c) in parts else None for c in chunks}
        if parts or joined != set(keys):
            names = join(folder, keys)
        for part in parts if names else ():
            out.remove(part)
        with suppress(OSError):  # another output's parts may still be there
            for empty in (folder / self.folder, (folder / self.folder).parent):
                empty.rmdir()
        return names

    def _check(self, missing: Sequence[Chunk], out: Storage) -> None:
        if not missing:
            return
        for chunk in missing:
            out.remove(record_name(chunk))
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        hint = "run the same command again: what is missing is made again"
        raise OutputError(f"the part {self.name(missing[0])}{more} is gone", where=out.url, hint=hint)


def local_folder(out: Storage) -> Path | None:
    """The folder that a storage is, None where it is remote or in memory."""
    scheme, mark, rest = out.url.partition("://")
    if not mark:
        return Path(out.url)
    return Path(rest) if scheme in ("file", "local") else None


def key_of(chunk: Chunk) -> str:
    """What tells a chunk from one of another plan."""
    return f"{chunk.name} {chunk.begin} {chunk.end}"


def stamp_of(made: Made, chunk: Chunk, position: int, rate_hz: float) -> int:
    """When the frame was seen, ns: the RGB image's stamp.

    Frames without a clock come from folders, whose chunks count pairs: they are placed at their number over
    `rate_hz`, from 0 (1970) on, so that they play in order; `position` is how many came before in the chunk.
    Where nobody knows the rate it is 10 Hz.
    """
    for stamp_ns in (made.fused.rgb_stamp_ns, made.frames.rgb.stamp_ns):
        if stamp_ns is not None:
            return stamp_ns
    rate = rate_hz if math.isfinite(rate_hz) and rate_hz > 0 else NO_RATE_HZ
    return round((chunk.begin + position) * 1e9 / rate)


def replace_by(target: Path, write: Callable[[Path], None]) -> None:
    """Let `write` fill a temporary file beside `target`, then rename it. Raises `OutputError`.

    Its name is that of a storage's temporary files, which the next run clears, and always the same for one
    target.
    """
    digest = hashlib.sha256(target.name.encode()).hexdigest()[:32]
    temporary = target.with_name(f".{digest}.tmp")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        write(temporary)
        temporary.replace(target)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise output_error(error, target) from None
        raise
