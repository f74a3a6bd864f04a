"""A copy of a map, or of a box of it, that is kept up to date by what changes: `MapClient.mirror`. numpy only."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from potclient.arrays import Bool, Float32, Float64
from potclient.errors import BadReplyError, UsageError
from potclient.kernels import KernelSet
from potclient.lean import lean_from_message
from potclient.occupancy import Occupancy
from potclient.parts import PartCheck
from potclient.tile_changes import Kernels, Steps, TileNodes, changed_nodes, kernels_of, steps_of
from potschemas.answers import RULE_FIELDS, AnswerRule
from potschemas.lean import LeanTiles
from potschemas.messages import (
    ABSENT,
    MAX_PART_KERNELS,
    CodedKernels,
    DType,
    Packed,
    TileChanges,
    TilesPart,
    TilesQuery,
)
from potschemas.wire import WireError, pack_array, unpack_array

Int64 = NDArray[np.int64]
TileIndex = tuple[int, int, int]  # floor(p_map / tile_size_m)
Ask = Callable[[TilesQuery], Iterator[tuple[TilesPart, int]]]  # the parts of the reply, with their bytes

_SAME_IN_ALL_PARTS = ("epoch", "map_revision", "whole", "tile_size_m", *RULE_FIELDS)
_CELLS = (DType.UINT8, DType.INT64)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class MirrorUpdate:
    """What one update of a mirror brought."""

    revision: int  # of the map that the mirror now is of
    epoch: int  # revisions of two epochs say nothing of each other
    is_whole: bool  # everything came anew: the first update, or the map was cleared, loaded or restarted
    n_tiles: int  # that came, new or in place of older ones
    n_removed: int  # tiles that are no longer there
    n_kernels: int  # that came
    n_bytes: int  # of the reply

    @property
    def is_empty(self) -> bool:
        """Nothing was changed."""
        return self.n_tiles == self.n_removed == 0


class MapMirror:
    """The kernels of a map, or of a box of it, held by the client; made by `MapClient.mirror`.

    One thread may update it while others ask: an update exchanges the whole state at once, and one that fails leaves the mirror
    as it was. All answers are of one revision of the map.
    """

    def __init__(
        self,
        ask: Ask,
        lower: list[float] | None = None,
        upper: list[float] | None = None,
        *,
        step: float | None = None,
    ) -> None:
        """An empty mirror.

        Args:
            ask: Sends a query of tiles, and gives the parts of its reply.
            lower, upper: (3,) m, map frame: the tiles that this box touches are mirrored; None = no bound on that side.
            step: Of the weights, see `MapClient.mirror`.
        """
        self._ask, self._lower, self._upper = ask, lower, upper
        self._step = ABSENT if step is None else step
        self._updating = threading.Lock()
        self._state: _State | None = None

    def update(self) -> MirrorUpdate:
        """Ask what has changed since the last update, and take it over.

        Raises:
            IncompleteReplyError, BadReplyError: the reply misses parts, or is not what the contract promises.
            MapServerError, NoServerError, QueryTimeoutError, LostReplyError: see there. The mirror is as it was.
        """
        with self._updating:
            state = self._state
            query = TilesQuery(lower=self._lower, upper=self._upper, step=self._step)
            if state is not None:
                query = msgspec.structs.replace(query, epoch=state.epoch, known=pack_array(state.known))
            reply = _Reply(state)
            for part, n_bytes in self._ask(query):
                reply.add(part, n_bytes)
            self._state, update = reply.applied()
            return update

    @property
    def revision(self) -> int | None:
        """Of the map that the mirror is of; None before the first update."""
        return None if self._state is None else self._state.revision

    @property
    def n_tiles(self) -> int:
        """Tiles that are held."""
        return 0 if self._state is None else len(self._state.revisions)

    @property
    def kernels(self) -> KernelSet:
        """All kernels that are held, map frame; put together once an update.

        Raises:
            UsageError: nothing was ever mirrored.
        """
        state = self._state
        if state is None:
            raise UsageError("the mirror is empty: call update() first")
        return state.kernels

    def occupancy(
        self, points: ArrayLike, *, gradient: bool = False, evidence_only: bool = False
    ) -> Occupancy:
        """What the map of the mirror's revision says at points, without the server; see `KernelSet.occupancy`.

        Raises:
            UsageError: nothing was ever mirrored, or the points have a wrong shape.
        """
        return self.kernels.occupancy(points, gradient=gradient, evidence_only=evidence_only)


_NO_NODES: TileNodes = {}


class _Tile(NamedTuple):
    revision: int
    hinge_mean: Float64  # (K, 3) m, map frame
    hinge_var: Float32
    gamma_shape: Float32
    gamma_rate: Float32
    weight_mean: Float32
    weight_var: Float32
    nodes: TileNodes = _NO_NODES  # of its kernels, those that came in whole steps
    steps: Steps | None = None  # None: none did


class _LeanTile(NamedTuple):
    revision: int
    nodes: NDArray[np.uint8]


_ARRAYS = _Tile._fields[1:7]


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class _State:
    """Never changes: `cached_property` only puts together what is there."""

    epoch: int
    revision: int
    rule: AnswerRule
    tile_size_m: float
    tiles: Mapping[TileIndex, _Tile]
    leans: Mapping[TileIndex, _LeanTile]  # of these tiles, or of others without kernels

    @property
    def revisions(self) -> dict[TileIndex, int]:
        """Of all tiles that are held."""
        held: list[Mapping[TileIndex, Any]] = [self.leans, self.tiles]  # a lean that stayed may be older
        return {index: tile.revision for tiles in held for index, tile in tiles.items()}

    @property
    def known(self) -> Int64:
        """(4, N) index and revision of each tile; in order, so that it deflates well."""
        columns = [(*index, revision) for index, revision in sorted(self.revisions.items())]
        return np.ascontiguousarray(np.array(columns, np.int64).reshape(-1, 4).T)

    @cached_property
    def kernels(self) -> KernelSet:
        tiles = list(self.tiles.values()) or [_NO_TILE]
        arrays: dict[str, Any] = {name: np.concatenate([getattr(t, name) for t in tiles]) for name in _ARRAYS}
        nodes = {index: tile.nodes for index, tile in self.leans.items()}
        lean = LeanTiles(self.tile_size_m, nodes) if nodes else None
        return KernelSet(**arrays, rule=self.rule, map_revision=self.revision, lean=lean)


_NONE = np.zeros(0, np.float32)
_NO_TILE = _Tile(0, np.zeros((0, 3)), np.zeros((0, 3), np.float32), _NONE, _NONE, _NONE, _NONE)


class _Reply:
    """A reply in the making; refuses what does not fit."""

    def __init__(self, state: _State | None) -> None:
        self._state = state  # what it is a reply to
        self._check = PartCheck("tiles")
        self._parts: dict[int, tuple[TilesPart, list[tuple[TileIndex, _Tile]]]] = {}
        self._n_bytes = 0

    def add(self, part: TilesPart, n_bytes: int) -> None:
        same = {name: getattr(part, name) for name in _SAME_IN_ALL_PARTS}
        self._check.add(part.part, part.n_parts, **same)
        try:
            held = {} if self._state is None or part.whole else self._state.tiles
            self._parts[part.part] = (part, list(_tiles_of(part, held)))
        except WireError as error:
            raise BadReplyError(f"tiles: {error}") from error
        self._n_bytes += n_bytes

    def applied(self) -> tuple[_State, MirrorUpdate]:
        """What was before, with all that came in its place; and what came."""
        self._check.finish()
        state = self._state
        first = self._parts[0][0]
        if first.whole != (state is None or state.epoch != first.epoch):
            raise BadReplyError(
                f"tiles: whole is {first.whole}, in epoch {first.epoch} after {state and state.epoch}"
            )
        try:
            rule = AnswerRule.of(first)
        except ValueError as error:
            raise BadReplyError(f"tiles: {error}") from error
        came, leans_came = self._joined(), self._leans()
        before = {} if state is None else state.revisions
        held = {} if first.whole else before
        gone = self._gone(held)
        changed = came.keys() | leans_came.keys()
        stays = held.keys() - set(gone) - changed
        # told by changes, a tile keeps its lean unless another comes
        leaning = held.keys() - set(gone) if first.changes is not ABSENT else stays
        tiles, leans = ({}, {}) if state is None else (state.tiles, state.leans)
        now = _State(
            epoch=first.epoch,
            revision=first.map_revision,
            rule=rule,
            tile_size_m=first.tile_size_m,
            tiles={index: tile for index, tile in tiles.items() if index in stays} | came,
            leans={index: lean for index, lean in leans.items() if index in leaning} | leans_came,
        )
        n_removed = len(before.keys() - now.revisions.keys())
        return now, MirrorUpdate(
            revision=first.map_revision,
            epoch=first.epoch,
            is_whole=first.whole,
            n_tiles=len(changed),
            n_removed=n_removed,
            n_kernels=sum(len(tile.weight_mean) for tile in came.values()),
            n_bytes=self._n_bytes,
        )

    def _joined(self) -> dict[TileIndex, _Tile]:
        """The tiles of all parts; one that goes on from part to part is put together."""
        pieces: dict[TileIndex, list[_Tile]] = {}
        last: TileIndex | None = None
        for number in range(len(self._parts)):
            for place, (index, tile) in enumerate(self._parts[number][1]):
                before = pieces.setdefault(index, [])
                goes_on = place == 0 and index == last and tile.steps is None
                if before and not (goes_on and before[0].revision == tile.revision):
                    raise BadReplyError(f"tiles: tile {index} came twice")
                before.append(tile)
                last = index
        return {index: _joined(*tiles) for index, tiles in pieces.items()}

    def _leans(self) -> dict[TileIndex, _LeanTile]:
        """The leans of all parts."""
        found: dict[TileIndex, _LeanTile] = {}
        for part, _ in self._parts.values():
            if part.lean is ABSENT:
                continue
            lean, revisions = lean_from_message(part.lean)
            if lean.tile_size_m != part.tile_size_m or found.keys() & lean.nodes.keys():
                raise BadReplyError("tiles: a lean that came twice, or is of tiles of another size")
            found |= {index: _LeanTile(revisions[index], own) for index, own in lean.nodes.items()}
        if len({lean.nodes.shape for lean in found.values()}) > 1:
            raise BadReplyError("tiles: leans with different numbers of nodes")
        return found

    def _gone(self, kept: Mapping[TileIndex, int]) -> list[TileIndex]:
        gone: list[TileIndex] = []
        for part, _ in self._parts.values():
            if part.gone is None:
                continue
            try:
                columns = _unpack(part.gone, "gone", (DType.INT64,), (3, None), 3 * len(kept))
            except WireError as error:
                raise BadReplyError(f"tiles: {error}") from error
            gone += [(x, y, z) for x, y, z in columns.T.tolist()]
        if len(set(gone)) != len(gone) or not kept.keys() >= set(gone):
            raise BadReplyError("tiles: tiles are gone that were never there, or twice")
        return gone


def _tiles_of(part: TilesPart, held: Mapping[TileIndex, _Tile]) -> Iterator[tuple[TileIndex, _Tile]]:
    """The tiles of one part, map frame, with arrays of their own.

    Raises:
        WireError, BadReplyError: arrays of the wrong form, or numbers that do not fit together.
    """
    tiles = _unpack(part.tiles, "tiles", (DType.INT64,), (4, None), 4 * MAX_PART_KERNELS)
    counts = _unpack(part.counts, "counts", (DType.INT64,), (tiles.shape[1],), MAX_PART_KERNELS)
    k = part.kernels.weight_mean.shape[0] if part.kernels.weight_mean.shape else 0
    changes = None if part.changes is ABSENT else part.changes
    least = 1 if changes is None else 0
    if (counts < least).any() or (counts > k).any() or counts.sum() != k:
        raise BadReplyError(f"tiles: the counts of part {part.part} are not those of {k} kernels")
    kernels = _decode(part.kernels, k)
    stops = np.cumsum(counts)
    runs = [slice(stop - count, stop) for stop, count in zip(stops, counts, strict=True)]
    # copies: a view would keep the whole part alive
    found = [
        _Tile(revision, *(getattr(kernels, name)[run].copy() for name in _ARRAYS))
        for run, revision in zip(runs, tiles[3].tolist(), strict=True)
    ]
    indices: list[TileIndex] = [(x, y, z) for x, y, z in tiles[:3].T.tolist()]
    if changes is not None:
        found = _with_nodes(found, changes, [held.get(index) for index in indices])
    for index, tile in zip(indices, found, strict=True):
        with np.errstate(over="ignore", invalid="ignore"):
            hinge = tile.hinge_mean + np.array(index, np.float64) * part.tile_size_m
        placed = tile._replace(hinge_mean=hinge)
        if not all(np.isfinite(getattr(placed, name)).all() for name in _ARRAYS):
            raise BadReplyError("tiles: kernels with numbers that are not finite")
        yield index, placed


def _joined(first: _Tile, *others: _Tile | Kernels) -> _Tile:
    """The first tile with the kernels of others too."""
    arrays: dict[str, Any] = {
        name: np.concatenate([getattr(s, name) for s in (first, *others)]) for name in _ARRAYS
    }

    return first._replace(**arrays)


def _with_nodes(tiles: list[_Tile], changes: TileChanges, held: list[_Tile | None]) -> list[_Tile]:
    """Tiles with the kernels that stand on lattices, hinges relative to the corners of their tiles."""
    steps = steps_of(changes)

    def before(t: int) -> TileNodes | None:
        tile = held[t]
        return tile.nodes if tile is not None and tile.steps == steps else None

    out = []
    for tile, nodes in zip(tiles, changed_nodes(changes, before, len(tiles)), strict=True):
        out.append(_joined(tile, *kernels_of(nodes, steps))._replace(nodes=nodes, steps=steps))
    return out


def _decode(coded: CodedKernels, k: int) -> _Tile:
    """The k kernels of a part, hinges relative to the corners of their tiles.

    Raises:
        WireError, BadReplyError: arrays of the wrong form, or numbers that do not fit together.
    """
    f4, f8 = (DType.FLOAT32,), (DType.FLOAT64,)
    weights = [
        _unpack(getattr(coded, name), name, f4, (k,), MAX_PART_KERNELS)
        for name in ("weight_mean", "weight_var")
    ]
    shapes = _unpack(coded.kinds, "kinds", f4, (5, None), 5 * MAX_PART_KERNELS)
    n_kinds = shapes.shape[1]
    lattices = _unpack(coded.lattices, "lattices", f8, (4, n_kinds), 4 * MAX_PART_KERNELS)
    kind: NDArray[Any] = np.arange(k)
    if coded.kind is not None:
        kind = _unpack(coded.kind, "kind", _CELLS, (k,), MAX_PART_KERNELS)
    elif n_kinds != k:
        raise BadReplyError(f"tiles: {n_kinds} kinds for {k} kernels, and not which kernel is of which")
    if k and not 0 <= kind.min() <= kind.max() < n_kinds:
        raise BadReplyError(f"tiles: kernels of kinds {kind.min()} to {kind.max()}, there are {n_kinds}")
    lattice = lattices[:, kind]
    on_lattice: Bool = lattice[0] != 0
    n = int(np.count_nonzero(on_lattice))
    cells = _unpack(coded.cells, "cells", _CELLS, (3, n), 3 * MAX_PART_KERNELS)
    others = _unpack(coded.hinge_mean, "hinge_mean", f4, (3, k - n), 3 * MAX_PART_KERNELS)
    hinge = np.empty((3, k), np.float32)
    with np.errstate(over="ignore", invalid="ignore"):  # what overflows is refused as infinite
        hinge[:, on_lattice] = lattice[1:, on_lattice] + cells * lattice[0, on_lattice]
    hinge[:, ~on_lattice] = others
    own = shapes[:, kind]
    if not all(np.isfinite(numbers).all() for numbers in (hinge, own, *weights)) or (own[3:] <= 0).any():
        raise BadReplyError(
            "tiles: kernels with numbers that are not finite, or widths that are not positive"
        )
    return _Tile(0, hinge.T.astype(np.float64), own[:3].T, own[3], own[4], weights[0], weights[1])


def _unpack(
    packed: Packed,
    name: str,
    dtypes: tuple[DType, ...],
    shape: tuple[int | None, ...],
    max_elements: int,
) -> NDArray[Any]:
    return unpack_array(packed, name, dtypes=dtypes, shape=shape, max_elements=max_elements)
