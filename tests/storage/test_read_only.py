"""A start that writes nothing: from disks that cannot be written, and from copies."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from potserver.errors import MapFileError, ReadOnlyError, StorageError
from potserver.health import Health
from potserver.mapping.service import MappingService
from potserver.storage.agreement import JOURNAL, MARK
from potserver.storage.map_store import Restored
from potserver.storage.read_only import ReadOnlyStore
from tests.conftest import ROOT

from .test_map_store import SETTINGS, OpenMap, assert_same_map, make_scan, open_map

__all__ = ["open_map"]

# as a file system of its own, mounted for reading only: the user's own namespaces allow that without privileges
_MOUNTED = ["unshare", "--map-root-user", "--mount", "sh", "-c"]
_REMOUNT = 'mount --bind "$1" "$1" && mount -o remount,bind,ro "$1"'


def read_only(folder: Path) -> tuple[MappingService, ReadOnlyStore, Restored]:
    mapper = MappingService(settings=SETTINGS, threads=1)
    store = ReadOnlyStore(folder, "default", keeps_evidence=True, health=Health())
    return mapper, store, store.restore(mapper)


def contents(folder: Path) -> dict[str, bytes]:
    return {
        path.name: path.read_bytes()
        for path in folder.rglob("*")
        if not path.name.endswith("-shm") and path.is_file()
    }


def test_a_killed_store_is_read_whole_and_not_touched(tmp_path: Path, open_map: OpenMap) -> None:
    ours = open_map(tmp_path / "store")
    for n in (1, 2, 3):
        ours.take(make_scan(n))
        if n == 2:
            ours.store.save(None, ours.mapper, ours.heard)
    left = ours.crash(tmp_path / "left")
    before = contents(left)
    mapper, store, restored = read_only(left)
    assert (restored.n_scans, restored.n_replayed) == (3, 1)
    assert_same_map(ours.state, mapper.state)
    assert contents(left) == before
    state = mapper.state
    for change in (
        lambda: store.keeping(make_scan(4)),
        lambda: mapper.clear(commit=lambda new: store.replace(new, {})),
        lambda: store.save(None, mapper, {}),
        lambda: store.load("x", mapper),
        store.check_takes,
    ):
        with pytest.raises(ReadOnlyError, match="--read-only"):
            change()
    assert mapper.state is state
    assert store.close()


def test_there_must_be_a_whole_store_that_nobody_writes(tmp_path: Path, open_map: OpenMap) -> None:
    with pytest.raises(MapFileError, match="no map is kept") as missing:
        read_only(tmp_path)
    assert missing.value.reason == "missing"
    ours = open_map(tmp_path / "store")
    with pytest.raises(StorageError, match="another server"):
        read_only(tmp_path / "store")
    left = ours.crash(tmp_path / "left")
    (left / "default" / MARK).unlink()
    ours.take(make_scan(1))
    shutil.copy(ours.folder / "default" / f"{JOURNAL}-wal", left / "default")
    with pytest.raises(MapFileError, match="mark is missing"):
        read_only(left)


_SCRIPT = """
import sys
from pathlib import Path
from potserver.errors import StorageError
from tests.storage.test_map_store import Map
from tests.storage.test_read_only import read_only
try:
    Map(Path(sys.argv[1]))
except StorageError as error:
    print(error.reason, "--read-only" in str(error), "damaged" in str(error))
mapper, _, restored = read_only(Path(sys.argv[1]))
print(restored.n_scans, restored.n_replayed)
"""


@pytest.mark.skipif(
    shutil.which("unshare") is None or subprocess.call([*_MOUNTED, "true"], stderr=subprocess.DEVNULL) != 0,
    reason="needs Linux's user namespaces",
)
@pytest.mark.parametrize("was_killed", [True, False])
def test_a_file_system_mounted_read_only(tmp_path: Path, open_map: OpenMap, was_killed: bool) -> None:
    ours = open_map(tmp_path / "store")
    for n in (1, 2):
        ours.take(make_scan(n))
    if not was_killed:
        ours.store.close()
    left = ours.crash(tmp_path / "left")
    told = subprocess.run(
        [*_MOUNTED, f'{_REMOUNT} && shift && exec "$@"', "sh", left, sys.executable, "-c", _SCRIPT, left],
        cwd=ROOT,
        check=True,
        capture_output=True,
        text=True,
        timeout=120,
    ).stdout.splitlines()
    assert told[0] == "read_only True False"
    assert told[1] == ("2 2" if was_killed else "2 0")
