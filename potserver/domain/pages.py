"""Pages: where a map's arrays lie that nobody changes any more, so that a year's map does not need a year's memory.

They are written to a file without a name and mapped into memory: whoever reads them finds the very same numbers, and the
system brings them in from the disk and takes their memory back as it needs to. So scans and questions know nothing of pages.
The file ends with the process; nothing is ever read from it at a start. Where the disk cannot read a page back, or reads other
bits, the file says so (`PageFile.check`), after which nothing that was computed from it may be used: what was acknowledged is
in the journal and the snapshot. What cannot be read is noticed at once. Other bits are found by a checksum of a run, compared
before what was made of it is kept anywhere, and of one run after the other as scans come.
"""

from __future__ import annotations

import collections
import dataclasses
import math
import mmap
import os
import tempfile
import weakref
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from potserver.domain.map_part import MapPart
from potserver.domain.mapped import MappedFile
from potserver.domain.tiles import Tile, TiledMap, TileIndex, part_of, tiles_of_part
from potserver.errors import MapDamagedError

_PAGE = mmap.ALLOCATIONGRANULARITY
_SEGMENT_BYTES = 256 * 2**20  # of the file are mapped at once; what was not written takes no room
_ALIGNED = 64  # bytes: a line of the processor's cache
_LEAST_BYTES = _ALIGNED  # smaller arrays would take no less on a page
_READY_AT_ONCE = 64  # parts of a map that is read
_AT_ONCE = 8 * 2**20  # bytes that are moved together: snapshots are indexed anew each time
# What so many scans have left alone goes to pages too, of a map that takes more than this: no scan brings it back soon.
_COLD_SCANS, _SMALL_BYTES = 64, 64 * 2**20


class _Extent(np.ndarray[Any, np.dtype[np.uint8]]):
    """A run of the file, mapped. A type of its own, so that arrays in it name it as their base and keep it alive: when the last
    one is gone its place is free."""

    digest: int  # of what was written

    @property
    def is_sound(self) -> bool:
        """What is read is what was written."""
        return zlib.crc32(self.data) == self.digest


class _Run(NamedTuple):
    start: int
    n_bytes: int


class _Resident(NamedTuple):
    """A part in memory."""

    n_bytes: int
    turn: int  # when it was changed


class PageFile:
    """A file without a name that arrays are moved to. One caller at a time; arrays may be dropped by any thread."""

    def __init__(self, folder: Path) -> None:
        """Use a folder; the file is made when it is needed first."""
        self._folder = folder
        self._fd = -1
        self._segments: list[tuple[int, MappedFile]] = []  # where each starts
        self._end = 0  # of the file
        self._free: list[_Run] = []  # by place, none beside another
        self._dropped: collections.deque[_Run] = collections.deque()
        self._extents: collections.deque[weakref.ref[_Extent]] = (
            collections.deque()
        )  # what was compared last is last
        self._is_damaged = False

    def put(self, arrays: Sequence[NDArray[Any]]) -> dict[int, NDArray[Any]]:
        """Move arrays, at least one, to the file.

        Returns:
            By `id` of each array: the same numbers on pages, as writeable as it was.
        Raises:
            OSError: the disk refuses; nothing was moved.
        """
        starts = np.cumsum([0, *(-(-array.nbytes // _ALIGNED) * _ALIGNED for array in arrays)]).tolist()
        run = self._take(-(-starts[-1] // _PAGE) * _PAGE)
        content = np.zeros(run.n_bytes, np.uint8)
        for array, at in zip(arrays, starts, strict=False):
            content[at : at + array.nbytes] = np.ascontiguousarray(array).reshape(-1).view(np.uint8)
        try:
            self._write(content, run.start)
        except OSError:
            self._dropped.append(run)
            raise
        start, segment = next(s for s in reversed(self._segments) if s[0] <= run.start)
        extent = _Extent((run.n_bytes,), np.uint8, segment.buffer, run.start - start)
        extent.digest = zlib.crc32(content.data)
        self._extents.append(weakref.ref(extent))
        weakref.finalize(extent, self._dropped.append, run).atexit = False
        moved: dict[int, NDArray[Any]] = {}
        for array, at in zip(arrays, starts, strict=False):
            moved[id(array)] = np.ndarray(array.shape, array.dtype, extent, at)
            moved[id(array)].flags.writeable = array.flags.writeable
        return moved

    def verify(self, *things: object) -> None:
        """Compare what records have here with its checksums; `check` tells."""
        for extent in {
            id(e): e for array in _arrays(*things) if (e := _extent_of(array)) is not None
        }.values():
            self._is_damaged = self._is_damaged or not extent.is_sound

    def scrub(self) -> None:
        """Compare the run whose turn it is; `check` tells."""
        while self._extents:
            extent = self._extents.popleft()()
            if extent is not None:
                self._extents.append(weakref.ref(extent))
                self._is_damaged = self._is_damaged or not extent.is_sound
                return

    def let_go(self) -> None:
        """Take what was read of the file out of this process's memory; the system still has what it needs to bring it back."""
        for _, segment in self._segments:
            segment.let_go()

    def check(self) -> None:
        """To be asked when something was computed from arrays here; from any thread.

        Raises:
            MapDamagedError: the disk could not read all of them back, and never will.
        """
        cut_off = self._fd >= 0 and os.fstat(self._fd).st_size < self._end
        if self._is_damaged or cut_off or any(segment.is_lost for _, segment in self._segments):
            raise MapDamagedError(
                "the disk cannot read back a part of the map that lay on pages. All that was acknowledged is in the store:"
                " restart the server to read it, and look at the disk"
            )

    @property
    def n_bytes(self) -> int:
        """Of the file that are in use."""
        return self._end - sum(run.n_bytes for run in (*self._free, *self._dropped))

    def close(self) -> None:
        """Write no more; arrays that were moved stay readable."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def _write(self, content: NDArray[np.uint8], at: int) -> None:
        left = content.data
        while left:
            n = os.pwrite(self._fd, left, at)
            left, at = left[n:], at + n

    def _take(self, n_bytes: int) -> _Run:
        self._collect()
        number = next((i for i, run in enumerate(self._free) if run.n_bytes >= n_bytes), None)
        if number is None:
            self._grow(max(n_bytes, _SEGMENT_BYTES))
            number = len(self._free) - 1
        run = self._free[number]
        self._free[number : number + 1] = (
            [_Run(run.start + n_bytes, run.n_bytes - n_bytes)] if run.n_bytes > n_bytes else []
        )
        return _Run(run.start, n_bytes)

    def _collect(self) -> None:
        """Runs that were dropped are free, beside others they are one; none crosses segments."""
        starts = {start for start, _ in self._segments}
        runs = list(self._free)
        while self._dropped:
            runs.append(self._dropped.popleft())
        self._free = []
        for run in sorted(runs):
            last = self._free[-1] if self._free else None
            if last and last.start + last.n_bytes == run.start and run.start not in starts:
                self._free[-1] = _Run(last.start, last.n_bytes + run.n_bytes)
            else:
                self._free.append(run)

    def _grow(self, n_bytes: int) -> None:
        if self._fd < 0:
            self._fd, name = tempfile.mkstemp(dir=self._folder, prefix="pages-")
            Path(name).unlink()  # a kill leaves nothing behind, and nobody can cut it off under us
        os.ftruncate(self._fd, self._end + n_bytes)
        self._segments.append((self._end, MappedFile(self._fd, n_bytes, self._end)))
        self._free.append(_Run(self._end, n_bytes))
        self._end += n_bytes


class Pages:
    """Keeps of one map's tiles in memory what scans change, up to a limit, and moves to pages what was changed longest ago."""

    def __init__(self, folder: Path, max_resident_bytes: int) -> None:
        """Use a folder for the page file.

        Args:
            folder: On a disk.
            max_resident_bytes: Of tiles, and what answers from them, that may stay in memory.
        """
        self.max_resident_bytes = max_resident_bytes
        self.file = PageFile(folder)
        self._seen: TiledMap | None = None  # as it was last
        self._resident: dict[TileIndex, _Resident] = {}  # the parts, last changed last
        self._turn = 0  # of `relieve`, one a scan

    def relieve(self, tiled: TiledMap) -> TiledMap:
        """The same map with its coldest parts on pages, if it has more in memory than it may; else the one that was given.

        To be called after each scan.

        Raises:
            OSError: the disk refuses; the map is as it was.
        """
        self._turn += 1
        n_bytes = self._look(tiled)
        if n_bytes > self.max_resident_bytes:
            return self._moved(tiled, self._coldest(n_bytes - max(self.max_resident_bytes - _AT_ONCE, 0)))
        cold = self._coldest(min(n_bytes - _SMALL_BYTES, _AT_ONCE), self._turn - _COLD_SCANS)
        is_worth_it = sum(self._resident[number].n_bytes for number in cold) >= _AT_ONCE
        return self._moved(tiled, cold) if is_worth_it else tiled

    def _coldest(self, n_bytes: int, until: float = math.inf) -> list[TileIndex]:
        """Parts of so many bytes, if there are as many that were changed at no later turn."""
        found = []
        for number, part in self._resident.items():
            if n_bytes <= 0 or part.turn > until:
                break
            found.append(number)
            n_bytes -= part.n_bytes
        return found

    def _moved(self, tiled: TiledMap, numbers: list[TileIndex]) -> TiledMap:
        if not numbers:
            return tiled
        tiles, parts = dict(tiled.tiles), dict(tiled.parts)
        for number in numbers:
            members = {index: tiles[index] for index in tiles_of_part(number) if index in tiles}
            tiles_now, parts[number] = self._move(tuple(members.values()), parts[number])
            tiles.update(zip(members, tiles_now, strict=True))
        for number in numbers:
            del self._resident[number]
        self._seen = tiled._replace(tiles=tiles, parts=parts)
        return self._seen

    @property
    def read_bytes(self) -> int:
        """Of a map that is being read, what stays in memory: no scan has touched it."""
        return min(self.max_resident_bytes, _SMALL_BYTES)

    def keep(self, tile: Tile) -> Tile:
        """A tile of a map that is being read, on pages.

        Raises:
            OSError: the disk refuses.
        """
        arrays = _in_memory(tile)
        return _exchanged(tile, dict(self.file.put(arrays))) if arrays else tile

    def gather(self, empty: TiledMap, tiles: Mapping[TileIndex, Tile]) -> TiledMap:
        """A map of tiles that were read: made ready some parts at a time, so that it never takes more than it may.

        Raises:
            OSError: the disk refuses.
        """
        by_part: dict[TileIndex, dict[TileIndex, Tile]] = {}
        for index, tile in tiles.items():
            by_part.setdefault(part_of(index), {})[index] = tile
        tiled, parts = empty, list(by_part.values())
        for start in range(0, len(parts), _READY_AT_ONCE):
            some = parts[start : start + _READY_AT_ONCE]
            tiled = tiled.with_tiles({index: tile for part in some for index, tile in part.items()})
            tiled = self._moved(tiled, self._coldest(self._look(tiled) - self.read_bytes))
        return tiled._replace(
            tiles={index: tiled.tiles[index] for index in tiles}
        )  # in the order of the file

    def close(self) -> None:
        """Move no more; what is on pages stays readable."""
        self.file.close()

    def verify(self, tiled: TiledMap) -> None:
        """Compare pages that went into what has changed since the last `relieve`; `PageFile.check` tells.

        To be called before a map is kept anywhere: what was made of damaged numbers would get a sound checksum there.
        """
        seen = self._seen
        for number, _ in self._changed(tiled):
            if seen is not None and number in seen.parts and number not in self._resident:
                self.file.verify(_members(seen, number), *_heavy(seen.parts[number]))

    def _look(self, tiled: TiledMap) -> int:
        """Note which parts have changed since the last time, and what they take; bytes of all that are in memory."""
        self.verify(tiled)
        self.file.scrub()
        self.file.let_go()
        for number, part in self._changed(tiled):
            self._resident.pop(number, None)
            n_bytes = sum(array.nbytes for array in _in_memory(_members(tiled, number), *_heavy(part)))
            if n_bytes:
                self._resident[number] = _Resident(n_bytes, self._turn)
        for number in [number for number in self._resident if number not in tiled.parts]:
            del self._resident[number]
        self._seen = tiled
        return sum(part.n_bytes for part in self._resident.values())

    def _changed(self, tiled: TiledMap) -> list[tuple[TileIndex, MapPart]]:
        seen = {} if self._seen is None else self._seen.parts
        return [(number, part) for number, part in tiled.parts.items() if seen.get(number) is not part]

    def _move(self, tiles: tuple[Tile, ...], part: MapPart) -> tuple[tuple[Tile, ...], MapPart]:
        new = self.file.put(_in_memory(tiles, *_heavy(part)))
        return _exchanged((tiles, part), dict(new))


def _members(tiled: TiledMap, number: TileIndex) -> list[Tile]:
    return [tiled.tiles[index] for index in tiles_of_part(number) if index in tiled.tiles]


def _heavy(part: MapPart) -> Iterator[object]:
    """What of a part is read where it is asked; the places of its bricks are read whenever a map is indexed, and stay."""
    yield part.members
    yield part.rest
    yield part.lookup
    for bricks in part.bricks:
        yield bricks.rows, bricks.row_of


def _in_memory(*things: object) -> list[NDArray[Any]]:
    """The arrays of records that are worth a move and not on pages yet, each once."""
    return [a for a in _arrays(*things) if a.nbytes >= _LEAST_BYTES and _extent_of(a) is None]


def _arrays(*things: object) -> list[NDArray[Any]]:
    """All arrays of records, each once."""
    found: dict[int, NDArray[Any]] = {}
    left = list(things)
    while left:
        thing = left.pop()
        if isinstance(thing, np.ndarray):
            found[id(thing)] = thing
        elif isinstance(thing, tuple | list):
            left.extend(thing)
        elif dataclasses.is_dataclass(thing):
            left.extend(getattr(thing, field.name) for field in dataclasses.fields(thing))
    return list(found.values())


def _extent_of(array: NDArray[Any]) -> _Extent | None:
    """The run of the file that it lies in."""
    base: object = array
    while isinstance(base, np.ndarray):
        if isinstance(base, _Extent):
            return base
        base = base.base
    return None


def _exchanged(thing: Any, new: dict[int, Any]) -> Any:
    """A record with other objects in the place of those named by `id`; what two of its fields share stays shared."""
    if id(thing) in new:
        return new[id(thing)]
    made = thing
    if isinstance(thing, tuple):
        fields = [_exchanged(field, new) for field in thing]
        if any(a is not b for a, b in zip(thing, fields, strict=True)):
            made = type(thing)._make(fields) if hasattr(thing, "_make") else tuple(fields)
    elif dataclasses.is_dataclass(thing):
        names = [field.name for field in dataclasses.fields(thing)]
        values = [_exchanged(getattr(thing, name), new) for name in names]
        if any(getattr(thing, name) is not value for name, value in zip(names, values, strict=True)):
            made = object.__new__(type(thing))  # what was checked before needs no check
            for name, value in zip(names, values, strict=True):
                object.__setattr__(made, name, value)
    new[id(thing)] = made
    return made
