"""The store of a map: what was accepted is there after any crash, and what is damaged is never taken for a map."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import random
import shutil
import sqlite3
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from potserver.codec.clouds import encode_cloud, read_cloud
from potserver.domain.map_state import MapState
from potserver.domain.order import CloudOrder, Heard
from potserver.domain.types import MapUpdate, Scan, yaw_pose
from potserver.errors import (
    EmptyError,
    MapFileError,
    StorageError,
    TooLargeError,
    UnknownMapError,
    UnsupportedError,
)
from potserver.health import Health
from potserver.mapping.service import MappingService
from potserver.mapping.settings import MappingSettings
from potserver.storage.agreement import JOURNAL, MARK, TILES
from potserver.storage.journal import Journal
from potserver.storage.map_file import MapFile, Origin, read_map, write_map
from potserver.storage.map_store import MapStore, MemoryOnly, Restored
from potserver.storage.seal import sealed, unsealed

from .test_tile_codec import assert_same

SETTINGS = MappingSettings(max_range_m=15.0, beams_per_scan=200)
DEADLINE_S = 30.0


@functools.cache
def make_scan(number: int, robot: str = "r1", planar: bool = False) -> Scan:
    """A small room, seen from somewhere in it."""
    rng = np.random.default_rng(number)
    angle = rng.uniform(-np.pi, np.pi, 200)
    height = np.zeros(200) if planar else rng.uniform(-1, 2, 200)
    points = np.stack([6 * np.cos(angle), 5 * np.sin(angle), height], axis=1).astype(np.float32)
    return Scan(
        points=points,
        T_map_sensor=yaw_pose(0.5 * number, 0.2, 0.1 * number),
        is_return=rng.random(200) < 0.9,
        is_planar=planar,
        robot_id=robot,
        seq=number,
        stamp_ns=1_000_000_000 * number,
    )


class Map:
    """A mapper and its store, driven as the writer drives them."""

    def __init__(self, folder: Path, settings: MappingSettings = SETTINGS, **options: Any) -> None:
        self.folder, self.health = folder, Health()
        self.mapper = MappingService(settings=settings, threads=1)
        self.store = MapStore(
            folder,
            "default",
            keeps_evidence=self.mapper.keeps_evidence,
            health=self.health,
            **{"fsync": False, **options},
        )
        try:
            self.restored: Restored = self.store.restore(self.mapper)
        except BaseException:
            self.store.close()
            raise
        self.order = CloudOrder(self.restored.heard)

    @property
    def state(self) -> MapState:
        return self.mapper.state

    @property
    def heard(self) -> Heard:
        return self.order.heard

    def take(self, scan: Scan) -> MapUpdate:
        with self.store.keeping(scan) as commit:
            update = self.mapper.integrate(scan, commit=commit)
        self.order.remember(scan.robot_id, scan.session, scan.seq)
        self.store.advance(self.mapper, self.order.heard)
        return update

    def clear(self) -> None:
        self.mapper.clear(commit=lambda state: self.store.replace(state, {}))
        self.order.replace({})

    def load(self, name: str) -> None:
        state, heard = self.store.load(name, self.mapper)
        self.mapper.restore(state, commit=lambda new: self.store.replace(new, heard))
        self.order.replace(heard)

    def crash(self, to: Path) -> Path:
        """The folder as a kill would leave it now, elsewhere."""
        shutil.copytree(self.folder, to)
        return to

    def wait_snapshots(self, n: int) -> None:
        """Until so many were written."""
        done = threading.Event()
        for _ in range(int(DEADLINE_S / 0.01)):
            if self.health.counters().get("store.snapshots", 0) >= n:
                return
            done.wait(0.01)
        raise AssertionError(f"no {n} snapshots within {DEADLINE_S} s")


@pytest.fixture
def open_map() -> Iterator[Callable[..., Map]]:
    """Opens maps, and closes them at the end."""
    opened: list[Map] = []

    def open_(folder: Path, *arguments: Any, **options: Any) -> Map:
        opened.append(Map(folder, *arguments, **options))
        return opened[-1]

    yield open_
    for each in opened:
        each.store.close()


OpenMap = Callable[..., Map]


@contextlib.contextmanager
def sqlite(path: Path) -> Iterator[sqlite3.Connection]:
    """A file as SQLite alone sees it."""
    with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as connection:
        yield connection


def assert_same_map(a: MapState, b: MapState) -> None:
    """Everything but the epoch, bit for bit."""
    assert (a.map_revision, a.n_scans, a.stamp_ns) == (b.map_revision, b.n_scans, b.stamp_ns)
    assert a.scores.n_points == b.scores.n_points
    assert a.scores.brier == b.scores.brier
    np.testing.assert_array_equal(a.scores.nll, b.scores.nll)
    np.testing.assert_array_equal(a.scores.bins, b.scores.bins)
    assert a.snapshot.rule == b.snapshot.rule
    if a.tiled is None or b.tiled is None:
        assert a.tiled is b.tiled
        return
    assert (a.tiled.grid, a.tiled.robots) == (b.tiled.grid, b.tiled.robots)
    assert list(a.tiled.tiles) == list(b.tiled.tiles)
    for index, tile in a.tiled.tiles.items():
        assert_same(tile, b.tiled.tiles[index])
    points = np.random.default_rng(0).uniform(-8, 8, (200, 3))
    for name in ("mean", "var", "observed"):
        x, y = (getattr(s.snapshot.occupancy(points), name) for s in (a, b))
        np.testing.assert_array_equal(x, y)


def _other_state(tile_size_m: float = SETTINGS.tile_size_m) -> MapState:
    """Of a map that no store has seen."""
    service = MappingService(settings=dataclasses.replace(SETTINGS, tile_size_m=tile_size_m), threads=1)
    service.integrate(make_scan(7))
    return service.state


# --- scans ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("planar", [False, True])
def test_a_kept_scan_is_the_same_scan(planar: bool) -> None:
    scan = make_scan(3, "r7", planar)
    again = read_cloud(encode_cloud(scan))
    assert (again.robot_id, again.seq, again.stamp_ns, again.is_planar) == ("r7", 3, scan.stamp_ns, planar)
    for name in ("points", "is_return", "T_map_sensor"):
        np.testing.assert_array_equal(getattr(scan, name), getattr(again, name))


@pytest.mark.parametrize("snapshot_scans", [1, 2, 100])
def test_a_crash_after_any_scan_loses_nothing(tmp_path: Path, open_map: OpenMap, snapshot_scans: int) -> None:
    ours = open_map(tmp_path / "store", snapshot_scans=snapshot_scans)
    assert ours.restored == (0, 0, {})
    left = []
    for n in range(1, 6):
        ours.take(make_scan(n, f"r{n % 2}"))
        if snapshot_scans <= n:
            ours.wait_snapshots(n // snapshot_scans)
        left.append((ours.crash(tmp_path / f"after-{n}"), ours.state, ours.heard))
    for n, (folder, state, heard) in enumerate(left, 1):
        again = open_map(folder)
        assert again.restored == (n, n % snapshot_scans, heard)
        assert_same_map(state, again.state)
        assert again.state.epoch != state.epoch, "numbers of revisions must not be mixed after a crash"
        again.take(make_scan(9))
        assert again.state.n_scans == n + 1


def test_a_clean_end_keeps_the_epoch_and_leaves_no_journal(tmp_path: Path, open_map: OpenMap) -> None:
    first = open_map(tmp_path)
    for n in (1, 2):
        first.take(make_scan(n))
    assert first.store.close()
    second = open_map(tmp_path)
    assert second.restored == (2, 0, {"r1": {"": 2}})
    assert second.state.epoch == first.state.epoch
    assert_same_map(first.state, second.state)
    assert second.store.close()
    third = open_map(tmp_path)
    third.take(make_scan(3))
    assert (third.state.map_revision, third.state.epoch) == (3, first.state.epoch)


def test_a_snapshot_writes_only_what_changed(tmp_path: Path, open_map: OpenMap) -> None:
    ours = open_map(tmp_path)
    for n in (1, 2):
        ours.take(make_scan(n))
    ours.store.save(None, ours.mapper, ours.heard)
    with sqlite(tmp_path / "default" / TILES) as connection:
        connection.execute("CREATE TABLE log (x)")
        connection.execute(
            "CREATE TRIGGER wrote AFTER UPDATE ON tiles BEGIN INSERT INTO log VALUES (new.rowid); END"
        )
    update = ours.take(make_scan(3))
    ours.store.save(None, ours.mapper, ours.heard)
    with sqlite(tmp_path / "default" / TILES) as connection:
        written = connection.execute("SELECT COUNT(*) FROM log").fetchone()[0]
    before = {index for index in update.changed.tiles if ours.state.tiled and index in ours.state.tiled.tiles}
    assert 0 < written <= len(before)


def test_a_journal_forgets_what_a_snapshot_has(tmp_path: Path, open_map: OpenMap) -> None:
    ours = open_map(tmp_path / "store", snapshot_scans=3)
    for n in range(1, 4):
        ours.take(make_scan(n))
    ours.wait_snapshots(1)
    ours.take(make_scan(4))
    journal = Journal(ours.crash(tmp_path / "copy") / "default" / JOURNAL)
    assert [number for number, _ in journal.scans(journal.pruned)] == [4]
    assert journal.last == 4
    journal.close()


# --- a disk that refuses ----------------------------------------------------------------------------------------------


def _limit_pages(connection: sqlite3.Connection, extra: int) -> None:
    """Let the file grow by no more than so many pages: SQLite then says what it says when the disk is full."""
    pages = connection.execute("PRAGMA page_count").fetchone()[0]
    connection.execute(f"PRAGMA max_page_count = {pages + extra}")


def test_a_scan_that_the_disk_refuses_is_not_in_the_map(tmp_path: Path, open_map: OpenMap) -> None:
    ours = open_map(tmp_path / "store")
    ours.take(make_scan(1))
    _limit_pages(ours.store._journal._connection, 0)
    large = Scan(points=np.tile(make_scan(2).points, (50, 1)), T_map_sensor=np.eye(4), stamp_ns=2)
    before = ours.state
    with pytest.raises(StorageError, match="full"):
        ours.take(large)
    assert ours.state is before
    assert ours.health.counters()["store.appends_failed"] == 1
    _limit_pages(ours.store._journal._connection, 1000)
    ours.take(make_scan(2))
    again = open_map(ours.crash(tmp_path / "copy"))
    assert_same_map(ours.state, again.state)


def test_a_snapshot_that_the_disk_refuses_leaves_the_journal_whole(tmp_path: Path, open_map: OpenMap) -> None:
    ours = open_map(tmp_path / "store", snapshot_scans=2)
    _limit_pages(ours.store._tiles._connection, 0)
    for n in range(1, 4):
        ours.take(make_scan(n))
    with pytest.raises(StorageError, match="full"):
        ours.store.save(None, ours.mapper, ours.heard)
    former = ours.state
    with pytest.raises(StorageError):
        ours.mapper.restore(_other_state(), commit=lambda state: ours.store.replace(state, {}))
    assert ours.state is former, "what cannot be kept does not become the map"
    again = open_map(ours.crash(tmp_path / "copy"))
    assert again.restored.n_replayed == 3
    assert_same_map(ours.state, again.state)
    assert not ours.store.close(), "the last snapshot failed too, and it says so"


# --- other maps -------------------------------------------------------------------------------------------------------


def test_a_cleared_map_stays_cleared(tmp_path: Path, open_map: OpenMap) -> None:
    ours = open_map(tmp_path / "store", snapshot_scans=2)
    for n in range(1, 4):
        ours.take(make_scan(n))
    ours.clear()
    empty = open_map(ours.crash(tmp_path / "empty"))
    assert (empty.restored.n_scans, empty.restored.heard, empty.state.map_revision) == (0, {}, 4)
    ours.take(make_scan(1))
    again = open_map(ours.crash(tmp_path / "copy"))
    assert again.restored == (1, 1, {"r1": {"": 1}})
    assert_same_map(ours.state, again.state)


def test_a_saved_map_comes_back_with_another_epoch_and_a_higher_revision(
    tmp_path: Path, open_map: OpenMap
) -> None:
    ours = open_map(tmp_path / "store")
    for n in (1, 2):
        ours.take(make_scan(n, f"r{n}"))
    saved = ours.state
    assert "2 scans saved as" in ours.store.save("two", ours.mapper, ours.heard)
    ours.clear()
    for n in (5, 6, 7):
        ours.take(make_scan(n))
    ours.load("two")
    assert ours.state.epoch not in (saved.epoch, 0)
    assert ours.state.map_revision == 7, "two scans, a clear, three scans, and this"
    assert (ours.state.n_scans, ours.heard) == (2, {"r1": {"": 1}, "r2": {"": 2}})
    assert saved.tiled is not None
    assert ours.state.tiled is not None
    assert list(saved.tiled.tiles) == list(ours.state.tiled.tiles)
    again = open_map(ours.crash(tmp_path / "copy"))
    assert again.restored == (2, 0, ours.heard)
    assert_same_map(ours.state, again.state)


def test_saved_maps_are_bounded_in_number(
    tmp_path: Path, open_map: OpenMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("potserver.storage.map_store.MAX_SAVED", 1)
    ours = open_map(tmp_path)
    ours.store.save("a", ours.mapper, {})
    ours.store.save("a", ours.mapper, {})
    with pytest.raises(TooLargeError, match="the limit is 1"):
        ours.store.save("b", ours.mapper, {})
    assert [path.name for path in (tmp_path / "saved" / "default").iterdir()] == ["a.map"]


def test_maps_without_evidence_are_kept_too(tmp_path: Path, open_map: OpenMap) -> None:
    paper = MappingSettings.of_profile("paper")
    ours = open_map(tmp_path / "store", paper)
    for n in (1, 2):
        ours.take(make_scan(n))
    ours.store.save("paper", ours.mapper, ours.heard)
    again = open_map(ours.crash(tmp_path / "copy"), paper)
    assert_same_map(ours.state, again.state)
    with pytest.raises(MapFileError, match="other profile") as refused:
        open_map(ours.crash(tmp_path / "other"), SETTINGS)
    assert refused.value.reason == "settings"


def test_imported_kernels_are_not_taken_for_a_map_of_evidence(tmp_path: Path, open_map: OpenMap) -> None:
    """No scan is in them, as in an empty map, but the next scans would solve their weights away."""
    paper = MappingService(settings=MappingSettings.of_profile("paper"), threads=1)
    paper.integrate(make_scan(1))
    state = dataclasses.replace(paper.state, n_scans=0)
    write_map(tmp_path / "saved" / "default" / "kernels.map", state, Origin("default", False, {}))
    ours = open_map(tmp_path)
    before = ours.state
    with pytest.raises(MapFileError, match="other profile"):
        ours.load("kernels")
    assert ours.state is before


def test_a_map_of_other_tiles_is_refused_and_nothing_changes(tmp_path: Path, open_map: OpenMap) -> None:
    state = _other_state(tile_size_m=5.0)
    write_map(tmp_path / "saved" / "default" / "small.map", state, Origin("default", True, {}))
    ours = open_map(tmp_path)
    ours.take(make_scan(1))
    before = ours.state
    with pytest.raises(MapFileError, match="tile_size_m"):
        ours.load("small")
    with pytest.raises(UnknownMapError, match="there are: small"):
        ours.load("other")
    assert ours.state is before


def test_nothing_is_kept_in_memory() -> None:
    mapper: Any = None
    with MemoryOnly().keeping(make_scan(1)) as commit:
        commit()
    for call in (lambda: MemoryOnly().save(None, mapper, {}), lambda: MemoryOnly().load("x", mapper)):
        with pytest.raises(UnsupportedError, match="--store"):
            call()


# --- files that are not what they should be ---------------------------------------------------------------------------


def test_the_second_server_on_a_store_is_refused(tmp_path: Path, open_map: OpenMap) -> None:
    open_map(tmp_path)
    with pytest.raises(StorageError, match="in use: another server"):
        open_map(tmp_path)


def test_a_folder_that_cannot_be_made_is_said(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="--in-memory"):
        Map(tmp_path / "file")


@pytest.fixture(scope="module")
def crashed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, MapState]:
    """A store as a kill left it: two scans in the snapshot, two in the journal; and the map that is in it."""
    folder = tmp_path_factory.mktemp("store")
    ours = Map(folder)
    for n in (1, 2):
        ours.take(make_scan(n))
    ours.store.save("kept", ours.mapper, ours.heard)
    for n in (3, 4):
        ours.take(make_scan(n))
    # as after a checkpoint: everything in the files, nothing in their logs
    for connection in (ours.store._journal._connection, ours.store._tiles._connection):
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    left = ours.crash(tmp_path_factory.mktemp("crashed") / "store")
    ours.store.close()
    return left, ours.state


def _copy(crashed: tuple[Path, MapState], to: Path) -> Path:
    shutil.copytree(crashed[0], to)
    return to


@pytest.mark.parametrize("file", [TILES, JOURNAL, MARK])
def test_a_lost_file_is_noticed(
    crashed: tuple[Path, MapState], tmp_path: Path, open_map: OpenMap, file: str
) -> None:
    folder = _copy(crashed, tmp_path / "store")
    (folder / "default" / file).unlink()
    for _ in range(2):  # a start that was refused changes nothing
        with pytest.raises(MapFileError, match=f"{file} is missing") as refused:
            open_map(folder)
    assert "move" in str(refused.value), "it says what to do"


def test_a_snapshot_from_an_old_copy_is_noticed(tmp_path: Path, open_map: OpenMap) -> None:
    ours = open_map(tmp_path / "store")
    ours.take(make_scan(1))
    ours.store.save(None, ours.mapper, ours.heard)
    old = ours.crash(tmp_path / "old")
    ours.take(make_scan(2))
    ours.store.save(None, ours.mapper, ours.heard)
    ours.take(make_scan(3))
    new = ours.crash(tmp_path / "new")
    for path in (new / "default").glob(f"{TILES}*"):
        path.unlink()
    for path in (old / "default").glob(f"{TILES}*"):
        shutil.copy(path, new / "default")
    with pytest.raises(MapFileError, match="too old"):
        open_map(new)


@pytest.mark.parametrize("file", [TILES, JOURNAL])
def test_another_version_is_refused_with_what_to_do(
    crashed: tuple[Path, MapState], tmp_path: Path, open_map: OpenMap, file: str
) -> None:
    folder = _copy(crashed, tmp_path / "store")
    with sqlite(folder / "default" / file) as connection:
        connection.execute("PRAGMA user_version = 9")
    with pytest.raises(MapFileError, match="format 9, this program writes format 2") as refused:
        open_map(folder)
    assert refused.value.reason == "version"
    assert "use the version of potserver that wrote it" in str(refused.value)


@pytest.mark.parametrize("file", [TILES, JOURNAL])
@pytest.mark.parametrize("content", [b"", b"not a map at all, but long enough" * 50, "sqlite"])
def test_a_file_of_something_else_is_refused(
    crashed: tuple[Path, MapState], tmp_path: Path, open_map: OpenMap, file: str, content: bytes | str
) -> None:
    folder = _copy(crashed, tmp_path / "store")
    path = folder / "default" / file
    path.unlink()
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        with sqlite(path) as connection:
            connection.execute("CREATE TABLE notes (text)")
    with pytest.raises(MapFileError):
        open_map(folder)


@pytest.mark.parametrize("file", [TILES, JOURNAL, "kept.map"])
def test_a_file_that_was_cut_off_is_refused_with_what_to_do(
    crashed: tuple[Path, MapState], tmp_path: Path, file: str
) -> None:
    is_map = file.endswith(".map")
    content = (crashed[0] / ("saved/default" if is_map else "default") / file).read_bytes()
    (tmp_path / file).write_bytes(content[: len(content) // 2])
    read: Callable[[Path], Any] = _scans_of if file == JOURNAL else read_map
    with pytest.raises(MapFileError, match="Take another copy" if is_map else "move it and its folder away"):
        read(tmp_path / file)


@pytest.mark.parametrize("file", [TILES, JOURNAL, "kept.map"])
def test_a_damaged_file_is_the_same_map_or_an_error(
    crashed: tuple[Path, MapState], tmp_path: Path, file: str
) -> None:
    """Bytes at random places; those that SQLite does not use change nothing, and no other may go unnoticed."""
    folder = tmp_path / "store"
    is_map = file.endswith(".map")
    rng = random.Random(file)
    source = crashed[0] / ("saved/default" if is_map else "default") / file
    content = source.read_bytes()
    read: Callable[[Path], Any] = _scans_of if file == JOURNAL else lambda path: read_map(path).state()
    shutil.copy(source, tmp_path / file)
    wanted = read(tmp_path / file)
    errors = []
    for trial in range(150):
        place = rng.randrange(len(content))
        if (
            trial % 3 == 0
        ):  # SQLite's own structures stand at the beginning of its pages, and would seldom be met
            place += rng.randrange(108) - place % 16_384
        damaged = bytearray(content)
        damaged[place % len(content)] ^= 1 << rng.randrange(8)
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        (folder / file).write_bytes(damaged)
        try:
            found = read(folder / file)
        except (MapFileError, StorageError) as error:
            errors.append(str(error))
            continue
        if file == JOURNAL:
            assert found == wanted
        else:
            assert_same_map(wanted, found)
    assert len(errors) > 10
    assert all(str(folder / file) in error for error in errors), "the messages name the file"


def _scans_of(path: Path) -> list[tuple[int, bytes]]:
    journal = Journal(path, fsync=False)
    try:
        return list(journal.scans(journal.pruned))
    finally:
        journal.close()


def test_a_scan_that_cannot_be_repeated_is_not_left_out(
    crashed: tuple[Path, MapState], tmp_path: Path, open_map: OpenMap
) -> None:
    folder = _copy(crashed, tmp_path / "store")
    with pytest.raises(MapFileError, match="scan 3 of the journal") as refused:
        open_map(folder, dataclasses.replace(SETTINGS, min_range_m=14.0))
    assert refused.value.reason == "settings"
    assert isinstance(refused.value.__cause__, EmptyError)


@pytest.mark.parametrize(
    ("rule", "what"), [([1.4, -1.0, 0.0, 1.0], "prior_var"), ([1.4], "1 numbers"), ([1.4] * 6, "6 numbers")]
)
def test_a_file_whose_rule_is_none_is_damaged(tmp_path: Path, rule: list[float], what: str) -> None:
    with pytest.raises(MapFileError, match=what) as refused:
        read_map(_with_rule(tmp_path / "m.map", rule))
    assert refused.value.reason == "damaged"


def test_a_file_of_when_rules_had_four_numbers_is_read(tmp_path: Path) -> None:
    found = read_map(_with_rule(tmp_path / "m.map", [1.4, 100.0, 50.0, 0.05])).record.answer_rule
    assert dataclasses.astuple(found) == (1.4, 100.0, 50.0, 0.05, 0.0)


def _with_rule(path: Path, rule: list[float]) -> Path:
    write_map(path, _other_state(), Origin("default", True, {}))
    with sqlite(path) as connection:
        ((record,),) = connection.execute("SELECT record FROM map").fetchall()
        changed = json.dumps(json.loads(unsealed(record)) | {"rule": rule}).encode()
        connection.execute("UPDATE map SET record = ?", (sealed(changed),))
    return path


def test_a_map_file_is_written_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.map"
    state = _other_state()
    write_map(path, state, Origin("default", True, {"r1": {"": 5}}))
    before = path.read_bytes()

    def refuse(self: MapFile, *_: Any) -> int:
        raise StorageError("cannot write: disk full")

    monkeypatch.setattr(MapFile, "write", refuse)
    with pytest.raises(StorageError):
        write_map(path, state, Origin("default", True, {}))
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.map"], "and nothing is left lying about"
