"""The atoms and the file they live in."""

from __future__ import annotations

import dataclasses
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest

from potserver.domain.dictionary import FORMAT, AtomDictionary
from potserver.domain.types import Atom, KernelSet
from potserver.errors import DictionaryError, UnknownAtomError


def _atom(atom_id: str, dims: int = 3, k: int = 4) -> Atom:
    rng = np.random.default_rng(len(atom_id) + k)
    return Atom(
        atom_id=atom_id,
        dims=dims,
        hit_points=rng.normal(size=(6, 3)).astype(np.float32),
        free_points=rng.normal(size=(3, 3)).astype(np.float32),
        kernels=KernelSet(
            hinge_mean=rng.normal(size=(k, 3)),
            hinge_var=rng.random((k, 3)).astype(np.float32),
            gamma_shape=rng.random(k).astype(np.float32),
            gamma_rate=rng.random(k).astype(np.float32),
            weight_mean=rng.normal(size=k).astype(np.float32),
            weight_var=rng.random(k).astype(np.float32),
        ),
        radius_m=20.0,
        azimuth_width_rad=1.0,
        provenance={"source": "tests"},
    )


@pytest.fixture
def atoms() -> AtomDictionary:
    return AtomDictionary((_atom("a"), _atom("bb", 2), _atom("ccc", 3, 0)))


def test_atoms_are_found_by_id_and_by_dimension(atoms: AtomDictionary) -> None:
    assert [a.atom_id for a in atoms] == ["a", "bb", "ccc"]
    assert atoms.get("bb").dims == 2
    assert [a.atom_id for a in atoms.of_dims(3)] == ["a", "ccc"]
    with pytest.raises(UnknownAtomError, match="nope"):
        atoms.get("nope")
    with pytest.raises(DictionaryError):
        AtomDictionary((_atom("a"), _atom("a")))


def test_the_file_holds_everything(atoms: AtomDictionary, tmp_path: Path) -> None:
    atoms.save(tmp_path / "atoms.npz")
    back = AtomDictionary.load(tmp_path / "atoms.npz")
    for before, after in zip(atoms, back, strict=True):
        for name in ("atom_id", "dims", "radius_m", "azimuth_width_rad", "provenance"):
            assert getattr(before, name) == getattr(after, name)
        arrays = [(before.hit_points, after.hit_points), (before.free_points, after.free_points)]
        arrays += [
            (getattr(before.kernels, f.name), getattr(after.kernels, f.name))
            for f in dataclasses.fields(KernelSet)
        ]
        for one, other in arrays:
            np.testing.assert_array_equal(one, other)
            assert one.dtype == other.dtype


def test_the_same_atoms_give_the_same_bytes(atoms: AtomDictionary, tmp_path: Path) -> None:
    atoms.save(tmp_path / "one.npz")
    AtomDictionary.load(tmp_path / "one.npz").save(tmp_path / "two.npz")
    assert (tmp_path / "one.npz").read_bytes() == (tmp_path / "two.npz").read_bytes()
    assert [p.name for p in sorted(tmp_path.iterdir())] == ["one.npz", "two.npz"], "no partial file is left"


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(DictionaryError, match="no atom dictionary"):
        AtomDictionary.load(tmp_path / "none.npz")


def test_damage_anywhere_is_noticed(atoms: AtomDictionary, tmp_path: Path) -> None:
    path = tmp_path / "atoms.npz"
    atoms.save(path)
    whole = path.read_bytes()
    truth = AtomDictionary.load(path)
    for position in range(0, len(whole), 97):
        damaged = bytearray(whole)
        damaged[position] ^= 0xFF
        path.write_bytes(bytes(damaged))
        try:
            back = AtomDictionary.load(path)
        except DictionaryError:
            continue
        # bytes that no reader looks at (dates, attributes) may change; what is read may not
        for one, other in zip(truth, back, strict=True):
            np.testing.assert_array_equal(one.kernels.weight_mean, other.kernels.weight_mean)
            np.testing.assert_array_equal(one.hit_points, other.hit_points)
    for length in (0, 1, 100, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(DictionaryError):
            AtomDictionary.load(path)


def _with_header(path: Path, header: object) -> None:
    np.savez(path, header=np.frombuffer(json.dumps(header).encode(), np.uint8))


@pytest.mark.parametrize(
    "header",
    [
        {"format": "something else", "version": 1, "atoms": []},
        {"format": FORMAT, "version": 99, "atoms": []},
        {"format": FORMAT, "version": 1, "atoms": [{"atom_id": "a"}]},
        {"format": FORMAT, "version": 1},
        [],
    ],
)
def test_another_format_version_or_an_incomplete_atom(header: object, tmp_path: Path) -> None:
    _with_header(tmp_path / "a.npz", header)
    with pytest.raises(DictionaryError):
        AtomDictionary.load(tmp_path / "a.npz")


def test_pickles_are_never_opened(tmp_path: Path) -> None:
    path = tmp_path / "evil.npz"
    np.savez(path, header=np.array([{"a": 1}], dtype=object))
    with pytest.raises(DictionaryError):
        AtomDictionary.load(path)
    (tmp_path / "text.npz").write_text("not a zip file")
    with pytest.raises(DictionaryError):
        AtomDictionary.load(tmp_path / "text.npz")
    with zipfile.ZipFile(tmp_path / "empty.npz", "w"):
        pass
    with pytest.raises(DictionaryError):
        AtomDictionary.load(tmp_path / "empty.npz")


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
