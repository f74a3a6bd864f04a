"""What a store makes of files that are damaged, gone, old, replaced or refused: nothing acknowledged goes without a word."""

from __future__ import annotations

import contextlib
import os
import random
import shutil
import sqlite3
import stat
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from potserver.domain.map_state import MapState
from potserver.errors import MapFileError, StorageError
from potserver.storage import map_file
from potserver.storage.agreement import JOURNAL, MARK, TILES
from potserver.storage.journal import scans_after
from potserver.storage.mark import read_mark
from potserver.storage.sqlite import log_of, reading, transaction

from .test_map_store import Map, OpenMap, assert_same_map, make_scan, open_map

__all__ = ["open_map"]

FILES = (JOURNAL, TILES, MARK)


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, MapState]]:
    """A store as a kill left it, everything newer than its making in the logs: two scans in a snapshot, two in the journal."""
    folder = tmp_path_factory.mktemp("killed")
    ours = Map(folder / "served", fsync=True)
    for n in (1, 2):
        ours.take(make_scan(n))
    ours.store.save(None, ours.mapper, ours.heard)
    for n in (3, 4):
        ours.take(make_scan(n))
    left = ours.crash(folder / "left")
    yield left, ours.state
    ours.store.close()


def copied(killed: tuple[Path, MapState], to: Path) -> Path:
    shutil.copytree(killed[0], to)
    return to / "default"


# --- files that disagree ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("file", [JOURNAL, TILES])
def test_a_bit_that_flips_in_a_log_is_noticed_wherever_it_is(
    killed: tuple[Path, MapState], tmp_path: Path, open_map: OpenMap, file: str
) -> None:
    size = log_of(killed[0] / "default" / file).stat().st_size
    rng = random.Random(file)
    refused = []
    for trial in range(40):
        folder = copied(killed, tmp_path / str(trial))
        with log_of(folder / file).open("r+b") as stream:
            place = rng.randrange(trial * size // 40, (trial + 1) * size // 40)
            stream.seek(place)
            byte = stream.read(1)[0]
            stream.seek(place)
            stream.write(bytes([byte ^ 1 << rng.randrange(8)]))
        try:
            again = open_map(folder.parent)
        except MapFileError as error:
            refused.append(error.reason)
        else:
            assert_same_map(killed[1], again.state)
    assert set(refused) == {"damaged"}
    assert len(refused) > 30


@pytest.mark.parametrize("file", [JOURNAL, TILES])
@pytest.mark.parametrize("left", [None, 0, 0.5])
def test_a_log_that_is_gone_or_cut_off_is_noticed_and_a_refused_start_changes_nothing(
    killed: tuple[Path, MapState], tmp_path: Path, open_map: OpenMap, file: str, left: float | None
) -> None:
    folder = copied(killed, tmp_path / "store")
    log = log_of(folder / file)
    if left is None:
        log.unlink()
    else:
        os.truncate(log, int(left * log.stat().st_size))
    before = log.read_bytes() if left else None
    for _ in range(2):
        with pytest.raises(MapFileError, match=r"was acknowledged|missing or too old") as refused:
            open_map(folder.parent)
        assert refused.value.reason == "damaged"
        assert "from one copy" in str(refused.value)
    if before is not None:
        assert log.read_bytes()[: len(before)] == before


def test_a_journal_from_an_older_copy_is_noticed(tmp_path: Path, open_map: OpenMap) -> None:
    ours = open_map(tmp_path / "store", fsync=True)
    ours.take(make_scan(1))
    old = ours.crash(tmp_path / "old")
    ours.take(make_scan(2))
    ours.store.save(None, ours.mapper, ours.heard)
    new = ours.crash(tmp_path / "new")
    for path in (old / "default").glob(f"{JOURNAL}*"):
        shutil.copy(path, new / "default")
    with pytest.raises(MapFileError, match=r"ends at scan 1, and scan 2 was acknowledged"):
        open_map(new)


def test_a_snapshot_that_no_scan_followed_cannot_be_lost_either(tmp_path: Path, open_map: OpenMap) -> None:
    """A map that was cleared, loaded or merged is in its snapshot alone."""
    ours = open_map(tmp_path / "store", fsync=True)
    ours.take(make_scan(1))
    old = ours.crash(tmp_path / "old")
    ours.clear()
    new = ours.crash(tmp_path / "new")
    for path in (old / "default").glob(f"{TILES}*"):
        shutil.copy(path, new / "default")
    with pytest.raises(MapFileError, match=r"tiles.sqlite has snapshot \d, and snapshot \d was acknowledged"):
        open_map(new)


def test_a_journal_without_the_one_that_was_there_is_no_new_map(tmp_path: Path, open_map: OpenMap) -> None:
    ours = open_map(tmp_path / "store")
    ours.take(make_scan(1))  # no snapshot says that there was anything
    left = ours.crash(tmp_path / "left")
    for path in (left / "default").glob(f"{JOURNAL}*"):
        path.unlink()
    shutil.copytree(open_map(tmp_path / "other").folder, tmp_path / "another")
    for path in (tmp_path / "another" / "default").glob(f"{JOURNAL}*"):
        shutil.copy(path, left / "default")
    with pytest.raises(MapFileError, match="of another store than mark"):
        open_map(left)


@pytest.mark.parametrize("was_killed", [True, False])
def test_a_log_whose_file_is_gone_is_no_new_store(
    killed: tuple[Path, MapState], tmp_path: Path, open_map: OpenMap, was_killed: bool
) -> None:
    folder = copied(killed, tmp_path / "left")
    for name in FILES:
        (folder / name).unlink()
    if not was_killed:  # nothing is left: a new store
        for name in (JOURNAL, TILES):
            log_of(folder / name).unlink()
        assert open_map(folder.parent).restored.n_scans == 0
        return
    logs = {path.name: path.read_bytes() for path in folder.iterdir()}
    for _ in range(2):
        with pytest.raises(MapFileError, match=r"journal.sqlite and tiles.sqlite are missing"):
            open_map(folder.parent)
        assert {path.name: path.read_bytes() for path in folder.iterdir()} == logs


def test_without_waiting_for_the_disk_a_power_cut_costs_the_end_and_numbers_go_on(
    tmp_path: Path, open_map: OpenMap
) -> None:
    ours = open_map(tmp_path / "store")
    states = [ours.state]
    for n in range(1, 5):
        ours.take(make_scan(n))
        states.append(ours.state)
    left = ours.crash(tmp_path / "left")
    log = log_of(left / "default" / JOURNAL)
    os.truncate(log, log.stat().st_size - 1)
    again = open_map(left)
    assert again.restored.n_scans == 3
    assert_same_map(states[3], again.state)
    again.take(make_scan(9))
    assert again.store._journal.last == 5, "scan 4 was acknowledged: its number is not given again"
    third = open_map(again.crash(tmp_path / "third"))
    assert (third.restored.n_scans, third.restored.n_replayed) == (4, 1)
    assert_same_map(again.state, third.state)


def test_half_a_mark_is_enough(killed: tuple[Path, MapState], tmp_path: Path, open_map: OpenMap) -> None:
    for slot in (0, 1):
        folder = copied(killed, tmp_path / str(slot))
        content = bytearray((folder / MARK).read_bytes())
        content[512 * slot + 5] ^= 1
        (folder / MARK).write_bytes(content)
        assert_same_map(killed[1], open_map(folder.parent).state)
    folder = copied(killed, tmp_path / "both")
    (folder / MARK).write_bytes(bytes(1024))
    with pytest.raises(MapFileError, match="mark is damaged"):
        open_map(folder.parent)


# --- files that are taken away ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("file", [*FILES, f"{JOURNAL}-wal", f"{TILES}-wal", "."])
def test_nothing_is_acknowledged_into_files_that_are_gone(
    tmp_path: Path, open_map: OpenMap, file: str
) -> None:
    ours = open_map(tmp_path / "store")
    ours.take(make_scan(1))
    path, aside = (tmp_path / "store" / "default" / file).resolve(), tmp_path / "aside"
    path.rename(aside)
    before = ours.state
    with pytest.raises(StorageError, match="removed, moved or replaced") as refused:
        ours.take(make_scan(2))
    assert (refused.value.reason, ours.state) == ("gone", before)
    with pytest.raises(StorageError):
        ours.store.save(None, ours.mapper, ours.heard)
    (shutil.copytree if aside.is_dir() else shutil.copy)(aside, path)  # the same bytes, and not the same file
    with pytest.raises(StorageError):
        ours.take(make_scan(2))
    if path.is_dir():
        shutil.rmtree(path)
    aside.rename(path)
    ours.take(make_scan(2))
    assert_same_map(ours.state, open_map(ours.crash(tmp_path / "copy")).state)


@pytest.mark.parametrize("file", [JOURNAL, TILES, f"{JOURNAL}-wal", f"{TILES}-wal"])
def test_nothing_is_acknowledged_into_files_that_somebody_cut(
    tmp_path: Path, open_map: OpenMap, file: str
) -> None:
    """By hand, or by a backup that is put back over the files of a running server: the names mean the same files still."""
    ours = open_map(tmp_path / "store")
    ours.take(make_scan(1))
    ours.store.save(None, ours.mapper, ours.heard)
    path, before = tmp_path / "store" / "default" / file, ours.state
    os.truncate(path, path.stat().st_size - 1)
    write = (
        (lambda: ours.take(make_scan(2)))
        if JOURNAL in file
        else (lambda: ours.store.save(None, ours.mapper, ours.heard))
    )
    with pytest.raises(StorageError, match="somebody else cut it") as refused:
        write()
    assert (refused.value.reason, ours.state) == ("gone", before)


def test_what_is_removed_at_the_end_is_said(tmp_path: Path, open_map: OpenMap) -> None:
    ours = open_map(tmp_path / "store")
    ours.take(make_scan(1))
    shutil.rmtree(tmp_path / "store")
    assert not ours.store.close()


# --- whose files they are ---------------------------------------------------------------------------------------------


def test_a_scan_counts_only_when_it_enters_the_map(tmp_path: Path, open_map: OpenMap) -> None:
    """Its bytes are on the disk before; a crash, an error in the middle, or the next scan forget them."""
    ours = open_map(tmp_path / "store")
    ours.take(make_scan(1))
    with pytest.raises(RuntimeError, match="in the middle"), ours.store.keeping(make_scan(7)):
        raise RuntimeError("in the middle")
    with ours.store.keeping(make_scan(8)):
        pass  # never committed; staged when the block has ended
    left = ours.crash(tmp_path / "left")
    assert scans_after(left / "default" / JOURNAL, 0) == 1
    again = open_map(left)
    assert (again.state.n_scans, again.restored.n_replayed) == (1, 1)
    again.take(make_scan(2))
    ours.take(make_scan(2))
    for journal in (ours.crash(tmp_path / "more"), again.crash(tmp_path / "others")):
        restored = open_map(journal)
        assert (restored.state.n_scans, restored.restored.n_replayed) == (2, 2)
    ours.store.close()
    with contextlib.closing(sqlite3.connect(tmp_path / "store" / "default" / JOURNAL)) as connection:
        assert connection.execute("SELECT COUNT(*) FROM scans").fetchone() == (0,)


def test_a_store_is_for_its_owner_alone(tmp_path: Path, open_map: OpenMap) -> None:
    before = os.umask(0)
    try:
        ours = open_map(tmp_path / "store")
        ours.take(make_scan(1))
        ours.store.save("kept", ours.mapper, ours.heard)
    finally:
        os.umask(before)
    modes = {
        path.relative_to(tmp_path).as_posix(): stat.S_IMODE(path.stat().st_mode)
        for path in tmp_path.rglob("*")
    }
    folders = ("store", "store/default", "store/saved", "store/saved/default")
    assert {modes.pop(name) for name in folders} == {0o700}
    assert len(modes) > 5
    assert set(modes.values()) == {0o600}, modes


def check_that_a_link_is_refused(path: Path, folder: Path, open_map: OpenMap) -> None:
    """A store does not open with a link in the place of one of its files, and what that leads to stays as it is."""
    elsewhere = folder.parent / "elsewhere"
    path.rename(elsewhere)
    path.symlink_to(elsewhere)
    before = elsewhere.read_bytes()
    with pytest.raises(MapFileError, match="is a symbolic link"):
        open_map(folder)
    assert elsewhere.read_bytes() == before


@pytest.mark.parametrize("file", FILES)
def test_a_link_in_the_place_of_a_file_is_refused(tmp_path: Path, open_map: OpenMap, file: str) -> None:
    open_map(tmp_path / "store").store.close()
    check_that_a_link_is_refused(tmp_path / "store" / "default" / file, tmp_path / "store", open_map)


@pytest.mark.parametrize("file", [JOURNAL, TILES])
def test_a_link_in_the_place_of_a_log_is_refused(
    killed: tuple[Path, MapState], tmp_path: Path, open_map: OpenMap, file: str
) -> None:
    log = log_of(copied(killed, tmp_path / "left") / file)
    check_that_a_link_is_refused(log, tmp_path / "left", open_map)


# --- whose fault it is ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("says", "reason"),
    [
        ("attempt to write a readonly database", "read_only"),
        ("database or disk is full", "full"),
        ("disk I/O error", "io"),
        ("unable to open database file", "permission"),
        ("locking protocol", "io"),
    ],
)
@pytest.mark.parametrize("wrap", [reading, lambda path: transaction(sqlite3.connect(":memory:"), path)])
def test_what_the_disk_refuses_is_not_called_damaged(
    tmp_path: Path, wrap: Callable[..., object], says: str, reason: str
) -> None:
    with pytest.raises(StorageError, match="nothing is wrong with the map") as caught, wrap(tmp_path / "f"):  # type: ignore[attr-defined]
        raise sqlite3.OperationalError(says)
    assert caught.value.reason == reason


@pytest.mark.parametrize("says", ["database disk image is malformed", "file is not a database"])
def test_a_file_that_the_disk_cannot_read_is_not_called_damaged(tmp_path: Path, says: str) -> None:
    """SQLite does: to it a page that cannot be read is one that holds nonsense."""
    file, mended = tmp_path / "f", tmp_path / "mended"
    file.symlink_to("/proc/self/mem")  # whose first bytes are an I/O error
    mended.write_bytes(b"nonsense")
    with (
        pytest.raises(StorageError, match=r"cannot read .* nothing is wrong with the map") as caught,
        reading(file),
    ):
        raise sqlite3.DatabaseError(says)
    assert caught.value.reason == "io"
    log_of(mended).symlink_to("/proc/self/mem")
    with pytest.raises(StorageError, match="cannot read"), reading(mended):
        raise sqlite3.DatabaseError(says)
    log_of(mended).unlink()
    with pytest.raises(MapFileError, match="is damaged"), reading(mended):
        raise sqlite3.DatabaseError(says)


class FailingOnce(sqlite3.Connection):
    """A disk that fails while the tiles are read: SQLite rolls back by itself then."""

    def execute(self, sql: str, *values: Any) -> sqlite3.Cursor:
        if sql.startswith("SELECT x, y, z, data"):
            self.rollback()
            raise sqlite3.OperationalError("disk I/O error")
        return super().execute(sql, *values)


def test_a_disk_that_fails_while_a_map_is_read_is_said_and_not_its_consequence(
    killed: tuple[Path, MapState], tmp_path: Path
) -> None:
    file = copied(killed, tmp_path / "left") / TILES
    with (
        contextlib.closing(sqlite3.connect(file, factory=FailingOnce, isolation_level=None)) as connection,
        pytest.raises(StorageError, match="disk I/O error"),
    ):
        map_file._read(connection, file, {}, None)


def test_the_mark_names_what_was_acknowledged(tmp_path: Path, open_map: OpenMap) -> None:
    ours = open_map(tmp_path)
    for n in (1, 2):
        ours.take(make_scan(n))
    ours.clear()
    mark = read_mark(tmp_path / "default" / MARK)
    assert mark is not None
    assert (mark.last, mark.edition, mark.synced) == (2, 1, False)
