"""The picture of atoms: whom it shows, and that it is drawn."""

from __future__ import annotations

import dataclasses
import struct
from pathlib import Path

import numpy as np
import pytest

from potserver.commands.atom_sheet import choose, draw_sheet, slice_level, views_of
from potserver.domain.dictionary import AtomDictionary
from potserver.domain.types import Atom, KernelSet
from potserver.errors import SettingsError, UnknownAtomError


@pytest.fixture(scope="module")
def builtin() -> AtomDictionary:
    return AtomDictionary.builtin()


def _size(png: Path) -> tuple[int, int]:
    head = png.read_bytes()[:24]
    assert head.startswith(b"\x89PNG")
    width, height = struct.unpack(">II", head[16:])
    return width, height


def test_few_are_chosen_evenly_and_names_win(builtin: AtomDictionary) -> None:
    chosen = choose(builtin, [], 5)
    assert len(chosen) == 5
    assert chosen[0] is builtin.atoms[0]
    assert chosen[-1] is builtin.atoms[-1]
    assert {atom.dims for atom in chosen} == {2, 3}
    assert choose(builtin, [], 1000) == list(builtin)
    name = builtin.atoms[3].atom_id
    assert [atom.atom_id for atom in choose(builtin, [name], 1)] == [name]
    with pytest.raises(UnknownAtomError):
        choose(builtin, ["nope"], 1)
    for dictionary, limit in ((builtin, 0), (AtomDictionary(), 3)):
        with pytest.raises(SettingsError):
            choose(dictionary, [], limit)


def test_the_slice_avoids_the_floor() -> None:
    rng = np.random.default_rng(0)
    floor = np.column_stack([rng.uniform(1, 9, (900, 2)), np.full(900, -2.0)])
    wall = np.column_stack([np.full(100, 8.5), rng.uniform(1, 2, 100), rng.uniform(-2, 1, 100)])
    free = np.column_stack([rng.uniform(1, 8, (300, 2)), rng.uniform(-1.9, 1, 300)])
    atom = Atom(
        atom_id="a", dims=3, hit_points=np.concatenate([floor, wall]).astype(np.float32),
        free_points=free.astype(np.float32), kernels=KernelSet.empty(), radius_m=20.0, azimuth_width_rad=2.0, provenance={},
    )  # fmt: skip
    assert -1.5 < slice_level(atom, across=2) < 1.0


def test_panels_keep_metres_square(builtin: AtomDictionary) -> None:
    for atom in builtin.atoms[::5]:
        views = views_of(atom)
        assert len(views) == (1 if atom.dims == 2 else 2)
        for view in views:
            width, height = view.upper - view.lower
            assert 0.2 < height / width < 1.51
            shown = np.concatenate([atom.hit_points, atom.free_points, atom.kernels.hinge_mean])
            assert (shown[:, [view.right, view.up]] > view.lower).all()
            assert (shown[:, [view.right, view.up]] < view.upper).all()


def test_the_sheet_grows_with_the_atoms(builtin: AtomDictionary, tmp_path: Path) -> None:
    flat, deep = builtin.of_dims(2).atoms[0], builtin.of_dims(3).atoms[0]
    draw_sheet([flat], tmp_path / "one.png", title="one")
    draw_sheet([deep, flat], tmp_path / "two.png", title="two")
    assert _size(tmp_path / "one.png")[0] == _size(tmp_path / "two.png")[0]
    assert _size(tmp_path / "one.png")[1] + 200 < _size(tmp_path / "two.png")[1]


def test_strange_atoms_are_drawn_too(builtin: AtomDictionary, tmp_path: Path) -> None:
    deep = builtin.of_dims(3).atoms[0]
    strange = [
        dataclasses.replace(deep, atom_id="no_$_kernels", kernels=KernelSet.empty()),
        dataclasses.replace(deep, hit_points=deep.hit_points[:0], provenance={}),
        dataclasses.replace(deep, hit_points=deep.hit_points[:1], free_points=deep.free_points[:0]),
    ]
    draw_sheet(strange, tmp_path / "strange.png")
    assert _size(tmp_path / "strange.png")[1] > 500
