"""AtomDictionary: the atoms that scans are matched against."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from importlib import resources
from pathlib import Path

from potserver.domain.atom_file import AtomFile, Learned, open_atoms, write_atoms
from potserver.domain.types import Atom
from potserver.errors import DictionaryError, UnknownAtomError
from potserver.numerics.surroundings import Perceptron

EXPECTATION = "expectation"  # the name of what its recordings teach


class AtomDictionary:
    """An ordered set of atoms with unique ids. Immutable: a change gives another dictionary.

    Atoms of a file stay in it until they are asked for, so that thousands of them open at once.
    """

    def __init__(
        self,
        atoms: Iterable[Atom] = (),
        *,
        expectation: Perceptron | None = None,
        grown: Sequence[Learned] = (),
    ) -> None:
        """Hold atoms.

        Args:
            atoms: In order.
            expectation: What the recordings that they were chosen from teach to expect about a scan; None: nothing.
            grown: What places that were mapped since have added to it, in the order they came.
        Raises:
            DictionaryError: two atoms have one id.
        """
        self._slots = _by_id(atoms)
        self.expectation, self.grown = expectation, tuple(grown)

    @classmethod
    def _of(
        cls,
        slots: Iterable[Atom | _StoredAtom],
        expectation: Perceptron | None,
        grown: Sequence[Learned],
    ) -> AtomDictionary:
        dictionary = cls(expectation=expectation, grown=grown)
        dictionary._slots = _by_id(slots)
        return dictionary

    def _with(self, slots: Iterable[Atom | _StoredAtom]) -> AtomDictionary:
        return AtomDictionary._of(slots, self.expectation, self.grown)

    def __len__(self) -> int:
        return len(self._slots)

    def __iter__(self) -> Iterator[Atom]:
        return (_open(slot) for slot in self._slots.values())

    def __contains__(self, atom_id: object) -> bool:
        return atom_id in self._slots

    @property
    def atoms(self) -> tuple[Atom, ...]:
        """All atoms, in order."""
        return tuple(self)

    @property
    def expectations(self) -> tuple[Learned, ...]:
        """All that may be expected about a scan: what the recordings teach first."""
        base = () if self.expectation is None else (Learned(EXPECTATION, self.expectation, {}),)
        return base + self.grown

    def get(self, atom_id: str) -> Atom:
        """One atom.

        Raises:
            UnknownAtomError: there is none of that id.
        """
        return _open(self._slot(atom_id))

    def of_dims(self, dims: int) -> AtomDictionary:
        """The atoms learned in 2 or in 3 dimensions."""
        return self._with(slot for slot in self._slots.values() if slot.dims == dims)

    def add(self, atom: Atom) -> AtomDictionary:
        """These atoms and one more, at the end.

        Raises:
            DictionaryError: its id is taken.
        """
        return self._with([*self._slots.values(), atom])

    def grow(self, learned: Learned) -> AtomDictionary:
        """These atoms, and what a place has taught: in place of what has its name, or at the end."""
        others = [one for one in self.grown if one.name != learned.name]
        return AtomDictionary._of(self._slots.values(), self.expectation, [*others, learned])

    def remove(self, atom_id: str) -> AtomDictionary:
        """These atoms without one, or without what a place of that name has taught.

        Raises:
            UnknownAtomError: there is none of that id.
        """
        if atom_id not in self and any(one.name == atom_id for one in self.grown):
            left = [one for one in self.grown if one.name != atom_id]
            return AtomDictionary._of(self._slots.values(), self.expectation, left)
        leaving = self._slot(atom_id)
        return self._with(slot for slot in self._slots.values() if slot is not leaving)

    @staticmethod
    def builtin() -> AtomDictionary:
        """The atoms that the package ships, 2D and 3D."""
        with resources.as_file(resources.files("potserver") / "data" / "builtin.atoms") as path:
            return AtomDictionary.load(path)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a file, whole or not at all; the same atoms give the same bytes. Kernels' positions become float32.

        Raises:
            DictionaryError: the disk refuses.
        """
        write_atoms(Path(path), self.atoms, self.expectation, self.grown)

    @staticmethod
    def load(path: str | os.PathLike[str]) -> AtomDictionary:
        """Read a file that `save` wrote; it never executes anything.

        Raises:
            DictionaryError: missing, truncated, damaged, or of another format or version; the message says which.
        """
        file = open_atoms(Path(path))
        return AtomDictionary._of(
            (_StoredAtom(file, number) for number in range(len(file.records))), file.expectation, file.grown
        )

    def _slot(self, atom_id: str) -> Atom | _StoredAtom:
        try:
            return self._slots[atom_id]
        except KeyError:
            raise UnknownAtomError(f"no atom {atom_id!r}; the dictionary holds {len(self)} atoms") from None


class _StoredAtom:
    """An atom that stays in its file until it is asked for."""

    def __init__(self, file: AtomFile, number: int) -> None:
        self.atom_id, self.dims = file.records[number].atom_id, file.records[number].dims
        self._file, self._number = file, number
        self._atom: Atom | None = None

    def open(self) -> Atom:
        if self._atom is None:  # two threads may both do it: they get equal atoms
            self._atom = self._file.atom(self._number)
        return self._atom


def _open(slot: Atom | _StoredAtom) -> Atom:
    return slot.open() if isinstance(slot, _StoredAtom) else slot


def _by_id(slots: Iterable[Atom | _StoredAtom]) -> dict[str, Atom | _StoredAtom]:
    by_id: dict[str, Atom | _StoredAtom] = {}
    for slot in slots:
        if slot.atom_id in by_id:
            raise DictionaryError(f"two atoms have the id {slot.atom_id!r}")
        by_id[slot.atom_id] = slot
    return by_id
