"""Maps as files: `tiles.sqlite` of a store, which is kept up to date, and `*.map`, which is written once. One format.

tiles    a row a tile: its index, and `tile_codec`'s bytes
map      one row: everything else (`MapRecord`) as JSON, sealed. It counts the tiles and sums their digests: a file that lost
         a tile is recognised
"""

from __future__ import annotations

import contextlib
import dataclasses
import sqlite3
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import msgspec
import numpy as np

from potschemas import __version__
from potschemas.answers import RULE_FIELDS, AnswerRule
from potserver.domain.folders import sync_folder
from potserver.domain.kernel_map import KernelMap
from potserver.domain.map_state import MapState
from potserver.domain.order import Heard
from potserver.domain.pages import Pages
from potserver.domain.running_scores import RunningScores
from potserver.domain.tiles import Tile, TiledMap, TileGrid, TileIndex
from potserver.domain.types import KernelSet
from potserver.errors import MapFileError
from potserver.numerics.threads import default_threads, parallel_map
from potserver.storage.files import disk_faults, make_private_folder
from potserver.storage.seal import SEAL_BYTES, seal_number, sealed, unsealed
from potserver.storage.sqlite import (
    Kind,
    after_damage,
    close_keeping_log,
    connect,
    connect_read_only,
    reading,
    transaction,
)
from potserver.storage.tile_codec import decode_tile, encode_tile

FORMAT = 2
KIND = Kind(
    application_id=0x706F746D,  # "potm"
    version=FORMAT,
    schema=(
        "CREATE TABLE tiles (x INTEGER, y INTEGER, z INTEGER, data BLOB NOT NULL, UNIQUE (x, y, z))",
        "CREATE TABLE map (id INTEGER PRIMARY KEY CHECK (id = 0), record BLOB NOT NULL)",
    ),
    readable=(1,),
)
_AT_ONCE = 256  # tiles that are read before they are decoded: some ten megabytes
_SUM_LIMIT = 1 << 8 * SEAL_BYTES
_FIRST_RULE = 4  # numbers that a rule had at first


class MapRecord(msgspec.Struct, frozen=True, kw_only=True):
    """What a map is, beside its tiles."""

    map_id: str
    store_id: str  # of the store whose journal goes on from here; empty in a file of its own
    number: int  # of the journal's last scan that is in it
    edition: int = 0  # counts the snapshots of a store
    written_ns: int
    written_by: str  # version of potserver
    epoch: int
    revision: int
    n_scans: int
    stamp_ns: int
    grid: tuple[float, float] | None  # size_m and fine_m; none: no scan yet
    robots: list[str]
    heard: dict[str, dict[str, int]] = {}  # see `CloudOrder`
    keeps_evidence: bool  # false: profile `paper`, kernels without rows
    rule: tuple[float, ...]  # with which it answered; the numbers that `AnswerRule` had then
    scores_n: float
    scores_nll: list[float]
    scores_brier: float
    scores_bins: list[list[float]]
    n_tiles: int
    tiles_digest: str  # sum of the tiles' digests, hexadecimal

    def __post_init__(self) -> None:
        if not _FIRST_RULE <= len(self.rule) <= len(RULE_FIELDS):
            raise ValueError(f"rule: {len(self.rule)} numbers, need {_FIRST_RULE} to {len(RULE_FIELDS)}")
        AnswerRule(*self.rule)  # raises ValueError where it is none

    @property
    def answer_rule(self) -> AnswerRule:
        """With which the map answered when it was written."""
        return AnswerRule(*self.rule)


class SavedMap(NamedTuple):
    """A map as it was read."""

    record: MapRecord
    tiled: TiledMap | None
    n_bytes: int  # of the tiles as they are kept
    version: int  # of the file's format

    def kernel_map(self) -> KernelMap:
        """The map that answers as the saved one did."""
        parts = [] if self.tiled is None else list(self.tiled.parts.values())
        lean = None if self.tiled is None else self.tiled.lean
        return KernelMap(parts, rule=self.record.answer_rule, map_revision=self.record.revision, lean=lean)

    def state(self, *, epoch: int | None = None, revision: int | None = None) -> MapState:
        """What `MappingService.restore` takes; it puts together the kernels that queries are answered from.

        Args:
            epoch, revision: In place of those that were saved.
        """
        r = self.record
        scores = RunningScores(
            n_points=r.scores_n,
            nll=np.array(r.scores_nll),
            brier=r.scores_brier,
            bins=np.array(r.scores_bins),
        )
        return MapState(
            snapshot=KernelMap(KernelSet.empty(), map_revision=r.revision if revision is None else revision),
            tiled=self.tiled,
            epoch=r.epoch if epoch is None else epoch,
            n_scans=r.n_scans,
            stamp_ns=r.stamp_ns,
            scores=scores,
        )


class Origin(NamedTuple):
    """Which map a file holds, and where in a store's journal it stands."""

    map_id: str
    keeps_evidence: bool
    heard: Heard
    store_id: str = ""
    number: int = 0
    edition: int = 0


class MapFile:
    """A map file that is open for writing. One caller at a time."""

    def __init__(self, path: Path, *, fsync: bool = True, wal: bool = True, must_exist: bool = False) -> None:
        """Open or make it.

        Args:
            path, fsync, wal, must_exist: See `sqlite.connect`.
        Raises:
            MapFileError, StorageError: see `sqlite.connect`.
        """
        self.path = path
        self._connection = connect(path, KIND, fsync=fsync, wal=wal, must_exist=must_exist)
        self._written: dict[TileIndex, tuple[int, int]] = {}  # revision and digest of each tile
        self._epoch: int | None = None  # which those revisions are of

    def read(self, pages: Pages | None = None) -> SavedMap | None:
        """The map, or None where none was written yet; from now on only what differs from it is written.

        Args:
            pages: For what memory may not hold of it.
        Raises:
            MapFileError: it is damaged. StorageError: the disk has no room for pages.
        """
        saved = _read(self._connection, self.path, self._written, pages)
        self._epoch = None if saved is None else saved.record.epoch
        return saved

    def write(self, state: MapState, origin: Origin, check: Callable[[], None] = lambda: None) -> int:
        """Make the file hold a map, in one transaction: tiles of the same epoch and revision are there already.

        Args:
            state, origin: The map.
            check: Called when all of it has been read; what it raises undoes the transaction.
        Returns:
            Bytes of the tiles that were written.
        Raises:
            StorageError: the disk refuses; the file holds what it held before.
        """
        tiles: Mapping[TileIndex, Tile] = {} if state.tiled is None else state.tiled.tiles
        known = dict(self._written) if self._epoch == state.epoch else {}
        gone = known.keys() - tiles.keys()
        n_bytes = 0
        with transaction(self._connection, self.path):
            if self._epoch != state.epoch:
                self._connection.execute("DELETE FROM tiles")
            self._connection.executemany("DELETE FROM tiles WHERE x = ? AND y = ? AND z = ?", gone)
            for index in gone:
                del known[index]
            for index, tile in tiles.items():
                if index in known and known[index][0] == tile.revision:
                    continue
                data = encode_tile(index, tile)
                # an update keeps the row's number, and so the order of the tiles
                self._connection.execute(
                    "INSERT INTO tiles VALUES (?, ?, ?, ?) ON CONFLICT (x, y, z) DO UPDATE SET data = excluded.data",
                    (*index, data),
                )
                known[index] = (tile.revision, seal_number(data))
                n_bytes += len(data)
            record = sealed(msgspec.json.encode(_record_of(state, origin, known)))
            self._connection.execute("INSERT OR REPLACE INTO map VALUES (0, ?)", (record,))
            check()
        self._written, self._epoch = known, state.epoch
        return n_bytes

    def close(self) -> None:
        """Close; what was committed is in the file."""
        with contextlib.suppress(sqlite3.Error):
            self._connection.close()

    def leave(self) -> None:
        """Close it as it was found."""
        close_keeping_log(self._connection, self.path)

    def __enter__(self) -> MapFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()


def write_map(path: Path, state: MapState, origin: Origin, check: Callable[[], None] = lambda: None) -> int:
    """Write a `*.map` file, whole or not at all; it is on the disk when this returns.

    Args:
        path: The file.
        state, origin, check: See `MapFile.write`.
    Returns:
        Bytes of the file.
    Raises:
        StorageError: the disk refuses; a file that was there is as it was.
    """
    partial = path.with_name(path.name + ".partial")
    try:
        with disk_faults("write", path):
            make_private_folder(path.parent)
            partial.unlink(missing_ok=True)
            with MapFile(partial, wal=False) as file:
                file.write(state, origin, check)
            n_bytes = partial.stat().st_size
            partial.replace(path)
            sync_folder(path.parent)
    finally:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
    return n_bytes


def read_map(path: Path, pages: Pages | None = None) -> SavedMap:
    """Read a `*.map` file or a store's `tiles.sqlite`, beside the server that writes it too: from one transaction.

    Args:
        path: The file.
        pages: For what memory may not hold of it.
    Raises:
        MapFileError: there is no such file, or it is damaged, of another version, or holds no map yet.
        StorageError: the disk has no room for pages.
    """
    with contextlib.closing(connect_read_only(path, KIND)) as connection:
        saved = _read(connection, path, {}, pages)
    if saved is None:
        raise MapFileError(
            f"{path} holds no map yet: a server writes it at its first snapshot, or at `potclient map save`",
            reason="empty",
        )
    return saved


class Contents(NamedTuple):
    """How much a file holds."""

    n_rows: int
    n_kernels: int
    n_bytes: int  # of the tiles as they are kept


def describe(saved: SavedMap) -> Contents:
    """Count what a map file holds."""
    tiles = [] if saved.tiled is None else list(saved.tiled.tiles.values())
    return Contents(
        n_rows=sum(len(tile.rows.kind) for tile in tiles),
        n_kernels=sum(len(tile.kernels) for tile in tiles),
        n_bytes=saved.n_bytes,
    )


def _record_of(state: MapState, origin: Origin, tiles: Mapping[TileIndex, tuple[int, int]]) -> MapRecord:
    scores, tiled, rule = state.scores, state.tiled, state.snapshot.rule
    return MapRecord(
        map_id=origin.map_id,
        store_id=origin.store_id,
        number=origin.number,
        edition=origin.edition,
        written_ns=time.time_ns(),
        written_by=__version__,
        epoch=state.epoch,
        revision=state.map_revision,
        n_scans=state.n_scans,
        stamp_ns=state.stamp_ns,
        grid=None if tiled is None else (tiled.grid.size_m, tiled.grid.fine_m),
        robots=[] if tiled is None else list(tiled.robots),
        heard={robot: dict(sessions) for robot, sessions in origin.heard.items()},
        keeps_evidence=origin.keeps_evidence,
        rule=dataclasses.astuple(rule),
        scores_n=scores.n_points,
        scores_nll=scores.nll.tolist(),
        scores_brier=scores.brier,
        scores_bins=scores.bins.tolist(),
        n_tiles=len(tiles),
        tiles_digest=f"{_sum(digest for _, digest in tiles.values()):x}",
    )


def _read(
    connection: sqlite3.Connection,
    path: Path,
    written: dict[TileIndex, tuple[int, int]],
    pages: Pages | None,
) -> SavedMap | None:
    """Read everything in one transaction, so that a writer beside us does not matter; `written` is filled."""
    tiles: dict[TileIndex, Tile] = {}
    n_bytes = n_resident = 0
    threads = default_threads()
    with reading(path), contextlib.ExitStack() as stack:
        connection.execute("BEGIN")
        stack.callback(
            connection.rollback
        )  # nothing was written; after an error of the disk there is no transaction any more
        found = connection.execute("SELECT record FROM map").fetchall()
        if not found and connection.execute("SELECT 1 FROM tiles LIMIT 1").fetchone() is None:
            return None
        if len(found) != 1:
            raise _damaged(path, "its record is missing")
        record = _parse(path, found[0][0])
        version = int(connection.execute("PRAGMA user_version").fetchone()[0])
        grid = TileGrid(*record.grid) if record.grid is not None else None
        rows = connection.execute("SELECT x, y, z, data FROM tiles ORDER BY rowid")

        def decoded(row: tuple[Any, ...]) -> tuple[TileIndex, Tile]:
            *named, data = row
            if grid is None or not isinstance(data, bytes):
                raise _damaged(path, "it has tiles and no grid, or a tile without bytes")
            try:
                index, tile = decode_tile(data, grid, len(record.robots))
            except MapFileError as error:
                raise _damaged(path, str(error)) from error
            if list(index) != named:
                raise _damaged(path, f"tile {index} stands at {tuple(named)}")
            return index, tile

        while some := rows.fetchmany(_AT_ONCE):
            for row, (index, tile) in zip(some, parallel_map(decoded, some, threads, "files"), strict=True):
                n_resident += tile.n_bytes
                if pages is not None and n_resident > pages.read_bytes:
                    with disk_faults("write pages of", path):
                        tile = pages.keep(tile)
                tiles[index] = tile
                n_bytes += len(row[-1])
                written[index] = (tile.revision, seal_number(row[-1]))
    if len(tiles) != record.n_tiles or f"{_sum(d for _, d in written.values()):x}" != record.tiles_digest:
        raise _damaged(path, f"it has {len(tiles)} tiles, and not the {record.n_tiles} that were written")
    if grid is None:
        return SavedMap(record, None, 0, version)
    empty = TiledMap.empty(grid)._replace(robots=tuple(record.robots))
    if pages is None:
        return SavedMap(record, empty.with_tiles(tiles, threads=threads), n_bytes, version)
    with disk_faults("write pages of", path):
        return SavedMap(record, pages.gather(empty, tiles), n_bytes, version)


def _parse(path: Path, data: object) -> MapRecord:
    content = unsealed(data)
    if content is None:
        raise _damaged(path, "the checksum of its record does not fit")
    try:
        record = msgspec.json.decode(content, type=MapRecord)
    except msgspec.DecodeError as error:
        raise _damaged(path, f"its record: {error}") from error
    empty = RunningScores()
    if (
        np.shape(record.scores_nll) != empty.nll.shape
        or np.shape(record.scores_bins) != empty.bins.shape
        or (record.grid is not None and not (0 < record.grid[1] <= record.grid[0] < np.inf))
    ):
        raise _damaged(path, "its record has scores or a grid that no map makes")
    return record


def _damaged(path: Path, what: str) -> MapFileError:
    return MapFileError(f"{path} is damaged: {what}{after_damage(path)}", reason="damaged")


def _sum(numbers: Iterable[int]) -> int:
    return sum(numbers) % _SUM_LIMIT
