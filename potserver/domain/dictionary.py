"""AtomDictionary: the atoms that scans are matched against, and the file they live in."""

from __future__ import annotations

import dataclasses
import io
import json
import zipfile
import zlib
from collections.abc import Iterator
from importlib import resources
from pathlib import Path

import numpy as np

from potserver.domain.types import Atom, KernelSet
from potserver.errors import BadPointsError, DictionaryError, EmptyError, ShapeError, UnknownAtomError

FORMAT = "potserver-atoms"
FORMAT_VERSION = 1
_POINT_SETS = ("hit_points", "free_points")
_KERNEL_ARRAYS = tuple(f.name for f in dataclasses.fields(KernelSet))


class AtomDictionary:
    """An ordered set of atoms with unique ids. Immutable."""

    def __init__(self, atoms: tuple[Atom, ...]) -> None:
        """Hold atoms.

        Raises:
            DictionaryError: two atoms have one id.
        """
        self.atoms = tuple(atoms)
        self._by_id = {atom.atom_id: atom for atom in self.atoms}
        if len(self._by_id) != len(self.atoms):
            raise DictionaryError("two atoms have the same id")

    def __len__(self) -> int:
        return len(self.atoms)

    def __iter__(self) -> Iterator[Atom]:
        return iter(self.atoms)

    def get(self, atom_id: str) -> Atom:
        """One atom.

        Raises:
            UnknownAtomError: there is none of that id.
        """
        try:
            return self._by_id[atom_id]
        except KeyError:
            raise UnknownAtomError(f"no atom {atom_id!r}; the dictionary holds {len(self)} atoms") from None

    def of_dims(self, dims: int) -> AtomDictionary:
        """The atoms learned in 2 or in 3 dimensions."""
        return AtomDictionary(tuple(a for a in self.atoms if a.dims == dims))

    @staticmethod
    def builtin() -> AtomDictionary:
        """The atoms that the package ships, 2D and 3D."""
        with resources.as_file(resources.files("potserver") / "data" / "atoms.npz") as path:
            return AtomDictionary.load(path)

    def save(self, path: str | Path) -> None:
        """Write the file whole or not at all. The same atoms give the same bytes."""
        arrays: dict[str, np.ndarray] = {}
        header = {"format": FORMAT, "version": FORMAT_VERSION, "atoms": []}
        for i, atom in enumerate(self.atoms):
            entry = {
                k: getattr(atom, k)
                for k in ("atom_id", "dims", "radius_m", "azimuth_width_rad", "provenance")
            }
            header["atoms"].append(entry)  # type: ignore[attr-defined]
            arrays |= {f"{i}.{name}": getattr(atom, name) for name in _POINT_SETS}
            arrays |= {f"{i}.{name}": getattr(atom.kernels, name) for name in _KERNEL_ARRAYS}
        arrays["header"] = np.frombuffer(json.dumps(header, sort_keys=True).encode(), np.uint8)
        target = Path(path)
        partial = target.with_name(target.name + ".partial")
        with zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
            for name in sorted(arrays):
                buffer = io.BytesIO()
                np.lib.format.write_array(buffer, np.ascontiguousarray(arrays[name]), allow_pickle=False)
                # a fixed date: the file depends on the atoms alone
                archive.writestr(
                    zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0)),
                    buffer.getvalue(),
                    zipfile.ZIP_DEFLATED,
                    9,
                )
        partial.replace(target)

    @staticmethod
    def load(path: str | Path) -> AtomDictionary:
        """Read a dictionary file; it never executes anything (no pickle).

        Raises:
            DictionaryError: missing, damaged (every member has a checksum), or of another format or version.
        """
        try:
            # opened here, because numpy leaves the file of a damaged archive open
            with Path(path).open("rb") as stream, np.load(stream, allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files}
            header = json.loads(arrays["header"].tobytes())
        except FileNotFoundError:
            raise DictionaryError(f"no atom dictionary at {path}") from None
        except (
            OSError,
            EOFError,
            ValueError,
            KeyError,
            RuntimeError,
            zipfile.BadZipFile,
            zlib.error,
        ) as error:
            raise DictionaryError(f"{path} is not an atom dictionary, or is damaged: {error}") from error
        if not isinstance(header, dict):
            raise DictionaryError(
                f"{path} is not an atom dictionary: its header is a {type(header).__name__}"
            )
        if header.get("format") != FORMAT or header.get("version") != FORMAT_VERSION:
            raise DictionaryError(
                f"{path}: format {header.get('format')!r} version {header.get('version')!r},"
                f" this program reads {FORMAT!r} version {FORMAT_VERSION}"
            )
        try:
            return AtomDictionary(
                tuple(
                    Atom(
                        **entry,
                        **{name: arrays[f"{i}.{name}"] for name in _POINT_SETS},
                        kernels=KernelSet(**{name: arrays[f"{i}.{name}"] for name in _KERNEL_ARRAYS}),
                    )
                    for i, entry in enumerate(header["atoms"])
                )
            )
        except (KeyError, TypeError, ShapeError, BadPointsError, EmptyError) as error:
            raise DictionaryError(f"{path}: an atom is incomplete: {error}") from error
