"""The differential question: which tiles of a map differ from what the asker has, and what is in them now."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from potschemas.answers import AnswerRule
from potschemas.lean import LEAN_ZERO, LeanTiles
from potserver.asking.plan import Plan, checked_box, pieces
from potserver.asking.tile_codes import Steps, TileCodes, TileKey, TileMemory, code_tile
from potserver.domain.map_state import MapState
from potserver.domain.tiles import Tile, TileIndex
from potserver.domain.types import KernelSet
from potserver.errors import BadPointsError, ShapeError, TooLargeError
from potserver.limits import Limits
from potserver.numerics.arrays import Int64, UInt8

LEAST_STEP, MOST_STEP = 1e-4, 10.0  # log-odds
_NO_TILES: Int64 = np.empty((0, 3), np.int64)
PART_KERNELS = 20_000  # of a part: 200 kB on the wire, at most 800; askers take up to MAX_PART_KERNELS
_SHORTER = 2  # so many times as many, where two bytes tell a kernel


class KnownTiles(NamedTuple):
    """What an asker has of a map."""

    epoch: int  # of the map that the revisions are of
    indices: Int64  # (N, 3)
    revisions: Int64  # (N,)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Tiles:
    """What is asked: the tiles that a box touches, where they differ from those that the asker has.

    With a `step` the latent mean is off by at most step / 2 sum_m phi_m, and the probability by at most a quarter of that,
    beside exp(1.5 step) - 1 of the latent variance.
    """

    known: KnownTiles | None = None  # what the asker has; None = nothing
    lower: ArrayLike | None = None  # (3,) m, map frame; None = no bound on that side
    upper: ArrayLike | None = None  # (3,) m, map frame; likewise
    step: float | None = (
        None  # log-odds: weights are rounded to it and nodes told by what has changed; None = as they are
    )

    def plan(
        self,
        state: MapState,
        limits: Limits,
        memory: TileMemory,
        *,
        tile_size_m: float,
        part_kernels: int = PART_KERNELS,
    ) -> TilesPlan:
        """Check the question, and compare. A tile without kernels and lean says nothing and counts as none.

        Args:
            state: Of the map.
            limits: That the question has to keep.
            memory: What was sent before, of the same map.
            tile_size_m: Edge of a tile where the map has none yet.
            part_kernels: Of a part, at most.
        Raises:
            ShapeError, BadPointsError, OutOfRangeError: an illegal corner, or known tiles of unequal number.
            TooLargeError: too many known tiles.
        """
        lower, upper = checked_box(self.lower, self.upper, limits)
        self._check_known(limits)
        if self.step is not None and not LEAST_STEP <= self.step <= MOST_STEP:
            raise BadPointsError(f"step is {self.step}, need {LEAST_STEP} to {MOST_STEP}")
        tiled = state.tiled
        size = tile_size_m if tiled is None else tiled.grid.size_m
        low = None if lower is None else np.floor(lower / size).astype(np.int64)
        high = None if upper is None else np.floor(upper / size).astype(np.int64)
        present = {} if tiled is None else _present(tiled.tiles, low, high)
        is_whole = self.known is None or self.known.epoch != state.epoch
        known = None if is_whole else self.known
        revisions, gone = ({}, _NO_TILES) if known is None else _compared(list(present), known, low, high)
        changed = tuple((i, tile) for i, tile in present.items() if revisions.get(i) != tile.revision)
        coding = None
        if self.step is not None:
            steps = Steps.of(self.step, state.snapshot.rule.prior_var)
            keys = [
                TileKey(state.epoch, i, revisions[i], steps) if i in revisions else None for i, _ in changed
            ]
            bases = tuple(None if key is None else memory.get(key) for key in keys)
            coding = Coding(steps, memory, bases)
        return TilesPlan(
            epoch=state.epoch,
            map_revision=state.map_revision,
            rule=state.snapshot.rule,
            tile_size_m=size,
            spacings_m=() if tiled is None else tiled.grid.spacings_m,
            is_whole=is_whole,
            tiles=changed,
            gone=gone,
            coding=coding,
            part_size=part_kernels if coding is None else _SHORTER * part_kernels,
        )

    def _check_known(self, limits: Limits) -> None:
        if self.known is None:
            return
        n = len(self.known.indices)
        if self.known.indices.shape != (n, 3) or self.known.revisions.shape != (n,):
            raise ShapeError(
                f"known tiles: {self.known.indices.shape} and {self.known.revisions.shape}, need (N, 3) and (N,)"
            )
        if n > limits.max_query_tiles:
            raise TooLargeError(f"{n} known tiles, the limit is {limits.max_query_tiles}; ask about a box")


class Change(NamedTuple):
    """A tile, and what of it the asker has."""

    codes: TileCodes
    base: TileCodes | None  # None = nothing


class Coding(NamedTuple):
    """How a plan tells tiles by what has changed."""

    steps: Steps
    memory: TileMemory
    bases: tuple[TileCodes | None, ...]  # of each tile of the plan


class TileRun(NamedTuple):
    """Some tiles, or parts of them, one after the other."""

    indices: Int64  # (T, 3)
    revisions: Int64  # (T,)
    counts: Int64  # (T,) of `kernels` in each
    kernels: KernelSet  # relative to the lower corners of their tiles; without those in `changes`
    leans: Leans | None  # none where no tile has one
    changes: tuple[Change, ...] = ()  # of each tile, where the plan has a coding: tiles are whole then


class Leans(NamedTuple):
    """The leans of some tiles that differ, and the revisions of these."""

    told: LeanTiles
    revisions: tuple[int, ...]


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class TilesPlan(Plan[TileRun]):
    """The tiles that differ from what the asker has."""

    epoch: int
    map_revision: int
    rule: AnswerRule
    tile_size_m: float
    spacings_m: tuple[float, ...]  # of the lattices that most of the map's kernels are on
    is_whole: bool  # all tiles of the box, because what the asker has is of another epoch
    tiles: tuple[tuple[TileIndex, Tile], ...]  # that differ, each with kernels or a lean
    gone: Int64  # (G, 3) tiles that the asker has and the map has not
    coding: Coding | None
    part_size: int

    @property
    def n_items(self) -> int:
        """Kernels of all tiles."""
        return sum(len(tile.kernels) for _, tile in self.tiles)

    def part(self, i: int) -> TileRun:
        """One run of kernels. Without a coding a tile may go on in the next; with one it is where its first kernel is."""
        sizes = np.array([len(tile.kernels) for _, tile in self.tiles], np.int64)
        run = self.items(i)
        if self.coding is not None:
            starts = np.cumsum(sizes) - sizes
            is_here = (sizes > 0) & (starts >= run.start) & (starts < run.stop)
            return self._coded(i, np.flatnonzero(is_here).tolist(), self.coding)
        found = list(pieces(sizes, run))
        kernels = [self.tiles[t][1].kernels.kernels.take(cut) for t, cut in found]
        return self._run(i, [t for t, _ in found], kernels)

    def _coded(self, i: int, members: Sequence[int], coding: Coding) -> TileRun:
        changes = []
        for t in members:
            index, tile = self.tiles[t]
            key = TileKey(self.epoch, index, tile.revision, coding.steps)
            codes = coding.memory.get(key)
            if codes is None:
                codes = code_tile(tile.kernels.kernels, self.spacings_m, self.tile_size_m, coding.steps)
                codes = codes._replace(lean=tile.lean)
                coding.memory.put(key, codes)
            base = coding.bases[t]
            # of a base without kernels the asker holds a lean, and no tile that nodes could change
            changes.append(Change(codes, base if base is not None and base.n_kernels else None))
        return self._run(i, members, [c.codes.others for c in changes])._replace(changes=tuple(changes))

    def _run(self, i: int, members: Sequence[int], kernels: list[KernelSet]) -> TileRun:
        return TileRun(
            np.array([self.tiles[t][0] for t in members], np.int64).reshape(-1, 3),
            np.array([self.tiles[t][1].revision for t in members], np.int64),
            np.array([len(k) for k in kernels], np.int64),
            KernelSet.concatenate(kernels),
            self._leans(i),
        )

    def _leans(self, i: int) -> Leans | None:
        """Those that travel with a part: each tile's once, and with a coding only those that the asker has not."""
        if not (mine := self._told_leans[i :: self.n_parts]):
            return None
        nodes = {self.tiles[t][0]: lean for t, lean in mine}
        return Leans(LeanTiles(self.tile_size_m, nodes), tuple(self.tiles[t][1].revision for t, _ in mine))

    @cached_property
    def _told_leans(self) -> list[tuple[int, UInt8]]:
        return [(t, lean) for t in range(len(self.tiles)) if (lean := self._lean_to_tell(t)) is not None]

    def _lean_to_tell(self, t: int) -> UInt8 | None:
        index, tile = self.tiles[t]
        if self.coding is None:
            return tile.lean
        if not len(tile.kernels):  # it is in no run, and told by its lean alone
            key = TileKey(self.epoch, index, tile.revision, self.coding.steps)
            self.coding.memory.put(key, TileCodes({}, KernelSet.empty(), tile.lean))
        base = self.coding.bases[t]
        if base is None or base.lean is None:
            return tile.lean
        if tile.lean is None:
            return np.full_like(base.lean, LEAN_ZERO)
        is_known = np.array_equal(base.lean, tile.lean) and (len(tile.kernels) or not base.n_kernels)
        return None if is_known else tile.lean


def _present(tiles: Mapping[TileIndex, Tile], low: Int64 | None, high: Int64 | None) -> dict[TileIndex, Tile]:
    """The tiles in a box that have kernels or a lean."""
    everywhere = {i: tile for i, tile in tiles.items() if len(tile.kernels) or tile.lean is not None}
    inside = _inside(np.array(list(everywhere), np.int64).reshape(-1, 3), low, high)
    return {index: everywhere[index] for index, is_in in zip(everywhere, inside, strict=True) if is_in}


def _compared(
    present: list[TileIndex], known: KnownTiles, low: Int64 | None, high: Int64 | None
) -> tuple[dict[TileIndex, int], Int64]:
    """What an asker has of a box: revisions of the tiles that the map has too, and (G, 3) the others.

    Whatever it says that it has, the interpreter is never held for long: arrays are sorted, and no lists are made of them.
    """
    meant = _inside(known.indices, low, high)
    ours = np.array(present, np.int64).reshape(-1, 3)
    both = np.concatenate([ours, known.indices[meant]])
    # stable: of equal ones the map's comes first, and what the asker said last comes last
    order = np.lexsort(both.T)
    ordered = both[order]
    is_first = np.ones(len(order), np.bool_)
    is_first[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    first = order[is_first]
    last = order[np.append(is_first[1:], np.ones(min(len(order), 1), np.bool_))]
    is_present, is_known = first < len(ours), last >= len(ours)
    told = known.revisions[meant][last[is_known] - len(ours)]
    shared = is_present[is_known]
    revisions = zip(first[is_known][shared].tolist(), told[shared].tolist(), strict=True)
    return {present[t]: revision for t, revision in revisions}, both[last[is_known & ~is_present]]


def _inside(index: Int64, low: Int64 | None, high: Int64 | None) -> NDArray[np.bool_]:
    """(N,) which tiles lie in a box of tiles, its upper corner included."""
    inside = np.ones(len(index), np.bool_)
    if low is not None:
        inside &= (index >= low).all(axis=1)
    if high is not None:
        inside &= (index <= high).all(axis=1)
    return inside
