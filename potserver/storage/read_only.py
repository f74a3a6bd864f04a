"""A kept map that is answered from and never changed, for disks that cannot be written, and for copies to look at."""

from __future__ import annotations

import contextlib
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

from potserver.domain.map_state import MapState
from potserver.domain.order import Heard
from potserver.domain.types import Scan
from potserver.errors import MapFileError, ReadOnlyError
from potserver.health import Health
from potserver.mapping.service import MappingService
from potserver.storage.agreement import JOURNAL, MARK, TILES
from potserver.storage.files import disk_faults
from potserver.storage.journal import is_in_use
from potserver.storage.map_store import RESIDENT_BYTES, Commit, MapStore, Restored
from potserver.storage.sqlite import in_use, log_of

_WHY = "this server answers from its maps and changes none: it was started with --read-only"


def copy_store(source: Path, to: Path) -> None:
    """Copy the files of one map's folder into another folder, which is made.

    Raises:
        MapFileError: there is no store. StorageError: a server has it open, or the disk refuses.
    """
    files = [source / name for name in (JOURNAL, TILES, MARK)]
    with disk_faults("read", source):
        if not files[0].exists():
            raise MapFileError(f"no map is kept in {source}: {JOURNAL} is not there", reason="missing")
    if is_in_use(files[0]):
        raise in_use(files[0])
    with disk_faults("copy", source):
        to.mkdir(parents=True)
        for file in (*files, log_of(files[0]), log_of(files[1])):
            if file.exists():  # what must be there and is not will be missed in the copy
                shutil.copyfile(file, to / file.name)


class ReadOnlyStore:
    """One map's folder, to which nothing is written: it is read from a copy, because SQLite reads no log without writing."""

    durable = False

    def __init__(
        self,
        folder: Path,
        map_id: str,
        *,
        keeps_evidence: bool,
        health: Health,
        max_resident_bytes: int = RESIDENT_BYTES,
    ) -> None:
        """Take the folder `<folder>/<map_id>`; see `MapStore`. Pages lie in the temporary folder."""
        self._folder, self._map_id = folder, map_id
        self._keeps_evidence, self._health = keeps_evidence, health
        self._max_resident_bytes = max_resident_bytes
        self.check_readable: Callable[[], None] = lambda: None  # see `MapStore`

    def restore(self, mapper: MappingService) -> Restored:
        """Give an empty mapper the map that is kept, see `MapStore.restore`.

        Raises:
            MapFileError: no map is kept there, it is damaged, or the settings do not fit it.
            StorageError: a server has it open, the disk refuses, or there is no room for the copy.
        """
        with disk_faults("copy to", Path(tempfile.gettempdir())), tempfile.TemporaryDirectory() as scratch:
            copy_store(self._folder / self._map_id, Path(scratch) / self._map_id)
            store = MapStore(
                Path(scratch),
                self._map_id,
                keeps_evidence=self._keeps_evidence,
                health=self._health,
                fsync=False,
                max_resident_bytes=self._max_resident_bytes,
            )
            self.check_readable = store.check_readable
            try:
                return store.restore(mapper)
            finally:
                store.drop()

    def check_takes(self) -> None:
        """Raises ReadOnlyError: nothing is taken in."""
        raise ReadOnlyError(_WHY)

    def keeping(self, scan: Scan) -> contextlib.AbstractContextManager[Commit]:
        """Raises ReadOnlyError, as all that follows does."""
        raise ReadOnlyError(_WHY)

    def relieve(self, mapper: MappingService) -> None:
        """Nothing to do: what memory may not hold is on pages since `restore`."""

    def advance(self, mapper: MappingService, heard: Heard) -> None:
        """Not here."""
        raise ReadOnlyError(_WHY)

    def replace(self, state: MapState, heard: Heard) -> None:
        """Not here."""
        raise ReadOnlyError(_WHY)

    def save(self, name: str | None, mapper: MappingService, heard: Heard) -> str:
        """Not here."""
        raise ReadOnlyError(_WHY)

    def load(self, name: str, mapper: MappingService) -> tuple[MapState, Heard]:
        """Not here."""
        raise ReadOnlyError(_WHY)

    def close(self) -> bool:
        """Nothing to do; true."""
        return True
