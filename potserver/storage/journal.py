"""The journal of a map: every accepted scan, from before it is in the map until a snapshot has it.

scans    a row a scan: its number, and the bytes of `pot.cloud.v1` with pose and robot, sealed. One beyond the last of the head
         is staged: it was written while it was worked on, and does not count
head     one row: which scans there must be (`_Head`), sealed
"""

from __future__ import annotations

import contextlib
import secrets
import sqlite3
from collections.abc import Iterator
from pathlib import Path

import msgspec

from potserver.errors import MapFileError, StorageError
from potserver.storage.seal import sealed, unsealed
from potserver.storage.sqlite import (
    Kind,
    close_keeping_log,
    connect,
    connect_read_only,
    reading,
    settle,
    transaction,
)

FORMAT = 2
KIND = Kind(
    application_id=0x706F746A,  # "potj"
    version=FORMAT,
    schema=(
        "CREATE TABLE scans (number INTEGER PRIMARY KEY, data BLOB NOT NULL)",
        "CREATE TABLE head (id INTEGER PRIMARY KEY CHECK (id = 0), content BLOB NOT NULL)",
    ),
    readable=(1,),
)


class _Head(msgspec.Struct, frozen=True, kw_only=True):
    store_id: str  # which tiles this is the journal of
    last: int  # number of the newest scan
    pruned: int  # scans up to this one may be gone: a snapshot has them
    closed: bool  # nothing happened since a snapshot took everything in


class Journal:
    """An open journal, which nobody else can open. One caller at a time."""

    def __init__(self, path: Path, *, fsync: bool = True, must_exist: bool = False) -> None:
        """Open or make it; nothing is written before `begin`.

        Args:
            path, fsync, must_exist: See `sqlite.connect`.
        Raises:
            MapFileError: damaged, or of another version. StorageError: another server has it, or the disk refuses.
        """
        self._path = path
        self._connection = connect(path, KIND, fsync=fsync, exclusive=True, must_exist=must_exist)
        try:
            with reading(path):
                found = self._connection.execute("SELECT content FROM head").fetchall()
            if found:
                head = self._parse(found[0][0])
            elif self._has_scans():
                raise self._damaged("its head", "is missing")
            else:
                head = _Head(store_id=secrets.token_hex(8), last=0, pruned=0, closed=True)
            self.was_closed = head.closed
            self._head = head
        except BaseException:
            close_keeping_log(self._connection, path)
            raise

    def begin(self, number: int) -> None:
        """Go on from here: the mark that all is complete goes, and the next scan gets a higher number than any before.

        Args:
            number: The largest that was ever given, if the journal does not know it; a snapshot has everything up to it.
        Raises:
            StorageError: the disk refuses.
        """
        with transaction(self._connection, self._path):
            self._drop_staged()
            if number > self.last:
                self._prune(number)
                head = self._put_head(last=number, pruned=number, closed=False)
            else:
                head = self._put_head(closed=False)
        self._head = head
        settle(self._connection, self._path)  # whose journal it is must not hang on the log

    @property
    def store_id(self) -> str:
        """Drawn when the journal was made; the map file of the same store holds it too."""
        return self._head.store_id

    @property
    def last(self) -> int:
        """Number of the newest scan; 0 before the first."""
        return self._head.last

    @property
    def pruned(self) -> int:
        """Scans up to this number may be gone."""
        return self._head.pruned

    def stage(self, cloud: bytes, *, prune_to: int) -> None:
        """Write a scan, on the disk when this returns, that does not count before `count_staged`. One that never did goes.

        Args:
            cloud: The scan as `pot.cloud.v1`, with pose and robot.
            prune_to: Number of the last scan that is in a snapshot: it and those before it are deleted.
        Raises:
            StorageError: the disk refuses.
        """
        number = self._head.last + 1
        content = sealed(cloud, place=_place(number))
        with transaction(self._connection, self._path):
            self._connection.execute("INSERT OR REPLACE INTO scans VALUES (?, ?)", (number, content))
            self._prune(prune_to)
            head = self._put_head(pruned=max(prune_to, self.pruned))
        self._head = head

    def count_staged(self) -> None:
        """The staged scan is one of the journal from now on, and that is on the disk when this returns.

        Raises:
            StorageError: the disk refuses; the journal is as it was.
        """
        with transaction(self._connection, self._path):
            head = self._put_head(last=self._head.last + 1)
        self._head = head

    def scans(self, after: int) -> Iterator[tuple[int, bytes]]:
        """The scans with higher numbers than `after`, in order, each checked as it comes.

        Raises:
            MapFileError: one is missing or damaged.
        """
        for number in range(after + 1, self.last + 1):
            with reading(self._path):
                row = self._connection.execute(
                    "SELECT data FROM scans WHERE number = ?", (number,)
                ).fetchone()
            cloud = None if row is None else unsealed(row[0], place=_place(number))
            if cloud is None:
                raise self._damaged(
                    f"scan {number} of {self.last}", "is missing or does not fit its checksum"
                )
            yield number, cloud

    def close(self, *, complete_to: int | None = None) -> None:
        """Close; a second time does nothing.

        Args:
            complete_to: Number of the last scan in a snapshot, if nothing has happened to the map since.
        Raises:
            StorageError: the disk refuses the mark that all is complete; the journal is closed as it is.
        """
        try:
            if complete_to is not None and complete_to == self.last:
                with transaction(self._connection, self._path):
                    self._drop_staged()
                    self._prune(complete_to)
                    self._put_head(pruned=complete_to, closed=True)
        finally:
            with contextlib.suppress(sqlite3.Error):
                self._connection.close()

    def leave(self) -> None:
        """Close it as it was found."""
        close_keeping_log(self._connection, self._path)

    def _has_scans(self) -> bool:
        with reading(self._path):
            return self._connection.execute("SELECT 1 FROM scans LIMIT 1").fetchone() is not None

    def _prune(self, number: int) -> None:
        self._connection.execute("DELETE FROM scans WHERE number <= ?", (number,))

    def _drop_staged(self) -> None:
        """A scan that never counted: whoever sent it was told so, or nothing."""
        self._connection.execute("DELETE FROM scans WHERE number > ?", (self.last,))

    def _put_head(self, **changes: int | bool) -> _Head:
        head = msgspec.structs.replace(self._head, **changes)
        content = sealed(msgspec.json.encode(head))
        self._connection.execute("INSERT OR REPLACE INTO head VALUES (0, ?)", (content,))
        return head

    def _parse(self, data: object) -> _Head:
        content = unsealed(data)
        if content is None:
            raise self._damaged("its head", "does not fit its checksum")
        try:
            return msgspec.json.decode(content, type=_Head)
        except msgspec.DecodeError as error:
            raise self._damaged("its head", str(error)) from error

    def _damaged(self, part: str, what: str) -> MapFileError:
        return MapFileError(
            f"{self._path} is damaged: {part} {what}. What the last snapshot has can be saved with"
            f" `potserver map import {self._path.parent} -o NAME.map`; then move the folder away, start, and load it",
            reason="damaged",
        )


def is_in_use(path: Path) -> bool:
    """Whether a server has a journal open."""
    try:
        with contextlib.closing(connect_read_only(path, KIND, busy_s=0.0)):
            return False
    except StorageError as error:
        return error.reason == "in_use"
    except MapFileError:  # whoever opens it will say what is wrong
        return False


def scans_after(path: Path, number: int) -> int | None:
    """How many scans with higher numbers a journal has, or None where a server has it open; it is not changed.

    Raises:
        MapFileError: it is missing or damaged. StorageError: it cannot be opened.
    """
    try:
        with contextlib.closing(connect_read_only(path, KIND, busy_s=0.0)) as connection, reading(path):
            found = connection.execute("SELECT content FROM head").fetchone()
            content = None if found is None else unsealed(found[0])
            last = 0 if content is None else msgspec.json.decode(content, type=_Head).last
            row = connection.execute(
                "SELECT COUNT(*) FROM scans WHERE number > ? AND number <= ?", (number, last)
            ).fetchone()
    except StorageError as error:
        if error.reason == "in_use":
            return None
        raise
    return int(row[0])


def _place(number: int) -> bytes:
    """A scan's number is part of its seal: a scan that stands at another number is damaged."""
    return number.to_bytes(8, "little")
