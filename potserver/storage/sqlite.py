"""What the files of a store have in common: SQLite, opened the same way, with our errors."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from potserver.errors import MapFileError, StorageError

_PAGE_BYTES = 16_384  # values are of 10 to 300 kB
_WAL_BYTES = 64 * 2**20  # to which a long log is cut back
_BUSY_S = 5.0


class Kind(NamedTuple):
    """What a file is: the two marks in SQLite's own header, and the tables."""

    application_id: int
    version: int
    schema: tuple[str, ...]


def connect(
    path: Path, kind: Kind, *, fsync: bool = True, exclusive: bool = False, wal: bool = True
) -> sqlite3.Connection:
    """Open or make a file for writing; any thread may use it, one at a time.

    Args:
        path: The file.
        kind: What a new file becomes, and an old one must be.
        fsync: Wait for the disk at each commit. Without, a crash of the machine may take the last commits; one of the process
            does not.
        exclusive: Let nobody else open it.
        wal: Commit to a log beside the file, which costs one wait for the disk. Without, the file is all there is, and a crash
            in the middle of a commit ruins it: for files that get their name when they are complete.
    Raises:
        MapFileError: not such a file, of another version, or damaged.
        StorageError: it cannot be opened or written, or somebody else has it open.
    """
    with reading(path):
        connection = sqlite3.connect(
            path, isolation_level=None, check_same_thread=False, timeout=0.0 if exclusive else _BUSY_S
        )
    try:
        with reading(path):
            _harden(connection)
            connection.execute(f"PRAGMA page_size = {_PAGE_BYTES}")
            connection.execute(f"PRAGMA locking_mode = {'EXCLUSIVE' if exclusive else 'NORMAL'}")
            connection.execute(f"PRAGMA synchronous = {'FULL' if fsync else 'NORMAL'}")
            connection.execute(f"PRAGMA journal_size_limit = {_WAL_BYTES}")
            is_new = _pragma(connection, "schema_version") == 0
            connection.execute(f"PRAGMA journal_mode = {'WAL' if wal else 'MEMORY'}")
        with transaction(connection, path):  # takes the lock
            if is_new:
                connection.execute(f"PRAGMA application_id = {kind.application_id}")
                connection.execute(f"PRAGMA user_version = {kind.version}")
                for statement in kind.schema:
                    connection.execute(statement)
        _check(connection, path, kind)
    except BaseException:
        connection.close()
        raise
    return connection


def connect_read_only(path: Path, kind: Kind, *, busy_s: float = _BUSY_S) -> sqlite3.Connection:
    """Open a file that is there, to read.

    Args:
        path: The file.
        kind: What it must be.
        busy_s: How long to wait for somebody who has it open alone.
    Raises:
        MapFileError: there is none, it is not such a file, of another version, or damaged.
        StorageError: somebody else has it open alone; `reason` is `in_use`.
    """
    if not path.is_file():
        raise MapFileError(f"no map file at {path}", reason="missing")
    with reading(path):
        connection = sqlite3.connect(
            f"{path.absolute().as_uri()}?mode=ro", uri=True, isolation_level=None, timeout=busy_s
        )
    try:
        with reading(path):
            _harden(connection)
        _check(connection, path, kind)
    except BaseException:
        connection.close()
        raise
    return connection


@contextlib.contextmanager
def reading(path: Path) -> Iterator[None]:
    """Give SQLite's errors our names: what cannot be read is damaged, what is locked is in use."""
    try:
        yield
    except (sqlite3.Error, UnicodeError, OverflowError) as error:
        if _is_locked(error):
            raise _in_use(path) from error
        if "unable to open" in str(error) or "readonly" in str(error):
            raise StorageError(f"cannot open {path}: {error}") from error
        raise MapFileError(
            f"{path} is damaged, or no file of ours: {error}{after_damage(path)}", reason="damaged"
        ) from error


def after_damage(path: Path) -> str:
    """What to do about a damaged file, to follow what is wrong with it."""
    if path.suffix != ".sqlite":  # a file of its own: a saved map, or something else altogether
        return ". Take another copy of it"
    return (
        ". Move it and its folder away, start with an empty map, and load a saved copy (`potclient map load NAME`) if there"
        " is one"
    )


@contextlib.contextmanager
def transaction(connection: sqlite3.Connection, path: Path) -> Iterator[None]:
    """All or nothing, and on the disk when the block has ended.

    Raises:
        StorageError: the disk refuses; nothing was changed.
    """
    try:
        connection.execute("BEGIN IMMEDIATE")
        try:
            yield
            connection.execute("COMMIT")
        except BaseException:
            # some errors, a full disk among them, have rolled back already
            if connection.in_transaction:
                with contextlib.suppress(sqlite3.Error):
                    connection.execute("ROLLBACK")
            raise
    except sqlite3.Error as error:  # what cannot be written is the disk's fault
        if _is_locked(error):
            raise _in_use(path) from error
        raise StorageError(f"cannot write {path}: {error}") from error


def _check(connection: sqlite3.Connection, path: Path, kind: Kind) -> None:
    with reading(path):
        mark, found = _pragma(connection, "application_id"), _pragma(connection, "user_version")
    if mark != kind.application_id:
        raise MapFileError(f"{path} is an SQLite file of another program", reason="not_a_map")
    if found != kind.version:
        raise MapFileError(
            f"{path} is of format {found}, this program reads format {kind.version}: use the version of potserver that wrote"
            " it, or move the file's folder away to start anew",
            reason="version",
        )


def _harden(connection: sqlite3.Connection) -> None:
    """A file may come from anywhere: trust neither its schema nor its pages."""
    connection.execute("PRAGMA trusted_schema = OFF")
    connection.execute("PRAGMA cell_size_check = ON")


def _pragma(connection: sqlite3.Connection, name: str) -> int:
    return int(connection.execute(f"PRAGMA {name}").fetchone()[0])


def _is_locked(error: Exception) -> bool:
    return "locked" in str(error)


def _in_use(path: Path) -> StorageError:
    return StorageError(
        f"{path} is in use: another server keeps its map there; give this one a store of its own"
        " (--store, or another --server-id), or none (--in-memory)",
        reason="in_use",
    )
