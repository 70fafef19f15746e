"""rosbag2's sqlite3 storage (.db3), read only and in place; what is left of one that is damaged."""

from __future__ import annotations

import re
import shutil
import sqlite3
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any
from urllib.parse import quote

from fusion.errors import InputError
from fusion.recordings.base import Packet, Schema, Topic
from fusion.recordings.chunks import merge_topics, normal_type
from fusion.recordings.files import Faults, Workspace, first_bytes, stem
from fusion.recordings.unpack import MAX_CHUNK_BYTES

MAGIC = b"SQLite format 3\0"
MAX_TOPICS = 1 << 16
MAX_TIME_NS = (1 << 63) - 1
# What sqlite says of a damaged file may quote its bytes, and Python then fails to decode the message.
_DAMAGES = (sqlite3.Error, UnicodeDecodeError)
_new_packet = tuple.__new__  # half the cost of calling Packet
_IN_TIME = "timestamp >= :start AND timestamp < :end"
_IN_ORDER = "SELECT topic_id, timestamp, rowid, data FROM messages WHERE {} ORDER BY timestamp, rowid"
_PLACES = "SELECT timestamp, rowid FROM messages WHERE {} AND rowid {} ? ORDER BY rowid {}"


class Sqlite3Recording:
    """See `Recording`. Every call of `packets` has a connection of its own."""

    form = "rosbag2 (sqlite3)"

    def __init__(self, path: str, shown: str | None = None) -> None:
        """`shown` is what messages call the file, where `path` is a copy of it."""
        self.path, self.shown = path, shown or path
        self.name = stem(self.shown)
        self.files: Sequence[str] = (self.shown,)
        self.noted = Faults()
        self.faults: Sequence[str] = self.noted
        self.metadata = ""  # YAML, where the file holds it
        self.topics: Sequence[Topic] = ()
        self.span_ns: tuple[int, int] | None = None
        self._workspace = Workspace()
        self._closed = False
        try:
            self._open()
        except _DAMAGES as error:
            self.close()
            raise InputError(f"nothing of it can be read: {error}", where=self.shown) from error
        except BaseException:
            self.close()
            raise

    def _open(self) -> None:
        self._settle_leftovers()
        self._cut = self._is_cut()
        with closing(self._connect()) as db:
            _check_tables(db, self.shown)
            rows = _rows_of_topics(db)
            definitions = self._definitions(db)
            connections = {
                key: Topic(name, _schema(kind, definitions), form) for key, name, kind, form in rows
            }
            same = {key: topic.schema for key, topic in connections.items()}
            self.topics, self.ids = merge_topics(connections, same.__getitem__, None)
            self._ordered = not self._cut and _has_order(db)
            if not self._ordered and not self._cut:
                self.noted.add(
                    f"{self.shown}: has no index by time: its messages are sorted for every reading"
                )
            self.span_ns = self._find_span(db)
            self.metadata = self._own_metadata(db)

    def _connect(self) -> sqlite3.Connection:
        """Read only, without locks or files beside it: folders may be read-only, too."""
        url = f"file:{quote(str(Path(self.path).absolute()))}?mode=ro&immutable=1"
        db = sqlite3.connect(url, uri=True, check_same_thread=False, isolation_level=None)
        db.text_factory = lambda data: data.decode("utf-8", "replace")
        db.setlimit(
            sqlite3.SQLITE_LIMIT_LENGTH, min(MAX_CHUNK_BYTES, max(Path(self.path).stat().st_size, 1 << 16))
        )
        db.execute("PRAGMA trusted_schema = OFF")
        if self._cut:  # sqlite refuses files that are shorter than they say, but for this
            db.execute("PRAGMA writable_schema = ON")
        return db

    def _settle_leftovers(self) -> None:
        """A journal beside the file is of a killed writer: sqlite brings both together, in a copy."""
        self._cut = False
        beside = [Path(self.path + end) for end in ("-wal", "-journal")]
        found = [path for path in beside if path.is_file() and path.stat().st_size]
        if not found:
            return
        names = " and ".join(path.name for path in found)
        needed = sum(path.stat().st_size for path in [Path(self.path), *found])
        copy = self._workspace.path(Path(self.path).name)
        if shutil.disk_usage(copy.parent).free < 2 * needed:
            self.noted.add(
                f"{self.shown}: {names} beside it is left out: no room for a copy in {copy.parent}"
            )
            return
        for path in [Path(self.path), *found]:
            shutil.copyfile(path, copy.parent / path.name)
        try:
            with closing(sqlite3.connect(copy, isolation_level=None)) as db:
                db.execute("PRAGMA trusted_schema = OFF")
                db.execute("PRAGMA journal_mode = DELETE")
        except _DAMAGES as error:
            self.noted.add(f"{self.shown}: {names} beside it is left out: {error}")
            return
        self.noted.add(f"{self.shown}: was not closed: read with {names}")
        self.path = str(copy)

    def _is_cut(self) -> bool:
        head, size = first_bytes(self.path, 100), Path(self.path).stat().st_size
        if len(head) < 100 or not head.startswith(MAGIC):
            raise InputError(f"is no SQLite file: it begins with {head[:16]!r}", where=self.shown)
        page = int.from_bytes(head[16:18], "big")
        page = 1 << 16 if page == 1 else page
        claimed = page * int.from_bytes(head[28:32], "big")
        if size >= claimed or head[24:28] != head[92:96]:  # the second: nobody wrote the number of pages
            return False
        self.noted.add(f"{self.shown}: ends at byte {size} of {claimed}: what is whole is read")
        if size % page:
            self._keep_whole_pages(size - size % page)
        return True

    def _keep_whole_pages(self, size: int) -> None:
        """A copy without the page that the file ends in: sqlite would believe the zeros behind it."""
        copy = self._workspace.copy(self.path)
        with copy.open("r+b") as file:
            file.truncate(size)
        self.path = str(copy)

    def _definitions(self, db: sqlite3.Connection) -> dict[str, tuple[str, bytes]]:
        query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions LIMIT ?"
        try:
            rows = db.execute(query, (MAX_TOPICS,)).fetchall()
        except _DAMAGES as error:
            if "no such table" not in str(error):
                self.noted.add(f"{self.shown}: its message definitions cannot be read: {error}")
            return {}
        texts = [row for row in rows if all(isinstance(value, str) for value in row)]
        return {normal_type(kind): (form, text.encode()) for kind, form, text in texts}

    def _own_metadata(self, db: sqlite3.Connection) -> str:
        try:
            row = db.execute("SELECT metadata FROM metadata ORDER BY rowid DESC LIMIT 1").fetchone()
        except _DAMAGES:
            return ""
        return row[0] if row and isinstance(row[0], str) else ""

    def _find_span(self, db: sqlite3.Connection) -> tuple[int, int] | None:
        """Two looks at the index; without one, all rows."""
        ends = []
        try:
            for which in ("min", "max"):
                query = f"SELECT {which}(timestamp) FROM messages WHERE {_IN_TIME}"  # noqa: S608 - our own words
                ends.append(db.execute(query, {"start": 0, "end": MAX_TIME_NS}).fetchone()[0])
            odd = "timestamp IS NULL OR timestamp < 0 OR timestamp >= ?"
            query = f"SELECT count(*) FROM messages WHERE {odd}"  # noqa: S608
            count = db.execute(query, (MAX_TIME_NS,)).fetchone()[0]
            if (ends[0] is None) != (ends[1] is None):
                raise sqlite3.DatabaseError("its index by time contradicts itself")
        except _DAMAGES as error:
            self._damaged(error)
            span = None
            for stamp, _ in self._places(db, 0, MAX_TIME_NS, (-1, -1), "1"):
                span = (min(span[0], stamp), max(span[1], stamp + 1)) if span else (stamp, stamp + 1)
            return span
        if count:
            self.noted.add(f"{self.shown}: {count} messages without a possible time are left out")
        return None if None in ends else (int(ends[0]), int(ends[1]) + 1)

    def _damaged(self, error: Exception) -> None:
        self._ordered = False
        self.noted.add(f"{self.shown}: is damaged ({error}): what is whole is read")

    def adopt(self, names: Mapping[Topic, Topic]) -> None:
        """Say the equal topics of a larger recording instead of its own."""
        self.ids = {key: names[topic] for key, topic in self.ids.items()}
        self.topics = tuple(names[topic] for topic in self.topics)

    def packets(
        self, topics: Collection[Topic] | None = None, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Packet]:
        """See `Recording.packets`."""
        if self._closed:
            raise ValueError("the recording is closed")
        wanted = None if topics is None else set(topics)
        ids = {key: topic for key, topic in self.ids.items() if wanted is None or topic in wanted}
        start, end = max(start_ns or 0, 0), MAX_TIME_NS if end_ns is None else min(end_ns, MAX_TIME_NS)
        return self._read(ids, start, end) if ids and start < end else iter(())

    def _read(self, ids: dict[int, Topic], start: int, end: int) -> Iterator[Packet]:
        only = "1" if len(ids) == len(self.ids) else f"topic_id IN ({','.join(map(str, ids))})"
        ordered, last, odd = self._ordered, (-1, -1), 0
        with closing(self._connect()) as db:
            try:
                if ordered:
                    query = _IN_ORDER.format(f"{_IN_TIME} AND {only}")
                    for key, stamp, row, data in db.execute(query, {"start": start, "end": end}):
                        topic, last = ids.get(key), (stamp, row)
                        if topic is None or type(data) is not bytes or type(stamp) is not int:
                            odd += 1
                        else:
                            yield _new_packet(Packet, (topic, stamp, data))
            except _DAMAGES as error:
                ordered = False
                self._damaged(error)
            if not ordered:
                yield from self._read_places(db, ids, start, end, last, only)
        if odd:
            self.noted.add(f"{self.shown}: {odd} messages of an unknown topic or without bytes are left out")

    def _read_places(
        self,
        db: sqlite3.Connection,
        ids: dict[int, Topic],
        start: int,
        end: int,
        last: tuple[int, int],
        only: str,
    ) -> Iterator[Packet]:
        """Messages after `last` (time, row) by way of a table of times and rows in a temporary file, which
        sqlite sorts; each message is then fetched on its own, so that one that is damaged costs no other.
        """
        lost, query = 0, "SELECT topic_id, data FROM messages WHERE rowid = ?"
        with closing(sqlite3.connect("", isolation_level=None, check_same_thread=False)) as places:
            places.execute("CREATE TABLE places (stamp INTEGER, place INTEGER)")
            places.execute("BEGIN")
            rows = self._places(db, start, end, last, only)
            places.executemany("INSERT INTO places VALUES (?, ?)", rows)
            for stamp, place in places.execute("SELECT stamp, place FROM places ORDER BY stamp, place"):
                try:
                    key, data = db.execute(query, (place,)).fetchone() or (None, None)
                except _DAMAGES:
                    key, data = None, None
                topic = ids.get(key) if type(key) is int else None
                if topic is None or type(data) is not bytes:
                    lost += 1
                    continue
                yield _new_packet(Packet, (topic, stamp, data))
        if lost:
            self.noted.add(f"{self.shown}: {lost} messages are damaged and left out")

    def _places(
        self, db: sqlite3.Connection, start: int, end: int, last: tuple[int, int], only: str
    ) -> Iterator[tuple[int, int]]:
        """(time, row) of the messages that can be reached: from the first row on, then from the last back."""
        reached, broken = -MAX_TIME_NS, False
        where = f"timestamp >= {start} AND timestamp < {end} AND {only}"
        for beyond, direction in ((">", "ASC"), (">", "DESC")):
            try:
                for stamp, row in db.execute(_PLACES.format(where, beyond, direction), (reached,)):
                    if direction == "ASC":
                        reached = row
                    if type(stamp) is int and (stamp, row) > last:
                        yield stamp, row
            except _DAMAGES as error:
                broken = True
                self.noted.add(f"{self.shown}: is damaged ({error}): what is whole is read")
            if not broken:
                return

    def close(self) -> None:
        self._closed = True
        self._workspace.close()


def _check_tables(db: sqlite3.Connection, shown: str) -> None:
    """The tables must be plain ones: views and virtual tables can run for ever."""
    names = ("messages", "topics", "message_definitions")
    query = "SELECT name, type, sql FROM sqlite_master WHERE name IN (?, ?, ?)"
    found = {name: (kind, str(sql).upper()) for name, kind, sql in db.execute(query, names)}
    for name in ("messages", "topics"):
        if name not in found:
            raise InputError(f"is an SQLite file but no recording: it has no table {name!r}", where=shown)
    for name, (kind, sql) in found.items():
        if kind != "table" or not sql.startswith("CREATE TABLE") or re.search(r"\bAS\s*\(", sql):
            raise InputError(f"is no recording: {name!r} is no plain table", where=shown)


def _rows_of_topics(db: sqlite3.Connection) -> list[tuple[int, str, str, str]]:
    rows: list[Any] = db.execute(
        "SELECT id, name, type, serialization_format FROM topics ORDER BY id LIMIT ?", (MAX_TOPICS,)
    ).fetchall()
    return [row for row in rows if isinstance(row[0], int) and all(isinstance(text, str) for text in row[1:])]


def _schema(kind: str, definitions: Mapping[str, tuple[str, bytes]]) -> Schema:
    name = normal_type(kind)
    return Schema(name, *definitions.get(name, ("", b"")))


def _has_order(db: sqlite3.Connection) -> bool:
    """Whether sqlite reads in the order of time by an index, without sorting."""
    query = "EXPLAIN QUERY PLAN " + _IN_ORDER.format(_IN_TIME)
    plan = " ".join(str(row[-1]) for row in db.execute(query, {"start": 0, "end": 1}))
    return "TEMP B-TREE" not in plan
