"""How far a store has come, kept outside the files that say it.

SQLite takes the sound beginning of a log for all of it: damage at its end, or a log that is gone, looks like a time when less
had been written. The mark names the last scan and the last snapshot that were acknowledged, so that a start can tell. It is
written after them, without waiting for the disk: it may lag behind, and never runs ahead.
"""

from __future__ import annotations

import os
import threading
from pathlib import Path

import msgspec

from potserver.domain.folders import sync_folder
from potserver.errors import MapFileError
from potserver.log import get_logger
from potserver.storage.files import claim_file, disk_faults
from potserver.storage.seal import SEAL_BYTES, sealed, unsealed

log = get_logger("potserver.store")

_SLOT_BYTES = 512  # a sector: it is written whole or not at all
_SLOTS = 2  # written in turn, so that the one before is there when a slot is damaged


class Progress(msgspec.Struct, frozen=True, kw_only=True):
    """What a store must hold at least."""

    store_id: str
    last: int = 0  # number of the newest scan
    edition: int = 0  # of the newest snapshot
    synced: bool = True  # false: nobody waited for the disk, and a power cut may have taken what this names
    turn: int = 0  # counts the writes of the mark


class Mark:
    """The open mark of one store. Any thread may call."""

    def __init__(self, path: Path, progress: Progress) -> None:
        """Open or make it, and write it; it is on the disk when this returns.

        Raises:
            MapFileError: it is a link. StorageError: the disk refuses.
        """
        self.path = path
        self._progress, self._lock = progress, threading.Lock()
        _make(path, progress)
        claim_file(path)
        with disk_faults("write", path):
            self._descriptor = os.open(path, os.O_WRONLY | os.O_NOFOLLOW)
        try:
            for _ in range(_SLOTS):
                self.advance()
            with disk_faults("write", path):
                os.fsync(self._descriptor)
                sync_folder(path.parent)
        except BaseException:
            self.close()
            raise

    def advance(self, *, last: int = 0, edition: int = 0) -> None:
        """Note that a scan or a snapshot was written; smaller numbers than before change nothing.

        Raises:
            StorageError: the disk refuses; what was written is as safe as before, only its loss might go unnoticed.
        """
        with self._lock:
            now = self._progress
            self._progress = msgspec.structs.replace(
                now, last=max(now.last, last), edition=max(now.edition, edition), turn=now.turn + 1
            )
            place = self._progress.turn % _SLOTS * _SLOT_BYTES
            with disk_faults("write", self.path):
                os.pwrite(self._descriptor, _slot(self._progress), place)

    def close(self) -> None:
        """Close; a second time does nothing."""
        with self._lock:
            descriptor, self._descriptor = self._descriptor, -1
            if descriptor >= 0:
                os.close(descriptor)


def read_mark(path: Path) -> Progress | None:
    """The newest sound mark in a file, or None where there is no file.

    Raises:
        MapFileError: there is none in it. StorageError: it cannot be read.
    """
    with disk_faults("read", path):
        try:
            data = path.read_bytes()
        except FileNotFoundError:
            return None
    slots = [_parse(data[i * _SLOT_BYTES : (i + 1) * _SLOT_BYTES]) for i in range(_SLOTS)]
    sound = [slot for slot in slots if slot is not None]
    if not sound:
        raise MapFileError(f"{path} is damaged: neither copy fits its checksum", reason="damaged")
    if len(sound) < _SLOTS:
        log.warning("mark_half_damaged", file=str(path))
    return max(sound, key=lambda slot: slot.turn)


def _make(path: Path, progress: Progress) -> None:
    """Give a store its mark, which gets its name when it is complete."""
    with disk_faults("write", path):
        if os.path.lexists(path):
            return
        new = path.with_name(f"{path.name}.new")
        new.unlink(missing_ok=True)
        claim_file(new)
        new.write_bytes(_slot(progress) * _SLOTS)
        with new.open("rb") as stream:
            os.fsync(stream.fileno())
        new.replace(path)
        sync_folder(path.parent)


def _slot(progress: Progress) -> bytes:
    return sealed(msgspec.json.encode(progress).ljust(_SLOT_BYTES - SEAL_BYTES))


def _parse(data: bytes) -> Progress | None:
    content = unsealed(data)
    if content is None:
        return None
    try:
        return msgspec.json.decode(content, type=Progress)
    except msgspec.DecodeError:
        return None
