"""Stores of older versions: a store file of each released format is kept in `stores/`, and read for ever after."""

from __future__ import annotations

import json
import shutil
import stat
import zipfile
from pathlib import Path
from typing import Any

import pytest

from potserver.errors import MapFileError, StorageError
from potserver.storage.agreement import JOURNAL, MARK, TILES
from potserver.storage.care import check_map, check_store, upgrade_store
from potserver.storage.map_file import FORMAT, read_map
from potserver.storage.sqlite import log_of

from .test_map_store import OpenMap, assert_same_map, make_scan, open_map, sqlite
from .test_tile_codec import assert_same

__all__ = ["open_map"]

STORES = sorted((Path(__file__).parent / "stores").glob("format-*.zip"))


def unpacked(archive: Path, to: Path) -> dict[str, Any]:
    """A store that was killed, and what it held: answers may change with the mapper, what was kept does not."""
    with zipfile.ZipFile(archive) as packed:
        packed.extractall(to)
    held: dict[str, Any] = json.loads((to / "contents.json").read_text())
    return held


def contents(path: Path) -> dict[str, float]:
    """Of a map file, in numbers."""
    tiled = read_map(path).tiled
    assert tiled is not None
    tiles = tiled.tiles.values()
    return {
        "n_tiles": len(tiles),
        "n_rows": sum(len(tile.rows.kind) for tile in tiles),
        "n_kernels": sum(len(tile.kernels) for tile in tiles),
        "looks": sum(float(tile.rows.sums[:, 3].astype(float).sum()) for tile in tiles),
        "log_odds": sum(float(tile.kernels.kernels.weight_mean.astype(float).sum()) for tile in tiles),
    }


def test_every_format_has_a_store() -> None:
    assert [path.stem for path in STORES] == [f"format-{n}" for n in range(1, FORMAT + 1)]


@pytest.mark.parametrize("archive", STORES, ids=lambda path: path.stem)
def test_a_store_of_any_release_is_checked_upgraded_and_served(
    archive: Path, tmp_path: Path, open_map: OpenMap
) -> None:
    held = unpacked(archive, tmp_path / "store")
    folder, version = tmp_path / "store" / "default", int(archive.stem.rpartition("-")[2])
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    found = check_store(folder)
    assert found[:3] == (version, held["n_scans"] - held["n_replayed"], held["n_replayed"])
    changed = {n for n, content in before.items() if (folder / n).read_bytes() != content}
    assert not {n for n in changed if not n.endswith("-shm")}, "a check changes nothing"
    if found.is_old:
        with pytest.raises(MapFileError, match=f"potserver map upgrade {folder}") as old:
            open_map(tmp_path / "store")
        assert old.value.reason == "version"
        assert upgrade_store(folder) == found
        assert {stat.S_IMODE(path.stat().st_mode) for path in folder.iterdir()} == {0o600}
    assert check_store(folder).format == upgrade_store(folder).format == FORMAT
    assert contents(folder / TILES) == pytest.approx(held["snapshot"])
    ours = open_map(tmp_path / "store")
    assert (ours.restored.n_scans, ours.restored.n_replayed) == (held["n_scans"], held["n_replayed"])
    assert ours.state.tiled is not None
    assert set(ours.state.tiled.robots) == {"r1", "r2"}
    ours.take(make_scan(9))
    assert_same_map(ours.state, open_map(ours.crash(tmp_path / "again")).state)


@pytest.mark.parametrize("archive", STORES, ids=lambda path: path.stem)
def test_a_saved_map_of_any_release_is_loaded(archive: Path, tmp_path: Path, open_map: OpenMap) -> None:
    held = unpacked(archive, tmp_path / "old")
    (saved,) = (tmp_path / "old" / "saved").rglob("*.map")
    version = int(archive.stem.rpartition("-")[2])
    assert check_map(saved)[:2] == (version, 2)
    ours = open_map(tmp_path / "new")
    ours.store.save("kept", ours.mapper, {})
    (kept,) = (tmp_path / "new" / "saved").rglob("kept.map")
    shutil.copy(saved, kept)
    ours.load("kept")
    assert ours.state.n_scans == 2
    assert contents(saved) == pytest.approx(held["snapshot"])
    old = read_map(saved).tiled
    assert old is not None
    assert ours.state.tiled is not None
    assert list(ours.state.tiled.tiles) == list(old.tiles)
    for index, tile in ours.state.tiled.tiles.items():
        assert_same(tile, old.tiles[index])


def test_an_upgrade_that_was_cut_short_goes_on(
    tmp_path: Path, open_map: OpenMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    held = unpacked(STORES[0], tmp_path / "store")
    folder = tmp_path / "store" / "default"
    from potserver.storage import care

    whole, steps = care.raise_version, []

    def until_the_originals(path: Path, kind: Any) -> int:
        if path.parent == folder:
            steps.append(path.name)
            if path.name == TILES:
                raise KeyboardInterrupt
        return whole(path, kind)

    monkeypatch.setattr(care, "raise_version", until_the_originals)
    with pytest.raises(KeyboardInterrupt):
        upgrade_store(folder)
    assert steps == [JOURNAL, TILES]
    with pytest.raises(MapFileError, match="map upgrade"):
        open_map(tmp_path / "store")
    monkeypatch.undo()
    assert upgrade_store(folder).format == 1
    assert open_map(tmp_path / "store").restored.n_scans == held["n_scans"]


def test_what_is_not_sound_is_not_upgraded(tmp_path: Path, open_map: OpenMap) -> None:
    unpacked(STORES[0], tmp_path / "store")
    folder = tmp_path / "store" / "default"
    log = log_of(folder / JOURNAL)
    with log.open("r+b") as stream:
        stream.truncate(log.stat().st_size // 4)
    for look in (check_store, upgrade_store):
        with pytest.raises(MapFileError, match=r"journal\.sqlite") as refused:
            look(folder)
        assert str(folder) in str(refused.value)
    assert not (folder / MARK).exists()


def test_versions_to_come_and_open_stores_are_refused(tmp_path: Path, open_map: OpenMap) -> None:
    ours = open_map(tmp_path / "store")
    ours.take(make_scan(1))
    for look in (check_store, upgrade_store):
        with pytest.raises(StorageError, match="another server"):
            look(tmp_path / "store" / "default")
    ours.store.close()
    with sqlite(tmp_path / "store" / "default" / TILES) as connection:
        connection.execute("PRAGMA user_version = 99")
    with pytest.raises(MapFileError, match="use the version of potserver that wrote it"):
        upgrade_store(tmp_path / "store" / "default")
