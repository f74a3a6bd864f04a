"""Damage of files: in every run of bytes of every file that a server reads a bit flips, a sector is cleared, or the file ends.

What is found must be as before, or be refused. The files are those of a store as a kill leaves it (all in the logs) and
after a clean end (all in the files), a saved map, a dictionary, and the pages of a map that is being served.
"""

from __future__ import annotations

import itertools
import os
import random
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from benchmarks.torture_store import SETTINGS, STEPS, Driven, Outcomes, digest, make_scan, reopened, wanted
from potserver.domain.dictionary import AtomDictionary
from potserver.domain.pages import Pages
from potserver.errors import MapDamagedError, PotserverError
from potserver.mapping.service import MappingService
from potserver.storage.map_file import read_map

_COARSE = 8  # so many runs of bytes to one sector that is cleared, and one end
_SCANS = 3  # of the map on pages

Damage = tuple[str, int]  # its kind, and the byte where


def torture_files(run_bytes: int, seed: int, show: Callable[[str], None]) -> list[Outcomes]:
    """Damage every run of `run_bytes` of every file of a store, and of a dictionary."""
    rng = random.Random(seed)
    outcomes = []
    with tempfile.TemporaryDirectory() as scratch:
        for state, store in [*_stores(Path(scratch)), ("alone", _dictionary(Path(scratch)))]:
            files = sorted(path for path in store.rglob("*") if path.is_file() and path.stat().st_size)
            for file in (path for path in files if not path.name.endswith("-shm")):
                look = _LOOKS.get(file.suffix, reopened)
                sound = look(shutil.copytree(store, Path(scratch) / f"sound-{state}-{file.name}"))
                outcome = Outcomes(f"{file.name} ({state}, {file.stat().st_size:,} bytes)")
                for damage in damages(file.stat().st_size, run_bytes, rng):
                    copy = shutil.copytree(store, Path(scratch) / "damaged")
                    _damage(copy / file.relative_to(store), damage, rng)
                    note(outcome, damage, look(copy), sound)
                    shutil.rmtree(copy)
                    show(f"{outcome.name}: at {damage[1]:,}, {dict(outcome.counts)}")
                outcomes.append(outcome)
    return outcomes


def damages(size: int, run_bytes: int, rng: random.Random) -> Iterator[Damage]:
    """A flip in every run of bytes of a file, a sector and an end in every eighth; each somewhere in it."""
    for number, start in enumerate(range(0, size, run_bytes)):
        for kind in ("flip", "clear", "cut") if number % _COARSE == 0 else ("flip",):
            yield kind, rng.randrange(start, min(start + run_bytes, size))


def note(outcome: Outcomes, damage: Damage, found: str, sound: str) -> None:
    """Count what became of one damage."""
    word = "refused" if found.startswith("refused") else "the same" if found == sound else "wrong"
    outcome.counts[word] += 1
    if word == "wrong":
        outcome.wrong.append(f"{outcome.name}: {damage[0]} at {damage[1]}: {found}")


def torture_pages(run_bytes: int, seed: int, show: Callable[[str], None]) -> Outcomes:
    """The same for the pages of a map that is served: other bits must be told by the time that each run of it was compared
    once, the end of the file at once."""
    rng, mapper = random.Random(seed), MappingService(settings=SETTINGS, threads=1)
    for number in range(_SCANS):
        mapper.integrate(make_scan(number))
    state, points = mapper.state, np.random.default_rng(seed).uniform(-6.0, 6.0, (500, 3))
    with tempfile.TemporaryDirectory() as scratch:

        def on_pages() -> tuple[Pages, int]:
            mapper.state = state
            pages = Pages(Path(scratch), 1)
            mapper.relieve(pages)
            return pages, pages.file.n_bytes

        pages, size = on_pages()
        outcome = Outcomes(f"pages ({size:,} bytes)")
        for kind, place in damages(size, run_bytes, rng):
            fd = pages.file._fd
            before = os.pread(fd, 512, place)
            if kind == "cut":
                os.ftruncate(fd, place)
                mapper.snapshot.occupancy(points)  # which may meet it, and must come back
            else:
                os.pwrite(fd, bytes(len(before)) if kind == "clear" else _flipped(before[:1], rng), place)
                for _ in range(len(pages.file._extents)):
                    pages.file.scrub()
            changed = kind == "cut" or os.pread(fd, 512, place) != before
            note(outcome, (kind, place), _told(pages), "refused" if changed else "sound")
            if kind == "cut":
                pages.close()
                pages, _ = on_pages()
            else:
                os.pwrite(fd, before, place)
                pages.file._is_damaged = False
            show(f"{outcome.name}: at {place:,}, {dict(outcome.counts)}")
        pages.close()
    return outcome


def _told(pages: Pages) -> str:
    try:
        pages.file.check()
    except MapDamagedError:
        return "refused"
    return "sound"


def torture_copies(show: Callable[[str], None]) -> Outcomes:
    """Copy a store file by file while it is written, a step between any two files: it holds all that was acknowledged, or is
    refused."""
    outcome = Outcomes("copies of a running store")
    with tempfile.TemporaryDirectory() as scratch:
        for begun, is_reversed in itertools.product(range(1, len(STEPS)), (False, True)):
            folder, copy = (
                Path(scratch) / f"{begun}-{is_reversed}",
                Path(scratch) / f"copy-{begun}-{is_reversed}",
            )
            driven, steps = Driven(folder), iter(range(len(STEPS)))
            for number in itertools.islice(steps, begun):
                driven.do(number)
            (copy / "default").mkdir(parents=True)
            for file in sorted((folder / "default").iterdir(), reverse=is_reversed):
                if not file.name.endswith("-shm"):
                    shutil.copy(file, copy / "default")
                    for number in itertools.islice(steps, 1):
                        driven.do(number)
            driven.store.close()
            found = reopened(copy)
            sound = {wanted(tuple(range(n))) for n in range(begun, len(STEPS) + 1)}
            word = (
                "refused"
                if found.startswith("refused")
                else "all acknowledged"
                if found in sound
                else "wrong"
            )
            outcome.counts[word] += 1
            if word == "wrong":
                outcome.wrong.append(f"copied from step {begun} on, reversed {is_reversed}: {found}")
            show(f"{outcome.name}: {dict(outcome.counts)}")
    return outcome


def _stores(scratch: Path) -> Iterator[tuple[str, Path]]:
    """The same map as a kill leaves it, all in the logs, and after a clean end, all in the files."""
    driven = Driven(scratch / "served")
    for number in range(len(STEPS)):
        driven.do(number)
    shutil.copytree(scratch / "served", scratch / "killed")
    driven.store.close()
    yield "killed", scratch / "killed"
    yield "ended", scratch / "served"


def _read_saved(store: Path) -> str:
    (file,) = (store / "saved").rglob("*.map")
    try:
        return digest(read_map(file).state())
    except PotserverError as error:
        return f"refused: {error}"
    except Exception as error:
        return f"crashed: {error!r}"


def _dictionary(scratch: Path) -> Path:
    folder = scratch / "dictionary"
    folder.mkdir()
    AtomDictionary(itertools.islice(AtomDictionary.builtin().atoms, 3)).save(folder / "few.atoms")
    return folder


def _read_dictionary(folder: Path) -> str:
    try:
        atoms = AtomDictionary.load(folder / "few.atoms")
        return repr(
            [(a.atom_id, a.hit_points.tobytes(), a.kernels.weight_mean.tobytes()) for a in atoms.atoms]
        )
    except PotserverError as error:
        return f"refused: {error}"
    except Exception as error:
        return f"crashed: {error!r}"


_LOOKS: dict[str, Callable[[Path], str]] = {".map": _read_saved, ".atoms": _read_dictionary}


def _damage(file: Path, damage: Damage, rng: random.Random) -> None:
    kind, place = damage
    if kind == "cut":
        os.truncate(file, place)
        return
    content = bytearray(file.read_bytes())
    if kind == "flip":
        content[place : place + 1] = _flipped(content[place : place + 1], rng)
    else:
        sector = slice(place // 512 * 512, place // 512 * 512 + 512)
        content[sector] = bytes(len(content[sector]))
    file.write_bytes(content)


def _flipped(byte: bytes, rng: random.Random) -> bytes:
    return bytes([byte[0] ^ 1 << rng.randrange(8)])
