"""`potserver map check` and `upgrade`."""

from __future__ import annotations

from pathlib import Path

from potserver.storage.agreement import TILES
from tests.storage.test_care import STORES, unpacked

from .test_maps import Run, run

__all__ = ["run"]


def test_check_and_upgrade_say_what_they_found(tmp_path: Path, run: Run) -> None:
    store = tmp_path / "store"
    unpacked(STORES[0], store)
    code, out, _ = run("check", store)
    assert code == 0
    assert f"{store / 'default'}: sound, 2 scans, 2 more in the journal, of format 1" in out
    assert f"{store / 'saved' / 'kept.map'}: sound, 2 scans" in out
    code, out, _ = run("upgrade", store)
    assert (code, "upgraded from format 1" in out) == (0, True)
    code, out, _ = run("upgrade", store / "default")
    assert (code, "format" in out) == (0, False)


def test_what_is_damaged_is_named_and_the_rest_is_looked_at(tmp_path: Path, run: Run) -> None:
    store = tmp_path / "store"
    unpacked(STORES[0], store)
    saved = store / "saved" / "kept.map"
    content = bytearray(saved.read_bytes())
    third = len(content) // 3
    content[third : 2 * third] = bytes(third)
    saved.write_bytes(content)
    code, out, _ = run("check", store)
    assert code == 1
    assert f"{saved}: NOT SOUND" in out
    assert f"{store / 'default'}: sound" in out
    (store / "default" / TILES).unlink()
    code, out, _ = run("upgrade", store)
    assert (code, f"{store / 'default'}: NOT SOUND" in out) == (1, True)


def test_there_must_be_something(tmp_path: Path, run: Run) -> None:
    code, _, err = run("check", tmp_path)
    assert (code, "no map in" in err) == (2, True)
    (tmp_path / "a.map").write_bytes(b"")
    code, _, err = run("upgrade", tmp_path)
    assert (code, "saved maps need no upgrade" in err) == (2, True)
