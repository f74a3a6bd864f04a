"""The one dictionary of a server, which may change."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from potserver.atoms.store import AtomStore
from potserver.domain.dictionary import AtomDictionary
from potserver.domain.types import Atom
from potserver.errors import AtomRefusedError, DictionaryError, ReadOnlyError, UnknownAtomError


@pytest.fixture(scope="module")
def builtin() -> AtomDictionary:
    return AtomDictionary.builtin()


def _ids(dictionary: AtomDictionary) -> list[str]:
    return [atom.atom_id for atom in dictionary]


def test_changes_are_used_and_counted(builtin: AtomDictionary) -> None:
    a, b, c = builtin.atoms[:3]
    used: list[list[str]] = []
    store = AtomStore(AtomDictionary([a]), lambda d: used.append(_ids(d)))
    assert store.add(b) == (b.atom_id, 2, False)
    assert store.remove(a.atom_id) == (a.atom_id, 1, False)
    assert store.add(c).n_atoms == 2
    assert used == [[a.atom_id, b.atom_id], [b.atom_id], [b.atom_id, c.atom_id]]
    assert _ids(store.dictionary) == used[-1]


def test_a_refusal_changes_nothing(builtin: AtomDictionary, tmp_path: Path) -> None:
    used: list[AtomDictionary] = []
    file = tmp_path / "d.atoms"
    store = AtomStore(builtin, used.append, file=file)
    with pytest.raises(AtomRefusedError):
        store.add(builtin.atoms[0])
    with pytest.raises(UnknownAtomError):
        store.remove("nope")
    assert store.dictionary is builtin
    assert used == []
    assert not file.exists()


def test_a_server_takes_no_more_atoms_than_scans_can_afford(builtin: AtomDictionary) -> None:
    a, b, c = builtin.atoms[:3]
    store = AtomStore(AtomDictionary([a]), lambda _: None, max_atoms=2)
    store.add(b)
    with pytest.raises(AtomRefusedError) as caught:
        store.add(c)
    assert caught.value.reason == "full"
    store.remove(b.atom_id)
    assert store.add(c).n_atoms == 2


def test_a_read_only_store(builtin: AtomDictionary) -> None:
    store = AtomStore(AtomDictionary(), lambda _: None, writable=False)
    with pytest.raises(ReadOnlyError, match=r"atoms\.writable"):
        store.add(builtin.atoms[0])
    with pytest.raises(ReadOnlyError):
        store.remove("nope")


def test_the_file_is_written_before_the_change_is_used(builtin: AtomDictionary, tmp_path: Path) -> None:
    a, b = builtin.atoms[:2]
    file = tmp_path / "d.atoms"
    on_disk: list[list[str]] = []
    store = AtomStore(
        AtomDictionary([a]), lambda _: on_disk.append(_ids(AtomDictionary.load(file))), file=file
    )
    assert store.add(b).persisted
    assert store.remove(a.atom_id).persisted
    assert on_disk == [[a.atom_id, b.atom_id], [b.atom_id]]


def test_a_disk_that_refuses_changes_nothing(builtin: AtomDictionary, tmp_path: Path) -> None:
    used: list[AtomDictionary] = []
    before = AtomDictionary(builtin.atoms[:1])
    store = AtomStore(before, used.append, file=tmp_path / "no" / "such" / "folder.atoms")
    with pytest.raises(DictionaryError, match="cannot write"):
        store.add(builtin.atoms[1])
    assert store.dictionary is before
    assert used == []


def test_many_threads_lose_no_change(builtin: AtomDictionary, tmp_path: Path) -> None:
    file = tmp_path / "d.atoms"
    store = AtomStore(AtomDictionary(), lambda _: None, file=file)
    start = threading.Barrier(8)

    def mine(thread: int) -> tuple[Atom, ...]:
        return builtin.atoms[4 * thread : 4 * thread + 4]

    def add(thread: int) -> None:
        start.wait()
        for atom in mine(thread):
            store.add(atom)
        store.remove(mine(thread)[0].atom_id)

    threads = [threading.Thread(target=add, args=(i,)) for i in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    expected = {atom.atom_id for thread in range(8) for atom in mine(thread)[1:]}
    assert len(expected) == 24
    assert set(_ids(store.dictionary)) == set(_ids(AtomDictionary.load(file))) == expected
