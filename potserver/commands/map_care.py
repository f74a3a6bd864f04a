"""`potserver map check` and `potserver map upgrade`: are kept maps sound, and of the present format?"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from potserver.commands.shared import EXIT_OK, EXIT_UNCLEAN, add_verb, say
from potserver.errors import MapFileError, PotserverError

if TYPE_CHECKING:
    from potserver.storage.care import Checked

_CHECK = """\
Read every byte of saved maps (*.map), of one map's folder, or of a whole store, and see that the files of a
store agree. Nothing is changed: a store is copied first, into a temporary folder. Exit code 1 where something is
not sound."""

_UPGRADE = """\
Bring one map's folder, or a whole store, up to the format that this version writes. No server may have it open.
Each map is checked first, on a copy; one that is not sound stays as it is. Saved maps (*.map) of older formats are
read as they are."""

_WHERE = "a map's folder, or a store"


def add(verbs: Any) -> None:
    """Add the verbs."""
    check = add_verb(verbs, "check", _check, help="whether kept maps are sound", description=_CHECK)
    check.add_argument("path", type=Path, metavar="FILE|DIR", help=f"a saved map, {_WHERE}")
    upgrade = add_verb(
        verbs, "upgrade", _upgrade, help="bring a store of an older version up to date", description=_UPGRADE
    )
    upgrade.add_argument("path", type=Path, metavar="DIR", help=_WHERE)


def _check(options: argparse.Namespace) -> int:
    from potserver.storage.care import check_map, check_store

    stores, files = _found(options.path)
    outcomes = [_told(check_store, path) for path in stores] + [_told(check_map, path) for path in files]
    return EXIT_OK if all(outcomes) else EXIT_UNCLEAN


def _upgrade(options: argparse.Namespace) -> int:
    from potserver.storage.care import upgrade_store

    stores, _ = _found(options.path)
    if not stores:
        raise MapFileError(f"{options.path} is no store: saved maps need no upgrade", reason="missing")
    outcomes = [_told(upgrade_store, path, did="upgraded from") for path in stores]
    return EXIT_OK if all(outcomes) else EXIT_UNCLEAN


def _found(path: Path) -> tuple[list[Path], list[Path]]:
    """The maps' folders and the saved maps that a path means.

    Raises:
        MapFileError: there are none.
    """
    from potserver.storage.agreement import JOURNAL, MARK, TILES

    def is_store(folder: Path) -> bool:
        return any((folder / name).exists() for name in (JOURNAL, TILES, MARK))

    if path.is_file():
        return [], [path]
    stores = [path] if is_store(path) else sorted(filter(is_store, path.glob("*/")))
    files = sorted(path.rglob("*.map"))
    if not stores and not files:
        raise MapFileError(f"no map in {path}", reason="missing")
    return stores, files


def _told(look: Callable[[Path], Checked], path: Path, did: str = "") -> bool:
    """Look at one map, and say what was found; whether it is sound."""
    try:
        found = look(path)
    except PotserverError as error:
        say(f"{path}: NOT SOUND: {error}")
        return False
    words = [f"{found.n_scans} scans"]
    if found.n_in_journal:
        words.append(f"{found.n_in_journal} more in the journal")
    if found.is_old:
        words.append(f"{did or 'of'} format {found.format}")
    words += [f"a power cut took its end: {what}" for what in found.lacks]
    say(f"{path}: sound, {', '.join(words)}")
    return True
