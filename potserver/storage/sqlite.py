"""What the files of a store have in common: SQLite, opened the same way, with our errors."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from potserver.errors import MapFileError, StorageError
from potserver.storage.files import check_no_link, claim_file, disk_fault, disk_faults

_PAGE_BYTES = 16_384  # values are of 10 to 300 kB
_WAL_BYTES = 64 * 2**20  # to which a long log is cut back
_BUSY_S = 5.0
_READ_BYTES = 2**20
# What SQLite says when the disk refuses, and why; what it says of a damaged file is another matter. (Python 3.10 has no codes.)
_DISK_FAULTS = {
    "readonly database": "read_only",
    "disk is full": "full",
    "disk I/O error": "io",
    "unable to open": "permission",
    "permission denied": "permission",
    "locking protocol": "io",  # a file system that cannot lock
}


class Kind(NamedTuple):
    """What a file is: the two marks in SQLite's own header, and the tables."""

    application_id: int
    version: int
    schema: tuple[str, ...]
    readable: tuple[int, ...] = ()  # older versions, which are read but not written


def log_of(path: Path) -> Path:
    """The log that SQLite keeps beside a file until it is copied in."""
    return path.with_name(f"{path.name}-wal")


def connect(
    path: Path,
    kind: Kind,
    *,
    fsync: bool = True,
    exclusive: bool = False,
    wal: bool = True,
    must_exist: bool = False,
) -> sqlite3.Connection:
    """Open or make a file for writing; any thread may use it, one at a time. A new one is for its owner's eyes only.

    Args:
        path: The file.
        kind: What a new file becomes, and an old one must be.
        fsync: Wait for the disk at each commit. Without, a crash of the machine may take the last commits; one of the process
            does not.
        exclusive: Let nobody else open it.
        wal: Commit to a log beside the file, which costs one wait for the disk. Without, the file is all there is, and a crash
            in the middle of a commit ruins it: for files that get their name when they are complete.
        must_exist: An empty file is not a new one, but one that has lost what it held.
    Raises:
        MapFileError: not such a file, of another version, damaged, or a link.
        StorageError: it cannot be opened or written, or somebody else has it open.
    """
    claim_file(path)
    check_no_link(log_of(path))
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
            if is_new and must_exist:
                raise sqlite3.DatabaseError("it is empty, and held something")
            connection.execute(f"PRAGMA journal_mode = {'WAL' if wal else 'MEMORY'}")
        with transaction(connection, path):  # takes the lock
            if is_new:
                connection.execute(f"PRAGMA application_id = {kind.application_id}")
                connection.execute(f"PRAGMA user_version = {kind.version}")
                for statement in kind.schema:
                    connection.execute(statement)
        if is_new:
            settle(connection, path)
        _check(connection, path, kind)
    except BaseException:
        close_keeping_log(connection, path)
        raise
    return connection


def raise_version(path: Path, kind: Kind) -> int:
    """Give a file of an older format that can be read the present one; the format that it had.

    Raises:
        MapFileError: not such a file, of an unknown version, damaged, or a link.
        StorageError: it cannot be written, or somebody else has it open.
    """
    claim_file(path)
    with contextlib.closing(sqlite3.connect(path, isolation_level=None, timeout=0.0)) as connection:
        with reading(path):
            _harden(connection)
        _check(connection, path, kind, older=kind.readable)
        with reading(path):
            found = _pragma(connection, "user_version")
        if found != kind.version:
            with transaction(connection, path):
                connection.execute(f"PRAGMA user_version = {kind.version}")
    return found


def settle(connection: sqlite3.Connection, path: Path) -> None:
    """Copy the log into the file: what was committed so far no longer needs the log.

    Raises:
        StorageError: the disk refuses.
    """
    try:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
    except sqlite3.Error as error:
        raise disk_fault("write", path, error, _disk_reason(error) or "io") from error


def close_keeping_log(connection: sqlite3.Connection, path: Path) -> None:
    """Close a file that was refused; its log, which SQLite would delete, stays for whoever looks into what is wrong."""
    log, aside = log_of(path), path.with_name(f"{path.name}-wal.aside")
    with contextlib.suppress(OSError):
        log.rename(aside)
    with contextlib.suppress(sqlite3.Error):
        connection.close()
    with contextlib.suppress(OSError):
        aside.rename(log)


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
    with disk_faults("open", path):
        is_file = path.is_file()
    if not is_file:
        raise MapFileError(f"no map file at {path}", reason="missing")
    with reading(path):
        connection = sqlite3.connect(
            f"{path.absolute().as_uri()}?mode=ro", uri=True, isolation_level=None, timeout=busy_s
        )
    try:
        with reading(path):
            _harden(connection)
        _check(connection, path, kind, older=kind.readable)
    except BaseException:
        connection.close()
        raise
    return connection


@contextlib.contextmanager
def reading(path: Path) -> Iterator[None]:
    """Give SQLite's errors our names: what the disk refuses is its fault, what is locked is in use, all else is damaged."""
    try:
        yield
    except (sqlite3.Error, UnicodeError, OverflowError) as error:
        if _is_locked(error):
            raise in_use(path) from error
        if (reason := _disk_reason(error)) is not None:
            raise disk_fault("open", path, error, reason) from error
        _check_readable(path)
        raise MapFileError(
            f"{path} is damaged, or no file of ours: {error}{after_damage(path)}", reason="damaged"
        ) from error


def _check_readable(path: Path) -> None:
    """SQLite calls a file damaged whose bytes the disk does not give: see whether it gives them.

    Raises:
        StorageError: it does not.
    """
    with disk_faults("read", path), contextlib.suppress(FileNotFoundError):
        for file in (path, log_of(path)):
            with file.open("rb") as stream:
                while stream.read(_READ_BYTES):
                    pass


def after_damage(path: Path) -> str:
    """What to do about a damaged file, to follow what is wrong with it."""
    if path.suffix != ".sqlite":  # a file of its own: a saved map, or something else altogether
        return ". Take another copy of it"
    return (
        f". If `potserver map check {path.parent}` finds nothing, the disk failed for a moment: start again. Else move it and"
        " its folder away, start with an empty map, and load a saved copy (`potclient map load NAME`) if there is one"
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
            raise in_use(path) from error
        raise disk_fault("write", path, error, _disk_reason(error) or "io") from error


def _check(connection: sqlite3.Connection, path: Path, kind: Kind, older: tuple[int, ...] = ()) -> None:
    with reading(path):
        mark, found = _pragma(connection, "application_id"), _pragma(connection, "user_version")
    if mark != kind.application_id:
        raise MapFileError(f"{path} is an SQLite file of another program", reason="not_a_map")
    if found == kind.version or found in older:
        return
    way_out = "use the version of potserver that wrote it, or move the file's folder away to start anew"
    if found in kind.readable:
        way_out = f"`potserver map upgrade {path.parent}` brings it up to date"
    raise MapFileError(
        f"{path} is of format {found}, this program writes format {kind.version}: {way_out}", reason="version"
    )


def _harden(connection: sqlite3.Connection) -> None:
    """A file may come from anywhere: trust neither its schema nor its pages."""
    connection.execute("PRAGMA trusted_schema = OFF")
    connection.execute("PRAGMA cell_size_check = ON")


def _pragma(connection: sqlite3.Connection, name: str) -> int:
    return int(connection.execute(f"PRAGMA {name}").fetchone()[0])


def _is_locked(error: Exception) -> bool:
    return "locked" in str(error)


def _disk_reason(error: Exception) -> str | None:
    """Why the disk refused, or None where it is not the disk that is wrong."""
    if not isinstance(error, sqlite3.OperationalError):
        return None
    return next((reason for text, reason in _DISK_FAULTS.items() if text in str(error)), None)


def in_use(path: Path) -> StorageError:
    """What to do about a file that another server has open."""
    return StorageError(
        f"{path} is in use: another server keeps its map there; give this one a store of its own"
        " (--store, or another --server-id), or none (--in-memory)",
        reason="in_use",
    )
