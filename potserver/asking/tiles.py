"""The differential question: which tiles of a map differ from what the asker has, and what is in them now."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from potschemas.answers import AnswerRule
from potserver.asking.plan import Plan, checked_box, pieces
from potserver.domain.map_state import MapState
from potserver.domain.tiles import Tile, TileIndex
from potserver.domain.types import Float32, KernelSet
from potserver.errors import BadPointsError, ShapeError, TooLargeError
from potserver.limits import Limits
from potserver.numerics.arrays import Int64

MANTISSA_BITS = 23  # of a float32
_LEAST_BITS = 2
PART_KERNELS = 20_000  # of a part: 200 kB on the wire, at most 800; askers take up to MAX_PART_KERNELS


class KnownTiles(NamedTuple):
    """What an asker has of a map."""

    epoch: int  # of the map that the revisions are of
    indices: Int64  # (N, 3)
    revisions: Int64  # (N,)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Tiles:
    """What is asked: the tiles that a box touches, where they differ from those that the asker has.

    With `mantissa_bits` of b the latent mean changes by at most 2^-(b + 1) sum_m |weight_mean_m| phi_m, and the probability by
    at most a quarter of that, beside a relative 2^-(b + 1) of the latent variance.
    """

    known: KnownTiles | None = None  # what the asker has; None = nothing
    lower: ArrayLike | None = None  # (3,) m, map frame; None = no bound on that side
    upper: ArrayLike | None = None  # (3,) m, map frame; likewise
    # of each weight's mean and variance, 2 to 23; fewer than 23 are rounded to
    mantissa_bits: int = MANTISSA_BITS

    def plan(
        self, state: MapState, limits: Limits, *, tile_size_m: float, part_kernels: int = PART_KERNELS
    ) -> TilesPlan:
        """Check the question, and compare. A tile without kernels says nothing and counts as none.

        Args:
            state: Of the map.
            limits: That the question has to keep.
            tile_size_m: Edge of a tile where the map has none yet.
            part_kernels: Of a part, at most.
        Raises:
            ShapeError, BadPointsError, OutOfRangeError: an illegal corner, or known tiles of unequal number.
            TooLargeError: too many known tiles.
        """
        lower, upper = checked_box(self.lower, self.upper, limits)
        self._check_known(limits)
        if not _LEAST_BITS <= self.mantissa_bits <= MANTISSA_BITS:
            raise BadPointsError(
                f"mantissa_bits is {self.mantissa_bits}, need {_LEAST_BITS} to {MANTISSA_BITS}"
            )
        tiled = state.tiled
        size = tile_size_m if tiled is None else tiled.grid.size_m
        low = None if lower is None else np.floor(lower / size).astype(np.int64)
        high = None if upper is None else np.floor(upper / size).astype(np.int64)
        present = {} if tiled is None else _present(tiled.tiles, low, high)
        is_whole = self.known is None or self.known.epoch != state.epoch
        revisions = {} if self.known is None or is_whole else _revisions(self.known, low, high)
        return TilesPlan(
            epoch=state.epoch,
            map_revision=state.map_revision,
            rule=state.snapshot.rule,
            tile_size_m=size,
            spacings_m=() if tiled is None else (tiled.grid.coarse_m, tiled.grid.fine_m),
            is_whole=is_whole,
            tiles=tuple((i, tile) for i, tile in present.items() if revisions.get(i) != tile.revision),
            gone=np.array([i for i in revisions if i not in present], np.int64).reshape(-1, 3),
            mantissa_bits=self.mantissa_bits,
            part_size=part_kernels,
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


class TileRun(NamedTuple):
    """Some tiles, or parts of them, one after the other."""

    indices: Int64  # (T, 3)
    revisions: Int64  # (T,)
    counts: Int64  # (T,) kernels of each, at least 1
    kernels: KernelSet  # relative to the lower corners of their tiles


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class TilesPlan(Plan[TileRun]):
    """The tiles that differ from what the asker has."""

    epoch: int
    map_revision: int
    rule: AnswerRule
    tile_size_m: float
    spacings_m: tuple[float, ...]  # of the lattices that most of the map's kernels are on
    is_whole: bool  # all tiles of the box, because what the asker has is of another epoch
    tiles: tuple[tuple[TileIndex, Tile], ...]  # that differ, each with kernels
    gone: Int64  # (G, 3) tiles that the asker has and the map has not
    mantissa_bits: int
    part_size: int

    @property
    def n_items(self) -> int:
        """Kernels of all tiles."""
        return sum(len(tile.kernels) for _, tile in self.tiles)

    def part(self, i: int) -> TileRun:
        """One run of kernels; a tile may go on in the next."""
        sizes = np.array([len(tile.kernels) for _, tile in self.tiles], np.int64)
        found = list(pieces(sizes, self.items(i)))
        members = [t for t, _ in found]
        kernels = KernelSet.concatenate([self.tiles[t][1].kernels.kernels.take(cut) for t, cut in found])
        if self.mantissa_bits < MANTISSA_BITS:
            kernels = kernels.replace(
                weight_mean=rounded(kernels.weight_mean, self.mantissa_bits),
                weight_var=rounded(kernels.weight_var, self.mantissa_bits),
            )
        return TileRun(
            np.array([self.tiles[t][0] for t in members], np.int64).reshape(-1, 3),
            np.array([self.tiles[t][1].revision for t in members], np.int64),
            np.array([cut.stop - cut.start for _, cut in found], np.int64),
            kernels,
        )


def rounded(values: Float32, bits: int) -> Float32:
    """Float32 numbers with mantissas of 2 to 22 bits, the nearest ones: off by at most 2^-(bits + 1) of themselves.

    Nothing becomes infinite: what would is cut off instead. Below 2^-126 numbers are off by at most 2^-(bits + 127).
    """
    dropped = MANTISSA_BITS - bits
    keep = np.uint32((0xFFFFFFFF << dropped) & 0xFFFFFFFF)
    raw = values.view(np.uint32)
    up = ((raw + np.uint32(1 << (dropped - 1))) & keep).view(np.float32)
    return np.where(np.isfinite(up), up, (raw & keep).view(np.float32))


def _present(tiles: Mapping[TileIndex, Tile], low: Int64 | None, high: Int64 | None) -> dict[TileIndex, Tile]:
    """The tiles in a box that have kernels."""
    everywhere = {index: tile for index, tile in tiles.items() if len(tile.kernels)}
    inside = _inside(np.array(list(everywhere), np.int64).reshape(-1, 3), low, high)
    return {index: everywhere[index] for index, is_in in zip(everywhere, inside, strict=True) if is_in}


def _revisions(known: KnownTiles, low: Int64 | None, high: Int64 | None) -> dict[TileIndex, int]:
    """What the asker has in a box."""
    meant = _inside(known.indices, low, high)
    pairs = zip(known.indices[meant].tolist(), known.revisions[meant].tolist(), strict=True)
    return {(x, y, z): revision for (x, y, z), revision in pairs}


def _inside(index: Int64, low: Int64 | None, high: Int64 | None) -> NDArray[np.bool_]:
    """(N,) which tiles lie in a box of tiles, its upper corner included."""
    inside = np.ones(len(index), np.bool_)
    if low is not None:
        inside &= (index >= low).all(axis=1)
    if high is not None:
        inside &= (index <= high).all(axis=1)
    return inside
