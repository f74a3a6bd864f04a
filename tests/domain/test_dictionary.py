"""The atoms and the file they live in."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import save as to_safetensors

from potserver.domain import atom_file
from potserver.domain.dictionary import AtomDictionary
from potserver.domain.types import Atom, KernelSet
from potserver.errors import DictionaryError, UnknownAtomError
from potserver.numerics.surroundings import FORMER_FEATURES, N_FEATURES, Perceptron

_KERNEL_ARRAYS = [f.name for f in dataclasses.fields(KernelSet)]


def _atom(atom_id: str, dims: int = 3, k: int = 4) -> Atom:
    rng = np.random.default_rng(len(atom_id) + k)
    return Atom(
        atom_id=atom_id,
        dims=dims,
        hit_points=rng.normal(size=(6, 3)).astype(np.float32),
        free_points=rng.normal(size=(3, 3)).astype(np.float32),
        kernels=KernelSet(
            hinge_mean=rng.normal(size=(k, 3)).astype(np.float32).astype(np.float64),
            hinge_var=rng.random((k, 3)).astype(np.float32),
            gamma_shape=rng.random(k).astype(np.float32) + np.float32(0.1),
            gamma_rate=rng.random(k).astype(np.float32) + np.float32(0.1),
            weight_mean=rng.normal(size=k).astype(np.float32),
            weight_var=rng.random(k).astype(np.float32),
        ),
        radius_m=20.0,
        azimuth_width_rad=1.0,
        provenance={"source": "tests", "place": "Münster"},
    )


@pytest.fixture
def atoms() -> AtomDictionary:
    return AtomDictionary((_atom("a"), _atom("bb", 2), _atom("ccc", 3, 0)))


@pytest.fixture
def path(atoms: AtomDictionary, tmp_path: Path) -> Path:
    atoms.save(tmp_path / "d.atoms")
    return tmp_path / "d.atoms"


def _ids(dictionary: AtomDictionary) -> list[str]:
    return [atom.atom_id for atom in dictionary]


def assert_equal(one: Atom, other: Atom) -> None:
    for name in ("atom_id", "dims", "radius_m", "azimuth_width_rad", "provenance"):
        assert getattr(one, name) == getattr(other, name)
    arrays = [(one.hit_points, other.hit_points), (one.free_points, other.free_points)]
    arrays += [(getattr(one.kernels, name), getattr(other.kernels, name)) for name in _KERNEL_ARRAYS]
    for mine, theirs in arrays:
        np.testing.assert_array_equal(mine, theirs)
        assert mine.dtype == theirs.dtype


# --- the collection -----------------------------------------------------------------------------------------


def test_atoms_are_found_by_id_and_by_dimension(atoms: AtomDictionary) -> None:
    assert _ids(atoms) == ["a", "bb", "ccc"]
    assert atoms.get("bb").dims == 2
    assert _ids(atoms.of_dims(3)) == ["a", "ccc"]
    assert "bb" in atoms
    assert "d" not in atoms
    with pytest.raises(UnknownAtomError, match="nope"):
        atoms.get("nope")
    with pytest.raises(DictionaryError, match="'a'"):
        AtomDictionary((_atom("a"), _atom("a")))


@pytest.mark.parametrize("stored", [False, True])
def test_a_change_gives_another_dictionary(atoms: AtomDictionary, path: Path, stored: bool) -> None:
    before = AtomDictionary.load(path) if stored else atoms
    added = before.add(_atom("dddd"))
    assert _ids(added) == ["a", "bb", "ccc", "dddd"]
    assert _ids(added.remove("bb")) == ["a", "ccc", "dddd"]
    assert _ids(before) == ["a", "bb", "ccc"]
    assert added.get("a") is before.get("a")
    with pytest.raises(DictionaryError, match="'bb'"):
        before.add(_atom("bb"))
    with pytest.raises(UnknownAtomError):
        before.remove("nope")


# --- the file -----------------------------------------------------------------------------------------------


def test_the_file_holds_everything(atoms: AtomDictionary, path: Path) -> None:
    for before, after in zip(atoms, AtomDictionary.load(path), strict=True):
        assert_equal(before, after)


def test_an_expectation_is_kept_through_files_and_changes(atoms: AtomDictionary, tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    shapes = ((N_FEATURES, 3), (3,), (3, 2), (2,), (2,), (1,))
    net = Perceptron(*(rng.normal(size=shape).astype(np.float32) for shape in shapes))
    changed = AtomDictionary(atoms, expectation=net).remove(atoms.atoms[0].atom_id).of_dims(3)
    changed.save(tmp_path / "a.atoms")
    again = AtomDictionary.load(tmp_path / "a.atoms").expectation
    assert again is not None
    for one, other in zip(again, net, strict=True):
        np.testing.assert_array_equal(one, other)
    assert atoms.expectation is None
    AtomDictionary(atoms, expectation=net._replace(first=net.first[1:])).save(tmp_path / "b.atoms")
    with pytest.raises(DictionaryError, match="expectation"):
        AtomDictionary.load(tmp_path / "b.atoms")


def test_a_net_of_before_that_knows_no_lines_says_what_it_said(tmp_path: Path) -> None:
    now = AtomDictionary.builtin().expectation
    assert now is not None
    former = now._replace(first=now.first[:FORMER_FEATURES])
    path = tmp_path / "former.atoms"
    AtomDictionary(expectation=former).save(path)
    read = AtomDictionary.load(path).expectation
    assert read is not None
    assert read.is_sound
    np.testing.assert_array_equal(read.first[:FORMER_FEATURES], former.first)
    assert not read.first[FORMER_FEATURES:].any()


def test_no_atoms_are_a_file_too(tmp_path: Path) -> None:
    AtomDictionary().save(tmp_path / "none.atoms")
    assert len(AtomDictionary.load(tmp_path / "none.atoms")) == 0


def test_positions_are_stored_to_a_micrometre(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    atom = _atom("a", k=50)
    hinges = rng.uniform(-25, 25, (50, 3))
    dictionary = AtomDictionary([dataclasses.replace(atom, kernels=atom.kernels.replace(hinge_mean=hinges))])
    dictionary.save(tmp_path / "d.atoms")
    back = AtomDictionary.load(tmp_path / "d.atoms").get("a").kernels.hinge_mean
    assert back.dtype == np.float64
    np.testing.assert_allclose(back, hinges, atol=1e-6, rtol=0)


def test_the_same_atoms_give_the_same_bytes(atoms: AtomDictionary, path: Path) -> None:
    again, direct = path.with_name("again.atoms"), path.with_name("direct.atoms")
    AtomDictionary.load(path).save(again)
    AtomDictionary(tuple(dataclasses.replace(a, provenance=dict(reversed(a.provenance.items()))) for a in atoms)).save(
        direct
    )  # fmt: skip
    assert path.read_bytes() == again.read_bytes() == direct.read_bytes()
    assert sorted(p.name for p in path.parent.iterdir()) == ["again.atoms", "d.atoms", "direct.atoms"], (
        "no partial file"
    )


def test_any_reader_of_safetensors_opens_it(path: Path) -> None:
    with safe_open(path, framework="numpy") as container:
        assert list(container.metadata()) == ["potserver-atoms"]
        assert container.get_tensor("kernel_offsets").tolist() == [0, 4, 8, 8]
    content = path.read_bytes()
    assert hashlib.sha256(content[:-32]).digest() == content[-32:]


def _base(array: Any) -> Any:
    while isinstance(array, np.ndarray | memoryview):
        array = array.base if isinstance(array, np.ndarray) else array.obj
    return array


def test_arrays_are_read_only_views_of_the_file(path: Path) -> None:
    atom = AtomDictionary.load(path).get("a")
    arrays = [atom.hit_points, atom.free_points]
    arrays += [getattr(atom.kernels, name) for name in _KERNEL_ARRAYS if name != "hinge_mean"]
    for array in arrays:
        assert isinstance(_base(array), bytes)
        assert array.flags.aligned
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0
    with pytest.raises(ValueError, match="read-only"):
        atom.kernels.hinge_mean[0] = 0


def test_what_becomes_of_the_file_later_changes_no_atom(path: Path) -> None:
    before, atoms = AtomDictionary.load(path).get("a"), AtomDictionary.load(path)
    os.truncate(path, 0)
    assert_equal(atoms.get("a"), before)


def test_thousands_of_atoms_are_not_made_until_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = _atom("a")
    AtomDictionary(dataclasses.replace(one, atom_id=f"a{i}") for i in range(3000)).save(tmp_path / "d.atoms")
    taken: list[int] = []
    take = atom_file.AtomFile.atom

    def counted(self: atom_file.AtomFile, number: int) -> Atom:
        taken.append(number)
        return take(self, number)

    monkeypatch.setattr(atom_file.AtomFile, "atom", counted)
    many = AtomDictionary.load(tmp_path / "d.atoms")
    assert len(many) == len(many.of_dims(3)) == 3000
    assert len(many.remove("a7").add(one)) == 3000
    assert taken == []
    assert_equal(many.get("a42"), dataclasses.replace(one, atom_id="a42"))
    assert many.of_dims(3).get("a42") is many.get("a42")
    assert taken == [42]


def test_an_open_file_may_be_replaced(atoms: AtomDictionary, path: Path) -> None:
    opened = AtomDictionary.load(path)
    opened.remove("a").save(path)
    assert_equal(opened.get("a"), atoms.get("a"))
    assert _ids(AtomDictionary.load(path)) == ["bb", "ccc"]


def test_a_failed_save_leaves_the_file_as_it_was(
    atoms: AtomDictionary, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = path.read_bytes()

    def full(_descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(DictionaryError, match="No space left"):
        atoms.remove("a").save(path)
    assert path.read_bytes() == before
    assert [p.name for p in path.parent.iterdir()] == ["d.atoms"]


# --- files that are refused ---------------------------------------------------------------------------------


def test_a_missing_file_a_folder_and_strangers(tmp_path: Path) -> None:
    with pytest.raises(DictionaryError, match="no atom dictionary at"):
        AtomDictionary.load(tmp_path / "none.atoms")
    with pytest.raises(DictionaryError, match="cannot read"):
        AtomDictionary.load(tmp_path)
    for content in (b"", b"\x80\x04\x95pickle", b"text " * 1000):
        (tmp_path / "x.atoms").write_bytes(content)
        with pytest.raises(DictionaryError, match="is not an atom dictionary, or is cut off"):
            AtomDictionary.load(tmp_path / "x.atoms")
    (tmp_path / "model.safetensors").write_bytes(to_safetensors({"a": np.ones(100, np.float32)}))
    with pytest.raises(DictionaryError, match="safetensors file, but no atom dictionary"):
        AtomDictionary.load(tmp_path / "model.safetensors")
    np.savez(tmp_path / "old.npz", header=np.zeros(3))
    with pytest.raises(DictionaryError, match=r"version 1 .*potserver atoms build"):
        AtomDictionary.load(tmp_path / "old.npz")


def test_a_file_cut_off_anywhere_is_refused(path: Path) -> None:
    whole = path.read_bytes()
    for length in [*range(0, len(whole), 13), len(whole) - 1]:
        path.write_bytes(whole[:length])
        with pytest.raises(DictionaryError):
            AtomDictionary.load(path)
    path.write_bytes(whole + b"\0")
    with pytest.raises(DictionaryError):
        AtomDictionary.load(path)


def test_a_changed_bit_anywhere_is_refused(path: Path) -> None:
    whole = path.read_bytes()
    for position in range(len(whole)):
        damaged = bytearray(whole)
        damaged[position] ^= 1 << position % 8
        path.write_bytes(damaged)
        with pytest.raises(DictionaryError):
            AtomDictionary.load(path)


def _record(**changes: Any) -> dict[str, Any]:
    return {
        "atom_id": "a",
        "dims": 3,
        "radius_m": 20.0,
        "azimuth_width_rad": 1.0,
        "provenance": {"source": "tests"},
    } | changes


def _write(path: Path, metadata: object, **changes: Any) -> None:
    """A file of one atom with a right checksum, whatever else is wrong with it."""
    atom = _atom("a")
    arrays: dict[str, Any] = {
        "hit_offsets": np.array([0, 6]),
        "free_offsets": np.array([0, 3]),
        "kernel_offsets": np.array([0, 4]),
        "hit_points": atom.hit_points,
        "free_points": atom.free_points,
        **{name: getattr(atom.kernels, name).astype(np.float32) for name in _KERNEL_ARRAYS},
        "sha256": np.zeros(32, np.uint8),
    } | changes
    arrays = {name: array for name, array in arrays.items() if array is not None}
    text = metadata if isinstance(metadata, str) else json.dumps(metadata)
    content = to_safetensors(arrays, metadata={"potserver-atoms": text})[:-32]
    path.write_bytes(content + hashlib.sha256(content).digest())


def test_the_crafted_file_is_good_when_nothing_is_wrong_with_it(tmp_path: Path) -> None:
    _write(tmp_path / "x.atoms", {"version": 2, "atoms": [_record()]})
    assert len(AtomDictionary.load(tmp_path / "x.atoms").get("a").kernels) == 4


@pytest.mark.parametrize(
    ("metadata", "changes", "message"),
    [
        ("{", {}, "not JSON"),
        ("[" * 100_000, {}, "not JSON"),
        ([], {}, "no list of atoms"),
        ({"version": 2}, {}, "no list of atoms"),
        ({"version": 3, "atoms": []}, {}, "version 3, this program reads version 2"),
        ({"version": 2, "atoms": [{"atom_id": "a"}]}, {}, "atom number 0"),
        ({"version": 2, "atoms": [_record(atom_id=5)]}, {}, "atom number 0"),
        ({"version": 2, "atoms": [_record(dims=4)]}, {}, "atom number 0"),
        ({"version": 2, "atoms": [_record(radius_m="wide")]}, {}, "atom number 0"),
        ({"version": 2, "atoms": [_record(radius_m=-1.0)]}, {}, "atom number 0"),
        ({"version": 2, "atoms": [_record(provenance={"a": 1})]}, {}, "atom number 0"),
        ({"version": 2, "atoms": [_record(), _record()]}, {}, "hit_offsets"),
        ({"version": 2, "atoms": [_record()]}, {"hit_offsets": np.array([0, 7])}, "hit_points"),
        ({"version": 2, "atoms": [_record()]}, {"hit_offsets": np.array([6, 6])}, "do not rise from 0"),
        ({"version": 2, "atoms": [_record()]}, {"hit_offsets": np.array([0, -1])}, "do not rise from 0"),
        ({"version": 2, "atoms": [_record()]}, {"hit_offsets": np.array([0.0, 6.0], np.float32)}, "hit_offsets"),
        ({"version": 2, "atoms": [_record()]}, {"hit_points": np.ones((6, 2), np.float32)}, "hit_points"),
        ({"version": 2, "atoms": [_record()]}, {"hit_points": None}, "hit_points"),
        ({"version": 2, "atoms": [_record()]}, {"weight_var": np.ones(4)}, "of type F64"),
        ({"version": 2, "atoms": [_record()]}, {"more": np.ones(4, np.float32)}, "more"),
    ],
)  # fmt: skip
def test_a_file_with_wrong_content_says_what(
    metadata: object, changes: dict[str, Any], message: str, tmp_path: Path
) -> None:
    _write(tmp_path / "x.atoms", metadata, **changes)
    with pytest.raises(DictionaryError, match=message):
        AtomDictionary.load(tmp_path / "x.atoms")


@pytest.mark.parametrize(
    "changes",
    [
        {"gamma_rate": np.zeros(4, np.float32)},
        {"weight_mean": np.full(4, np.nan, np.float32)},
        {"hit_points": np.full((6, 3), np.inf, np.float32)},
    ],
)
def test_numbers_that_no_atom_has_are_refused_when_it_is_taken(
    changes: dict[str, Any], tmp_path: Path
) -> None:
    _write(tmp_path / "x.atoms", {"version": 2, "atoms": [_record()]}, **changes)
    with pytest.raises(DictionaryError, match="atom 'a'"):
        AtomDictionary.load(tmp_path / "x.atoms").get("a")


# --- the shipped one ----------------------------------------------------------------------------------------


def test_the_built_in_dictionary_serves_2d_and_3d() -> None:
    builtin = AtomDictionary.builtin()
    for dims in (2, 3):
        atoms = builtin.of_dims(dims).atoms
        assert atoms
        for atom in atoms:
            assert len(atom.hit_points)
            assert len(atom.kernels)
            assert (atom.kernels.weight_var > 0).all()
            assert (atom.kernels.gamma > 0).all()
            assert np.isfinite(atom.kernels.hinge_mean).all()
            if dims == 2:
                assert not atom.hit_points[:, 2].any()
                assert not atom.kernels.hinge_mean[:, 2].any()
