"""Where a map survives: a journal of accepted scans, and snapshots of the tiles that they made.

A scan is in the journal, on the disk, before it is in the map and before anybody is told so; most of that is done beside the
work on the scan. A thread of its own writes snapshots, from states that never change. What a snapshot has, the journal
forgets with its next scan. At the start the last snapshot is read, and the journal's scans after it are integrated again.
There are two files so that a long snapshot never holds up a scan. Each knows what the other must have, and a mark beside them
how far both have come: a file that is lost, old or cut off is noticed (`agreement`). Nothing is acknowledged that went into
files which no longer bear their names.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import secrets
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import msgspec

from potserver.codec.clouds import encode_cloud, read_cloud
from potserver.domain.map_state import MapState
from potserver.domain.order import CloudOrder, Heard
from potserver.domain.pages import Pages
from potserver.domain.types import ParamsKind, Scan
from potserver.errors import (
    MapDamagedError,
    MapFileError,
    PotserverError,
    StorageError,
    TooLargeError,
    UnknownMapError,
    UnsupportedError,
)
from potserver.health import Health
from potserver.log import get_logger
from potserver.mapping.service import MappingService
from potserver.storage.agreement import (
    JOURNAL,
    MARK,
    TILES,
    Standing,
    check_agreement,
    check_complete,
)
from potserver.storage.files import NamedFiles, make_private_folder
from potserver.storage.journal import Journal
from potserver.storage.map_file import MapFile, Origin, SavedMap, read_map, write_map
from potserver.storage.mark import Mark, Progress, read_mark
from potserver.storage.sqlite import log_of
from potserver.thread_names import show_name
from potserver.threads import spawn

log = get_logger("potserver.store")

Commit = Callable[[], None]  # the scan counts from when it returns

SAVED = "saved"
SNAPSHOT_SCANS = 16  # a restart after a crash integrates at most so many again: seconds
SNAPSHOT_BYTES = 64 * 2**20  # large scans make a snapshot due earlier
RESIDENT_BYTES = 2 * 2**30
MAX_SAVED = 100  # copies with a name: whoever reaches the server may ask for one more
_REPORT_S = 2.0  # between two lines of progress
_IN_MEMORY = "this server keeps its maps in memory only: start it with --store DIR, or without --in-memory"


class Restored(NamedTuple):
    """What a start found."""

    n_scans: int  # in the map now
    n_replayed: int  # of those, from the journal
    heard: Heard  # the robots' last numbers


class _Newest(NamedTuple):
    """A state of the map, and where in the journal it stands."""

    state: MapState
    heard: Heard
    number: int


class MapStore:
    """One map's folder; all methods have one caller at a time, the map's writer."""

    durable = True  # what was appended survives this process

    def __init__(
        self,
        folder: Path,
        map_id: str,
        *,
        keeps_evidence: bool,
        health: Health,
        fsync: bool = True,
        snapshot_scans: int = SNAPSHOT_SCANS,
        snapshot_bytes: int = SNAPSHOT_BYTES,
        max_resident_bytes: int = RESIDENT_BYTES,
    ) -> None:
        """Open the folder `<folder>/<map_id>`, or make it.

        Args:
            folder: Of all maps of a server.
            map_id: Of this one.
            keeps_evidence: Whether the map keeps rows, and not only kernels: a map of the other kind is refused.
            health: Gets counts and times.
            fsync: Wait for the disk with each scan. Without, a crash of the machine may take the last ones; a crash of the
                process does not.
            snapshot_scans, snapshot_bytes: A snapshot is written after so many scans, or so many bytes of the journal.
            max_resident_bytes: Of the map that stay in memory; the rest lies in a file without a name in the folder.
        Raises:
            StorageError: another server has the folder, or the disk refuses.
            MapFileError: a file in it is damaged, or of another version.
        """
        self.folder = folder / map_id
        self._saved = folder / SAVED / map_id
        self._map_id, self._keeps_evidence, self._health = map_id, keeps_evidence, health
        self._snapshot_scans, self._snapshot_bytes = snapshot_scans, snapshot_bytes
        self._fsync = fsync
        make_private_folder(folder)
        make_private_folder(self.folder)
        has_begun = check_complete(self.folder)
        self._journal = Journal(self.folder / JOURNAL, fsync=fsync, must_exist=has_begun)
        try:
            self._tiles = MapFile(self.folder / TILES, fsync=fsync, must_exist=has_begun)
        except BaseException:
            self._journal.leave()
            raise
        self._pages = Pages(self.folder, max_resident_bytes)
        self._mark: Mark | None = None  # from `restore` on
        self._files: NamedFiles | None = None
        self._edition = 0  # of the newest snapshot
        self._number = self._journal.last
        self._taken = 0  # number of the last scan that is in a snapshot
        self._unsaved_bytes = 0  # of the journal, since the last snapshot that was asked for
        self._asked = 0  # number that the last snapshot was asked for at
        self._newest: _Newest | None = None
        self._written: tuple[int, int] | None = None  # epoch and revision of what the last snapshot holds
        self._changed = threading.Condition()
        self._writing = threading.Lock()  # one snapshot at a time
        self._wanted = self._closed = False
        self._thread = spawn(f"{map_id}-snapshots", self._run)
        self._stager = concurrent.futures.ThreadPoolExecutor(
            1, thread_name_prefix=f"{map_id}-journal", initializer=show_name
        )

    # --- start ----------------------------------------------------------------------------------------------

    def restore(self, mapper: MappingService) -> Restored:
        """Give an empty mapper the map that is kept: the last snapshot, and the scans of the journal after it.

        Raises:
            MapFileError: something that must be there is damaged or missing, or the settings do not fit the map.
        """
        started_s = time.perf_counter()
        saved = self._tiles.read(self._pages)
        mark = read_mark(self.folder / MARK)
        standing = check_agreement(self.folder, self._journal, None if saved is None else saved.record, mark)
        order = CloudOrder()
        if saved is not None:
            order.replace(saved.record.heard)
            self._taken = saved.record.number
            # a scan that is integrated again may give other last digits: the epoch tells readers that the revision is another
            keeps_epoch = self._journal.was_closed and self._journal.last == self._taken
            epoch = saved.record.epoch if keeps_epoch else secrets.randbits(62)
            self._check_fits(mapper, saved, self._tiles.path)
            mapper.restore(saved.state(epoch=epoch))
            if keeps_epoch:
                self._written = mapper.state.epoch, mapper.state.map_revision
        n_replayed = self._replay(mapper, order)
        self.check_readable()
        self._begin(mapper.state, order.heard, standing, mark)
        log.info(
            "map_restored",
            map_id=self._map_id,
            folder=str(self.folder),
            n_scans=mapper.n_scans,
            n_replayed=n_replayed,
            map_revision=mapper.state.map_revision,
            elapsed_ms=round((time.perf_counter() - started_s) * 1e3, 1),
        )
        return Restored(mapper.n_scans, n_replayed, order.heard)

    def _begin(self, state: MapState, heard: Heard, standing: Standing, mark: Progress | None) -> None:
        """From now on scans and snapshots are written."""
        self._number, self._edition = standing.number, standing.edition
        if standing.lacks:
            log.warning("store_short", map_id=self._map_id, folder=str(self.folder), lacks=standing.lacks)
            # before the journal goes on from a number that it has not reached
            self._write(_Newest(state, heard, self._number))
        self._journal.begin(self._number)
        progress = mark or Progress(store_id=self._journal.store_id)
        self._mark = Mark(
            self.folder / MARK,
            msgspec.structs.replace(progress, last=self._number, edition=self._edition, synced=self._fsync),
        )
        files = [self.folder / name for name in (JOURNAL, TILES)]
        self._files = NamedFiles([self._mark.path, *files, *map(log_of, files)])
        self._asked = self._taken
        self._newest = _Newest(state, heard, self._number)

    def _replay(self, mapper: MappingService, order: CloudOrder) -> int:
        n = self._journal.last - self._taken
        if n > 0:
            log.info("journal_replaying", map_id=self._map_id, n_scans=n)
        reported_s = time.monotonic()
        done = 0
        for number, payload in self._journal.scans(self._taken):
            try:
                scan = read_cloud(payload)
                mapper.integrate(scan, params=ParamsKind.NONE)
            except PotserverError as error:
                raise MapFileError(
                    f"{self.folder}: scan {number} of the journal, which was accepted, cannot be integrated again: {error}."
                    " Start with the settings that it was accepted with",
                    reason="settings",
                ) from error
            self._unsaved_bytes += len(payload)
            self.relieve(mapper)
            order.remember(scan.robot_id, scan.session, scan.seq)
            done += 1
            if time.monotonic() - reported_s > _REPORT_S:
                reported_s = time.monotonic()
                log.info("journal_replaying", map_id=self._map_id, n_scans=n, n_done=done)
        return done

    def check_readable(self) -> None:
        """To be asked when something was computed from the map; from any thread.

        Raises:
            MapDamagedError: the disk could not read back a part of it.
        """
        self._pages.file.check()

    def check_takes(self) -> None:
        """Raises MapDamagedError: nothing can be added to such a map."""
        self.check_readable()

    # --- scans ----------------------------------------------------------------------------------------------

    @contextlib.contextmanager
    def keeping(self, scan: Scan) -> Iterator[Commit]:
        """Write a scan beside the work of the block.

        Yields:
            To be called when the scan is about to enter the map; it is on the disk when that returns.

        Raises (what is called):
            StorageError: the disk refuses; the scan must not enter the map. MapDamagedError: see `check_readable`.
        """
        payload = encode_cloud(scan)
        staged = self._stager.submit(self._stage, payload, self._taken)
        try:
            yield lambda: self._keep(len(payload), staged)
        finally:
            concurrent.futures.wait([staged])  # nothing goes on behind the writer's back

    def _stage(self, payload: bytes, prune_to: int) -> None:
        with self._writing_to(JOURNAL):
            self._journal.stage(payload, prune_to=prune_to)

    def _keep(self, n_bytes: int, staged: concurrent.futures.Future[None]) -> None:
        started_s = time.perf_counter()
        self.check_readable()
        try:
            staged.result()
            with self._writing_to(JOURNAL):
                self._journal.count_staged()
        except StorageError:
            self._health.count("store.appends_failed")
            raise
        self._number = self._journal.last
        self._advance_mark(last=self._number)
        self._unsaved_bytes += n_bytes
        self._health.count("store.appends")
        self._health.observe("journal", (time.perf_counter() - started_s) * 1e3)

    def relieve(self, mapper: MappingService) -> None:
        """Move to pages what memory may not hold of the map. If the disk refuses, it stays in memory, and that is counted."""
        try:
            mapper.relieve(self._pages)
        except OSError as error:
            self._health.count("store.pages_failed")
            log.warning("pages_failed", map_id=self._map_id, detail=str(error))

    def advance(self, mapper: MappingService, heard: Heard) -> None:
        """The last scan is in the map; a snapshot is begun if enough have come. Never waits.

        Args:
            mapper: With it.
            heard: The robots' last numbers, with it.
        """
        with self._changed:
            self._newest = _Newest(mapper.state, heard, self._number)
            due = self._number - self._asked >= self._snapshot_scans
            if due or self._unsaved_bytes >= self._snapshot_bytes:
                self._asked, self._unsaved_bytes = self._number, 0
                self._wanted = True
                self._changed.notify_all()

    # --- maps -----------------------------------------------------------------------------------------------

    def replace(self, state: MapState, heard: Heard) -> None:
        """Write a snapshot of a state that is about to become the map; it is on the disk when this returns.

        Raises:
            StorageError: the disk refuses; what was kept before still is, and the state must not become the map.
            MapDamagedError: likewise, see `check_readable`.
        """
        if state.tiled is not None:
            self._pages.verify(state.tiled)
        with self._writing:
            newest = _Newest(state, heard, self._number)
            self._write(newest)
            with self._changed:
                self._newest = newest
                self._asked, self._unsaved_bytes = self._number, 0

    def save(self, name: str | None, mapper: MappingService, heard: Heard) -> str:
        """Write a snapshot now, and a file of its own if there is a name; what was done, for people.

        Raises:
            StorageError: the disk refuses. TooLargeError: there are as many files as may be.
        """
        state = mapper.state
        self.replace(state, heard)
        if name is None:
            return f"the snapshot holds all {state.n_scans} scans"
        path = self._saved / f"{name}.map"
        others = [p for p in self._saved.glob("*.map") if p != path]
        if len(others) >= MAX_SAVED:
            raise TooLargeError(
                f"{len(others)} maps are saved already, the limit is {MAX_SAVED}: move some out of {self._saved}"
            )
        make_private_folder(self._saved.parent)
        origin = Origin(self._map_id, self._keeps_evidence, heard)
        n_bytes = write_map(path, state, origin, self.check_readable)
        self._health.count("store.saved")
        return f"{state.n_scans} scans saved as {path}, {n_bytes} bytes"

    def load(self, name: str, mapper: MappingService) -> tuple[MapState, Heard]:
        """Read a saved map: the state to replace the present one with, of a new epoch and a higher revision, and its numbers.

        Raises:
            UnknownMapError: none was saved under that name.
            MapFileError: it is damaged, of another version, or does not fit the settings.
        """
        path = self._saved / f"{name}.map"
        if not path.is_file():
            names = ", ".join(sorted(p.stem for p in self._saved.glob("*.map"))) or "none"
            common = self._saved.parent / path.name
            hint = (
                f"; {common} is where all maps had their copies: move it to {path}"
                if common.is_file()
                else ""
            )
            raise UnknownMapError(f"no map was saved as {name!r}; there are: {names}{hint}")
        saved = read_map(path, self._pages)
        self._check_fits(mapper, saved, path)
        revision = max(mapper.state.map_revision, saved.record.revision) + 1
        return saved.state(epoch=secrets.randbits(62), revision=revision), saved.record.heard

    # --- end ------------------------------------------------------------------------------------------------

    def drop(self) -> None:
        """Close without a last snapshot; what was never restored stays as it was found."""
        self._end_snapshots()
        self._pages.close()
        self._tiles.leave()
        self._journal.leave()
        if self._mark is not None:
            self._mark.close()

    def close(self) -> bool:
        """Write a last snapshot if the map has changed since the one before, and close; false if the disk refused."""
        if self._mark is None:
            self.drop()
            return True
        self._end_snapshots()
        complete_to = None
        try:
            newest = self._newest
            # a scan that is in the journal and not in the map is the next start's
            if newest is not None and newest.number == self._number:
                if (newest.state.epoch, newest.state.map_revision) != self._written:
                    self._write(newest)
                complete_to = newest.number
            self._journal.close(complete_to=complete_to)
            return True
        except (StorageError, MapDamagedError) as error:
            # the journal has it all
            log.error("last_snapshot_failed", map_id=self._map_id, detail=str(error))
            return False
        finally:
            self._pages.close()
            self._tiles.close()
            self._journal.close()
            self._mark.close()

    def _writing_to(self, name: str) -> contextlib.AbstractContextManager[None]:
        """Raises StorageError where what is written now is not what stands on the disk under the store's names."""
        path = self.folder / name
        return contextlib.nullcontext() if self._files is None else self._files.writing(path, log_of(path))

    def _advance_mark(self, **numbers: int) -> None:
        if self._mark is None:
            return
        try:
            self._mark.advance(**numbers)
        except StorageError as error:  # what was written is safe; only its loss might go unnoticed
            self._health.count("store.marks_failed")
            log.warning("mark_failed", map_id=self._map_id, detail=str(error))

    def _end_snapshots(self) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join()
        self._stager.shutdown()

    def _run(self) -> None:
        """Write the snapshots that `advance` asks for."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._wanted or self._closed)
                if self._closed:
                    return
                self._wanted = False
            with self._writing:
                newest = self._newest  # inside: `replace` may just have written a newer one
                try:
                    if newest is not None:
                        self._write(newest)
                except (StorageError, MapDamagedError) as error:
                    # the scans are safe in the journal, which grows until a snapshot succeeds
                    self._health.count("store.snapshots_failed")
                    log.warning("snapshot_failed", map_id=self._map_id, detail=str(error))
                except Exception:  # a bug must not end the thread
                    self._health.count("store.snapshots_failed")
                    log.exception("snapshot_failed", map_id=self._map_id)

    def _write(self, newest: _Newest) -> None:
        started_s = time.perf_counter()
        origin = Origin(
            self._map_id,
            self._keeps_evidence,
            newest.heard,
            self._journal.store_id,
            newest.number,
            self._edition + 1,
        )
        with self._writing_to(TILES):
            n_bytes = self._tiles.write(newest.state, origin, self.check_readable)
        self._edition += 1
        self._advance_mark(edition=self._edition)
        self._taken, self._written = newest.number, (newest.state.epoch, newest.state.map_revision)
        elapsed_ms = (time.perf_counter() - started_s) * 1e3
        self._health.count("store.snapshots")
        self._health.observe("snapshot", elapsed_ms)
        log.info(
            "snapshot_written",
            map_id=self._map_id,
            n_scans=newest.state.n_scans,
            map_revision=newest.state.map_revision,
            n_bytes=n_bytes,
            elapsed_ms=round(elapsed_ms, 1),
        )

    def _check_fits(self, mapper: MappingService, saved: SavedMap, path: Path) -> None:
        r, size_m = saved.record, mapper.settings.tile_size_m
        if r.grid is not None and r.grid[0] != size_m:
            raise MapFileError(
                f"{path} has tiles of {r.grid[0]} m, and mapping.tile_size_m is {size_m}: set it to the map's",
                reason="settings",
            )
        if r.n_tiles and r.keeps_evidence != self._keeps_evidence:
            kinds = ("kernels alone (profile `paper`)", "evidence")
            raise MapFileError(
                f"{path} is a map of {kinds[r.keeps_evidence]}, this server makes maps of {kinds[self._keeps_evidence]}:"
                " choose the other profile",
                reason="settings",
            )


class MemoryOnly:
    """Keeps nothing: the store of a map that lives in memory."""

    durable = False

    def check_readable(self) -> None:
        """Nothing lies on pages."""

    def check_takes(self) -> None:
        """All scans are welcome."""

    @contextlib.contextmanager
    def keeping(self, scan: Scan) -> Iterator[Commit]:
        """Nothing to do."""
        yield lambda: None

    def relieve(self, mapper: MappingService) -> None:
        """Nothing to do: there is no disk."""

    def advance(self, mapper: MappingService, heard: Heard) -> None:
        """Nothing to do."""

    def replace(self, state: MapState, heard: Heard) -> None:
        """Nothing to do."""

    def save(self, name: str | None, mapper: MappingService, heard: Heard) -> str:
        """Not here.

        Raises:
            UnsupportedError: always.
        """
        raise UnsupportedError(_IN_MEMORY)

    def load(self, name: str, mapper: MappingService) -> tuple[MapState, Heard]:
        """Not here.

        Raises:
            UnsupportedError: always.
        """
        raise UnsupportedError(_IN_MEMORY)
