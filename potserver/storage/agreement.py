"""Whether the files of a store are of one store, and hold all that was acknowledged."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from potserver.errors import MapFileError
from potserver.storage.journal import Journal
from potserver.storage.map_file import MapRecord
from potserver.storage.mark import Progress
from potserver.storage.sqlite import log_of

JOURNAL, TILES, MARK = "journal.sqlite", "tiles.sqlite", "mark"


class Standing(NamedTuple):
    """How far a store has come."""

    number: int = 0  # the largest that a scan was ever given
    edition: int = 0  # of the newest snapshot
    lacks: tuple[str, ...] = ()  # what a power cut took from a store whose writer did not wait for the disk


def check_complete(folder: Path) -> bool:
    """Whether a folder holds a store that has begun; False where a new one may be made.

    Raises:
        MapFileError: some of its files are missing.
    """
    has_begun = (folder / MARK).exists()
    gone = [name for name in (JOURNAL, TILES) if not (folder / name).exists()]
    # SQLite deletes a log whose file is new
    if gone and (has_begun or any(log_of(folder / name).exists() for name in gone)):
        raise _disagree(folder, f"{' and '.join(gone)} {'is' if len(gone) == 1 else 'are'} missing")
    return has_begun


def check_agreement(
    folder: Path, journal: Journal, record: MapRecord | None, mark: Progress | None
) -> Standing:
    """See that journal, snapshot and mark are of one store and that none is older than another says.

    Args:
        folder: Of the map.
        journal: Open, and not begun.
        record: Of the snapshot; None where none was written yet.
        mark: None where there is no file.
    Raises:
        MapFileError: they do not fit. Only where the store's writer never waited for the disk it is no error that its last
            scans or snapshot are not there: a power cut takes those.
    """
    number, edition, store_id = (
        (0, 0, "") if record is None else (record.number, record.edition, record.store_id)
    )
    if store_id not in ("", journal.store_id):
        raise _disagree(folder, f"{JOURNAL} is missing or of another map than {TILES}")
    if number < journal.pruned:
        raise _disagree(
            folder,
            f"{TILES} is missing or too old: it has the scans up to {number}, and {JOURNAL} only those after"
            f" {journal.pruned}",
        )
    if mark is None:
        if record is not None or journal.last:
            raise _disagree(folder, f"{MARK} is missing")
        return Standing()
    if mark.store_id != journal.store_id:
        raise _disagree(folder, f"{JOURNAL} is missing or of another store than {MARK}")
    lacks = []
    largest = max(number, mark.last)
    if journal.last < largest:
        lacks.append(f"{JOURNAL} ends at scan {journal.last}, and scan {largest} was acknowledged")
    if edition < mark.edition:
        lacks.append(f"{TILES} has snapshot {edition}, and snapshot {mark.edition} was acknowledged")
    if lacks and mark.synced:
        raise _disagree(folder, f"{'; '.join(lacks)}. A file is damaged, cut off, or of an older copy")
    return Standing(max(largest, journal.last), max(edition, mark.edition), tuple(lacks))


def _disagree(folder: Path, what: str) -> MapFileError:
    return MapFileError(
        f"{folder}: {what}. Put the whole folder back from one copy, if there is one. Else move it away, start with an empty"
        f" map, and load a saved one (`potclient map load NAME`); `potserver map import {folder} -o NAME.map` makes one of"
        " the last snapshot",
        reason="damaged",
    )
