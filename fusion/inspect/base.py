"""What is said of anything that is inspected: plain values, and the one table of what can be."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

from numpy.typing import NDArray

from fusion.messages.roles import Roles

FORMAT = "fusion-inspect/1"
QUICK_BYTES = 64 * 2**20  # a recording up to this size is read whole even without --full
QUICK_ITEMS = 20  # pictures or clouds decoded of a stream without --full
# Numbers, texts, lists and tables as JSON has them. A key says its unit: _ns, _s, _ms, _hz, _bytes, _m, _wh.
Facts = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Looked:
    """How much of something was looked at: `seen` of `of` (None: nobody knows how many there are)
    `things`.
    """

    seen: int
    of: int | None
    things: str

    def __str__(self) -> str:
        if self.seen == self.of:
            return (
                f"{'all ' if self.of != 1 else ''}{self.of:,} {'of 1 ' if self.of == 1 else ''}{self.things}"
            )
        return (
            f"{self.seen:,} of {'an unknown number of' if self.of is None else f'{self.of:,}'} {self.things}"
        )


@dataclass(frozen=True, slots=True)
class Times:
    """What the stamps of a stream say; of the messages that `looked` counts, and of no others.

    `clock` is ``header``, ``log`` or ``name``. `first_ns` and `last_ns` are the least and the greatest stamp,
    `without` counts messages that have none. The rest is as `fusion.timing.rates` has it, and None unless
    every message was seen: `gaps_ns` are (begin, end), the longest first, `gap_count` is how many there are;
    `backwards` and `duplicates` count steps below and at zero; `delay_ms` is log time minus stamp, (median,
    spread).
    """

    clock: Literal["header", "log", "name"]
    looked: Looked
    first_ns: int
    last_ns: int
    without: int = 0
    rate_hz: float | None = None
    jitter_ms: float | None = None
    gap_count: int | None = None
    gaps_ns: tuple[tuple[int, int], ...] = ()
    backwards: int | None = None
    duplicates: int | None = None
    delay_ms: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class Stream:
    """A topic, or the images or clouds of one folder. `count` is None where nobody counted.

    `facts` are measured of the items that `looked` counts. `used` says what its items are read as (``image``,
    ``cloud``, …), "" for what is not used. `stamps_ns` are the times that were seen, for the page's time line
    only.
    """

    name: str
    type: str
    used: str
    count: int | None = None
    encoding: str = ""
    looked: Looked | None = None
    facts: Facts = field(default_factory=dict)
    times: Times | None = None
    notes: tuple[str, ...] = ()
    stamps_ns: NDArray[Any] | None = field(default=None, compare=False, repr=False)


class Step(NamedTuple):
    """What to do next: a command's words (not quoted yet), and what it is for."""

    words: tuple[str, ...]
    why: str


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture for the page: PNG or JPEG bytes."""

    title: str
    caption: str
    data: bytes = field(repr=False)


@dataclass(frozen=True, slots=True)
class Finding:
    """What is in `path`. `kind` is a row of `KINDS`, `title` says it in words; `notes` are worth knowing,
    `faults` what is damaged, and how much of it is whole; `steps` come next.
    """

    path: str
    kind: str
    title: str
    facts: Facts = field(default_factory=dict)
    streams: tuple[Stream, ...] = ()
    roles: Roles | None = None
    notes: tuple[str, ...] = ()
    faults: tuple[str, ...] = ()
    steps: tuple[Step, ...] = ()
    pictures: tuple[Picture, ...] = ()


def no_progress(done: int, total: int) -> None:
    """Says nothing."""


@dataclass(frozen=True, slots=True)
class Asked:
    """How closely to look: `full` reads everything, `pictures` makes those of the page."""

    full: bool = False
    pictures: bool = False
    progress: Callable[[int, int], None] = no_progress


@dataclass(frozen=True, slots=True)
class InspectKind:
    """One row of the table: what it `expects` in words, whether it `accepts` a path, how to `look` at it."""

    expects: str
    accepts: Callable[[Path], bool]
    look: Callable[[Path, Asked], Finding]


FALLBACK = "a folder of images, of clouds, or of such folders"  # any folder: where it fails, others are asked
# Name -> "module:attribute" of its `InspectKind`, tried in this order. Text, so that naming one imports none.
KINDS: dict[str, str] = {
    "run": "fusion.inspect.run:RUN",  # before recordings: it may hold an MCAP
    "mine": "fusion.inspect.mine:MINE",
    "recording": "fusion.inspect.recording:RECORDING",
    "rig": "fusion.inspect.rigs:RIG",
    "manifest": "fusion.inspect.dataset:MANIFEST",
    "radiometric": "fusion.inspect.image:RADIOMETRIC",
    "image": "fusion.inspect.image:IMAGE",
    "video": "fusion.inspect.image:VIDEO",
    "cloud": "fusion.inspect.cloud:CLOUD",
    "dataset": "fusion.inspect.dataset:ROOT",
    "folder": "fusion.inspect.folder:FOLDER",
}


def steps_of(*steps: tuple[Sequence[object], str]) -> tuple[Step, ...]:
    """Steps from (words, why); words may be paths and numbers."""
    return tuple(Step(tuple(map(str, words)), why) for words, why in steps)
