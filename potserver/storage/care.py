"""Kept maps without a server: is a store sound, and how one of an older format is brought up to date."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import NamedTuple

from potserver.codec.clouds import read_cloud
from potserver.errors import MapFileError
from potserver.storage import journal as journals
from potserver.storage import map_file as map_files
from potserver.storage.agreement import JOURNAL, MARK, TILES, check_agreement, check_complete
from potserver.storage.files import disk_faults
from potserver.storage.journal import Journal
from potserver.storage.map_file import MapFile, read_map
from potserver.storage.mark import Mark, Progress, read_mark
from potserver.storage.read_only import copy_store
from potserver.storage.sqlite import raise_version


class Checked(NamedTuple):
    """What was found in a sound map."""

    format: int  # of the older of its files
    n_scans: int  # in its snapshot, or the file
    n_in_journal: int  # beyond that
    lacks: tuple[str, ...] = ()  # see `Standing`

    @property
    def is_old(self) -> bool:
        """A server refuses it until it is upgraded."""
        return self.format < map_files.FORMAT


def check_map(path: Path) -> Checked:
    """Read every byte of a saved map.

    Raises:
        MapFileError: it is damaged, of an unknown version, or none. StorageError: the disk refuses.
    """
    saved = read_map(path)
    saved.kernel_map()
    return Checked(saved.version, saved.record.n_scans, 0)


def check_store(folder: Path) -> Checked:
    """Read every byte of one map's folder, and see that its files agree. It is copied first, and not touched.

    Raises:
        MapFileError: something that must be there is damaged or missing.
        StorageError: a server has it open, the disk refuses, or there is no room for the copy.
    """
    return _look_at(folder)[0]


def upgrade_store(folder: Path) -> Checked:
    """Bring one map's folder up to date, after a check; an end in the middle leaves what can be upgraded again.

    Returns:
        What was found, with the format that it had.
    Raises:
        MapFileError, StorageError: see `check_store`; nothing was changed.
    """
    found, mark = _look_at(folder)
    if found.is_old:
        Mark(folder / MARK, mark).close()  # first: a file of the present format without it is no store
        raise_version(folder / JOURNAL, journals.KIND)
        raise_version(folder / TILES, map_files.KIND)
        with disk_faults("close to others", folder):
            folder.chmod(0o700)
            for file in folder.iterdir():
                file.chmod(0o600)
    return found


def _look_at(folder: Path) -> tuple[Checked, Progress]:
    """What a copy of a store says, upgraded if need be, and its mark."""
    with disk_faults("copy to", Path(tempfile.gettempdir())), tempfile.TemporaryDirectory() as scratch:
        copy = Path(scratch) / "copy"
        copy_store(folder, copy)
        check_complete(copy)
        try:
            return _read(copy)
        except MapFileError as error:  # its words are about the store, not about our copy
            raise MapFileError(str(error).replace(str(copy), str(folder)), reason=error.reason) from error


def _read(folder: Path) -> tuple[Checked, Progress]:
    version = min(
        raise_version(folder / JOURNAL, journals.KIND), raise_version(folder / TILES, map_files.KIND)
    )
    journal = Journal(folder / JOURNAL, fsync=False, must_exist=True)
    try:
        with MapFile(folder / TILES, fsync=False, must_exist=True) as tiles:
            saved = tiles.read()
        number, edition = (0, 0) if saved is None else (saved.record.number, saved.record.edition)
        mark = read_mark(folder / MARK)
        if mark is None and version < map_files.FORMAT:  # older ones had none
            mark = Progress(store_id=journal.store_id, last=max(journal.last, number), edition=edition)
        standing = check_agreement(folder, journal, None if saved is None else saved.record, mark)
        n = 0
        for _, payload in journal.scans(number):
            read_cloud(payload)
            n += 1
    finally:
        journal.close()
    n_scans = 0 if saved is None else saved.record.n_scans
    return Checked(version, n_scans, n, standing.lacks), mark or Progress(store_id=journal.store_id)
