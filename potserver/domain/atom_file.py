"""The file of an atom dictionary, `*.atoms`: a safetensors container that any reader of that format opens.

    header    names, dtypes, shapes and places of the arrays; one metadata entry, a canonical JSON of the version, per atom
              id, dims, radius_m, azimuth_width_rad and provenance, and maybe what the recordings teach to expect, and what
              places that were mapped since have added to it
    int64     hit_offsets, free_offsets, kernel_offsets (A + 1,): atom i has the rows offsets[i] to offsets[i + 1]
    float32   hit_points (H, 3), free_points (F, 3) and the kernels' arrays, of all atoms one after the other
    uint8     sha256 (32,): of every byte of the file before it

Nothing in it is executed. The same atoms give the same bytes. A file is read once and as a whole: what becomes of it later
changes no atom. Positions of kernels are float32 here, exact to 1 um in a sector, and widened to float64 when an atom is taken
out.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save as to_safetensors

from potserver.domain.folders import sync_folder
from potserver.domain.types import KERNEL_ARRAYS, Atom, KernelSet
from potserver.errors import BadPointsError, DictionaryError, EmptyError, ShapeError
from potserver.numerics.surroundings import FORMER_FEATURES, N_FEATURES, Perceptron

VERSION = 2
_METADATA_KEY = "potserver-atoms"  # one key: safetensors keeps no order between several
_DIGEST = "sha256"  # the only array of bytes, and safetensors puts those last
_DIGEST_BYTES = hashlib.sha256().digest_size
_COLUMNS = {  # array -> numbers a row, its offsets
    "hit_points": (3, "hit_offsets"),
    "free_points": (3, "free_offsets"),
    **{name: (3 if name.startswith("hinge") else 0, "kernel_offsets") for name in KERNEL_ARRAYS},
}
_OFFSETS = ("hit_offsets", "free_offsets", "kernel_offsets")
_DTYPES: dict[str, np.dtype[Any]] = {"I64": np.dtype("<i8"), "F32": np.dtype("<f4"), "U8": np.dtype("u1")}
_ZIP_MAGIC = b"PK\x03\x04"  # version 1 was an .npz


class AtomRecord(NamedTuple):
    """What a file says of an atom beside its arrays."""

    atom_id: str
    dims: int
    radius_m: float
    azimuth_width_rad: float
    provenance: dict[str, str]


class Learned(NamedTuple):
    """What may be expected about a scan, and where it was learned."""

    name: str
    net: Perceptron
    provenance: dict[str, str]


class AtomFile:
    """What a file holds; lives as long as an atom of it."""

    def __init__(
        self,
        path: Path,
        records: list[AtomRecord],
        expectation: Perceptron | None,
        grown: tuple[Learned, ...],
        arrays: dict[str, NDArray[Any]],
    ) -> None:
        self.path, self.records, self._arrays = path, records, arrays
        self.expectation, self.grown = expectation, grown

    def atom(self, number: int) -> Atom:
        """One atom; all its arrays but the kernels' positions are read-only views of its bytes.

        Raises:
            DictionaryError: its numbers are no atom's.
        """
        record = self.records[number]
        rows: dict[str, Any] = {}
        for name, (_, offsets_name) in _COLUMNS.items():
            offsets = self._arrays[offsets_name]
            rows[name] = self._arrays[name][int(offsets[number]) : int(offsets[number + 1])]
        rows["hinge_mean"] = rows["hinge_mean"].astype(np.float64)
        try:
            return Atom(
                **record._asdict(),
                hit_points=rows["hit_points"],
                free_points=rows["free_points"],
                kernels=KernelSet(**{name: rows[name] for name in KERNEL_ARRAYS}),
            )
        except (ShapeError, BadPointsError, EmptyError) as error:
            raise DictionaryError(f"{self.path}: atom {record.atom_id!r}: {error}") from error


def write_atoms(
    path: Path,
    atoms: Sequence[Atom],
    expectation: Perceptron | None = None,
    grown: Sequence[Learned] = (),
) -> None:
    """Write a file whole or not at all; it is on the disk when this returns, and replaces an open one without harm.

    Raises:
        DictionaryError: the disk refuses.
    """
    image = _image(atoms, expectation, grown)
    partial = path.with_name(path.name + ".partial")
    try:
        with partial.open("wb") as stream:
            stream.write(image)
            stream.flush()
            os.fsync(stream.fileno())
        partial.replace(path)
        sync_folder(path.parent)
    except OSError as error:
        with contextlib.suppress(OSError):
            partial.unlink()
        raise DictionaryError(f"cannot write {path}: {error.strerror or error}") from error


def open_atoms(path: Path) -> AtomFile:
    """Read a file.

    Raises:
        DictionaryError: missing, truncated, damaged, of another format or of another version; the message says which.
    """
    try:
        with path.open("rb") as stream:
            if stream.read(len(_ZIP_MAGIC)) == _ZIP_MAGIC:
                raise DictionaryError(
                    f"{path} is an atom dictionary of version 1 (.npz) or a zip file; this program reads version {VERSION}:"
                    " build it again with `potserver atoms build`"
                )
            # opening checks that the header describes the whole file
            with safe_open(path, framework="numpy") as container:
                metadata = container.metadata() or {}
                described = [
                    (name, (part := container.get_slice(name)).get_dtype(), tuple(part.get_shape()))
                    for name in container.offset_keys()
                ]
            stream.seek(0)
            content = stream.read()
    except FileNotFoundError:
        raise DictionaryError(f"no atom dictionary at {path}") from None
    except SafetensorError as error:
        raise DictionaryError(f"{path} is not an atom dictionary, or is cut off: {error}") from error
    except OSError as error:
        raise DictionaryError(f"cannot read {path}: {error.strerror or error}") from error
    if _METADATA_KEY not in metadata:
        raise DictionaryError(f"{path} is a safetensors file, but no atom dictionary")
    if hashlib.sha256(memoryview(content)[:-_DIGEST_BYTES]).digest() != content[-_DIGEST_BYTES:]:
        raise DictionaryError(f"{path} is damaged: its SHA-256 does not fit its content")
    records, expectation, grown = _parse_metadata(path, metadata[_METADATA_KEY])
    return AtomFile(path, records, expectation, grown, _arrays_of(path, content, described, len(records)))


def _image(atoms: Sequence[Atom], expectation: Perceptron | None, grown: Sequence[Learned]) -> bytes:
    arrays: dict[str, NDArray[Any]] = {
        "hit_offsets": _offsets([len(atom.hit_points) for atom in atoms]),
        "free_offsets": _offsets([len(atom.free_points) for atom in atoms]),
        "kernel_offsets": _offsets([len(atom.kernels) for atom in atoms]),
        _DIGEST: np.zeros(_DIGEST_BYTES, np.uint8),
    }
    for name, (width, _) in _COLUMNS.items():
        parts = [getattr(atom.kernels if name in KERNEL_ARRAYS else atom, name) for atom in atoms]
        empty = np.zeros((0, width) if width else 0, np.float32)
        arrays[name] = np.ascontiguousarray(np.concatenate([empty, *parts]), np.dtype("<f4"))
    records = [
        {
            "atom_id": atom.atom_id,
            "dims": atom.dims,
            "radius_m": float(atom.radius_m),
            "azimuth_width_rad": float(atom.azimuth_width_rad),
            "provenance": dict(atom.provenance),
        }
        for atom in atoms
    ]
    tree: dict[str, Any] = {"version": VERSION, "atoms": records}
    if expectation is not None:
        tree["expectation"] = _layers(expectation)
    if grown:
        tree["grown"] = [{"name": g.name, "net": _layers(g.net), "provenance": g.provenance} for g in grown]
    text = json.dumps(tree, sort_keys=True, separators=(",", ":"), allow_nan=False)
    content = to_safetensors(arrays, metadata={_METADATA_KEY: text})[:-_DIGEST_BYTES]
    return content + hashlib.sha256(content).digest()


def _layers(net: Perceptron) -> dict[str, Any]:
    return {name: values.tolist() for name, values in net._asdict().items()}


def _offsets(counts: list[int]) -> NDArray[np.int64]:
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.dtype("<i8"))


def _arrays_of(
    path: Path, content: bytes, described: list[tuple[str, str, tuple[int, ...]]], n_atoms: int
) -> dict[str, NDArray[Any]]:
    """Read-only views; the container guarantees that the arrays lie one after the other and end with the file."""
    arrays: dict[str, NDArray[Any]] = {}
    start = 8 + int.from_bytes(content[:8], "little")
    for name, dtype_name, shape in described:
        if dtype_name not in _DTYPES:
            raise DictionaryError(f"{path}: array {name!r} is of type {dtype_name}")
        dtype = _DTYPES[dtype_name]
        size = math.prod(shape)
        arrays[name] = (
            np.frombuffer(content, dtype, size, start).reshape(shape) if size else np.zeros(shape, dtype)
        )
        start += size * dtype.itemsize
    expected: dict[str, tuple[str, tuple[int, ...]]] = dict.fromkeys(_OFFSETS, ("I64", (n_atoms + 1,)))
    expected[_DIGEST] = ("U8", (_DIGEST_BYTES,))
    present = {name: (dtype, shape) for name, dtype, shape in described}
    for name in _OFFSETS:
        if present.get(name) != expected[name]:
            raise DictionaryError(f"{path}: {name} is {present.get(name)}, need {expected[name]}")
        if arrays[name][0] != 0 or (np.diff(arrays[name]) < 0).any():
            raise DictionaryError(f"{path}: {name} do not rise from 0")
    for name, (width, offsets_name) in _COLUMNS.items():
        n = int(arrays[offsets_name][-1])
        expected[name] = ("F32", (n, width) if width else (n,))
    if present != expected:
        wrong = sorted(n for n in present.keys() | expected.keys() if present.get(n) != expected.get(n))
        raise DictionaryError(f"{path}: the arrays {', '.join(wrong)} are not those of an atom dictionary")
    return arrays


def _parse_metadata(path: Path, text: str) -> tuple[list[AtomRecord], Perceptron | None, tuple[Learned, ...]]:
    try:
        tree = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise DictionaryError(f"{path}: the metadata is not JSON: {error}") from error
    if not isinstance(tree, dict) or not isinstance(tree.get("atoms"), list):
        raise DictionaryError(f"{path}: the metadata has no list of atoms")
    if tree.get("version") != VERSION:
        raise DictionaryError(
            f"{path} is of version {tree.get('version')!r}, this program reads version {VERSION}"
        )
    records = [_parse_record(path, number, record) for number, record in enumerate(tree["atoms"])]
    expectation = _parse_net(path, tree["expectation"]) if "expectation" in tree else None
    return records, expectation, _parse_grown(path, tree.get("grown", []))


def _parse_grown(path: Path, told: object) -> tuple[Learned, ...]:
    if isinstance(told, list) and all(isinstance(one, dict) for one in told):
        grown = [(one.get("name"), one.get("provenance"), one.get("net")) for one in told]
        if all(isinstance(name, str) and _is_provenance(noted) for name, noted, _ in grown):
            return tuple(Learned(name, _parse_net(path, net), noted) for name, noted, net in grown)
    raise DictionaryError(f"{path}: what was learned since is incomplete, or its fields have the wrong types")


def _is_provenance(noted: object) -> bool:
    return isinstance(noted, dict) and all(isinstance(v, str) for v in itertools.chain(*noted.items()))


def _parse_net(path: Path, told: object) -> Perceptron:
    try:
        layers = cast("dict[str, Any]", told).items()
        net = Perceptron(**{name: np.array(values, np.float32) for name, values in layers})
        if len(net.first) == FORMER_FEATURES:  # it knows no lines
            net = net._replace(first=np.pad(net.first, ((0, N_FEATURES - FORMER_FEATURES), (0, 0))))
        sound = net.is_sound
    except (TypeError, ValueError, AttributeError):
        sound = False
    if not sound:
        raise DictionaryError(f"{path}: the expectation is incomplete, or its numbers are no net's")
    return net


def _parse_record(path: Path, number: int, record: object) -> AtomRecord:
    if isinstance(record, dict) and record.keys() == set(AtomRecord._fields):
        parsed = AtomRecord(**cast("dict[str, Any]", record))
        if (
            isinstance(parsed.atom_id, str)
            and parsed.dims in (2, 3)
            and all(
                isinstance(v, float) and 0 < v < math.inf for v in (parsed.radius_m, parsed.azimuth_width_rad)
            )
            and _is_provenance(parsed.provenance)
        ):
            return parsed
    raise DictionaryError(f"{path}: atom number {number} is incomplete, or its fields have the wrong types")
